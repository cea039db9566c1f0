"""The training state and the compiled epoch: collect, insert, sample, update."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp

from twirl_mjx.replay import mixed, ring
from twirl_mjx.replay import share as share_lib
from twirl_mjx.replay.config import AUTO
from twirl_mjx.replay.mixed import MixedReplay
from twirl_mjx.tasks import measures
from twirl_mjx.tasks.measures import Tracker
from twirl_mjx.training.config import TrainConfig
from twirl_mjx.training.guards import FINITE, INSERTED, all_finite
from twirl_mjx.training.guidance import Guide
from twirl_mjx.training.learners import learner_of
from twirl_mjx.training.metrics import FIRST_DROP
from twirl_mjx.types import Metrics, Transition
from twirl_mjx.worlds.vector import EnvState, VectorEnv, make_transition

GUIDE = 1
"""What is folded into a step's key for a guide's draws."""


class TrainState(flax.struct.PyTreeNode):
    """Everything a run needs to go on; one pytree, one donated argument."""

    learner: Any
    """State of the learner, see ``types.Learner``; DroQ's is ``droq.state.DroqState``."""
    env: EnvState
    """All worlds."""
    replay: MixedReplay
    """Both rings."""
    tracker: Tracker
    """Measures of the episodes under way."""
    key: jax.Array
    """PRNG key, split once per vector step."""
    env_steps: jax.Array
    """int32, transitions gathered (dropped ones included)."""
    inserted: jax.Array
    """int32, transitions inserted in the online ring, dropped ones excluded."""
    share: share_lib.Share | None = None
    """Source rows of a minibatch, where they are data; None: phi is a number when compiled."""
    guide: Any = ()
    """State of the guide (``guidance.GuideState``); nothing without one."""


class EpisodeSums(flax.struct.PyTreeNode):
    """Sums over the episodes that ended, folded over an epoch."""

    values: dict[str, jax.Array]
    count: jax.Array


def init(
    config: TrainConfig,
    env: VectorEnv,
    key: jax.Array,
    source: ring.RingBuffer | None,
    guide: Guide | None = None,
) -> TrainState:
    """Return the state before the first transition.

    Args:
        config: The run.
        env: Its worlds.
        key: PRNG key of the run.
        source: Frozen source experience, or None.
        guide: Who else acts, or None.
    """
    learner_key, env_key, key = jax.random.split(key, 3)
    worlds = env.reset(env_key)
    return TrainState(
        learner=learner_of(config.droq).init(
            learner_key, config.droq, env.observation_size, env.action_size
        ),
        env=worlds,
        replay=MixedReplay(
            source=source,
            online=ring.init(config.replay.capacity, env.observation_size, env.action_size),
        ),
        tracker=measures.tracker_init(env.task, env.num_envs),
        key=key,
        env_steps=jnp.zeros((), jnp.int32),
        inserted=jnp.zeros((), jnp.int32),
        share=(
            share_lib.init(AUTO, config.droq.batch_size) if config.effective_phi == AUTO else None
        ),
        guide=() if guide is None else guide.init(worlds),
    )


def collect_step(
    config: TrainConfig,
    env: VectorEnv,
    state: TrainState,
    key: jax.Array,
    guide: Guide | None = None,
) -> tuple[TrainState, EnvState, jax.Array]:
    """Act once in every world and insert the transitions.

    Actions are uniformly random in the first ``warmup_env_steps`` transitions, unless the actor
    begins with the weights of a source; a guide may put others in their place.

    Returns:
        The new state, what the worlds returned, and why transitions were dropped: [N] int32
        indices into ``FAULTS``.
    """
    warm_key, act_key = jax.random.split(key)
    learner = learner_of(config.droq)
    action = learner.sample(state.learner.actor, state.env.obs, act_key)
    if not config.uses_source_weights:
        warm = jax.random.uniform(warm_key, action.shape, minval=-1.0, maxval=1.0)
        action = jnp.where(state.env_steps < config.warmup_env_steps, warm, action)
    if guide is not None:
        assert learner.value is not None, "refused before (source_rules.check_guide)"
        value = functools.partial(learner.value, state.learner, config.droq, state.env.obs)
        guide_key = jax.random.fold_in(key, GUIDE)
        noted, action = guide.choose(
            state.guide, state.env, state.env_steps, action, value, guide_key
        )
        state = state.replace(guide=noted)
    result, fault = env.step_and_fault(state.env, action)
    valid = ~result.invalid
    transition = make_transition(state.env, jnp.nan_to_num(action), result)
    online = ring.insert(state.replay.online, transition, valid)
    state = state.replace(
        env=result,
        replay=state.replay.replace(online=online),
        env_steps=state.env_steps + env.num_envs,
        inserted=state.inserted + jnp.sum(valid, dtype=jnp.int32),
    )
    return state, result, fault


def draw(config: TrainConfig, state: TrainState, key: jax.Array) -> Transition:
    """Draw the minibatches [U, B, ...] of a block of updates."""
    sizes = {
        "num_minibatches": config.droq.updates_per_block,
        "batch_size": config.droq.batch_size,
    }
    phi = config.effective_phi
    if state.share is not None:
        return mixed.sample_counted(state.replay, key, num_source=state.share.num_source, **sizes)
    assert not isinstance(phi, str), "phi that chooses itself is data"
    return mixed.sample(state.replay, key, phi=phi, **sizes)


def update_blocks(config: TrainConfig, state: TrainState, key: jax.Array) -> tuple[Any, Metrics]:
    """Run all blocks of critic updates that follow one vector step; none during warm-up.

    A loop with a trip count, not a ``lax.cond``, decides: a conditional would copy the rings.

    Returns:
        The learner, and means over the blocks (NaN without any).
    """
    keys = jax.random.split(key, config.blocks_per_step)

    def block(learner: Any, block_key: jax.Array) -> tuple[Any, Metrics]:
        sample_key, update_key = jax.random.split(block_key)
        minibatches = draw(config, state, sample_key)
        return learner_of(config.droq).update(learner, config.droq, minibatches, update_key)

    def body(i: jax.Array, carry: tuple[Any, Metrics]) -> tuple[Any, Metrics]:
        learner, metrics = block(carry[0], keys[i])
        return learner, jax.tree.map(jnp.add, carry[1], metrics)

    shapes = jax.eval_shape(block, state.learner, keys[0])[1]
    zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    trips = jnp.where(state.env_steps > config.warmup_env_steps, config.blocks_per_step, 0)
    learner, sums = jax.lax.fori_loop(0, trips, body, (state.learner, zeros))
    return learner, jax.tree.map(lambda x: x / trips, sums)


def train_step(
    config: TrainConfig, env: VectorEnv, state: TrainState, guide: Guide | None = None
) -> tuple[TrainState, tuple[Metrics, Metrics, EpisodeSums]]:
    """One vector step and its updates.

    Returns:
        The new state; learner metrics (NaN during warm-up); per-step means of the worlds; sums
        over the episodes that ended.
    """
    key, act_key, update_key = jax.random.split(state.key, 3)
    state, result, fault = collect_step(config, env, state.replace(key=key), act_key, guide)
    tracker = measures.tracker_step(env.task, state.tracker, result)
    done = result.done & ~result.invalid
    finished = EpisodeSums(
        values={
            name: jnp.sum(jnp.where(done, value, 0.0))
            for name, value in measures.tracker_read(env.task, tracker).items()
        },
        count=jnp.sum(done, dtype=jnp.float32),
    )
    state = state.replace(tracker=measures.tracker_reset(env.task, tracker, result.done))
    learner, learner_metrics = update_blocks(config, state, update_key)
    worlds = {f"world/{name}": jnp.mean(value) for name, value in result.metrics.items()}
    worlds |= {
        "reward": jnp.mean(result.reward),
        "dropped_transitions": jnp.sum(result.invalid, dtype=jnp.float32),
        FIRST_DROP: jnp.max(fault).astype(jnp.float32),
    }
    if guide is not None:
        worlds["guided"] = state.guide.share
    return state.replace(learner=learner), (learner_metrics, worlds, finished)


def train_epoch(
    config: TrainConfig, env: VectorEnv, state: TrainState, guide: Guide | None = None
) -> tuple[TrainState, Metrics]:
    """Run ``steps_per_epoch`` vector steps; the body of the only training jit.

    Returns:
        The new state and scalar metrics of the epoch, NaN where nothing was measured; what the
        guards want to know (``guards.FINITE``, ``INSERTED``) is among them.
    """
    state, (learning, worlds, finished) = jax.lax.scan(
        lambda s, _: train_step(config, env, s, guide), state, length=config.steps_per_epoch
    )
    metrics = {name: jnp.nanmean(value) for name, value in learning.items()}
    metrics |= {name: jnp.mean(value) for name, value in worlds.items()}
    metrics["dropped_transitions"] = jnp.sum(worlds["dropped_transitions"])
    metrics[FIRST_DROP] = worlds[FIRST_DROP][jnp.argmax(worlds[FIRST_DROP] > 0.0)]
    episodes = jnp.sum(finished.count)
    metrics |= {name: jnp.sum(value) / episodes for name, value in finished.values.items()}
    metrics |= {
        "episodes": episodes,
        "online_rows": state.replay.online.size.astype(jnp.float32),
    }
    metrics |= {FINITE: all_finite(state.learner), INSERTED: state.inserted}
    if state.share is not None:
        assert state.replay.source is not None, "a share of source rows has a source ring"
        gathered = config.steps_per_epoch * env.num_envs
        moved, told = share_lib.move(
            state.share,
            state.replay.source,
            metrics["reward"],
            jnp.sum(finished.values["terminated"]) / gathered,
            batch_size=config.droq.batch_size,
            episode_length=env.episode_length,
        )
        state, metrics = state.replace(share=moved), metrics | told
    return state, metrics


def compile_epoch(
    config: TrainConfig, env: VectorEnv, guide: Guide | None = None
) -> Callable[[TrainState], tuple[TrainState, Metrics]]:
    """Return the jitted epoch; it donates its argument."""
    return jax.jit(functools.partial(train_epoch, config, env, guide=guide), donate_argnums=0)
