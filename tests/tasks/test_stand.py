"""Task ``stand``: reward, measures, terminations and the two ways an episode starts."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from twirl_mjx.sim.dynamics import make_dynamics
from twirl_mjx.sim.robots import A1
from twirl_mjx.sim.scene import build_scene
from twirl_mjx.tasks.base import Outcome
from twirl_mjx.tasks.stand import Stand, StandOptions

FEET = StandOptions(height_of="front_feet", risen_fraction=1.0)


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return build_scene("flat").mj_model


def nose_up(qpos: np.ndarray) -> float:
    """Return the z-component of the base x-axis."""
    return float(Rotation.from_quat(qpos[3:7], scalar_first=True).as_matrix()[2, 0])


def front_foot_height(model: mujoco.MjModel, qpos: np.ndarray) -> float:
    """Return the mean height in m of the centres of the front feet, by C MuJoCo."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    return float(np.mean([data.geom(f"{leg}_foot").xpos[2] for leg in ("FR", "FL")]))


def numpy_terms(model: mujoco.MjModel, qpos: np.ndarray, height_of: str) -> tuple[float, float]:
    height = qpos[2] if height_of == "root" else front_foot_height(model, qpos)
    return (0.5 * nose_up(qpos) + 0.5) ** 2, np.exp(height) - 1.0


@pytest.mark.parametrize(
    ("options", "height_of"),
    [
        ({}, "root"),
        pytest.param({"options": FEET}, "front_feet", marks=pytest.mark.slow),
    ],
)
def test_reward_recomputed_from_the_state(
    options: dict[str, Any],
    height_of: str,
    model: mujoco.MjModel,
    worlds: Callable[..., Any],
    actions: Callable[..., np.ndarray],
    read: Callable[..., Any],
) -> None:
    made = worlds("stand", **options)
    states = [read(s) for s in made.run(made.reset(3), actions(6, 3, scale=0.6))]
    checked = 0
    for state in states:
        for world in np.flatnonzero(~state.done):
            qpos = state.qpos[world]
            upright, bonus = numpy_terms(model, qpos, height_of)
            terms = {name: float(value[world]) for name, value in state.metrics.items()}
            assert terms["upright"] == pytest.approx(upright, abs=1e-5)
            assert terms["height"] == pytest.approx(bonus, abs=1e-5)
            assert float(state.reward[world]) == pytest.approx(upright + bonus, abs=2e-5)
            assert terms["cosine"] == pytest.approx(nose_up(qpos), abs=1e-5)
            height = front_foot_height(model, qpos)
            assert terms["front_foot_height"] == pytest.approx(height, abs=1e-5)
            checked += 1
    assert checked >= 9


def test_reward_by_hand(judge: Callable[..., Outcome]) -> None:
    """Level at 0.5 m, then nose straight up at 0.5 m with hanging front legs."""
    level = np.concatenate([[0, 0, 0.5, 1, 0, 0, 0], A1.default_pose])
    up = np.concatenate([[0, 0, 0.5, 0.5**0.5, 0, -(0.5**0.5), 0], A1.default_pose])
    root = judge(Stand(), [level, up])
    np.testing.assert_allclose(root.reward, [0.25 + 0.6487213, 1.0 + 0.6487213], atol=1e-5)
    # Front feet: level 0.5 - 0.4 cos 0.9 = 0.251356 m; up: 0.183 m along the nose, the leg level.
    feet = judge(Stand(FEET), [level, up])
    np.testing.assert_allclose(
        feet.reward, [0.25 + np.expm1(0.251356), 1.0 + np.expm1(0.683)], atol=1e-5
    )


def test_standing_needs_cosine_and_both_front_feet(judge: Callable[..., Outcome]) -> None:
    """c >= 0.7 is a pitch of 44.43 deg; a foot 1 cm up or less is not lifted."""

    def pose(pitch: float, z: float, lower_leg: tuple[float, float] = (0.9, -1.8)) -> np.ndarray:
        half = np.deg2rad(-pitch) / 2
        joints = np.concatenate([[0.0, *lower_leg], A1.default_pose[3:]])
        return np.concatenate([[0, 0, z, np.cos(half), 0, np.sin(half), 0], joints])

    reach = (-1.047, -0.92)  # the front right leg stretched forwards, which is up
    down = (2.4, -0.92)  # and back, towards the ground of a raised robot
    task = Stand()
    outcome = judge(task, [pose(44.3, 0.6), pose(44.6, 0.6), pose(80, 0.6, reach), pose(80, 0.0)])
    np.testing.assert_array_equal(outcome.metrics["standing"], [False, True, True, True])
    lowered = [pose(50, z, down) for z in np.linspace(0.05, 0.6, 12)]
    feet = judge(task, lowered).metrics["standing"]
    assert not feet[0]
    assert feet[-1]


def test_anything_but_a_foot_on_the_ground_ends_the_episode(
    judge: Callable[..., Outcome], poses: dict[str, np.ndarray]
) -> None:
    outcome = judge(Stand(), list(poses.values()))
    fallen = dict(zip(poses, outcome.terminated.tolist(), strict=True))
    assert fallen == {
        "on four feet": False,
        "on the hind feet": False,
        "kneeling": True,
        "on its side": True,
        "on the hips": True,
        "on its back": True,
        "on its head": True,
    }
    np.testing.assert_array_equal(outcome.metrics["fall"], outcome.terminated)


def test_a_millimetre_off_the_ground_is_no_fall(
    judge: Callable[..., Outcome], poses: dict[str, np.ndarray]
) -> None:
    raised = [pose + np.eye(19)[2] * 0.005 for pose in poses.values()]
    assert not judge(Stand(), raised).terminated.any()


def draw_starts(config: StandOptions, count: int) -> np.ndarray:
    """Return qpos [count, 19] of as many episode starts."""
    task, scene = Stand(config), build_scene("flat")
    keys = jax.random.split(jax.random.key(1), count)
    start = jax.jit(jax.vmap(lambda key: task.start(key, scene, make_dynamics()).qpos))
    return np.asarray(start(keys), np.float64)


def pitches(qpos: np.ndarray) -> np.ndarray:
    return np.rad2deg([np.arcsin(nose_up(q)) for q in qpos])


def lowest(model: mujoco.MjModel, qpos: np.ndarray) -> tuple[str, float]:
    """Return the body class and height in m of the lowest contact shape, by C MuJoCo."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    floor = model.geom("floor").id
    distance, body = min(
        (mujoco.mj_geomDistance(model, data, floor, model.geom(s.name).id, 3.0, None), s.body)
        for s in A1.contact_geoms
    )
    return body, distance


def test_starts_on_four_feet(model: mujoco.MjModel) -> None:
    """joint_pos = default + U(-0.05, 0.05), level, the lowest foot just on the ground."""
    qpos = draw_starts(StandOptions(), 500)
    np.testing.assert_array_equal(qpos[:, :2], 0.0)
    np.testing.assert_array_equal(qpos[:, 3:7], np.tile([1.0, 0, 0, 0], (500, 1)))
    noise = qpos[:, 7:] - A1.default_pose
    assert np.abs(noise).max() < 0.0500001
    np.testing.assert_allclose(noise.std(axis=0), 0.1 / 12**0.5, rtol=0.1)
    for start in qpos[:50]:
        body, height = lowest(model, start)
        assert body == "foot"
        assert height == pytest.approx(0.0, abs=1e-6)


def test_risen_starts(model: mujoco.MjModel) -> None:
    """Pitch U(0, 83 deg), on the hind feet alone, within the joint limits, not fallen."""
    qpos = draw_starts(StandOptions(risen_fraction=1.0), 500)
    pitch = pitches(qpos)
    assert 0.0 <= pitch.min() < 2.0
    assert 81.0 < pitch.max() <= 83.01
    assert pitch.mean() == pytest.approx(41.5, abs=3.0)
    low, high = A1.joint_limits.T
    assert (qpos[:, 7:] > low).all()
    assert (qpos[:, 7:] < high).all()
    for start in qpos[:100]:
        body, height = lowest(model, start)
        assert body == "foot"
        assert height == pytest.approx(0.0, abs=2e-6)


def test_share_of_risen_starts() -> None:
    pitch = pitches(draw_starts(StandOptions(risen_fraction=0.25), 500))
    risen = pitch > 1e-3
    assert risen.mean() == pytest.approx(0.25, abs=0.06)
    np.testing.assert_allclose(pitch[~risen], 0.0, atol=1e-6)
