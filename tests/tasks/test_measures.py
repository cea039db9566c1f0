"""Episode measures by hand: folds, scales, success, reset."""

from __future__ import annotations

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from twirl_mjx.tasks import measures
from twirl_mjx.tasks.registry import TASKS
from twirl_mjx.tasks.task import Task

BIPED = TASKS.get("biped")()


def make_step(reward: list, standing: list, distance: list, terminated: list) -> SimpleNamespace:
    zeros = jnp.zeros(len(reward))
    return SimpleNamespace(
        reward=jnp.array(reward),
        terminated=jnp.array(terminated),
        metrics={
            "standing": jnp.array(standing),
            "on_feet": zeros,
            "goal_distance": jnp.array(distance),
            "at_goal": jnp.array(standing) * jnp.exp(-jnp.array(distance)),
            "cosine": zeros + 0.5,
        },
    )


def test_biped_measures_by_hand() -> None:
    tracker = measures.tracker_init(BIPED, 2)
    steps = [
        make_step([1.0, 2.0], [1.0, 0.0], [0.9, 0.4], [False, False]),
        make_step([3.0, 0.5], [1.0, 1.0], [0.1, 0.6], [False, True]),
    ]
    for step in steps:
        tracker = measures.tracker_step(BIPED, tracker, step)  # type: ignore[arg-type]
    values = {k: np.asarray(v) for k, v in measures.tracker_read(BIPED, tracker).items()}
    np.testing.assert_allclose(values["return"], [4.0, 2.5])
    np.testing.assert_allclose(values["episode_length"], [2.0, 2.0])
    np.testing.assert_allclose(values["standing_time"], [0.1, 0.05])
    np.testing.assert_allclose(values["min_distance"], [0.1, 0.4])
    np.testing.assert_allclose(values["cosine"], [0.5, 0.5])
    np.testing.assert_allclose(
        values["mean_distance"], [0.5, 0.5]
    )  # (0.9 + 0.1) / 2, (0.4 + 0.6) / 2
    # 0.05 s of each step upright: exp(-0.9) and exp(-0.1) m from the goal, then exp(-0.6)
    at_goal = [0.05 * (0.4065697 + 0.9048374), 0.05 * 0.5488116]
    np.testing.assert_allclose(values["goal_time"], at_goal, rtol=1e-5)
    np.testing.assert_allclose(values["terminated"], [0.0, 1.0])
    np.testing.assert_allclose(values["success"], [0.0, 0.0])
    after = measures.tracker_reset(BIPED, tracker, jnp.array([True, False]))
    values = measures.tracker_read(BIPED, after)
    np.testing.assert_allclose(values["return"], [0.0, 2.5])
    assert np.isnan(values["min_distance"][0]), "no step, no minimum"


def test_means_are_over_the_episodes_that_have_a_measure() -> None:
    values = {"a": np.array([1.0, np.nan, 3.0]), "b": np.array([np.nan, np.nan, np.nan])}
    assert measures.episode_means(values) == {"a": 2.0}


@pytest.mark.parametrize(
    ("task", "values", "expected"),
    [
        ("stand", {"standing_time": [11.9, 12.0]}, [False, True]),
        (
            "biped",
            {"standing_time": [12.0, 12.0, 11.0], "min_distance": [0.14, 0.15, 0.1]},
            [True, False, False],
        ),
        ("imitate", {"flights": [2.0, 3.0]}, [False, True]),
        ("hurdles", {"hurdles_passed": [1.0, 2.0]}, [False, True]),
    ],
)
def test_success_thresholds(task: str, values: dict, expected: list) -> None:
    arrays = {name: jnp.array(column) for name, column in values.items()}
    assert np.asarray(TASKS.get(task)().success(arrays)).tolist() == expected


def test_a_task_without_a_criterion_succeeds_when_it_is_not_ended_before_time() -> None:
    ended = {"terminated": jnp.array([0.0, 1.0])}
    assert np.asarray(Task.success(BIPED, ended)).tolist() == [True, False]
