"""The experience of a source in the target task (paper Alg. 1, step 1)."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np

from twirl_mjx.tasks import measures
from twirl_mjx.types import SourcePolicy, Transition
from twirl_mjx.worlds.vector import VectorEnv, make_transition


def collect(
    env: VectorEnv, policy: SourcePolicy, key: jax.Array, size: int
) -> tuple[Transition, dict[str, float]]:
    """Return exactly ``size`` transitions of ``policy`` acting in ``env``.

    Non-finite steps are dropped and replaced by further ones.

    Args:
        env: Worlds of the target task.
        policy: The source, a black box.
        key: Seeds worlds and policy.
        size: Transitions wanted.

    Returns:
        Transitions [size, ...] (numpy) and the mean measures of the episodes that ended (empty
        when none did).

    Raises:
        RuntimeError: More than half of the steps were not finite.
    """
    reset_key, key = jax.random.split(key)
    state = jax.jit(env.reset)(reset_key)
    carry = (state, policy.init(state), measures.tracker_init(env.task, env.num_envs))
    chunk = min(200, -(-size // env.num_envs))
    run = jax.jit(functools.partial(_collect_chunk, env, policy, chunk))
    rows: list[Transition] = []
    kept = dropped = 0
    sums: dict[str, float] = {}
    while kept < size:
        key, chunk_key = jax.random.split(key)
        carry, (transitions, valid, ended, values) = run(carry, chunk_key)
        valid, ended = np.asarray(valid), np.asarray(ended)
        rows.append(jax.tree.map(lambda x, keep=valid: np.asarray(x)[keep], transitions))
        kept, dropped = kept + int(valid.sum()), dropped + int((~valid).sum())
        for name, value in (values | {"episodes": jnp.ones_like(values["return"])}).items():
            sums[name] = sums.get(name, 0.0) + float(np.asarray(value)[ended].sum())
        if dropped > max(kept, size):
            raise RuntimeError(f"the source policy diverges: {dropped} of {kept + dropped} steps")
    episodes = sums.pop("episodes")
    means = {name: value / episodes for name, value in sums.items()} if episodes else {}
    data = jax.tree.map(lambda *parts: np.concatenate(parts)[:size], *rows)
    return data, means


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
        out = (make_transition(state, action, result), ~result.invalid, ended, values)
        return (result, memory, tracker), out

    return jax.lax.scan(step, carry, jax.random.split(key, length))
