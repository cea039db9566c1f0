"""Losses against numbers worked out by hand."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from twirl_mjx.droq import losses


def test_td_target_by_hand():
    """y = r + 0.9 (min - 0.5 log pi), and only r where the episode terminated."""
    target = losses.td_target(
        reward=jnp.asarray([1.0, 2.0, -3.0]),
        terminated=jnp.asarray([False, True, False]),
        next_q=jnp.asarray([[10.0, 7.0, 4.0], [8.0, 9.0, 6.0]]),
        next_log_prob=jnp.asarray([2.0, 1.0, -4.0]),
        temperature=jnp.asarray(0.5),
        discount=0.9,
    )
    # 1 + 0.9 (8 - 1); terminated; -3 + 0.9 (4 + 2)
    np.testing.assert_allclose(target, [7.3, 2.0, 2.4], rtol=1e-6)


def test_termination_cuts_even_an_infinite_value():
    target = losses.td_target(
        jnp.asarray([1.5]),
        jnp.asarray([True]),
        jnp.asarray([[jnp.inf], [jnp.inf]]),
        jnp.asarray([0.0]),
        jnp.asarray(1.0),
        0.99,
    )
    np.testing.assert_array_equal(target, [1.5])


def test_no_gradient_flows_through_the_target():
    def loss(next_q, next_log_prob, temperature):
        target = losses.td_target(
            jnp.zeros(2), jnp.zeros(2, bool), next_q, next_log_prob, temperature, 0.9
        )
        return losses.critic_loss(jnp.ones((2, 2)), target)

    args = (jnp.ones((2, 2)), jnp.ones(2), jnp.asarray(0.5))
    for grad in jax.grad(loss, argnums=(0, 1, 2))(*args):
        np.testing.assert_array_equal(grad, jnp.zeros_like(grad))


def test_critic_loss_is_the_mean_over_ensemble_and_rows():
    q = jnp.asarray([[1.0, 2.0], [3.0, 5.0]])
    target = jnp.asarray([0.0, 1.0])
    assert losses.critic_loss(q, target) == pytest.approx((1 + 1 + 9 + 16) / 4)


def test_actor_loss_uses_the_mean_of_the_ensemble():
    q = jnp.asarray([[1.0, 10.0], [3.0, 0.0]])
    log_prob = jnp.asarray([2.0, -1.0])
    # mean of (0.5 * 2 - 2, 0.5 * -1 - 5); the minimum would give -0.25
    loss = losses.actor_loss(log_prob, q, jnp.asarray(0.5))
    assert loss == pytest.approx(-3.25)
    # Both critics pull on the action equally.
    grad = jax.grad(lambda q: losses.actor_loss(log_prob, q, jnp.asarray(0.5)))(q)
    np.testing.assert_allclose(grad, np.full((2, 2), -0.25))


def test_temperature_falls_when_the_policy_is_more_random_than_asked():
    grad = jax.grad(losses.temperature_loss)
    log_temperature = jnp.log(jnp.asarray(0.5))
    assert losses.temperature_loss(log_temperature, jnp.asarray(2.0), -6.0) == pytest.approx(4.0)
    # Descent moves against the gradient.
    assert grad(log_temperature, jnp.asarray(2.0), -6.0) == pytest.approx(4.0)
    assert grad(log_temperature, jnp.asarray(-7.0), -6.0) == pytest.approx(-0.5)
