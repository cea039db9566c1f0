"""A policy with an observation of its own as a source: it brings its observer into any task."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp

from twirl_mjx.tasks.observations import Observer
from twirl_mjx.types import Learner

ActOnObs = Callable[[jax.Array, jax.Array], jax.Array]
"""(observations [N, O], key) -> actions [N, A]; traceable by jax."""


class ObservedMemory(flax.struct.PyTreeNode):
    """Memory of a source policy in a foreign task."""

    observer: Any
    """Memory of the source task's observer, leaves [N, ...]."""


class OwnTaskSource:
    """A policy in the task it was trained on: it sees that task's observation."""

    def __init__(self, act: ActOnObs) -> None:
        """Keep what maps observations to actions."""
        self._act = act

    def init(self, state: Any) -> tuple[()]:
        """Return no memory: the worlds keep the observer's."""
        del state
        return ()

    def act(self, memory: tuple[()], state: Any, key: jax.Array) -> tuple[jax.Array, tuple[()]]:
        """Act on the observation of the worlds."""
        return self._act(state.obs, key), memory


class ObservingSource:
    """A policy in a foreign task, with the observer of the task it was trained on.

    Nothing of the target task reaches it but the physical state, its own last action and the goal.
    """

    def __init__(self, act: ActOnObs, observer: Observer) -> None:
        """Keep what maps observations to actions, and the source task's observer."""
        self._act = act
        self._observer = observer

    def init(self, state: Any) -> ObservedMemory:
        """Start the observer in every world."""
        return ObservedMemory(jax.vmap(self._observer.init)(state.data.qpos, state.data.qvel))

    def act(self, memory: ObservedMemory, state: Any, key: jax.Array) -> tuple[jax.Array, Any]:
        """Observe as the source task does, then act."""
        qpos, qvel, world = state.data.qpos, state.data.qvel, state.world
        fresh = self.init(state).observer
        pushed = jax.vmap(self._observer.push)(memory.observer, qpos, qvel, world.action)
        new = world.episode_step == 0

        def pick(a: jax.Array, b: jax.Array) -> jax.Array:
            return jnp.where(new.reshape(new.shape + (1,) * (a.ndim - 1)), a, b)

        observer = jax.tree.map(pick, fresh, pushed)
        obs = jax.vmap(self._observer.observe)(observer, world.goal, qpos, qvel)
        return self._act(obs, key), ObservedMemory(observer)


def actor_act(learner: Learner, actor: Any, *, noise: bool = False) -> ActOnObs:
    """Return how a learner's actor acts: its mean, or with ``noise`` as in training."""

    def act(obs: jax.Array, key: jax.Array) -> jax.Array:
        return learner.sample(actor, obs, key) if noise else learner.mean(actor, obs)

    return act
