"""Critic parameters in the layout of the fast update, and back.

The fast update keeps activations as [E, H, B], batch last. Kernels are then [out, in], the first
one covers all critics at once and carries its bias as a last column, and every other vector lies
in one matrix, so that Adam and Polyak touch a handful of arrays.
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
    """First [1, E * H0, O + A + 1] with the bias as last column; the others [E, H_i, H_(i-1)]."""
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
    """Arrange critic parameters for the fast update."""
    num_layers = len(hidden_sizes)
    hidden = [critic[f"hidden_{i}"] for i in range(num_layers)]
    first = jnp.concatenate([hidden[0]["kernel"], hidden[0]["bias"][:, None]], axis=1)
    first = first.transpose(0, 2, 1).reshape(1, -1, first.shape[1])
    vectors = [layer["bias"] for layer in hidden[1:]]
    for i in range(num_layers):
        vectors += [critic[f"norm_{i}"]["scale"], critic[f"norm_{i}"]["bias"]]
    vectors += [critic["out"]["kernel"][..., 0], critic["out"]["bias"]]
    return PackedCritic(
        kernels=(first, *(layer["kernel"].transpose(0, 2, 1) for layer in hidden[1:])),
        vectors=jnp.concatenate(vectors, axis=1),
    )


def unpack(packed: PackedCritic, hidden_sizes: Sequence[int]) -> Params:
    """Undo ``pack``."""
    num_layers = len(hidden_sizes)
    num_critics = packed.vectors.shape[0]
    vectors = split_vectors(packed.vectors, hidden_sizes)
    first = packed.kernels[0].reshape(num_critics, hidden_sizes[0], -1).transpose(0, 2, 1)
    critic = {"hidden_0": {"kernel": first[:, :-1], "bias": first[:, -1]}}
    for i in range(1, num_layers):
        kernel = packed.kernels[i].transpose(0, 2, 1)
        critic[f"hidden_{i}"] = {"kernel": kernel, "bias": vectors[i - 1]}
    norms = vectors[num_layers - 1 : -2]
    for i in range(num_layers):
        critic[f"norm_{i}"] = {"scale": norms[2 * i], "bias": norms[2 * i + 1]}
    critic["out"] = {"kernel": vectors[-2][..., None], "bias": vectors[-1]}
    return critic
