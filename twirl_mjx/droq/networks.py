"""The networks of DroQ: a tanh-Gaussian actor and an ensemble of dropout critics.

Parameters are plain dicts with fixed names, so that files written by one version of the learner
(plain or fast) drive every other reader:

- actor: ``hidden_i``, ``mean``, ``log_std``, each ``{"kernel": [in, out], "bias": [out]}``;
- critic: ``hidden_i`` and ``out`` likewise and ``norm_i`` with ``{"scale", "bias"}``, every leaf
  with a leading ensemble axis E.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

Params = dict[str, Any]
"""Nested dict of parameter arrays."""

LOG_STD_MIN = -20.0
LOG_STD_MAX = 2.0
LAYER_NORM_EPSILON = 1e-6


def dot_general(
    lhs: jax.Array, rhs: jax.Array, dimension_numbers: Any, matmul_dtype: str = "float32", **_: Any
) -> jax.Array:
    """Contract in ``matmul_dtype`` with float32 accumulation and result."""
    dtype = jnp.dtype(matmul_dtype)
    return jax.lax.dot_general(
        lhs.astype(dtype),
        rhs.astype(dtype),
        dimension_numbers,
        preferred_element_type=jnp.float32,
    )


class Critic(nn.Module):
    """One Q function: (Dense -> Dropout -> LayerNorm -> ReLU) per hidden layer, then Dense 1.

    The order of the layers is that of DroQ (Hiraoka et al. 2021, Fig. 1).
    """

    hidden_sizes: Sequence[int]
    dropout_rate: float
    matmul_dtype: str = "float32"

    @nn.compact
    def __call__(self, inputs: jax.Array, keep: Sequence[jax.Array] | None = None) -> jax.Array:
        """Return Q [B] of observation-action rows [B, O + A].

        Dropout is always active: DroQ uses it in every loss and in the target.

        Args:
            inputs: Observations and actions side by side.
            keep: One bool mask [B, H] per hidden layer to use in place of random dropout.
        """
        dense = partial(nn.Dense, dot_general=partial(dot_general, matmul_dtype=self.matmul_dtype))
        x = inputs
        for i, size in enumerate(self.hidden_sizes):
            x = dense(size, name=f"hidden_{i}")(x)
            if keep is not None:
                x = jnp.where(keep[i], x / (1.0 - self.dropout_rate), 0.0)
            else:
                x = nn.Dropout(self.dropout_rate, deterministic=False)(x)
            x = nn.relu(nn.LayerNorm(epsilon=LAYER_NORM_EPSILON, name=f"norm_{i}")(x))
        return dense(1, name="out")(x)[..., 0]


def critic_ensemble(
    num_critics: int, hidden_sizes: Sequence[int], dropout_rate: float, matmul_dtype: str
) -> nn.Module:
    """Make ``num_critics`` critics with independent parameters and dropout: inputs -> Q [E, B]."""
    ensemble = nn.vmap(
        Critic,
        variable_axes={"params": 0},
        split_rngs={"params": True, "dropout": True},
        in_axes=(None, 0),  # pyright: ignore[reportArgumentType]
        axis_size=num_critics,
    )
    return ensemble(tuple(hidden_sizes), dropout_rate, matmul_dtype)


def init_critic(
    key: jax.Array, num_critics: int, hidden_sizes: Sequence[int], input_size: int
) -> Params:
    """Draw the parameters of an ensemble of critics over inputs of length O + A."""
    module = critic_ensemble(num_critics, hidden_sizes, 0.0, "float32")
    variables = module.init(key, jnp.zeros((1, input_size)), None)
    return dict(variables["params"])


def init_actor(
    key: jax.Array, hidden_sizes: Sequence[int], obs_size: int, action_size: int
) -> Params:
    """Draw the parameters of an actor: LeCun-normal kernels, zero biases."""
    sizes = [obs_size, *hidden_sizes]
    shapes = {f"hidden_{i}": (sizes[i], sizes[i + 1]) for i in range(len(hidden_sizes))}
    shapes |= {"mean": (sizes[-1], action_size), "log_std": (sizes[-1], action_size)}
    kernel_init = jax.nn.initializers.lecun_normal()
    return {
        name: {"kernel": kernel_init(layer_key, shape), "bias": jnp.zeros(shape[1:])}
        for layer_key, (name, shape) in zip(
            jax.random.split(key, len(shapes)), shapes.items(), strict=True
        )
    }


def num_hidden(params: Params) -> int:
    """Count the hidden layers of an actor or a critic."""
    return sum(name.startswith("hidden_") for name in params)


def actor_distribution(
    params: Params, obs: jax.Array, matmul_dtype: str = "float32"
) -> tuple[jax.Array, jax.Array]:
    """Return the pre-tanh mean and the log standard deviation, [..., A] each.

    Args:
        params: Actor parameters.
        obs: [..., O] observations.
        matmul_dtype: Number format of the operands of the matrix products.
    """
    dot: Callable[..., jax.Array] = partial(_dense, matmul_dtype=matmul_dtype)
    x = obs
    for i in range(num_hidden(params)):
        x = jax.nn.relu(dot(params[f"hidden_{i}"], x))
    log_std = jnp.clip(dot(params["log_std"], x), LOG_STD_MIN, LOG_STD_MAX)
    return dot(params["mean"], x), log_std


def _dense(layer: Params, x: jax.Array, *, matmul_dtype: str) -> jax.Array:
    """Apply one affine layer to [..., in]."""
    dimension_numbers = (((x.ndim - 1,), (0,)), ((), ()))
    return dot_general(x, layer["kernel"], dimension_numbers, matmul_dtype) + layer["bias"]


def act(
    params: Params, obs: jax.Array, noise: jax.Array, matmul_dtype: str = "float32"
) -> tuple[jax.Array, jax.Array]:
    """Return the actor's actions [..., A] and their log-densities [...] in nats.

    Args:
        params: Actor parameters.
        obs: [..., O] observations.
        noise: [..., A] standard normal draws.
        matmul_dtype: Number format of the operands of the matrix products.
    """
    return squash(*actor_distribution(params, obs, matmul_dtype), noise)


def squash(mean: jax.Array, log_std: jax.Array, noise: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return action tanh(u), u = mean + std * noise, and its log-density.

    log pi(a) = sum_j [log N(u_j; mean_j, std_j) - log(1 - tanh(u_j)^2)] (SAC, Haarnoja et al.
    2018, appendix C), with log(1 - tanh(u)^2) = 2 (log 2 - u - softplus(-2 u)), which neither
    overflows nor cancels for large abs(u).

    Args:
        mean: [..., A] pre-tanh mean.
        log_std: [..., A] log standard deviation.
        noise: [..., A] standard normal draws.

    Returns:
        Actions [..., A] in [-1, 1] and log-densities [...] in nats.
    """
    pre_tanh = mean + jnp.exp(log_std) * noise
    log_normal = -0.5 * jnp.square(noise) - log_std - 0.5 * jnp.log(2.0 * jnp.pi)
    log_slope = 2.0 * (jnp.log(2.0) - pre_tanh - jax.nn.softplus(-2.0 * pre_tanh))
    return jnp.tanh(pre_tanh), jnp.sum(log_normal - log_slope, axis=-1)
