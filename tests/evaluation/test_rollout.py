"""Batched evaluation: the first episode only, and shifts together equal shifts one by one."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from twirl_mjx.evaluation.record import record_episode
from twirl_mjx.evaluation.rollout import make_evaluate
from twirl_mjx.evaluation.shifts import evaluate_shifts, scenes_of
from twirl_mjx.policies.scripted import get_scripted
from twirl_mjx.training.presets import make_config
from twirl_mjx.worlds.make import make_env
from twirl_mjx.worlds.vector import EnvState


@pytest.fixture(scope="module")
def config():
    base = make_config("biped", "debug")
    return dataclasses.replace(base.evaluation, num_envs=4, episode_length=12)


def test_scenes_group_the_shifts() -> None:
    groups = scenes_of(("none", "bumpy", "icy", "weakened", "sloped", "gravity"))
    assert groups == {
        "flat": ["none", "icy", "weakened", "gravity"], "bumpy": ["bumpy"], "sloped": ["sloped"],
    }  # fmt: skip


def test_a_broken_step_is_no_measurement(config) -> None:
    env = make_env(config, num_envs=2)

    def act(params: Any, memory: Any, state: EnvState, key: jax.Array) -> tuple:
        broken = (memory == 5) & (jnp.arange(2) == 0)
        return jnp.where(broken[:, None], jnp.nan, jnp.zeros((2, 12))), memory + 1

    values = make_evaluate(env, lambda state: jnp.zeros((), jnp.int32), act)(
        None, jax.random.key(0)
    )
    assert values["invalid"].tolist() == [1.0, 0.0]
    assert values["episode_length"].tolist() == [5.0, 12.0]
    assert (values["min_distance"] > 0.1).all(), "metrics of a broken step are 0"


def test_only_the_first_episode_counts() -> None:
    """Random actions end `stand` within a few steps; later episodes must leave no trace."""
    base = make_config("stand", "debug")
    config = dataclasses.replace(base.evaluation, num_envs=4, episode_length=60)
    env = make_env(config, num_envs=3)

    def act(params: Any, memory: Any, state: EnvState, key: jax.Array) -> tuple:
        return jnp.ones((3, 12)), memory  # a fixed lunge falls over

    evaluate = make_evaluate(env, lambda state: (), act)
    values = evaluate(None, jax.random.key(5))
    assert (values["terminated"] == 1.0).all()
    assert (values["episode_length"] < 60).all()

    state = env.reset(jax.random.split(jax.random.key(5))[0])
    total, length = np.zeros(3), np.zeros(3)
    alive = np.ones(3, bool)
    step = jax.jit(env.step)
    for _ in range(60):
        state = step(state, jnp.ones((3, 12)))
        total += alive * np.asarray(state.reward)
        length += alive
        alive &= ~np.asarray(state.done)
    np.testing.assert_allclose(values["return"], total, rtol=1e-5)
    np.testing.assert_array_equal(values["episode_length"], length)


@pytest.mark.slow
def test_conditions_together_equal_conditions_alone(config) -> None:
    policy = get_scripted("trot")
    together = evaluate_shifts(
        config, policy, episodes=2, seed=3, shifts=("none", "icy", "gravity")
    )
    alone = evaluate_shifts(config, policy, episodes=2, seed=3, shifts=("icy",))
    for name, value in alone["icy"].items():
        np.testing.assert_allclose(together["icy"][name], value, rtol=1e-5, err_msg=name)
    assert not np.allclose(together["none"]["return"], together["gravity"]["return"])


@pytest.mark.slow
def test_recording_has_one_row_per_step(config) -> None:
    recording = record_episode(config, get_scripted("zero"), seed=0, steps=5)
    assert recording.qpos.shape == (5, 19)
    assert recording.goals.shape == (5, 3)
    assert recording.metrics["cosine"].shape == (5,)
    assert recording.hurdles == ()
    assert np.isfinite(recording.qpos).all()


@pytest.mark.slow
def test_goals_of_a_recording_lie_on_the_hill(config) -> None:
    sloped = dataclasses.replace(config, shift="sloped")
    goals = record_episode(sloped, get_scripted("zero"), seed=0, steps=2).goals
    np.testing.assert_allclose(goals, [[1.5, 0.0, np.tan(np.deg2rad(8.0))]] * 2, rtol=1e-5)
