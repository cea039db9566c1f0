"""Five tiny decision problems, each of which needs one more part of the learner to work.

Transitions are made directly from the policy's own actions; there is no simulator. A wrong value
names the broken part: 1 the value loss, 2 the dependence on observations, 3 the bootstrap and its
discount, 4 the actor, 5 the actor's dependence on observations.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from twirl_mjx.droq import fast, learner, plain
from twirl_mjx.droq.config import DroqConfig
from twirl_mjx.types import Transition

BATCH, U, BLOCKS = 64, 10, 60
Probe = Callable[[jax.Array, jax.Array], tuple[jax.Array, jax.Array, jax.Array]]
"""Maps obs [N, 1] and action [N, 1] to reward [N], terminated [N], next_obs [N, 1]."""


def constant_reward(obs, action):
    return jnp.ones(obs.shape[0]), jnp.ones(obs.shape[0], bool), obs


def reward_is_observation(obs, action):
    return obs[:, 0], jnp.ones(obs.shape[0], bool), obs


def delayed_reward(obs, action):
    """From -1 to +1 without reward; reward 1 and the end at +1."""
    at_end = obs[:, 0] > 0
    return at_end.astype(jnp.float32), at_end, jnp.ones_like(obs)


def reward_from_action(obs, action):
    return -jnp.square(action[:, 0] - 0.5), jnp.ones(obs.shape[0], bool), obs


def action_should_follow_observation(obs, action):
    return -jnp.square(action[:, 0] - 0.6 * obs[:, 0]), jnp.ones(obs.shape[0], bool), obs


def draw(probe: Probe, actor, key: jax.Array) -> Transition:
    """Draw U minibatches: observations -1 or +1, actions half random and half the policy's."""
    obs_key, act_key, mix_key, random_key = jax.random.split(key, 4)
    num = U * BATCH
    obs = jnp.where(jax.random.bernoulli(obs_key, 0.5, (num, 1)), 1.0, -1.0)
    own = learner.sample_action(actor, obs, act_key)
    random = jax.random.uniform(random_key, own.shape, minval=-1.0)
    action = jnp.where(jax.random.bernoulli(mix_key, 0.5, own.shape), own, random)
    reward, terminated, next_obs = probe(obs, action)
    rows = Transition(obs, action, reward, terminated, next_obs)
    return jax.tree.map(lambda x: x.reshape(U, BATCH, *x.shape[1:]), rows)


def solve(probe: Probe, *, is_fast: bool = True):
    """Train on a probe; return mean actions and Q at observations -1 and +1."""
    config = DroqConfig(
        hidden_sizes=(32, 32),
        batch_size=BATCH,
        discount=0.5,
        learning_rate=5e-3,
        tau=0.05,
        initial_temperature=1e-3,
        target_entropy=-2.0,
        fast=is_fast,
    )

    @jax.jit
    def train(state, key):
        def block(state, key):
            draw_key, update_key = jax.random.split(key)
            batch = draw(probe, state.actor, draw_key)
            return learner.update(state, config, batch, update_key)[0], None

        return jax.lax.scan(block, state, jax.random.split(key, BLOCKS))[0]

    state = train(learner.init(jax.random.key(0), config, 1, 1), jax.random.key(1))
    obs = jnp.asarray([[-1.0], [1.0]])
    action = learner.mean_action(state.actor, obs)
    module = fast if is_fast else plain
    q = module.critic_q(state.critic, obs, action, config, jax.random.key(2))
    return np.asarray(action[:, 0]), np.asarray(q)


BOTH = pytest.mark.parametrize("is_fast", [True, pytest.param(False, marks=pytest.mark.slow)])


@BOTH
def test_probe_1_value_of_a_constant_reward(is_fast):
    _, q = solve(constant_reward, is_fast=is_fast)
    np.testing.assert_allclose(q, 1.0, atol=0.1)


def test_probe_2_value_depends_on_the_observation():
    _, q = solve(reward_is_observation)
    np.testing.assert_allclose(q, [[-1.0, 1.0]] * 2, atol=0.15)


def test_probe_3_reward_is_discounted_by_one_step():
    _, q = solve(delayed_reward)
    np.testing.assert_allclose(q, [[0.5, 1.0]] * 2, atol=0.1)


def test_probe_4_actor_finds_the_best_action():
    action, q = solve(reward_from_action)
    np.testing.assert_allclose(action, 0.5, atol=0.15)
    np.testing.assert_allclose(q, 0.0, atol=0.15)


@BOTH
def test_probe_5_actor_follows_the_observation(is_fast):
    action, _ = solve(action_should_follow_observation, is_fast=is_fast)
    np.testing.assert_allclose(action, [-0.6, 0.6], atol=0.15)
