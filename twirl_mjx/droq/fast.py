"""The fast critic updates of a CPU (``hoisted``): few and large operations, the batch last.

Dropout, layer norm and ReLU have a hand-written gradient (``fused``); activations are [E, H, B].
``docs/performance_learner.md`` has the gain of each choice.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from twirl_mjx.droq import dropout, fused
from twirl_mjx.droq.hoisted import Layout
from twirl_mjx.droq.packing import PackedCritic


def _arrange(packed: PackedCritic) -> PackedCritic:
    """Turn kernels to [E, out, in], the first one to [1, E * H0, O + A + 1]."""
    first, *others = (kernel.transpose(0, 2, 1) for kernel in packed.kernels)
    return packed.replace(kernels=(first.reshape(1, -1, first.shape[2]), *others))


def _restore(packed: PackedCritic) -> PackedCritic:
    first, *others = packed.kernels
    first = first.reshape(packed.vectors.shape[0], -1, first.shape[2])
    return packed.replace(kernels=tuple(k.transpose(0, 2, 1) for k in (first, *others)))


def _columns(obs: jax.Array, action: jax.Array) -> jax.Array:
    """Return critic inputs [..., O + A + 1, B] with a last row of ones (it meets the biases)."""
    ones = jnp.ones((*action.shape[:-1], 1))
    return jnp.swapaxes(jnp.concatenate([obs, action, ones], axis=-1), -1, -2)


def _first(kernel: jax.Array, inputs: jax.Array, num_critics: int, matmul_dtype: str) -> jax.Array:
    z = fused.matmul(kernel, inputs[None], matmul_dtype)
    return z.reshape(num_critics, -1, inputs.shape[-1])


def _dense(kernel: jax.Array, h: jax.Array, bias: jax.Array, matmul_dtype: str) -> jax.Array:
    return fused.matmul(kernel, h, matmul_dtype) + bias[..., None]


LAYOUT = Layout(
    arrange=_arrange,
    restore=_restore,
    inputs=_columns,
    shape=lambda critics, rows, units: (critics, units, rows),
    mask=dropout.keep_mask,
    first=_first,
    dense=_dense,
    norm=fused.dropout_norm_relu,
    out=lambda weights, h: jnp.einsum("eh,ehb->eb", weights, h),
)
"""Activations [E, H, B]; the first layer of all critics is one product."""

critic_q = LAYOUT.critic_q
critic_block = LAYOUT.critic_block
