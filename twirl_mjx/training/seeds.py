"""Several seeds of one config trained by one program, as a batch axis in front of every array.

Every product of the learner then covers all seeds at once, and the native engine gets the worlds
of all seeds in one call. ``sharding`` spreads the same axis over devices.

What equals what: a seed of a batch draws the same random numbers and steps the same physics as
the same seed alone. Both agree to float32 rounding, because a program compiled for another shape,
and a batched matrix product, sum in another order; contacts amplify such differences in time.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from twirl_mjx.replay.mixed import MixedReplay
from twirl_mjx.replay.ring import RingBuffer
from twirl_mjx.training import state as single
from twirl_mjx.training.config import TrainConfig
from twirl_mjx.training.guidance import Guide
from twirl_mjx.training.state import TrainState
from twirl_mjx.types import Metrics
from twirl_mjx.worlds.vector import VectorEnv


def per_field(batched: Any, shared: Any, *, own_sources: bool = False) -> Any:
    """Return a prefix tree of ``TrainState``: ``batched`` where seeds differ, else ``shared``.

    The source ring is read by all seeds unless they have ``own_sources``, and all seeds are equally
    far: ``env_steps`` decides how many updates follow a step, which must not differ within one
    program.
    """
    source = batched if own_sources else shared
    return TrainState(
        learner=batched,
        env=batched,
        replay=MixedReplay(source=source, online=batched),
        tracker=batched,
        key=batched,
        env_steps=shared,
        inserted=batched,
        share=batched,
        guide=batched,
    )


AXES = per_field(0, None)
"""``in_axes`` of a batch of seeds; it shares the source ring and ``env_steps``."""


def init_seeds(
    config: TrainConfig,
    env: VectorEnv,
    seeds: Sequence[int],
    source: RingBuffer | None,
    guide: Guide | None = None,
) -> TrainState:
    """Return the states of several seeds before the first transition.

    Args:
        config: The run; its ``seed`` is not used.
        env: Its worlds; every seed has ``env.num_envs`` of its own.
        seeds: S seeds; one may occur again where runs differ in phi.
        source: Frozen source experience that all seeds share, or None.
        guide: Who else acts, one for all seeds, or None.

    Returns:
        A state with a leading axis [S] on every leaf but those of ``AXES`` without one.

    Raises:
        ValueError: No seed.
    """
    if not seeds:
        raise ValueError("a batch needs at least one seed")
    keys = jax.vmap(jax.random.key)(jnp.asarray(seeds, jnp.uint32))

    def fresh(key: jax.Array) -> TrainState:
        return single.init(config, env, key, None, guide)

    states = jax.jit(jax.vmap(fresh, out_axes=AXES))(keys)
    return states.replace(replay=states.replay.replace(source=source))


def batch_epoch(
    config: TrainConfig,
    env: VectorEnv,
    *,
    own_sources: bool = False,
    guide: Guide | None = None,
) -> Callable[[TrainState], tuple[TrainState, Metrics]]:
    """Return ``train_epoch`` of a batch of seeds, not compiled; metrics are [S] each.

    A batch of one is the program of a run alone between two changes of shape: a batch axis would
    make conditionals compute both of their branches.
    """
    epoch = functools.partial(single.train_epoch, config, env, guide=guide)
    axes = per_field(0, None, own_sources=own_sources)
    batched = jax.vmap(epoch, in_axes=(axes,), out_axes=(axes, 0))

    def run(states: TrainState) -> tuple[TrainState, Metrics]:
        if num_seeds(states) > 1:
            return batched(states)
        after, metrics = epoch(_each(lambda leaf: leaf[0], axes, states))
        one = _each(lambda leaf: leaf[None], axes, after)
        return one, jax.tree.map(lambda value: value[None], metrics)

    return run


def _each(change: Callable[[jax.Array], jax.Array], axes: TrainState, states: Any) -> Any:
    """Return a state with every leaf changed that ``axes`` gives a batch axis."""

    def at(axis: int | None, subtree: Any) -> Any:
        return subtree if axis is None else jax.tree.map(change, subtree)

    return jax.tree.map(at, axes, states, is_leaf=lambda axis: axis is None)


def compile_epoch_seeds(
    config: TrainConfig,
    env: VectorEnv,
    *,
    own_sources: bool = False,
    guide: Guide | None = None,
) -> Callable[[TrainState], tuple[TrainState, Metrics]]:
    """Return the jitted epoch of a batch of seeds; it donates its argument.

    Args:
        config: The run.
        env: The worlds of one seed.
        own_sources: Whether every seed has a source ring of its own (``stack_rings``).
        guide: Who else acts, one for all seeds, or None.

    Returns:
        A function of a state from ``init_seeds``; its metrics are [S] each.
    """
    return jax.jit(batch_epoch(config, env, own_sources=own_sources, guide=guide), donate_argnums=0)


def num_seeds(states: TrainState) -> int:
    """Return S of a batch of seeds."""
    return states.inserted.shape[0]


def seed_state(states: TrainState, index: int) -> TrainState:
    """Return one seed of a batch as a state of its own, for a checkpoint or a policy file.

    Args:
        states: State of S seeds.
        index: Place in the batch, 0 to S - 1.

    Raises:
        ValueError: No such place.
    """
    if not 0 <= index < num_seeds(states):
        raise ValueError(f"seed index {index} is outside [0, {num_seeds(states) - 1}]")

    source = states.replay.source
    axes = per_field(0, None, own_sources=source is not None and source.rows.ndim == 3)
    return _each(lambda leaf: leaf[index], axes, states)


def stack_states(states: Sequence[TrainState]) -> TrainState:
    """Return the batch of the states of several seeds, all equally far and without source rings.

    Raises:
        ValueError: They are not equally far.
    """
    steps = [int(state.env_steps) for state in states]
    if len(set(steps)) != 1:
        raise ValueError(f"seeds of one program must be equally far, these are at {steps}")

    def put(axis: int | None, *subtrees: Any) -> Any:
        if axis is None:
            return subtrees[0]
        return jax.tree.map(lambda *leaves: jnp.stack(leaves), *subtrees)

    return jax.tree.map(put, AXES, *states, is_leaf=lambda axis: axis is None)


def stack_rings(rings: Sequence[RingBuffer]) -> RingBuffer:
    """Return the source rings of several seeds as one, rows [S, C, W].

    C is the largest capacity; only the rows of its own ring are drawn for a seed, as alone.
    """
    capacity = max(ring.capacity for ring in rings)
    padded = [
        ring.replace(rows=jnp.pad(ring.rows, ((0, capacity - ring.capacity), (0, 0))))
        for ring in rings
    ]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *padded)
