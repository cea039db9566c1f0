"""The fast critic updates of a GPU or TPU (``hoisted``): rows [B, features], nothing transposed.

One learner is bound there by the number of operations that are launched, not by arithmetic, so
what counts is how few kernels the compiler makes of an update. Gradients are autodiff's: XLA fuses
what it differentiates itself. ``docs/accelerators.md`` has the counts (``bench gpu-compile``).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from twirl_mjx.droq import dropout
from twirl_mjx.droq.hoisted import Layout
from twirl_mjx.droq.networks import LAYER_NORM_EPSILON, dot_general
from twirl_mjx.droq.packing import PackedCritic


def _as_packed(packed: PackedCritic) -> PackedCritic:
    """Return kernels [E, in, out] as they are: ``packing`` is batch first."""
    return packed


def _rows(obs: jax.Array, action: jax.Array) -> jax.Array:
    """Return critic inputs [..., B, O + A + 1] with a last column of ones."""
    return jnp.concatenate([obs, action, jnp.ones((*action.shape[:-1], 1))], axis=-1)


def _product(kernel: jax.Array, x: jax.Array, matmul_dtype: str) -> jax.Array:
    """Return x [E, B, in] times kernel [E, in, out]: [E, B, out]."""
    return dot_general(x, kernel, (((2,), (1,)), ((0,), (0,))), matmul_dtype)


def _first(kernel: jax.Array, inputs: jax.Array, num_critics: int, matmul_dtype: str) -> jax.Array:
    return _product(kernel, jnp.broadcast_to(inputs, (num_critics, *inputs.shape)), matmul_dtype)


def _dense(kernel: jax.Array, h: jax.Array, bias: jax.Array, matmul_dtype: str) -> jax.Array:
    return _product(kernel, h, matmul_dtype) + bias[:, None]


def _norm(
    z: jax.Array, scale: jax.Array, bias: jax.Array, keep: jax.Array, rate: float
) -> jax.Array:
    """Return ReLU(LayerNorm(Dropout(z))) over the last axis; see ``fused.dropout_norm_relu``."""
    kept = jnp.where(keep, z, 0.0)
    centred = kept - jnp.mean(kept, axis=-1, keepdims=True)
    variance = jnp.mean(jnp.square(centred), axis=-1, keepdims=True)
    normal = centred * jax.lax.rsqrt(variance + LAYER_NORM_EPSILON * (1.0 - rate) ** 2)
    return jnp.maximum(normal * scale[:, None] + bias[:, None], 0.0)


LAYOUT = Layout(
    arrange=_as_packed,
    restore=_as_packed,
    inputs=_rows,
    shape=lambda critics, rows, units: (critics, rows, units),
    mask=dropout.keep_mask_by_element,
    first=_first,
    dense=_dense,
    norm=_norm,
    out=lambda weights, h: jnp.einsum("eh,ebh->eb", weights, h),
)
"""Activations [E, B, H]."""

critic_q = LAYOUT.critic_q
critic_block = LAYOUT.critic_block
