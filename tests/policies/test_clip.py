"""The clip's feed-forward actions as a source: phase of a state, play-back, its worth."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from twirl_mjx.evaluation.rollout import evaluate_policy
from twirl_mjx.motion.clip import sample
from twirl_mjx.motion.leap_checks import feed_forward, inverse_dynamics
from twirl_mjx.policies.clip import ClipPolicy
from twirl_mjx.policies.resolve import resolve_policy
from twirl_mjx.sim.robots import A1
from twirl_mjx.tasks.imitate import load_clip, standing_time
from twirl_mjx.training.presets import make_config
from twirl_mjx.worlds.make import make_env

STEP = 0.05


@pytest.fixture(scope="module")
def policy() -> ClipPolicy:
    return ClipPolicy(load_clip("leap"))


def test_the_phase_of_every_reference_state_is_found(policy: ClipPolicy) -> None:
    clip = load_clip("leap").to_arrays()
    steps = len(policy.actions)
    qpos, qvel = jax.vmap(lambda time: sample(clip, time))(jnp.arange(steps) * STEP)
    moved = qpos.at[:, :2].add(jnp.array([3.0, -1.0]))  # the place does not matter
    np.testing.assert_array_equal(jax.vmap(policy.phase)(moved, qvel), np.arange(steps))


def test_a_robot_at_rest_joins_at_the_standing_time(policy: ClipPolicy) -> None:
    qpos = jnp.concatenate([jnp.array([0, 0, 0.3, 1.0, 0, 0, 0]), jnp.asarray(A1.default_pose)])
    expected = round(standing_time(load_clip("leap")) / STEP)
    assert int(policy.phase(qpos, jnp.zeros(18))) == expected


def test_it_plays_the_planned_actions_and_starts_anew_in_a_new_episode(policy: ClipPolicy) -> None:
    clip = load_clip("leap")
    planned = feed_forward(clip, inverse_dynamics(clip))[0]
    steps = len(planned)
    qpos, qvel = jax.vmap(lambda time: sample(clip.to_arrays(), time))(jnp.array([0.2, 0.5]))

    def state(episode_step: list[int]) -> SimpleNamespace:
        return SimpleNamespace(
            data=SimpleNamespace(qpos=qpos, qvel=qvel),
            world=SimpleNamespace(episode_step=jnp.array(episode_step)),
        )

    key = jax.random.key(0)
    memory = policy.init(state([0, 0]))
    action, memory = policy.act(memory, state([0, 0]), key)
    np.testing.assert_allclose(action, planned[[4, 10]], atol=1e-6)
    for _ in range(steps - 6):
        action, memory = policy.act(memory, state([1, 1]), key)
    np.testing.assert_allclose(action, planned[[(4 + steps - 6) % steps, 4]], atol=1e-6)
    action, memory = policy.act(memory, state([1, 0]), key)  # the second world was reset
    np.testing.assert_allclose(action, planned[[(4 + steps - 5) % steps, 10]], atol=1e-6)


@pytest.mark.slow
def test_it_tracks_better_than_chance_but_not_for_long() -> None:
    config = make_config("imitate", "cpu")
    env = make_env(config.evaluation, num_envs=24, threads=1)
    found = {}
    for name in ("clip", "random"):
        policy = resolve_policy(name, config).policy
        found[name] = evaluate_policy(env, policy)(jax.random.key(5))
    assert found["clip"]["tracking"].mean() > 2.0 * found["random"]["tracking"].mean()
    assert found["clip"]["terminated"].mean() > 0.9


def test_the_clip_is_the_one_of_the_config() -> None:
    config = make_config("imitate", "cpu")
    missing = dataclasses.replace(config.options, clip="no/such/clip.json")
    with pytest.raises(FileNotFoundError, match="no/such/clip"):
        resolve_policy("clip", dataclasses.replace(config, options=missing))
