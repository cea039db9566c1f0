"""Shapes and order of the networks, and the density of the tanh-Gaussian."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import scipy.stats

from twirl_mjx.droq import networks

OBS_SIZE, ACTION_SIZE = 5, 2


def test_parameter_names_and_shapes():
    actor = networks.init_actor(jax.random.key(0), (8, 6), OBS_SIZE, ACTION_SIZE)
    assert jax.tree.map(jnp.shape, actor) == {
        "hidden_0": {"kernel": (5, 8), "bias": (8,)},
        "hidden_1": {"kernel": (8, 6), "bias": (6,)},
        "mean": {"kernel": (6, 2), "bias": (2,)},
        "log_std": {"kernel": (6, 2), "bias": (2,)},
    }
    critic = networks.init_critic(jax.random.key(0), 3, (8, 6), OBS_SIZE + ACTION_SIZE)
    assert jax.tree.map(jnp.shape, critic) == {
        "hidden_0": {"kernel": (3, 7, 8), "bias": (3, 8)},
        "hidden_1": {"kernel": (3, 8, 6), "bias": (3, 6)},
        "norm_0": {"scale": (3, 8), "bias": (3, 8)},
        "norm_1": {"scale": (3, 6), "bias": (3, 6)},
        "out": {"kernel": (3, 6, 1), "bias": (3, 1)},
    }


def test_ensemble_members_have_their_own_parameters():
    critic = networks.init_critic(jax.random.key(0), 2, (8,), 4)
    for name in ("hidden_0", "out"):
        assert not jnp.array_equal(critic[name]["kernel"][0], critic[name]["kernel"][1])


def dropped_by_hand(critic, inputs, keep, rate):
    """Compute Q [E, B] with numpy: Dense, Dropout, LayerNorm, ReLU, Dense."""
    values = []
    for e in range(keep.shape[0]):
        p = jax.tree.map(lambda x, e=e: np.asarray(x[e], np.float64), critic)
        x = inputs @ p["hidden_0"]["kernel"] + p["hidden_0"]["bias"]
        x = np.where(keep[e], x / (1 - rate), 0.0)
        x = (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + 1e-6)
        x = np.maximum(x * p["norm_0"]["scale"] + p["norm_0"]["bias"], 0.0)
        values.append(x @ p["out"]["kernel"][:, 0] + p["out"]["bias"])
    return np.stack(values)


def test_dropout_comes_before_layer_norm_and_relu_after_it():
    critic = networks.init_critic(jax.random.key(0), 2, (16,), 4)
    critic = jax.tree.map(lambda x: x + 0.3 * jnp.cos(jnp.arange(x.size)).reshape(x.shape), critic)
    inputs = jax.random.normal(jax.random.key(1), (6, 4))
    keep = jax.random.bernoulli(jax.random.key(2), 0.6, (2, 6, 16))
    module = networks.critic_ensemble(2, (16,), 0.4, "float32")
    q = module.apply({"params": critic}, inputs, [keep])
    expected = dropped_by_hand(critic, np.asarray(inputs), np.asarray(keep), 0.4)
    np.testing.assert_allclose(q, expected, rtol=1e-4, atol=1e-5)


def test_log_density_equals_scipy_and_numerical_change_of_variables():
    keys = jax.random.split(jax.random.key(0), 3)
    mean = jax.random.normal(keys[0], (50, 3))
    log_std = jax.random.uniform(keys[1], (50, 3), minval=-2.0, maxval=0.3)
    noise = jax.random.normal(keys[2], (50, 3))
    action, log_prob = networks.squash(mean, log_std, noise)
    std = np.exp(np.asarray(log_std, np.float64))
    u = np.asarray(mean, np.float64) + std * np.asarray(noise, np.float64)
    np.testing.assert_allclose(action, np.tanh(u), rtol=1e-4, atol=1e-6)
    normal = scipy.stats.norm.logpdf(u, mean, std)
    expected = (normal - np.log(1.0 / np.cosh(u) ** 2)).sum(-1)
    np.testing.assert_allclose(log_prob, expected, rtol=1e-4, atol=1e-4)
    slope = (np.tanh(u + 1e-5) - np.tanh(u - 1e-5)) / 2e-5
    np.testing.assert_allclose(log_prob, (normal - np.log(slope)).sum(-1), rtol=1e-4, atol=1e-3)


def test_density_integrates_to_one():
    u = jnp.linspace(-12.0, 12.0, 20001)
    mean, log_std = jnp.full((u.size, 1), 0.4), jnp.full((u.size, 1), -0.5)
    noise = (u[:, None] - mean) / jnp.exp(log_std)
    action, log_prob = networks.squash(mean, log_std, noise)
    area = np.trapezoid(np.exp(np.asarray(log_prob, np.float64)), np.asarray(action[:, 0]))
    np.testing.assert_allclose(area, 1.0, atol=2e-3)


def test_saturated_actions_have_finite_densities_and_gradients():
    def total(mean):
        action, log_prob = networks.squash(mean, jnp.full((4, 1), 2.0), jnp.ones((4, 1)))
        return jnp.sum(log_prob) + jnp.sum(action)

    mean = jnp.asarray([[-100.0], [-20.0], [20.0], [100.0]])
    value, grad = jax.value_and_grad(total)(mean)
    assert np.isfinite(value)
    # d log pi / d u = 2 tanh(u) in the tails: the pull back towards the middle never vanishes.
    np.testing.assert_allclose(grad[:, 0], [-2.0, -2.0, 2.0, 2.0], rtol=1e-4)


def test_log_std_is_clipped():
    actor = networks.init_actor(jax.random.key(0), (8,), OBS_SIZE, ACTION_SIZE)
    for bias, limit in ((1e3, 2.0), (-1e3, -20.0)):
        actor["log_std"]["bias"] = jnp.full(ACTION_SIZE, bias)
        log_std = networks.actor_distribution(actor, jnp.ones((3, OBS_SIZE)))[1]
        np.testing.assert_array_equal(log_std, jnp.full((3, ACTION_SIZE), limit))
