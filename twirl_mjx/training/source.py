"""The experience of a source in the target task (paper Alg. 1, step 1)."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from twirl_mjx.tasks import measures
from twirl_mjx.types import SourcePolicy, Transition
from twirl_mjx.worlds.vector import VectorEnv, make_transition

ROUNDING = 1e-3
"""By which an action may leave [-1, 1] and not count as clipped."""
PROGRESS_S = 5.0
"""s between lines of progress."""


def collect(
    env: VectorEnv,
    policy: SourcePolicy,
    key: jax.Array,
    size: int,
    *,
    max_clipped: float = 1.0,
    say: Callable[[str], None] = lambda line: None,
) -> tuple[Transition, dict[str, float]]:
    """Return exactly ``size`` transitions of ``policy`` acting in ``env``.

    Non-finite steps are dropped and replaced by further ones.

    Args:
        env: Worlds of the target task.
        policy: The source, a black box.
        key: Seeds worlds and policy.
        size: Transitions wanted.
        max_clipped: Largest share of joint targets outside the action box.
        say: Gets a line of progress every ``PROGRESS_S``.

    Returns:
        Transitions [size, ...] (numpy) and the mean measures of the episodes that ended (none
        when none did); ``clipped`` among them is the share of joint targets that lay outside the
        action box, if any did.

    Raises:
        RuntimeError: More than half of the steps were not finite.
        ValueError: A larger share than ``max_clipped`` was clipped.
    """
    reset_key, key = jax.random.split(key)
    state = jax.jit(env.reset)(reset_key)
    carry = (state, policy.init(state), measures.tracker_init(env.task, env.num_envs))
    chunk = min(200, -(-size // env.num_envs))
    run = jax.jit(functools.partial(_collect_chunk, env, policy, chunk))
    rows: list[Transition] = []
    kept = dropped = 0
    outside, told = 0.0, time.monotonic()
    sums: dict[str, float] = {}
    while kept < size:
        if time.monotonic() - told > PROGRESS_S:
            told = time.monotonic()
            say(f"collected {kept:,} of {size:,} transitions")
        key, chunk_key = jax.random.split(key)
        carry, (transitions, valid, ended, values, beyond) = run(carry, chunk_key)
        outside += float(np.asarray(beyond)[np.asarray(valid)].sum())
        valid, ended = np.asarray(valid), np.asarray(ended)
        rows.append(jax.tree.map(lambda x, keep=valid: np.asarray(x)[keep], transitions))
        kept, dropped = kept + int(valid.sum()), dropped + int((~valid).sum())
        for name, value in (values | {"episodes": jnp.ones_like(values["return"])}).items():
            sums[name] = sums.get(name, 0.0) + float(np.asarray(value)[ended].sum())
        if dropped > max(kept, size):
            raise RuntimeError(f"the source policy diverges: {dropped} of {kept + dropped} steps")
        check_clipped(outside / max(kept, 1), max_clipped)
    episodes = sums.pop("episodes")
    means = {name: value / episodes for name, value in sums.items()} if episodes else {}
    if outside:
        means["clipped"] = outside / kept
    data = jax.tree.map(lambda *parts: np.concatenate(parts)[:size], *rows)
    return data, means


def check_clipped(share: float, limit: float) -> None:
    """Refuse a source that leaves the action box too often.

    Raises:
        ValueError: ``share`` of the joint targets is above ``limit``.
    """
    if share > limit:
        raise ValueError(
            f"{share:.0%} of the source's joint targets lie outside the action box and would be"
            f" clipped (limit {limit:.0%}): its action scale or default pose is not what was said"
            " (nearest: --source-contract with the right ones, or --allow-clipping)"
        )


def _collect_chunk(
    env: VectorEnv, policy: SourcePolicy, length: int, carry: tuple, key: jax.Array
) -> tuple[tuple, tuple]:
    def step(carry: tuple, step_key: jax.Array) -> tuple[tuple, tuple]:
        state, memory, tracker = carry
        action, memory = policy.act(memory, state, step_key)
        result = env.step(state, action)
        tracker = measures.tracker_step(env.task, tracker, result)
        values = measures.tracker_read(env.task, tracker)
        ended = result.done & ~result.invalid
        tracker = measures.tracker_reset(env.task, tracker, result.done)
        beyond = jnp.mean(jnp.abs(action) > 1.0 + ROUNDING, axis=-1)
        out = (make_transition(state, action, result), ~result.invalid, ended, values, beyond)
        return (result, memory, tracker), out

    return jax.lax.scan(step, carry, jax.random.split(key, length))
