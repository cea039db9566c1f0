"""The same critic updates as ``plain``, arranged for few and large operations on a CPU.

- Dropout bits come from a counter hash (``dropout``) instead of threefry.
- Actor and temperature are constant during a block of U updates, so next actions and log-densities
  of all U minibatches are one large matrix product ahead of the scan.
- Adam and the Polyak average run over one flat parameter vector.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from twirl_mjx.config import DroqConfig
from twirl_mjx.droq import dropout, losses
from twirl_mjx.droq.networks import (
    LAYER_NORM_EPSILON,
    Params,
    actor_distribution,
    dot_general,
    num_hidden,
    squash,
)
from twirl_mjx.droq.state import ADAM_B1, ADAM_B2, ADAM_EPSILON, AdamState, CriticState
from twirl_mjx.types import Metrics, Transition


def critic_q(
    critic: Params,
    obs: jax.Array,
    action: jax.Array,
    config: DroqConfig,
    key: jax.Array,
) -> jax.Array:
    """Return Q [E, B] under fresh dropout; arguments as in ``plain.critic_q``."""
    inputs = jnp.concatenate([obs, action], axis=-1)
    seeds = dropout.seeds(key, (num_hidden(critic),))
    return _ensemble_q(critic, inputs, seeds, config)


def _ensemble_q(
    critic: Params, inputs: jax.Array, seeds: jax.Array, config: DroqConfig
) -> jax.Array:
    """Return Q [E, B] of rows [B, O + A] with the masks of ``seeds`` [layers, 2]."""
    rate = dropout.quantised_rate(config.dropout_rate)
    x = jnp.broadcast_to(inputs, (config.num_critics, *inputs.shape))
    batched = (((2,), (1,)), ((0,), (0,)))
    for i in range(num_hidden(critic)):
        layer, norm = critic[f"hidden_{i}"], critic[f"norm_{i}"]
        x = dot_general(x, layer["kernel"], batched, config.matmul_dtype)
        x = x + layer["bias"][:, None]
        keep = dropout.keep_mask(seeds[i], x.shape, config.dropout_rate)
        x = jnp.where(keep, x / (1.0 - rate), 0.0)
        centred = x - jnp.mean(x, axis=-1, keepdims=True)
        variance = jnp.mean(jnp.square(centred), axis=-1, keepdims=True)
        x = centred * jax.lax.rsqrt(variance + LAYER_NORM_EPSILON)
        x = jax.nn.relu(x * norm["scale"][:, None] + norm["bias"][:, None])
    out = critic["out"]
    return jnp.sum(x * out["kernel"][:, None, :, 0], axis=-1) + out["bias"]


def critic_block(
    state: CriticState,
    actor: Params,
    temperature: jax.Array,
    config: DroqConfig,
    minibatches: Transition,
    next_noise: jax.Array,
    key: jax.Array,
) -> tuple[CriticState, Metrics]:
    """Take U critic steps; arguments and result as in ``plain.critic_block``."""
    mean, log_std = actor_distribution(actor, minibatches.next_obs, config.matmul_dtype)
    next_action, next_log_prob = squash(mean, log_std, next_noise)
    inputs = jnp.concatenate([minibatches.obs, minibatches.action], axis=-1)
    next_inputs = jnp.concatenate([minibatches.next_obs, next_action], axis=-1)
    params, unravel = ravel_pytree(state.critic)
    flat = [params, *(ravel_pytree(t)[0] for t in (state.target_critic, *state.critic_opt[1:]))]
    num_steps = minibatches.reward.shape[0]
    seeds = dropout.seeds(key, (num_steps, 2, num_hidden(state.critic)))
    xs = (inputs, next_inputs, minibatches.reward, minibatches.terminated, next_log_prob, seeds)

    def body(carry: tuple, step: tuple) -> tuple[tuple, Metrics]:
        (params, target_params, mu, nu), count = carry
        x, next_x, reward, terminated, log_prob, seed = step
        next_q = _ensemble_q(unravel(target_params), next_x, seed[1], config)
        target = losses.td_target(
            reward, terminated, next_q, log_prob, temperature, config.discount
        )

        def loss_fn(params: jax.Array) -> tuple[jax.Array, jax.Array]:
            q = _ensemble_q(unravel(params), x, seed[0], config)
            return losses.critic_loss(q, target), q

        (loss, q), grad = jax.value_and_grad(loss_fn, has_aux=True)(params)
        count = count + 1
        flat = _adam_polyak(params, target_params, mu, nu, grad, count, config)
        metrics = {
            "critic_loss": loss,
            "q_mean": jnp.mean(q),
            "target_q_mean": jnp.mean(target),
            "critic_grad_norm": jnp.sqrt(jnp.vdot(grad, grad)),
        }
        return (flat, count), metrics

    (flat, count), metrics = jax.lax.scan(body, (tuple(flat), state.critic_opt.count), xs)
    critic, target_critic, mu, nu = map(unravel, flat)
    state = CriticState(critic, target_critic, AdamState(count, mu, nu))
    return state, jax.tree.map(jnp.mean, metrics)


@partial(jax.named_call, name="adam_polyak")
def _adam_polyak(
    params: jax.Array,
    target_params: jax.Array,
    mu: jax.Array,
    nu: jax.Array,
    grad: jax.Array,
    count: jax.Array,
    config: DroqConfig,
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Take one Adam step and one Polyak step in a single pass over flat vectors."""
    mu = ADAM_B1 * mu + (1.0 - ADAM_B1) * grad
    nu = ADAM_B2 * nu + (1.0 - ADAM_B2) * jnp.square(grad)
    step = count.astype(jnp.float32)
    mu_scale = config.learning_rate / (1.0 - ADAM_B1**step)
    nu_scale = jax.lax.rsqrt(1.0 - ADAM_B2**step)
    params = params - mu_scale * mu / (jnp.sqrt(nu) * nu_scale + ADAM_EPSILON)
    target_params = target_params + config.tau * (params - target_params)
    return params, target_params, mu, nu
