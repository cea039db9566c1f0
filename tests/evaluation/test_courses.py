"""Courses that ``twirl evaluate`` can be asked for."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import numpy as np
import pytest

from twirl_mjx.commands.options import with_overrides
from twirl_mjx.worlds.config import WorldConfig
from twirl_mjx.worlds.make import make_env


def first_state(task: str, course: Any, num_envs: int, **options: Any) -> Any:
    config = with_overrides(WorldConfig(task=task, course=course), {task: options})
    return make_env(dataclasses.replace(config, num_envs=num_envs)).reset(jax.random.key(0))


def goals(course: str = "fixed", **options: Any) -> np.ndarray:
    return np.asarray(first_state("biped", course, 8, **options).world.goal)


def bands(course: str = "fixed", **options: Any) -> np.ndarray:
    return np.asarray(first_state("hurdles", course, 4, **options).world.task.positions)


def test_fixed_goal_is_straight_ahead() -> None:
    np.testing.assert_allclose(goals(), [[1.5, 0.0]] * 8)
    np.testing.assert_allclose(goals(goal_distance=1.0), [[1.0, 0.0]] * 8)


def test_random_goals_of_one_distance_lie_all_around() -> None:
    found = goals("random", goal_distance=1.0)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0, rtol=1e-5)
    assert np.ptp(np.arctan2(found[:, 1], found[:, 0])) > 1.0


@pytest.mark.parametrize("course", ["fixed", "random"])
def test_hurdles_are_a_given_gap_apart(course: str) -> None:
    found = bands(course, gap=2.8)
    np.testing.assert_allclose(np.diff(found, axis=1), 2.8, rtol=1e-4)
    np.testing.assert_allclose(found[:, 0], 2.8, rtol=1e-4)


def test_random_hurdles_are_those_of_training() -> None:
    gaps = np.diff(bands("random"), axis=1)
    assert gaps.min() >= 1.6 - 1e-4
    assert gaps.max() <= 2.6 + 1e-4
    assert np.ptp(gaps) > 0.5


def test_random_hurdles_of_other_gaps() -> None:
    gaps = np.diff(bands("random", min_gap=2.8, max_gap=3.6), axis=1)
    assert gaps.min() >= 2.8 - 1e-4
    assert gaps.max() <= 3.6 + 1e-4
    assert np.ptp(gaps) > 0.4


def test_options_of_another_task_are_refused() -> None:
    with pytest.raises(ValueError, match=r"hurdles\.gap is an option of task hurdles, not"):
        with_overrides(WorldConfig(task="biped"), {"hurdles": {"gap": 2.0}})
