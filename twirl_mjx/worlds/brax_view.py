"""A thin ``brax.envs.base.Env`` view of the worlds; imported only when it is asked for."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from brax.envs.base import Env, State

from twirl_mjx.sim.engine import MjxEngine
from twirl_mjx.worlds.vector import EnvState, VectorEnv


class BraxEnv(Env):
    """The worlds as brax sees them.

    ``done`` is 1 wherever an episode ended, ``info["truncation"]`` is 1 where it ended without
    the MDP ending (time limit, or a step that was not finite), and ``info["next_obs"]`` is the
    true successor observation. Worlds restart by themselves: ``obs`` already belongs to the new
    episode. ``pipeline_state`` is the whole ``EnvState`` [N, ...].
    """

    def __init__(self, env: VectorEnv, *, batched: bool) -> None:
        """Wrap worlds; unless ``batched``, there must be one and its axis is left out."""
        self._env = env
        self._batched = batched

    def reset(self, rng: jax.Array) -> State:
        """Start an episode in every world from a typed or a raw uint32 PRNG key."""
        if not jnp.issubdtype(rng.dtype, jax.dtypes.prng_key):
            rng = jax.random.wrap_key_data(rng)
        return self._view(self._env.reset(rng), {}, {})

    def step(self, state: State, action: jax.Array) -> State:
        """Advance every world by one control step; entries of wrappers are carried along."""
        world: Any = state.pipeline_state
        result = self._env.step(world, action if self._batched else action[None])
        return self._view(result, state.metrics, state.info)

    @property
    def observation_size(self) -> int:
        """O."""
        return self._env.observation_size

    @property
    def action_size(self) -> int:
        """A, one action per joint."""
        return self._env.action_size

    @property
    def backend(self) -> str:
        """The physics engine, ``mjx`` or ``native``."""
        return "mjx" if isinstance(self._env.engine, MjxEngine) else "native"

    def _view(self, world: EnvState, metrics: dict[str, Any], info: dict[str, Any]) -> State:
        own = {
            "obs": world.obs,
            "reward": world.reward,
            "done": world.done.astype(jnp.float32),
            "metrics": world.metrics,
            "truncation": (world.done & ~world.terminated).astype(jnp.float32),
            "next_obs": world.next_obs,
        }
        if not self._batched:
            own = jax.tree.map(lambda leaf: leaf[0], own)
        return State(
            pipeline_state=world,  # type: ignore[arg-type]
            obs=own["obs"],
            reward=own["reward"],
            done=own["done"],
            metrics=metrics | own["metrics"],
            info=info | {"truncation": own["truncation"], "next_obs": own["next_obs"]},
        )
