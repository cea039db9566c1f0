"""Batched evaluation: the first episode of every world, one compiled call."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from twirl_mjx.sim.dynamics import Dynamics
from twirl_mjx.tasks import measures
from twirl_mjx.types import SourcePolicy
from twirl_mjx.worlds.vector import EnvState, VectorEnv

ActFn = Callable[[Any, Any, EnvState, jax.Array], tuple[jax.Array, Any]]
"""(parameters, memory, state, key) -> (actions [N, A], memory)."""


def first_episodes(
    env: VectorEnv,
    init_memory: Callable[[EnvState], Any],
    act: ActFn,
    params: Any,
    key: jax.Array,
    dynamics: Dynamics | None = None,
    index: jax.Array | None = None,
) -> dict[str, jax.Array]:
    """Run one episode in every world and measure it; traceable.

    Args:
        env: The worlds; one episode each.
        init_memory: Makes the policy's memory from the reset state.
        act: The policy.
        params: First argument of ``act``, e.g. network parameters.
        key: Seeds both the worlds and the policy.
        dynamics: Physical parameters, leaves () or [N]; the env's by default.
        index: [N] number of every episode; equal numbers start alike. 0 to N - 1 by default.

    Returns:
        Every measure of the task and ``success``, each [N]; steps after the first end of a world,
        and one with a non-finite state, do not count. ``invalid`` is 1 where the episode was cut
        short by a non-finite state; measures are NaN where that was its first step.
    """
    task = env.task
    reset_key, act_key = jax.random.split(key)
    state = env.reset(reset_key, dynamics, index)

    def step(carry: tuple, step_key: jax.Array) -> tuple[tuple, None]:
        state, memory, tracker, alive, broken = carry
        action, memory = act(params, memory, state, step_key)
        state = env.step(state, action)
        moved = measures.tracker_step(task, tracker, state)
        counts = alive & ~state.invalid  # metrics of a broken step are 0, not measurements
        tracker = jax.tree.map(lambda new, old: jnp.where(counts, new, old), moved, tracker)
        broken = broken | (alive & state.invalid)
        return (state, memory, tracker, alive & ~state.done, broken), None

    everyone = jnp.ones(env.num_envs, bool)
    carry = (
        state,
        init_memory(state),
        measures.tracker_init(task, env.num_envs),
        everyone,
        ~everyone,
    )
    keys = jax.random.split(act_key, env.episode_length)
    (_, _, tracker, _, broken), _ = jax.lax.scan(step, carry, keys)
    return measures.tracker_read(task, tracker) | {"invalid": broken.astype(jnp.float32)}


def make_evaluate(
    env: VectorEnv, init_memory: Callable[[EnvState], Any], act: ActFn
) -> Callable[..., dict[str, np.ndarray]]:
    """Return a compiled :func:`first_episodes`: ``evaluate(params, key, dynamics, index)``.

    Measures come back as numpy arrays [N].
    """
    run = jax.jit(functools.partial(first_episodes, env, init_memory, act))

    def evaluate(
        params: Any,
        key: jax.Array,
        dynamics: Dynamics | None = None,
        index: jax.Array | None = None,
    ) -> dict[str, np.ndarray]:
        return {k: np.asarray(v) for k, v in run(params, key, dynamics, index).items()}

    return evaluate


def evaluate_policy(env: VectorEnv, policy: SourcePolicy) -> Callable[..., dict[str, np.ndarray]]:
    """Return a compiled evaluation of any policy: ``evaluate(key, dynamics, index)``."""

    def act(params: Any, memory: Any, state: EnvState, key: jax.Array) -> tuple[jax.Array, Any]:
        return policy.act(memory, state, key)

    return functools.partial(make_evaluate(env, policy.init, act), None)
