"""The losses of DroQ, each with its equation; pure functions of network outputs."""

from __future__ import annotations

import jax
import jax.numpy as jnp


def td_target(
    reward: jax.Array,
    terminated: jax.Array,
    next_q: jax.Array,
    next_log_prob: jax.Array,
    temperature: jax.Array,
    discount: float,
) -> jax.Array:
    """Return y = r + gamma (1 - terminated) [min_i Q'_i(s', a') - alpha log pi(a'|s')].

    Hiraoka et al. 2021, Algorithm 2, line 6. A truncated transition is not terminated, so it
    bootstraps from its true successor.

    Args:
        reward: [B].
        terminated: [B] bool.
        next_q: [E, B] target critics at the next observation and a' ~ pi.
        next_log_prob: [B] log pi(a'|s'), nats.
        temperature: [] alpha.
        discount: gamma.

    Returns:
        [B] targets, cut from the gradient.
    """
    next_value = jnp.min(next_q, axis=0) - temperature * next_log_prob
    target = reward + discount * jnp.where(terminated, 0.0, next_value)
    return jax.lax.stop_gradient(target)


def critic_loss(q: jax.Array, target: jax.Array) -> jax.Array:
    """Return the mean over ensemble and rows of (Q_i - y)^2 (Algorithm 2, line 8).

    Args:
        q: [E, B] critics.
        target: [B] targets y.
    """
    return jnp.mean(jnp.square(q - target))


def actor_loss(log_prob: jax.Array, q: jax.Array, temperature: jax.Array) -> jax.Array:
    """Return mean(alpha log pi(a|s) - mean_i Q_i(s, a)) (Algorithm 2, line 10).

    DroQ takes the mean of the ensemble here and the minimum only in the target.

    Args:
        log_prob: [B] log pi(a|s), nats.
        q: [E, B] critics at the actor's own action.
        temperature: [] alpha.
    """
    return jnp.mean(temperature * log_prob - jnp.mean(q, axis=0))


def temperature_loss(
    log_temperature: jax.Array, entropy: jax.Array, target_entropy: float
) -> jax.Array:
    """Return alpha (H - H_target) with H = -mean log pi held fixed (SAC, Haarnoja et al. 2018).

    The gradient lowers alpha while the policy is more random than asked, and raises it otherwise.

    Args:
        log_temperature: [] log alpha.
        entropy: [] policy entropy, nats.
        target_entropy: H_target, nats.
    """
    return jnp.exp(log_temperature) * (jax.lax.stop_gradient(entropy) - target_entropy)
