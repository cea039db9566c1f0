"""A learned policy as a source: it brings its own observer into any task."""

from __future__ import annotations

from typing import Any

import flax.struct
import jax
import jax.numpy as jnp

from twirl_mjx.droq import learner as droq
from twirl_mjx.tasks.observations import Observer


class LearnedMemory(flax.struct.PyTreeNode):
    """Memory of a learned source policy in a foreign task."""

    observer: Any
    """Memory of the source task's observer, leaves [N, ...]."""


class LearnedSource:
    """A trained actor that brings the observer of the task it was trained on.

    Nothing of the target task reaches it but the physical state, its own last action and the
    goal; with ``noise`` it acts as in training, else deterministically.
    """

    def __init__(self, actor: Any, observer: Observer, *, noise: bool = False) -> None:
        """Keep actor parameters (see ``droq.networks``) and the source task's observer."""
        self._actor = actor
        self._observer = observer
        self._noise = noise

    def init(self, state: Any) -> LearnedMemory:
        """Start the observer in every world."""
        return LearnedMemory(jax.vmap(self._observer.init)(state.data.qpos, state.data.qvel))

    def act(self, memory: LearnedMemory, state: Any, key: jax.Array) -> tuple[jax.Array, Any]:
        """Observe as the source task does, then act."""
        qpos, qvel, world = state.data.qpos, state.data.qvel, state.world
        fresh = self.init(state).observer
        pushed = jax.vmap(self._observer.push)(memory.observer, qpos, qvel, world.action)
        new = world.episode_step == 0

        def pick(a: jax.Array, b: jax.Array) -> jax.Array:
            return jnp.where(new.reshape(new.shape + (1,) * (a.ndim - 1)), a, b)

        observer = jax.tree.map(pick, fresh, pushed)
        obs = jax.vmap(self._observer.observe)(observer, world.goal, qpos, qvel)
        if self._noise:
            return droq.sample_action(self._actor, obs, key), LearnedMemory(observer)
        return droq.mean_action(self._actor, obs), LearnedMemory(observer)
