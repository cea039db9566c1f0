"""Source and online experience mixed in a fixed proportion, the core of TWiRL.

Every minibatch of B rows holds exactly ``round(phi * B)`` source rows (paper Alg. 1, line 8), so
phi is a property of each gradient and not only of their mean.
"""

from __future__ import annotations

import flax.struct
import jax
import jax.core
import jax.numpy as jnp

from twirl_mjx.replay import ring as ring_lib
from twirl_mjx.replay.ring import RingBuffer
from twirl_mjx.types import Transition


class MixedReplay(flax.struct.PyTreeNode):
    """Frozen source experience beside the growing online experience."""

    source: RingBuffer | None
    """Source transitions, never written; None when learning from scratch (phi 0)."""
    online: RingBuffer
    """Transitions gathered while training."""


def source_rows(phi: float, batch_size: int) -> int:
    """Return how many of the ``batch_size`` rows of a minibatch come from the source.

    Raises:
        ValueError: If ``phi`` is outside [0, 1] or ``batch_size`` is below 1.
    """
    if not 0.0 <= phi <= 1.0:
        raise ValueError(f"phi is {phi}; it must lie in [0, 1] (nearest: {min(max(phi, 0), 1)})")
    if batch_size < 1:
        raise ValueError(f"batch_size is {batch_size}; it must be at least 1")
    return round(phi * batch_size)


def sample(
    replay: MixedReplay, key: jax.Array, *, num_minibatches: int, batch_size: int, phi: float
) -> Transition:
    """Draw minibatches uniformly with replacement, source rows first.

    A side that contributes no row (phi 0 or 1) is not read and may be empty. A side that does
    contribute must hold at least one row; this is checked here only outside a traced function.

    Args:
        replay: Both rings.
        key: Random key.
        num_minibatches: U.
        batch_size: B.
        phi: Share of source rows, in [0, 1].

    Returns:
        Transitions [U, B, ...]; rows [:, :round(phi * B)] are from the source.

    Raises:
        ValueError: If a ring that must contribute is missing or known to be empty, or the rings
            store rows of different sizes.
    """
    num_source = source_rows(phi, batch_size)
    num_online = batch_size - num_source
    source_key, online_key = jax.random.split(key)
    blocks = []
    if num_source:
        if replay.source is None:
            raise ValueError(
                f"phi {phi} asks for {num_source} of {batch_size} rows from the source, but there "
                "is no source ring; give one or set phi to 0"
            )
        _check_same_rows(replay.source, replay.online)
        blocks.append(_draw(replay.source, source_key, (num_minibatches, num_source), "source"))
    if num_online:
        blocks.append(_draw(replay.online, online_key, (num_minibatches, num_online), "online"))
    rows = blocks[0] if len(blocks) == 1 else jnp.concatenate(blocks, axis=1)
    return ring_lib.unpack(rows, replay.online.obs_size, replay.online.action_size)


def sample_counted(
    replay: MixedReplay,
    key: jax.Array,
    *,
    num_minibatches: int,
    batch_size: int,
    num_source: jax.Array,
) -> Transition:
    """Draw what :func:`sample` draws, with the number of source rows as data.

    A run whose share moves, and runs of one program whose shares differ, cannot have it in the
    shapes. The same key draws the same rows as there; each position reads both rings, and one that
    does not count reads a single row again and again, which stays in the cache.

    Args:
        replay: Both rings.
        key: Random key.
        num_minibatches: U.
        batch_size: B.
        num_source: [] int32 in [0, B], rows of every minibatch from the source. A side that then
            contributes a row must hold at least one.

    Returns:
        Transitions [U, B, ...]; rows [:, :num_source] are from the source.

    Raises:
        ValueError: If there is no source ring, or the rings store rows of different sizes.
    """
    if replay.source is None:
        raise ValueError("a number of source rows that is data needs a source ring")
    _check_same_rows(replay.source, replay.online)
    source_key, online_key = jax.random.split(key)
    minibatch, position = jnp.arange(num_minibatches)[:, None], jnp.arange(batch_size)
    is_source = position < num_source
    num_online = batch_size - num_source
    # A side draws [U, its rows]: where in that stands the number of each position.
    source_place = jnp.where(is_source, minibatch * num_source + position, 0)
    online_place = jnp.where(is_source, 0, minibatch * num_online + position - num_source)
    sides = []
    for ring, side_key, at in (
        (replay.source, source_key, source_place),
        (replay.online, online_key, online_place),
    ):
        shape = (num_minibatches * batch_size,)
        drawn = jax.random.randint(side_key, shape, 0, ring.size, jnp.int32)
        sides.append(ring_lib.gather_rows(ring, drawn[at]))
    rows = jnp.where(is_source[:, None], *sides)
    return ring_lib.unpack(rows, replay.online.obs_size, replay.online.action_size)


def _draw(ring: RingBuffer, key: jax.Array, shape: tuple[int, int], name: str) -> jax.Array:
    """Gather packed rows [*shape, W] uniformly from the filled part of a ring."""
    if not isinstance(ring.size, jax.core.Tracer) and int(ring.size) < 1:
        raise ValueError(f"cannot draw {shape[1]} rows per minibatch: the {name} ring is empty")
    indices = jax.random.randint(key, shape, 0, ring.size, jnp.int32)
    return ring_lib.gather_rows(ring, indices)


def _check_same_rows(source: RingBuffer, online: RingBuffer) -> None:
    """Raise ``ValueError`` when the two rings store transitions of different sizes."""
    sizes = [(ring.obs_size, ring.action_size) for ring in (source, online)]
    if sizes[0] != sizes[1]:
        raise ValueError(
            f"source rows have (obs, action) sizes {sizes[0]}, online rows {sizes[1]}; "
            "the source must be recorded in the target task"
        )
