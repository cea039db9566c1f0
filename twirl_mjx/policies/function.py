"""Source policies from host code: any numpy function, policy file or ONNX graph."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from twirl_mjx.sim.robot import LEG_SIZE, NUM_LEGS
from twirl_mjx.types import Policy

ACTION_SIZE = NUM_LEGS * LEG_SIZE
"""A of every robot of the family."""


def default_observe(state: Any) -> jax.Array:
    """Return the task's own observation [N, O] of an ``EnvState``."""
    return state.obs


def fresh_worlds(state: Any) -> jax.Array:
    """Return which worlds [N] bool have just been reset."""
    return state.world.episode_step == 0


@dataclasses.dataclass(frozen=True, eq=False)
class HostPolicy:
    """A source policy (``types.SourcePolicy``) that calls a numpy function on the host.

    The function runs inside compiled code through ``jax.pure_callback``, once per control step
    for all worlds together, also under ``vmap``. It must depend on its arguments only: keep
    whatever it remembers, a random state included, in its memory.
    """

    function: Callable[..., Any]
    """``function(obs [N, O]) -> action [N, A]``, or, with a memory,
    ``function(obs, memory) -> (action, memory)`` with leaves [N, ...]. Numpy in and out."""
    initial_memory: Any = None
    """Memory of one fresh world, a pytree of arrays without a world axis; ``None`` for none."""
    observe: Callable[[Any], jax.Array] = default_observe
    """What the policy sees of the batched state, [N, O]; traceable by jax."""
    action_size: int = ACTION_SIZE
    """A."""

    def init(self, state: Any) -> Any:
        """Return the memory of freshly reset worlds, leaves [N, ...]."""
        worlds = state.world.episode_step.shape
        return jax.tree.map(
            lambda x: jnp.broadcast_to(jnp.asarray(x), worlds + jnp.shape(x)), self.initial_memory
        )

    def act(self, memory: Any, state: Any, key: jax.Array) -> tuple[jax.Array, Any]:
        """Return actions [N, A] clipped to [-1, 1], and the next memory.

        Raises:
            ValueError: the function returned a wrong shape or a value that is not finite.
        """
        del key  # host functions are deterministic
        memory = jax.tree.map(
            lambda start, now: jnp.where(_along(fresh_worlds(state), now), start, now),
            self.init(state),
            memory,
        )
        obs = self.observe(state)
        shapes = (
            jax.ShapeDtypeStruct((*obs.shape[:-1], self.action_size), jnp.float32),
            jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), memory),
        )
        return jax.pure_callback(self._on_host, shapes, obs, memory, vmap_method="broadcast_all")

    def on_observation(self, obs: jax.Array, key: jax.Array) -> jax.Array:
        """Return actions [..., A] at observations [..., O]; for a function without memory."""
        del key  # host functions are deterministic
        shape = jax.ShapeDtypeStruct((*obs.shape[:-1], self.action_size), jnp.float32)
        return jax.pure_callback(
            lambda rows: self._on_host(rows, None)[0], shape, obs, vmap_method="broadcast_all"
        )

    def _on_host(self, obs: Any, memory: Any) -> tuple[np.ndarray, Any]:
        """Flatten leading axes, call the function, check and restore the shape."""
        obs = np.asarray(obs)
        lead = obs.shape[:-1]
        rows = obs.reshape(-1, obs.shape[-1])
        if self.initial_memory is None:
            action, following = self.function(rows), memory
        else:
            flat = jax.tree.map(lambda x: _merge(np.asarray(x), len(lead)), memory)
            action, following = self.function(rows, flat)
            following = jax.tree.map(
                lambda new, old: np.asarray(new, old.dtype).reshape(old.shape), following, memory
            )
        action = np.asarray(action, np.float32)
        if action.shape != (len(rows), self.action_size):
            raise ValueError(
                f"the host policy returned actions of shape {action.shape}, expected "
                f"{(len(rows), self.action_size)}"
            )
        if not np.isfinite(action).all():
            world = int(np.argwhere(~np.isfinite(action))[0, 0])
            raise ValueError(f"the host policy returned a non-finite action in world {world}")
        return np.clip(action, -1.0, 1.0).reshape(*lead, self.action_size), following


def _along(mask: jax.Array, like: jax.Array) -> jax.Array:
    """Reshape a mask [N] so that it broadcasts against ``like`` [N, ...]."""
    return mask.reshape(mask.shape + (1,) * (like.ndim - mask.ndim))


def _merge(array: np.ndarray, axes: int) -> np.ndarray:
    """Merge the first ``axes`` axes into one."""
    return array.reshape(-1, *array.shape[axes:])


def from_policy(
    policy: Policy, observe: Callable[[Any], jax.Array] = default_observe
) -> HostPolicy:
    """Use a loaded policy (``.npz`` or ``.onnx``) as a source policy on the host.

    Args:
        policy: anything with ``act(obs [N, O]) -> action [N, A]``.
        observe: what the policy sees; give this when its observation is not the target task's.
    """
    return HostPolicy(policy.act, None, observe, getattr(policy, "action_size", ACTION_SIZE))
