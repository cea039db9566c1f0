"""Critic updates written the obvious way: flax.linen, optax, autodiff and threefry dropout.

The reference that the other forms are tested and timed against; chosen with ``fast=False``.
"""

from __future__ import annotations

from collections.abc import Sequence

import flax.linen as nn
import jax
import jax.numpy as jnp

from twirl_mjx.droq import losses
from twirl_mjx.droq.config import DroqConfig
from twirl_mjx.droq.dropout import quantised_rate
from twirl_mjx.droq.networks import Params, act, critic_ensemble
from twirl_mjx.droq.state import CriticState, adam_step, polyak, squared_norm
from twirl_mjx.types import Metrics, Transition

Keep = Sequence[jax.Array]
"""One bool mask [E, B, H] per hidden layer."""


def _module(config: DroqConfig) -> nn.Module:
    """Make the ensemble of critics that the config describes."""
    rate = quantised_rate(config.dropout_rate)
    return critic_ensemble(config.num_critics, config.hidden_sizes, rate, config.matmul_dtype)


def critic_q(
    critic: Params,
    obs: jax.Array,
    action: jax.Array,
    config: DroqConfig,
    key: jax.Array,
    keep: Keep | None = None,
) -> jax.Array:
    """Return Q [E, B] under fresh dropout.

    Args:
        critic: Ensemble parameters.
        obs: [B, O].
        action: [B, A].
        config: Learner settings.
        key: Random key of the dropout masks.
        keep: Masks to use instead of random ones.
    """
    inputs = jnp.concatenate([obs, action], axis=-1)
    masks = None if keep is None else list(keep)
    q = _module(config).apply({"params": critic}, inputs, masks, rngs={"dropout": key})
    return jnp.asarray(q)


def critic_step(
    state: CriticState,
    actor: Params,
    temperature: jax.Array,
    config: DroqConfig,
    minibatch: Transition,
    next_noise: jax.Array,
    key: jax.Array,
    keep: tuple[Keep, Keep] | None = None,
) -> tuple[CriticState, Metrics]:
    """Take one gradient step on the critics, then one Polyak step on their targets.

    Args:
        state: Critics before the step.
        actor: Actor parameters.
        temperature: [] alpha.
        config: Learner settings.
        minibatch: Transitions [B, ...].
        next_noise: [B, A] standard normal draws behind a'.
        key: Random key of the dropout masks.
        keep: Masks of the online and of the target critics, instead of random ones.

    Returns:
        Critics after the step, and metrics.
    """
    online_key, target_key = jax.random.split(key)
    online_keep, target_keep = (None, None) if keep is None else keep
    next_action, next_log_prob = act(actor, minibatch.next_obs, next_noise, config.matmul_dtype)
    next_q = critic_q(
        state.target_critic, minibatch.next_obs, next_action, config, target_key, target_keep
    )
    target = losses.td_target(
        minibatch.reward,
        minibatch.terminated,
        next_q,
        next_log_prob,
        temperature,
        config.discount,
    )

    def loss_fn(critic: Params) -> tuple[jax.Array, jax.Array]:
        q = critic_q(critic, minibatch.obs, minibatch.action, config, online_key, online_keep)
        return losses.critic_loss(q, target), q

    (loss, q), grads = jax.value_and_grad(loss_fn, has_aux=True)(state.critic)
    critic, opt = adam_step(state.critic, grads, state.critic_opt, config.learning_rate)
    metrics = {
        "critic_loss": loss,
        "q_mean": jnp.mean(q),
        "target_q_mean": jnp.mean(target),
        "critic_grad_norm": jnp.sqrt(squared_norm(grads)),
    }
    target_critic = polyak(state.target_critic, critic, config.tau)
    return CriticState(critic, target_critic, opt), metrics


def critic_block(
    state: CriticState,
    actor: Params,
    temperature: jax.Array,
    config: DroqConfig,
    minibatches: Transition,
    next_noise: jax.Array,
    key: jax.Array,
) -> tuple[CriticState, Metrics]:
    """Take U critic steps; actor and temperature stay as they are.

    Args:
        state: Critics before the block.
        actor: Actor parameters.
        temperature: [] alpha.
        config: Learner settings.
        minibatches: Transitions [U, B, ...], one minibatch per step.
        next_noise: [U, B, A] standard normal draws behind a'.
        key: Random key of the dropout masks.

    Returns:
        Critics after U steps, and the mean of the metrics over the block.
    """

    def body(carry: CriticState, step: tuple) -> tuple[CriticState, Metrics]:
        minibatch, noise, step_key = step
        return critic_step(carry, actor, temperature, config, minibatch, noise, step_key)

    keys = jax.random.split(key, minibatches.reward.shape[0])
    state, metrics = jax.lax.scan(body, state, (minibatches, next_noise, keys))
    return state, jax.tree.map(jnp.mean, metrics)
