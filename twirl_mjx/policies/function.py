"""Source policies from host code and from functions: numpy or jax, with a memory or without."""

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
class HostCall:
    """A numpy function that compiled code can call, once for all worlds, also under ``vmap``."""

    function: Callable[..., Any]
    """``function(rows [n, O]) -> action [n, A]``, or, with a memory,
    ``function(rows, memory) -> (action, memory)`` with leaves [n, ...]."""
    has_memory: bool = False
    """Which of the two."""
    action_size: int = ACTION_SIZE
    """A."""

    def __call__(self, obs: jax.Array, memory: Any = None) -> tuple[jax.Array, Any]:
        """Return actions [..., A] at observations [..., O], and the next memory; traceable.

        Raises:
            ValueError: the function returned a wrong shape or a value that is not finite.
        """
        shapes = (
            jax.ShapeDtypeStruct((*obs.shape[:-1], self.action_size), jnp.float32),
            jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), memory),
        )
        return jax.pure_callback(self._on_host, shapes, obs, memory, vmap_method="broadcast_all")

    def _on_host(self, obs: Any, memory: Any) -> tuple[np.ndarray, Any]:
        """Flatten leading axes, call the function, check and restore the shape."""
        obs = np.asarray(obs)
        lead = obs.shape[:-1]
        rows = obs.reshape(-1, obs.shape[-1])
        if not self.has_memory:
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
        return action.reshape(*lead, self.action_size), following


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
        return spread(self.initial_memory, state)

    def act(self, memory: Any, state: Any, key: jax.Array) -> tuple[jax.Array, Any]:
        """Return actions [N, A] as the function gives them, and the next memory.

        Raises:
            ValueError: the function returned a wrong shape or a value that is not finite.
        """
        del key  # host functions are deterministic
        memory = restart(fresh_worlds(state), self.init(state), memory)
        return self._call(self.observe(state), memory)

    def on_observation(self, obs: jax.Array, key: jax.Array) -> jax.Array:
        """Return actions [..., A] at observations [..., O]; for a function without memory."""
        del key  # host functions are deterministic
        return self._call(obs)[0]

    @property
    def _call(self) -> HostCall:
        return HostCall(self.function, self.initial_memory is not None, self.action_size)


def spread(initial: Any, state: Any) -> Any:
    """Return the memory of one fresh world for all worlds of a state, leaves [N, ...]."""
    worlds = state.world.episode_step.shape
    return jax.tree.map(lambda x: jnp.broadcast_to(jnp.asarray(x), worlds + jnp.shape(x)), initial)


def restart(fresh: jax.Array, initial: Any, memory: Any) -> Any:
    """Return a memory, leaves [N, ...], started anew in the worlds ``fresh`` [N] bool."""
    return jax.tree.map(
        lambda start, now: jnp.where(_along(fresh, now), start, now), initial, memory
    )


Run = Callable[[jax.Array, jax.Array, Any], tuple[jax.Array, Any]]
"""(observations [N, O], time steps [N], memory) -> (outputs [N, A], memory); traceable."""


@dataclasses.dataclass(frozen=True, eq=False)
class Brain:
    """What maps observations to outputs, whatever they mean."""

    run: Run
    initial_memory: Any = None
    """Of one fresh world, a pytree of arrays; ``None`` for none."""
    observation_size: int | None = None
    """O; ``None`` where the brain takes what it is given."""
    action_size: int = ACTION_SIZE
    """A."""


@dataclasses.dataclass(frozen=True, eq=False)
class BrainPolicy:
    """A brain that sees the observation of the task and answers with its actions."""

    brain: Brain

    def init(self, state: Any) -> Any:
        """Return the memory of freshly reset worlds, leaves [N, ...]."""
        return spread(self.brain.initial_memory, state)

    def act(self, memory: Any, state: Any, key: jax.Array) -> tuple[jax.Array, Any]:
        """Return actions [N, A] as the brain gives them, and the next memory."""
        del key  # brains are deterministic
        memory = restart(fresh_worlds(state), self.init(state), memory)
        return self.brain.run(state.obs, state.world.episode_step, memory)


def brain_of_function(item: Any, size: int, origin: str) -> Brain:
    """Return the brain in a user's function.

    Args:
        item: ``function(obs [N, O]) -> [N, A]``, or a pair ``(init, step)`` with ``init() ->
            memory of one world`` and ``step(obs, memory) -> (output, memory)``, leaves [N, ...].
            Traceable by jax, or numpy on the host: tried in this order.
        size: O.
        origin: What errors call it.

    Raises:
        ValueError: Something else, or a function that fails or returns another shape.
    """
    pair = _is_pair(item)
    if not (pair or _is_callable(item)):
        raise ValueError(
            f"{origin} is {type(item).__name__}: need function(obs) -> action, a pair (init, step),"
            " or a policy object with init(state) and act(memory, state, key)"
        )
    try:
        initial = jax.tree.map(np.asarray, item[0]()) if pair else None
    except Exception as error:  # whatever a user's function may raise
        raise ValueError(f"{origin}: init() failed: {_line(error)}") from error
    step = item[1] if pair else item
    given: tuple[Any, ...] = (jax.ShapeDtypeStruct((2, size), jnp.float32),)
    if pair:
        given += (
            jax.tree.map(
                lambda x: jax.ShapeDtypeStruct((2, *x.shape), jnp.asarray(x).dtype), initial
            ),
        )
    try:
        jax.eval_shape(step, *given)
        is_traceable = True
    except Exception:  # numpy code fails on tracers in many ways; it is tried on the host below
        is_traceable = False
    zeros = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), given)
    try:
        out = step(*zeros)
        action = np.asarray(out[0] if pair else out)
    except Exception as error:
        raise ValueError(f"{origin} failed when it was tried on zeros: {_line(error)}") from error
    if action.shape != (2, ACTION_SIZE):
        raise ValueError(
            f"{origin} makes outputs of shape {action.shape} of observations (2, {size}), expected"
            f" {(2, ACTION_SIZE)}: it gets all worlds at once, [N, {size}] -> [N, {ACTION_SIZE}]"
        )
    call = HostCall(step, pair)

    def run(obs: jax.Array, ticks: jax.Array, memory: Any) -> tuple[jax.Array, Any]:
        del ticks
        if not is_traceable:
            return call(obs, memory)
        if not pair:
            return jnp.asarray(step(obs), jnp.float32), memory
        action, following = step(obs, memory)
        following = jax.tree.map(lambda new, old: jnp.asarray(new, old.dtype), following, memory)
        return jnp.asarray(action, jnp.float32), following

    return Brain(run, initial, size)


def _is_pair(item: Any) -> bool:
    return isinstance(item, tuple | list) and len(item) == 2 and all(map(callable, item))


def _is_callable(item: Any) -> bool:
    return callable(item)


def _line(error: BaseException) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"


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
