"""The experience of a source in the target task (paper Alg. 1, step 1)."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from twirl_mjx.tasks import measures
from twirl_mjx.training.guards import MAX_DROPPED, DivergedError
from twirl_mjx.types import SourcePolicy, Transition
from twirl_mjx.worlds.vector import FAULTS, VectorEnv, make_transition

ROUNDING = 1e-3
"""By which an action may leave [-1, 1] and not count as clipped."""
PROGRESS_S = 5.0
"""s between lines of progress."""


class Collector:
    """A policy in the worlds of the target task; what is compiled serves any key."""

    def __init__(self, env: VectorEnv, policy: SourcePolicy) -> None:
        """Build (not compile) the functions.

        Args:
            env: Worlds of the target task.
            policy: The source, a black box.
        """
        self.env = env
        self._policy = policy
        self._reset = jax.jit(env.reset)
        self._run = jax.jit(
            functools.partial(_collect_chunk, env, policy), static_argnames=("length",)
        )

    def __call__(
        self,
        key: jax.Array,
        size: int,
        *,
        max_clipped: float = 1.0,
        say: Callable[[str], None] = lambda line: None,
    ) -> tuple[Transition, dict[str, float]]:
        """Return exactly ``size`` transitions.

        Steps that are not finite are dropped and replaced by further ones.

        Args:
            key: Seeds worlds and policy.
            size: Transitions wanted.
            max_clipped: Largest share of joint targets outside the action box.
            say: Gets a line of progress every ``PROGRESS_S``.

        Returns:
            Transitions [size, ...] (numpy) and the mean measures of the episodes that ended (none
            when none did); ``clipped`` among them is the share of joint targets that lay outside
            the action box, if any did.

        Raises:
            DivergedError: More steps than ``MAX_DROPPED`` of ``size`` were dropped.
            ValueError: A larger share than ``max_clipped`` was clipped.
        """
        env = self.env
        reset_key, key = jax.random.split(key)
        state = self._reset(reset_key)
        carry = (state, self._policy.init(state), measures.tracker_init(env.task, env.num_envs))
        chunk = min(200, -(-size // env.num_envs))
        rows: list[Transition] = []
        kept = dropped = 0
        cause, outside, tell = "", 0.0, _progress(size, say)
        sums: dict[str, float] = {}
        while kept < size:
            tell(kept)
            key, chunk_key = jax.random.split(key)
            carry, (transitions, fault, ended, values, beyond) = self._run(
                carry, chunk_key, length=chunk
            )
            fault = np.asarray(fault)
            valid = fault == 0
            cause = cause or next((FAULTS[i] for i in fault.ravel() if i), "")
            outside += float(np.asarray(beyond)[valid].sum())
            ended = np.asarray(ended)
            rows.append(jax.tree.map(lambda x, keep=valid: np.asarray(x)[keep], transitions))
            kept, dropped = kept + int(valid.sum()), dropped + int((~valid).sum())
            for name, value in (values | {"episodes": jnp.ones_like(values["return"])}).items():
                sums[name] = sums.get(name, 0.0) + float(np.asarray(value)[ended].sum())
            check_dropped(dropped, kept, size, cause)
            check_clipped(outside / max(kept, 1), max_clipped)
        episodes = sums.pop("episodes")
        means = {name: value / episodes for name, value in sums.items()} if episodes else {}
        if outside:
            means["clipped"] = outside / kept
        data = jax.tree.map(lambda *parts: np.concatenate(parts)[:size], *rows)
        return data, means


def check_dropped(dropped: int, kept: int, size: int, cause: str) -> None:
    """Refuse a recording of which too much was dropped.

    Raises:
        DivergedError: More than ``MAX_DROPPED`` of the ``size`` steps that are wanted.
    """
    if dropped > MAX_DROPPED * size:
        raise DivergedError(
            f"{dropped:,} of {kept + dropped:,} steps of the source were dropped, more than"
            f" {MAX_DROPPED:.0%} of the {size:,} that are wanted; the first one because {cause}"
        )


def _progress(size: int, say: Callable[[str], None]) -> Callable[[int], None]:
    """Return what is called with the number of transitions so far and now and then says it."""
    told = time.monotonic()

    def tell(kept: int) -> None:
        nonlocal told
        if time.monotonic() - told > PROGRESS_S:
            told = time.monotonic()
            say(f"collected {kept:,} of {size:,} transitions")

    return tell


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
    env: VectorEnv, policy: SourcePolicy, carry: tuple, key: jax.Array, *, length: int
) -> tuple[tuple, tuple]:
    def step(carry: tuple, step_key: jax.Array) -> tuple[tuple, tuple]:
        state, memory, tracker = carry
        action, memory = policy.act(memory, state, step_key)
        result, fault = env.step_and_fault(state, action)
        tracker = measures.tracker_step(env.task, tracker, result)
        values = measures.tracker_read(env.task, tracker)
        ended = result.done & ~result.invalid
        tracker = measures.tracker_reset(env.task, tracker, result.done)
        beyond = jnp.mean(jnp.abs(action) > 1.0 + ROUNDING, axis=-1)
        out = (make_transition(state, action, result), fault, ended, values, beyond)
        return (result, memory, tracker), out

    return jax.lax.scan(step, carry, jax.random.split(key, length))
