"""The update as a whole: schedule, counters, targets, dropout keys and the seed axis."""

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from twirl_mjx.droq import learner, losses, networks
from twirl_mjx.droq.config import settings_of
from twirl_mjx.droq.forms import FORMS
from twirl_mjx.droq.state import CriticState

OBS_SIZE, ACTION_SIZE, U = 5, 2, 4

METRICS = {
    "actor_loss",
    "critic_grad_norm",
    "critic_loss",
    "entropy",
    "q_mean",
    "target_q_mean",
    "temperature",
    "temperature_loss",
}

EVERY_FORM = pytest.mark.parametrize(
    # Compiling interpreted kernels takes long, and test_fast.py compares their blocks.
    "form",
    [pytest.param(form, marks=[pytest.mark.slow] * (form == "kernels")) for form in FORMS],
)

# One jitted function per form, shared by the tests, so that equal shapes compile once.
update = jax.jit(learner.update, static_argnums=1)
blocks = {name: jax.jit(form.critic_block, static_argnums=3) for name, form in FORMS.items()}


def in_form(config, form):
    return dataclasses.replace(config, **settings_of(form))


@pytest.fixture
def one_step_config(small_config):
    """Settings of the tests that take a single critic step."""
    return dataclasses.replace(small_config, tau=0.25, discount=0.9)


@pytest.fixture
def state(small_config):
    return learner.init(jax.random.key(0), small_config, OBS_SIZE, ACTION_SIZE)


def largest_change(new, old):
    return jax.tree.map(lambda a, b: float(jnp.abs(a - b).max()), new, old)


@EVERY_FORM
def test_update_is_u_critic_steps_then_one_actor_and_temperature_step(
    state, small_config, transitions, form
):
    """The scan over U equals U calls, and the actor sees the last minibatch and the new critics."""
    config = in_form(small_config, form)
    module = FORMS[form]
    batch = transitions(jax.random.key(1), U, config.batch_size)
    key = jax.random.key(2)
    new, metrics = update(state, config, batch, key)

    next_key, noise_key, critic_key, actor_key = jax.random.split(key, 4)
    noise = jax.random.normal(next_key, batch.action.shape)
    before = CriticState(state.critic, state.target_critic, state.critic_opt)
    after, _ = blocks[form](
        before, state.actor, jnp.exp(state.log_temperature), config, batch, noise, critic_key
    )
    jax.tree.map(
        partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-6), new.critic, after.critic
    )

    last = batch.obs[-1]
    actor_noise = jax.random.normal(noise_key, batch.action.shape[1:])

    def actor_loss(actor):
        mean, log_std = networks.actor_distribution(actor, last)
        action, log_prob = networks.squash(mean, log_std, actor_noise)
        q = module.critic_q(after.critic, last, action, config, actor_key)
        return losses.actor_loss(log_prob, q, jnp.asarray(1.0)), -jnp.mean(log_prob)

    (loss, entropy), grads = jax.jit(jax.value_and_grad(actor_loss, has_aux=True))(state.actor)
    np.testing.assert_allclose(metrics["actor_loss"], loss, rtol=1e-4)
    np.testing.assert_allclose(metrics["entropy"], entropy, rtol=1e-4)
    # The first Adam step moves every parameter by the learning rate against its gradient.
    for path, grad in jax.tree_util.tree_leaves_with_path(grads):
        moved = state.actor[path[0].key][path[1].key] - new.actor[path[0].key][path[1].key]
        clear = np.abs(grad) > 1e-4
        np.testing.assert_allclose(
            np.asarray(moved)[clear], config.learning_rate * np.sign(grad)[clear], rtol=1e-2
        )
    surplus = entropy - learner.target_entropy(config, ACTION_SIZE)
    assert surplus > 0
    np.testing.assert_allclose(new.log_temperature, -config.learning_rate, rtol=1e-3)
    np.testing.assert_allclose(metrics["temperature_loss"], surplus, rtol=1e-4)


@EVERY_FORM
def test_counters_types_and_metrics(state, small_config, transitions, count_traces, form):
    config = in_form(small_config, form)
    counter = count_traces(learner.update)
    step = jax.jit(counter, static_argnums=1)
    new, current = None, state
    for i in range(2):
        batch = transitions(jax.random.key(i), U, config.batch_size)
        new, metrics = step(current, config, batch, jax.random.key(i))
        assert jax.tree.map(jax.typeof, new) == jax.tree.map(jax.typeof, current)
        current = new
    assert counter.traces == 1
    assert int(new.grad_steps) == 2 * U
    assert int(new.critic_opt.count) == 2 * U
    assert int(new.actor_opt.count) == int(new.temperature_opt.count) == 2
    assert set(metrics) == METRICS
    for name, value in metrics.items():
        assert (value.shape, value.dtype) == ((), jnp.float32), name
        assert np.isfinite(value), name
    assert min(jax.tree.leaves(largest_change(new.actor, state.actor))) > 0


@EVERY_FORM
def test_target_moves_by_tau_after_the_critic(state, one_step_config, transitions, form):
    config = one_step_config
    old = CriticState(state.critic, jax.tree.map(lambda x: x + 1.0, state.critic), state.critic_opt)
    batch = transitions(jax.random.key(1), 1, config.batch_size)
    new, _ = blocks[form](
        old, state.actor, jnp.asarray(1.0), config, batch, batch.action, jax.random.key(2)
    )
    expected = jax.tree.map(
        lambda target, critic: 0.75 * target + 0.25 * critic, old.target_critic, new.critic
    )
    jax.tree.map(
        partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-6), new.target_critic, expected
    )
    assert min(jax.tree.leaves(largest_change(new.critic, old.critic))) > 0


@pytest.mark.parametrize("module", FORMS.values(), ids=FORMS)
def test_dropout_tells_keys_and_critics_apart(state, small_config, transitions, module):
    batch = transitions(jax.random.key(1), small_config.batch_size)
    twins = jax.tree.map(lambda x: jnp.stack([x[0], x[0]]), state.critic)
    q = partial(module.critic_q, twins, batch.obs, batch.action)
    first, again = q(small_config, jax.random.key(0)), q(small_config, jax.random.key(0))
    other = q(small_config, jax.random.key(1))
    np.testing.assert_array_equal(first, again)
    assert not np.allclose(first, other, atol=1e-3)
    assert not np.allclose(first[0], first[1], atol=1e-3)
    off = dataclasses.replace(small_config, dropout_rate=0.0)
    calm = q(off, jax.random.key(0))
    np.testing.assert_allclose(calm, q(off, jax.random.key(1)), rtol=1e-6)
    np.testing.assert_allclose(calm[0], calm[1], rtol=1e-6)


@EVERY_FORM
def test_dropout_is_active_in_online_target_and_actor_losses(
    state, one_step_config, transitions, form
):
    """Two keys with the same noise give other targets, other critics and another actor."""
    config = one_step_config
    batch = transitions(jax.random.key(1), 1, config.batch_size)
    old = CriticState(state.critic, state.target_critic, state.critic_opt)
    results = [
        blocks[form](
            old, state.actor, jnp.asarray(1.0), config, batch, batch.action, jax.random.key(i)
        )
        for i in range(2)
    ]
    for name in ("target_q_mean", "q_mean"):
        assert abs(float(results[0][1][name] - results[1][1][name])) > 1e-4, name
    actor_config = in_form(config, form)
    step = jax.jit(
        lambda key: learner.actor_step(state, actor_config, batch.obs[0], batch.action[0], key)[1][
            "actor_loss"
        ]
    )
    actor_losses = [step(jax.random.key(i)) for i in range(2)]
    assert abs(float(actor_losses[0] - actor_losses[1])) > 1e-4


def test_vmapped_seeds_equal_single_seeds(small_config, transitions):
    """Batched products sum in another order: 1e-3 of a value, 1e-4 of parameters near zero."""
    config = small_config
    keys = jax.random.split(jax.random.key(5), 2)
    init = partial(learner.init, config=config, obs_size=OBS_SIZE, action_size=ACTION_SIZE)
    states = jax.vmap(init)(keys)
    batch = transitions(jax.random.key(1), 2, U, config.batch_size)
    batched, metrics = jax.jit(jax.vmap(lambda s, b, k: learner.update(s, config, b, k)))(
        states, batch, keys
    )
    for i in range(2):
        pick = partial(jax.tree.map, lambda x, i=i: x[i])
        single, single_metrics = update(pick(states), config, pick(batch), keys[i])
        jax.tree.map(
            partial(np.testing.assert_allclose, rtol=1e-3, atol=1e-4), pick(batched), single
        )
        jax.tree.map(
            partial(np.testing.assert_allclose, rtol=1e-3, atol=1e-4),
            pick(metrics),
            single_metrics,
        )
    assert max(jax.tree.leaves(largest_change(pick(batched).critic, single.critic))) < 1e-3
    assert not np.allclose(metrics["critic_loss"][0], metrics["critic_loss"][1])


def test_acting(state):
    obs = jax.random.normal(jax.random.key(0), (3, 4, OBS_SIZE))
    mean = learner.mean_action(state.actor, obs)
    assert mean.shape == (3, 4, ACTION_SIZE)
    distribution, _ = networks.actor_distribution(state.actor, obs)
    np.testing.assert_allclose(mean, np.tanh(distribution), rtol=1e-6)
    drawn = [learner.sample_action(state.actor, obs, jax.random.key(i)) for i in (0, 0, 1)]
    np.testing.assert_array_equal(drawn[0], drawn[1])
    assert not np.array_equal(drawn[0], drawn[2])
    assert float(jnp.abs(drawn[0]).max()) <= 1.0


def test_target_entropy_defaults_to_minus_half_the_actions(small_config):
    assert learner.target_entropy(small_config, 12) == -6.0
    assert learner.target_entropy(dataclasses.replace(small_config, target_entropy=-2.0), 12) == -2
