"""Layouts without gaps, and the observation recomputed from the physical state in numpy."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from twirl_mjx.deploy import reference
from twirl_mjx.sim.robots import A1
from twirl_mjx.tasks import observations

UPRIGHT = observations.proprioceptive(A1, axes=True)


@pytest.mark.parametrize(
    ("layout", "size"), [(observations.proprioceptive(A1, axes=False), 95), (UPRIGHT, 101)]
)
def test_layout_covers_the_observation(layout: tuple[observations.Entry, ...], size: int) -> None:
    slices = observations.layout_slices(layout)
    assert observations.layout_size(layout) == size
    assert len(slices) == len(layout)  # names are unique
    covered = np.concatenate([np.arange(size)[s] for s in slices.values()])
    np.testing.assert_array_equal(covered, np.arange(size))  # in order, no gap, no overlap
    assert all(entry.unit and entry.size > 0 for entry in layout)


def test_where_the_entries_are() -> None:
    slices = observations.layout_slices(UPRIGHT)
    assert slices["goal_displacement_w"] == slice(0, 2)
    assert slices["roll_pitch[-2]"] == slice(2, 4)  # the oldest frame comes first
    assert slices["previous_action[-2]"] == slice(21, 33)
    assert slices["roll_pitch[0]"] == slice(64, 66)
    assert slices["previous_action[0]"] == slice(83, 95)
    assert slices["base_x_axis_w"] == slice(95, 98)
    assert slices["base_z_axis_w"] == slice(98, 101)


def numpy_frame(
    qpos: np.ndarray, qvel: np.ndarray, start: np.ndarray, action: np.ndarray
) -> np.ndarray:
    _, pitch, roll = Rotation.from_quat(qpos[3:7], scalar_first=True).as_euler("ZYX")
    return np.concatenate([[roll, pitch], qvel[3:5], qpos[7:], qpos[:3] - start, action])


def numpy_observation(history: list[np.ndarray], qpos: np.ndarray, goal: np.ndarray) -> np.ndarray:
    matrix = Rotation.from_quat(qpos[3:7], scalar_first=True).as_matrix()
    return np.concatenate([goal - qpos[:2], *history, matrix[:, 0], matrix[:, 2]])


@pytest.mark.parametrize("task", ["stand", "biped"])
def test_observation_recomputed(
    task: str,
    worlds: Callable[..., Any],
    actions: Callable[..., np.ndarray],
    read: Callable[..., Any],
) -> None:
    """Seven steps of three worlds, against numpy here and against the rehearsal's observer."""
    made = worlds(task)
    first = made.reset(7)
    taken = actions(7, 3, scale=0.5)
    state, states = read(first), [read(s) for s in made.run(first, taken)]
    assert not np.any([s.done for s in states])
    for world in range(3):
        qpos, qvel, goal = state.qpos[world], state.qvel[world], state.goal[world]
        start = qpos[:3].copy()
        history = [numpy_frame(qpos, qvel, start, np.zeros(12))] * 3
        theirs = reference.Observer(task, reading(qpos, qvel))
        expected = numpy_observation(history, qpos, goal)
        np.testing.assert_allclose(state.obs[world], expected, atol=2e-5)
        for action, after in zip(taken[:, world], states, strict=True):
            qpos, qvel = after.qpos[world], after.qvel[world]
            history = [*history[1:], numpy_frame(qpos, qvel, start, action)]
            theirs.push(reading(qpos, qvel), action)
            expected = numpy_observation(history, qpos, goal)
            np.testing.assert_allclose(after.next_obs[world], expected, atol=2e-5)
            np.testing.assert_array_equal(after.obs[world], after.next_obs[world])
            also = theirs.observe(reading(qpos, qvel), goal)
            np.testing.assert_allclose(after.next_obs[world], also, atol=2e-5)


def reading(qpos: np.ndarray, qvel: np.ndarray) -> reference.Reading:
    matrix = Rotation.from_quat(qpos[3:7], scalar_first=True).as_matrix()
    return reference.Reading(matrix, qvel[3:6], qpos[7:], qpos[:3])
