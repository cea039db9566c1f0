"""Guidance at run time: a source that acts in place of the learner while experience is gathered.

It comes on top of mixed replay and changes nothing but who chooses the action. ``jump-start``
(Uchendu et al. 2023, "Jump-Start Reinforcement Learning"): the source acts in the first h control
steps of every episode; h begins at the length of an episode and shrinks whenever the return of
both together reaches the best so far. ``best-of`` (Hu et al. 2024, "Imitation Bootstrapped
Reinforcement Learning"): of the source's and the learner's action the one that the critic values
higher is taken, once there is a critic that has been updated.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp

from twirl_mjx.training.config import TrainConfig
from twirl_mjx.types import Metrics, SourcePolicy
from twirl_mjx.worlds.vector import EnvState

STAGES = 10
"""Shrinkings of h from the length of an episode to 0."""
WINDOW = 20
"""Episodes over which a return is averaged before h is decided on; it is read every step."""
TOLERANCE = 0.05
"""Share of the best return by which a return may stay behind and count as reaching it."""


class GuideState(flax.struct.PyTreeNode):
    """What a guide remembers; in the checkpoint, so that a resumed run is the same run."""

    memory: Any
    """Of the source, leaves [N, ...]."""
    horizon: jax.Array
    """int32, h in control steps; of ``jump-start`` only."""
    best: jax.Array
    """Best mean return of a window so far."""
    returns: jax.Array
    """Sum of the returns of this window."""
    episodes: jax.Array
    """Episodes of this window that ended."""
    share: jax.Array
    """Share of the worlds in which the source acted in the last step."""


class Guide:
    """A source that is asked at every step; static under jit."""

    def __init__(self, config: TrainConfig, policy: SourcePolicy) -> None:
        """Keep the source and how ``config.guide`` uses it."""
        self._kind, self._policy = config.guide, policy
        self._length = config.episode_length
        self._warmup = 0 if config.uses_source_weights else config.warmup_env_steps

    def init(self, env: EnvState) -> GuideState:
        """Return the state for freshly reset worlds."""
        zero = jnp.zeros((), jnp.float32)
        return GuideState(
            memory=self._policy.init(env),
            horizon=jnp.asarray(self._length if self._kind == "jump-start" else 0, jnp.int32),
            best=jnp.full((), -jnp.inf, jnp.float32),
            returns=zero,
            episodes=zero,
            share=zero,
        )

    def choose(
        self,
        state: GuideState,
        env: EnvState,
        env_steps: jax.Array,
        own: jax.Array,
        value: Callable[[jax.Array], jax.Array] | None,
        key: jax.Array,
    ) -> tuple[GuideState, jax.Array]:
        """Return the next state and the actions [N, A] of a step.

        Args:
            state: The guide's.
            env: All worlds, N.
            env_steps: Transitions gathered so far.
            own: [N, A] of the learner.
            value: The critic's value [N] of actions [N, A] in these worlds; of ``best-of`` only.
            key: Random key of the source.
        """
        action, memory = self._policy.act(state.memory, env, key)
        action = jnp.clip(action, -1.0, 1.0)
        if self._kind == "jump-start":
            takes = env.world.episode_step < state.horizon
        else:
            assert value is not None, "refused before (source_rules.check_guide)"
            takes = (value(action) > value(own)) & (env_steps > self._warmup)
        share = jnp.mean(takes, dtype=jnp.float32)
        return state.replace(memory=memory, share=share), jnp.where(takes[:, None], action, own)

    def note(
        self, state: GuideState, returns: jax.Array, episodes: jax.Array
    ) -> tuple[GuideState, Metrics]:
        """Take the episodes that ended in a step; return the next state and what is logged.

        Args:
            state: The guide's.
            returns: Sum of their returns.
            episodes: Their number.
        """
        metrics = {"guided": state.share}
        if self._kind != "jump-start":
            return state, metrics
        returns, episodes = state.returns + returns, state.episodes + episodes
        full = episodes >= WINDOW
        mean = returns / jnp.maximum(episodes, 1.0)
        reached = full & ~(mean < state.best - TOLERANCE * jnp.abs(state.best))
        shorter = jnp.maximum(state.horizon - -(-self._length // STAGES), 0)
        state = state.replace(
            horizon=jnp.where(reached, shorter, state.horizon),
            best=jnp.where(full, jnp.maximum(mean, state.best), state.best),
            returns=jnp.where(full, 0.0, returns),
            episodes=jnp.where(full, 0.0, episodes),
        )
        return state, metrics | {"guide_horizon": state.horizon.astype(jnp.float32)}
