"""Critic parameters as a handful of arrays, for Adam and Polyak, and back.

The first kernel carries its bias as a last row, and every other vector lies in one matrix.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import flax.struct
import jax
import jax.numpy as jnp

from twirl_mjx.droq.networks import Params


class PackedCritic(flax.struct.PyTreeNode):
    """Parameters (or gradients, or moments) of E critics; built by ``pack``."""

    kernels: tuple[jax.Array, ...]
    """First [E, O + A + 1, H_0] with the bias as last row; the others [E, H_(i-1), H_i]. A
    ``hoisted.Layout`` may turn them."""
    vectors: jax.Array
    """[E, V], the columns listed by ``vector_sizes``."""


def vector_sizes(hidden_sizes: Sequence[int]) -> list[int]:
    """Return the lengths of the vectors: biases 1.., (scale, bias) of each norm, output layer."""
    norms = [size for size in hidden_sizes for _ in ("scale", "bias")]
    return [*hidden_sizes[1:], *norms, hidden_sizes[-1], 1]


def split_vectors(vectors: jax.Array, hidden_sizes: Sequence[int]) -> list[jax.Array]:
    """Cut [E, V] into the vectors of ``vector_sizes``, each [E, size]."""
    ends = [0]
    for size in vector_sizes(hidden_sizes):
        ends.append(ends[-1] + size)
    return [vectors[:, start:end] for start, end in itertools.pairwise(ends)]


def pack(critic: Params, hidden_sizes: Sequence[int]) -> PackedCritic:
    """Gather critic parameters in a few arrays."""
    num_layers = len(hidden_sizes)
    hidden = [critic[f"hidden_{i}"] for i in range(num_layers)]
    first = jnp.concatenate([hidden[0]["kernel"], hidden[0]["bias"][:, None]], axis=1)
    vectors = [layer["bias"] for layer in hidden[1:]]
    for i in range(num_layers):
        vectors += [critic[f"norm_{i}"]["scale"], critic[f"norm_{i}"]["bias"]]
    vectors += [critic["out"]["kernel"][..., 0], critic["out"]["bias"]]
    return PackedCritic(
        kernels=(first, *(layer["kernel"] for layer in hidden[1:])),
        vectors=jnp.concatenate(vectors, axis=1),
    )


def unpack(packed: PackedCritic, hidden_sizes: Sequence[int]) -> Params:
    """Undo ``pack``."""
    num_layers = len(hidden_sizes)
    vectors = split_vectors(packed.vectors, hidden_sizes)
    first = packed.kernels[0]
    critic = {"hidden_0": {"kernel": first[:, :-1], "bias": first[:, -1]}}
    for i in range(1, num_layers):
        critic[f"hidden_{i}"] = {"kernel": packed.kernels[i], "bias": vectors[i - 1]}
    norms = vectors[num_layers - 1 : -2]
    for i in range(num_layers):
        critic[f"norm_{i}"] = {"scale": norms[2 * i], "bias": norms[2 * i + 1]}
    critic["out"] = {"kernel": vectors[-2][..., None], "bias": vectors[-1]}
    return critic
