"""DroQ: soft actor-critic with dropout and layer norm in the critics and many updates per step.

Hiraoka et al. 2021, "Dropout Q-functions for doubly efficient reinforcement learning", with the
update schedule of the TWiRL paper: every critic update has a minibatch of its own and is followed
by a Polyak step; the actor and the temperature are updated once per block, on the last minibatch.

All functions are pure and may be vmapped over a leading seed axis of state, minibatches and key.
"""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp

from twirl_mjx.droq import forms, losses, networks, plain
from twirl_mjx.droq.config import DroqConfig
from twirl_mjx.droq.networks import Params
from twirl_mjx.droq.state import CriticState, DroqState, adam_init, adam_step
from twirl_mjx.types import Learner, MetricInfo, Metrics, Transition

__all__ = ["LEARNER", "DroqState", "init", "mean_action", "sample_action", "update"]


@functools.partial(jax.jit, static_argnums=(1, 2, 3))
def init(key: jax.Array, config: DroqConfig, obs_size: int, action_size: int) -> DroqState:
    """Draw fresh networks for observations of length O and actions of length A."""
    actor_key, critic_key = jax.random.split(key)
    actor = networks.init_actor(actor_key, config.hidden_sizes, obs_size, action_size)
    critic = networks.init_critic(
        critic_key, config.num_critics, config.hidden_sizes, obs_size + action_size
    )
    log_temperature = jnp.log(jnp.asarray(config.initial_temperature, jnp.float32))
    return DroqState(
        actor=actor,
        critic=critic,
        target_critic=jax.tree.map(jnp.copy, critic),
        actor_opt=adam_init(actor),
        critic_opt=adam_init(critic),
        log_temperature=log_temperature,
        temperature_opt=adam_init(log_temperature),
        grad_steps=jnp.zeros((), jnp.int32),
    )


def sample_action(actor: Params, obs: jax.Array, key: jax.Array) -> jax.Array:
    """Draw actions [..., A] in [-1, 1] from the policy at observations [..., O]."""
    mean, log_std = networks.actor_distribution(actor, obs)
    noise = jax.random.normal(key, mean.shape, mean.dtype)
    return jnp.tanh(mean + jnp.exp(log_std) * noise)


def mean_action(actor: Params, obs: jax.Array) -> jax.Array:
    """Return the deterministic actions tanh(mean), [..., A], at observations [..., O]."""
    return jnp.tanh(networks.actor_distribution(actor, obs)[0])


def value(state: DroqState, config: DroqConfig, obs: jax.Array, action: jax.Array) -> jax.Array:
    """Return the least of the target critics' values [B] of actions [B, A], without dropout."""
    config = dataclasses.replace(config, dropout_rate=0.0)
    q = plain.critic_q(state.target_critic, obs, action, config, jax.random.key(0))
    return jnp.min(q, axis=0)


def target_entropy(config: DroqConfig, action_size: int) -> float:
    """Return the entropy set-point in nats: the configured one, else -A/2."""
    return -0.5 * action_size if config.target_entropy is None else config.target_entropy


def update(
    state: DroqState, config: DroqConfig, minibatches: Transition, key: jax.Array
) -> tuple[DroqState, Metrics]:
    """Take U critic steps, then one actor and one temperature step on the last minibatch.

    Args:
        state: Learner state.
        config: Learner settings; static under jit.
        minibatches: Transitions [U, B, ...], one minibatch per critic step.
        key: Random key of the block (actor noise and dropout).

    Returns:
        The state after the block, and float32 scalars: means over the U critic steps, and the
        values of the one actor and temperature step.
    """
    next_key, noise_key, critic_key, actor_key = jax.random.split(key, 4)
    next_noise = jax.random.normal(next_key, minibatches.action.shape)
    critic_state = CriticState(state.critic, state.target_critic, state.critic_opt)
    critic_state, critic_metrics = forms.form_of(config).critic_block(
        critic_state,
        state.actor,
        jnp.exp(state.log_temperature),
        config,
        minibatches,
        next_noise,
        critic_key,
    )
    state = state.replace(
        critic=critic_state.critic,
        target_critic=critic_state.target_critic,
        critic_opt=critic_state.critic_opt,
        grad_steps=state.grad_steps + minibatches.reward.shape[0],
    )
    noise = jax.random.normal(noise_key, minibatches.action.shape[1:])
    state, actor_metrics = actor_step(state, config, minibatches.obs[-1], noise, actor_key)
    return state, critic_metrics | actor_metrics


def actor_step(
    state: DroqState, config: DroqConfig, obs: jax.Array, noise: jax.Array, key: jax.Array
) -> tuple[DroqState, Metrics]:
    """Take one actor step at observations [B, O], then one temperature step.

    Args:
        state: Learner state.
        config: Learner settings.
        obs: [B, O] observations.
        noise: [B, A] standard normal draws behind the actions.
        key: Random key of the critics' dropout masks.

    Returns:
        The state with another actor and temperature, and metrics.
    """
    temperature = jnp.exp(state.log_temperature)
    critic_q = forms.form_of(config).critic_q

    def actor_loss_fn(actor: Params) -> tuple[jax.Array, jax.Array]:
        action, log_prob = networks.act(actor, obs, noise, config.matmul_dtype)
        q = critic_q(state.critic, obs, action, config, key)
        return losses.actor_loss(log_prob, q, temperature), -jnp.mean(log_prob)

    (actor_loss, entropy), grads = jax.value_and_grad(actor_loss_fn, has_aux=True)(state.actor)
    actor, actor_opt = adam_step(state.actor, grads, state.actor_opt, config.learning_rate)
    temperature_loss, grad = jax.value_and_grad(losses.temperature_loss)(
        state.log_temperature, entropy, target_entropy(config, noise.shape[-1])
    )
    log_temperature, temperature_opt = adam_step(
        state.log_temperature, grad, state.temperature_opt, config.learning_rate
    )
    metrics = {
        "actor_loss": actor_loss,
        "entropy": entropy,
        "temperature": temperature,
        "temperature_loss": temperature_loss,
    }
    state = state.replace(
        actor=actor,
        actor_opt=actor_opt,
        log_temperature=log_temperature,
        temperature_opt=temperature_opt,
    )
    return state, metrics


METRICS = {
    "critic_loss": MetricInfo("squared TD error, mean over ensemble and rows", "1"),
    "actor_loss": MetricInfo("temperature * log_prob - mean critic value", "1"),
    "temperature": MetricInfo("SAC's alpha, the weight of the entropy", "1"),
    "q_mean": MetricInfo("critic value of the minibatch actions", "1"),
    "target_q_mean": MetricInfo("TD target", "1"),
    "critic_grad_norm": MetricInfo("Euclidean norm of the critic gradient", "1"),
    "entropy": MetricInfo("policy entropy, -log_prob of sampled actions", "nat"),
    "temperature_loss": MetricInfo("temperature * (entropy - target entropy)", "1"),
}
"""What ``update`` reports: means over critic updates, or values of the one actor update."""

LEARNER = Learner("droq", DroqConfig, init, sample_action, mean_action, update, METRICS, value)
