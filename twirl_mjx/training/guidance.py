"""Guidance at run time: a source that acts beside the learner while experience is gathered.

It comes on top of mixed replay and changes nothing but who chooses the action. ``best-of`` (Hu et
al. 2024, "Imitation Bootstrapped Reinforcement Learning"): of the source's and the learner's action
the one that the critic values higher is taken, once there is a critic that has been updated.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp

from twirl_mjx.training.config import TrainConfig
from twirl_mjx.types import SourcePolicy
from twirl_mjx.worlds.vector import EnvState


class GuideState(flax.struct.PyTreeNode):
    """What a guide remembers; in the checkpoint, so that a resumed run is the same run."""

    memory: Any
    """Of the source, leaves [N, ...]."""
    share: jax.Array
    """Share of the worlds in which the source acted in the last step."""


class Guide:
    """A source that is asked at every step; static under jit."""

    def __init__(self, config: TrainConfig, policy: SourcePolicy) -> None:
        """Keep the source, and when the critic is first asked."""
        self._policy = policy
        self._warmup = 0 if config.uses_source_weights else config.warmup_env_steps

    def init(self, env: EnvState) -> GuideState:
        """Return the state for freshly reset worlds."""
        return GuideState(memory=self._policy.init(env), share=jnp.zeros((), jnp.float32))

    def choose(
        self,
        state: GuideState,
        env: EnvState,
        env_steps: jax.Array,
        own: jax.Array,
        value: Callable[[jax.Array], jax.Array],
        key: jax.Array,
    ) -> tuple[GuideState, jax.Array]:
        """Return the next state and the actions [N, A] of a step.

        Args:
            state: The guide's.
            env: All worlds, N.
            env_steps: Transitions gathered so far.
            own: [N, A] of the learner.
            value: The critic's value [N] of actions [N, A] in these worlds.
            key: Random key of the source.
        """
        action, memory = self._policy.act(state.memory, env, key)
        action = jnp.clip(action, -1.0, 1.0)
        takes = (value(action) > value(own)) & (env_steps > self._warmup)
        share = jnp.mean(takes, dtype=jnp.float32)
        return state.replace(memory=memory, share=share), jnp.where(takes[:, None], action, own)
