"""Dropout masks from a counter hash: a few integer operations per pair of bits.

Drawing dropout bits with threefry costs more than a third of a critic update on a CPU. Here the
bits of element ``i`` are a hash of ``i`` and of a 64-bit seed; each seed is drawn from the block's
random key, so masks are reproducible, resume exactly and stay independent under ``vmap``.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp

RESOLUTION = 1 << 16
"""Dropout probabilities are multiples of 1 / RESOLUTION: 16 random bits decide an element."""


def threshold(rate: float) -> int:
    """Return the number of 16-bit values that drop an element, e.g. 655 for a rate of 0.01.

    Raises:
        ValueError: If ``rate`` is outside [0, 1).
    """
    if not 0.0 <= rate < 1.0:
        raise ValueError(f"dropout_rate is {rate}; it must lie in [0, 1)")
    return round(rate * RESOLUTION)


def quantised_rate(rate: float) -> float:
    """Return the dropout probability actually used: the nearest multiple of 1 / RESOLUTION."""
    return threshold(rate) / RESOLUTION


def seeds(key: jax.Array, shape: Sequence[int]) -> jax.Array:
    """Draw 64-bit hash seeds [*shape, 2] uint32, one for each pair of masks."""
    return jax.random.bits(key, (*shape, 2), jnp.uint32)


def hash_bits(seed: jax.Array, num: int) -> jax.Array:
    """Return 32 random bits for each of the counters 0 .. num - 1: [num] uint32.

    Args:
        seed: [2] uint32.
        num: Number of counters.
    """
    return _hash(seed, jnp.arange(num, dtype=jnp.uint32))


def _hash(seed: jax.Array | tuple[jax.Array, jax.Array], counter: jax.Array) -> jax.Array:
    """Return 32 random bits for every counter.

    The finaliser of MurmurHash3 (Appleby, public domain) with the seed entering twice, before and
    between its rounds, so that two seeds never give shifted copies of one stream.
    """
    bits = counter ^ seed[0]
    bits = (bits ^ (bits >> 16)) * jnp.uint32(0x85EBCA6B) + seed[1]
    bits = (bits ^ (bits >> 13)) * jnp.uint32(0xC2B2AE35)
    return bits ^ (bits >> 16)


def keep_mask(seed: jax.Array, shape: tuple[int, int, int], rate: float) -> jax.Array:
    """Return the bool mask of the elements to keep, in the shape that is given.

    One hash serves two ensemble members: its low half the even one, its high half the odd one.

    Args:
        seed: [2] uint32.
        shape: Ensemble members E first, then rows and units in either order.
        rate: Probability of dropping an element, rounded to a multiple of 1 / RESOLUTION.
    """
    num_critics, rows, units = shape
    pairs = (num_critics + 1) // 2
    bits = hash_bits(seed, pairs * rows * units).reshape(pairs, rows, units)
    halves = jnp.stack([bits & 0xFFFF, bits >> 16], axis=1)
    return halves.reshape(2 * pairs, rows, units)[:num_critics] >= threshold(rate)


def keep_mask_by_element(seed: jax.Array, shape: tuple[int, int, int], rate: float) -> jax.Array:
    """Return the mask of :func:`keep_mask`, every element by itself.

    It hashes twice as often and stores nothing, so that a GPU can make it where it is used instead
    of in a kernel of its own.
    """
    member, row, column = (jax.lax.broadcasted_iota(jnp.uint32, shape, i) for i in range(3))
    return keep_at((seed[0], seed[1]), member, row, column, shape[1:], rate)


def keep_at(
    seed: tuple[jax.Array, jax.Array],
    member: jax.Array,
    row: jax.Array,
    column: jax.Array,
    shape: tuple[int, int],
    rate: float,
) -> jax.Array:
    """Return what :func:`keep_mask` says of some elements.

    Args:
        seed: The two halves of the hash seed.
        member: Ensemble members of the elements, uint32.
        row: Their rows, uint32.
        column: Their columns, uint32.
        shape: Rows and columns of the whole mask.
        rate: Probability of dropping an element, rounded to a multiple of 1 / RESOLUTION.
    """
    rows, columns = shape
    counter = (member // 2) * jnp.uint32(rows * columns) + row * jnp.uint32(columns) + column
    half = (_hash(seed, counter) >> (16 * (member % 2))) & 0xFFFF
    return half >= threshold(rate)
