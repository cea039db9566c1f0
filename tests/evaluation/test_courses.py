"""Courses that ``twirl evaluate`` can be asked for."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
import pytest

from twirl_mjx.commands.evaluate import EvaluateOptions, on_course
from twirl_mjx.training.presets import make_config
from twirl_mjx.worlds.make import make_env


def goals(options: EvaluateOptions) -> np.ndarray:
    env = make_env(on_course(make_config("biped"), options), num_envs=8)
    return np.asarray(env.reset(jax.random.key(0)).world.goal)


def bands(options: EvaluateOptions) -> np.ndarray:
    env = make_env(on_course(make_config("hurdles"), options), num_envs=4)
    return np.asarray(env.reset(jax.random.key(0)).world.task.positions)


def test_fixed_goal_is_straight_ahead() -> None:
    np.testing.assert_allclose(goals(EvaluateOptions(())), [[1.5, 0.0]] * 8)
    np.testing.assert_allclose(goals(EvaluateOptions((), goal_distance=1.0)), [[1.0, 0.0]] * 8)


def test_random_goals_of_one_distance_lie_all_around() -> None:
    found = goals(EvaluateOptions((), course="random", goal_distance=1.0))
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0, rtol=1e-5)
    assert np.ptp(np.arctan2(found[:, 1], found[:, 0])) > 1.0


@pytest.mark.parametrize("course", ["fixed", "random"])
def test_hurdles_are_a_given_gap_apart(course: str) -> None:
    found = bands(EvaluateOptions((), course=course, hurdle_gap=2.8))  # type: ignore[arg-type]
    np.testing.assert_allclose(np.diff(found, axis=1), 2.8, rtol=1e-4)
    np.testing.assert_allclose(found[:, 0], 2.8, rtol=1e-4)


def test_random_hurdles_are_those_of_training() -> None:
    gaps = np.diff(bands(EvaluateOptions((), course="random")), axis=1)
    assert gaps.min() >= 1.6 - 1e-4
    assert gaps.max() <= 2.6 + 1e-4
    assert np.ptp(gaps) > 0.5


def test_random_hurdles_of_other_gaps() -> None:
    options = EvaluateOptions((), course="random", hurdle_gaps=(2.8, 3.6))
    gaps = np.diff(bands(options), axis=1)
    assert gaps.min() >= 2.8 - 1e-4
    assert gaps.max() <= 3.6 + 1e-4
    assert np.ptp(gaps) > 0.4


@pytest.mark.parametrize("changes", [{"course": "fixed"}, {"hurdle_gap": 2.0}])
def test_random_gaps_need_the_random_course(changes: dict[str, Any]) -> None:
    options = EvaluateOptions((), **{"course": "random", "hurdle_gaps": (1.6, 2.6), **changes})
    with pytest.raises(ValueError, match=r"hurdle_gaps 1.6 2.6 .*nearest: add --course random"):
        on_course(make_config("hurdles"), options)
