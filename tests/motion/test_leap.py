"""The leap: the plan's dynamics, the shipped clip's properties, and checks that can fail."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest

from twirl_mjx.assets import asset_path
from twirl_mjx.motion import leap_plan, leap_solver, planar
from twirl_mjx.motion.clip import Clip
from twirl_mjx.motion.formats import read_clip
from twirl_mjx.motion.leap import (
    LeapConfig,
    make_leap,
    motion_to_clip,
    shipped_plan,
    write_plan,
)
from twirl_mjx.motion.leap_checks import (
    LeapError,
    band_margins,
    check_leap,
    inverse_dynamics,
    longest_flight,
    require_leap,
)
from twirl_mjx.motion.tracking import open_loop
from twirl_mjx.sim import kinematics
from twirl_mjx.sim.robots import A1


@pytest.fixture(scope="module")
def leap() -> Clip:
    return read_clip(asset_path("a1", "leap.json"))


@pytest.fixture(scope="module")
def model() -> planar.PlanarModel:
    return planar.planar_model(mujoco.MjModel.from_xml_path(str(A1.model())))


def random_motion(model: planar.PlanarModel, seed: int) -> tuple[LeapConfig, leap_plan.LeapMotion]:
    """A plan near the first guess, with its fictitious torque."""
    config = LeapConfig()
    layout = leap_plan.make_layout(config)
    start = leap_solver.first_guess(config, layout, model)
    noise = np.random.default_rng(seed).uniform(-0.005, 0.005, len(start))
    params = start + noise * (layout.upper - layout.lower) * (np.abs(start) < 50)
    return config, leap_plan.plan_motion(config, layout, model, params)


def test_planar_model_weighs_what_the_robot_weighs(model: planar.PlanarModel) -> None:
    robot = mujoco.MjModel.from_xml_path(str(A1.model()))
    assert model.mass == pytest.approx(robot.body_mass.sum())
    qpos = np.array([0.1, 0, 0.3, np.cos(0.2), 0, np.sin(0.2), 0, *([0, 0.7, -1.5] * 4)])
    data = mujoco.MjData(robot)
    data.qpos[:] = qpos
    mujoco.mj_forward(robot, data)
    pose = planar.Pose(
        np.array([[0.1, 0.3]]), np.array([0.4]), np.full((1, 2), 0.7), np.full((1, 2), -1.5)
    )
    com = planar.centre_of_mass(model, planar.link_states(model, pose))
    np.testing.assert_allclose(com[0], data.subtree_com[1][[0, 2]], atol=1e-9)
    inertia = np.zeros((6, 6))
    full = np.zeros((robot.nv, robot.nv))
    mujoco.mj_fullM(robot, data, full)
    inertia = full[:6, :6]
    # Moving the trunk of a frozen robot by v at rate w: momentum about the centre of mass.
    still = dataclasses.replace(pose, root=np.repeat(pose.root, 2, 0), pitch=np.array([0.4, 0.401]))
    still = dataclasses.replace(still, thigh=np.full((2, 2), 0.7), calf=np.full((2, 2), -1.5))
    momentum = planar.angular_momentum(model, planar.link_states(model, still), 0.001)
    arm = data.subtree_com[1] - qpos[:3]
    about_com = inertia[4, 4] - model.mass * (arm[0] ** 2 + arm[2] ** 2)
    assert momentum[0] == pytest.approx(about_com, rel=1e-3)


def test_leg_ik_reaches_the_foot(model: planar.PlanarModel) -> None:
    rng = np.random.default_rng(0)
    root, pitch = rng.uniform([0, 0.25], [0.1, 0.3], (50, 2)), rng.uniform(-0.4, 0.4, 50)
    feet = planar.hip_positions(root, pitch) + rng.uniform([-0.1, -0.3], [0.1, -0.15], (50, 2, 2))
    thigh, calf, length = planar.leg_ik(root, pitch, feet)
    states = planar.link_states(model, planar.Pose(root, pitch, thigh, calf))
    shank = pitch[:, None] + thigh + calf
    reached = states.knee + planar.turn(shank, np.array([0.0, -A1.calf_length]))
    np.testing.assert_allclose(reached, feet, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(feet - states.hip, axis=-1), length)
    joints = np.zeros((50, 4, 3))
    joints[:, :2, 1:] = np.stack([thigh[:, 0], calf[:, 0]], axis=-1)[:, None]
    joints[:, 2:, 1:] = np.stack([thigh[:, 1], calf[:, 1]], axis=-1)[:, None]
    base = kinematics.foot_positions(A1, joints.reshape(50, 12))[:, [0, 2]][..., [0, 2]]
    world = root[:, None] + planar.turn(pitch[:, None], base)
    np.testing.assert_allclose(world, feet, atol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_plan_obeys_newton_and_euler(model: planar.PlanarModel, seed: int) -> None:
    config, motion = random_motion(model, seed)
    com = planar.centre_of_mass(model, motion.states)
    np.testing.assert_allclose(com, motion.com, atol=1e-5)
    momentum = planar.angular_momentum(model, motion.states, motion.dt)
    np.testing.assert_allclose(np.diff(momentum) / motion.dt, motion.moment[1:-1], atol=0.02)
    accel = np.diff(com, 2, axis=0) / motion.dt**2
    wanted = motion.force.sum(axis=1) / model.mass - [0.0, planar.GRAVITY]
    inside = motion.times[1:-1] < config.flight_time - motion.dt
    np.testing.assert_allclose(accel[inside], wanted[1:-1][inside], atol=0.05)
    assert np.abs(accel - wanted[1:-1]).max() < 6.0  # the forces' kinks, smeared by a frame


def shipped_motion(model: planar.PlanarModel) -> leap_plan.LeapMotion:
    layout = leap_plan.make_layout(LeapConfig())
    params = shipped_plan(layout)
    assert params is not None
    return leap_plan.plan_motion(LeapConfig(), layout, model, params)


def test_shipped_clip_is_the_shipped_plan(leap: Clip, model: planar.PlanarModel) -> None:
    clip = motion_to_clip(shipped_motion(model), LeapConfig().duration, "leap")
    np.testing.assert_allclose(clip.qpos, leap.qpos, atol=2e-6)
    other = leap_plan.make_layout(LeapConfig(run_up_strides=1))
    assert shipped_plan(other) is None


def test_plans_survive_their_file(tmp_path: Path) -> None:
    layout = leap_plan.make_layout(LeapConfig())
    write_plan(layout, layout.start, tmp_path / "plan.json")
    numbers = json.loads((tmp_path / "plan.json").read_text())
    back = np.concatenate([numbers[name] for name in layout.index])
    np.testing.assert_allclose(back, layout.start, atol=1e-8)


def test_torques_of_the_plan_agree_with_mujoco(model: planar.PlanarModel) -> None:
    """The same torques from the planar moment balance and from C MuJoCo's inverse dynamics."""
    config, motion = LeapConfig(), shipped_motion(model)
    joints = leap_solver.joint_motion(config, model, motion)
    clip = motion_to_clip(motion, config.duration, "plan")
    robot = mujoco.MjModel.from_xml_path(str(A1.model()))
    robot.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_LIMIT
    data = mujoco.MjData(robot)
    for frame in range(1, 99, 7):
        slope = np.zeros((2, robot.nv))
        for row, k in enumerate((frame - 1, frame)):
            mujoco.mj_differentiatePos(
                robot, slope[row], clip.frame_duration, clip.qpos[k], clip.qpos[k + 1]
            )
        data.qpos[:], data.qvel[:] = clip.qpos[frame], slope.mean(axis=0)
        data.qacc[:] = (slope[1] - slope[0]) / clip.frame_duration
        mujoco.mj_inverse(robot, data)
        torque = data.qfrc_inverse[6:].copy()
        for leg in range(4):
            geom, pair = robot.geom(A1.feet[leg]).id, leg // 2
            jacobian = np.zeros((3, robot.nv))
            point = data.geom_xpos[geom] * [1, 1, 0]
            mujoco.mj_jac(robot, data, jacobian, None, point, int(robot.geom_bodyid[geom]))
            force = 0.5 * motion.force[frame, pair]
            torque -= (jacobian.T @ [force[0], 0.0, force[1]])[6:]
        planned = joints.torque[:, frame]
        np.testing.assert_allclose(torque[[1, 7, 2, 8]], planned, atol=0.3)
        np.testing.assert_allclose(torque[[1, 7]], torque[[4, 10]], atol=1e-6)


def test_shipped_leap_has_every_property(leap: Clip) -> None:
    findings = require_leap(leap)
    assert len(findings) >= 20
    config = LeapConfig()
    assert leap.cycle_displacement[0] == pytest.approx(config.cycle_length, abs=1e-3)
    assert leap.cycle_duration == pytest.approx(config.duration, abs=1e-3)
    _, frames = longest_flight(leap)
    assert frames * leap.frame_duration == pytest.approx(config.flight_time, abs=0.02)


def _scaled_height(clip: Clip) -> Clip:
    pos = clip.root_pos.copy()
    pos[:, 2] = 0.3 + 1.3 * (pos[:, 2] - 0.3)
    return dataclasses.replace(clip, root_pos=pos)


def _lowered(clip: Clip) -> Clip:
    return dataclasses.replace(clip, root_pos=clip.root_pos - [0, 0, 0.01])


def _joint(change: float, joint: int) -> Callable[[Clip], Clip]:
    def damage(clip: Clip) -> Clip:
        return dataclasses.replace(
            clip, joint_pos=clip.joint_pos + change * (np.arange(12) == joint)
        )

    return damage


def _slower(clip: Clip) -> Clip:
    return dataclasses.replace(clip, frame_duration=1.1 * clip.frame_duration)


def _stretched(clip: Clip) -> Clip:
    return dataclasses.replace(clip, root_pos=clip.root_pos * [1.04, 1, 1])


def _open_loop_seam(clip: Clip) -> Clip:
    joints = clip.joint_pos.copy()
    joints[-1] += 0.05
    return dataclasses.replace(clip, joint_pos=joints)


@pytest.mark.parametrize(
    ("damage", "names"),
    [
        (_scaled_height, ("off gravity's fall", "unexplained force", "lowest point")),
        (_lowered, ("lowest point",)),
        (_joint(0.7, 0), ("joint angles inside",)),
        (_slower, ("off gravity's fall", "unexplained force")),
        (_stretched, ("slip",)),
        (_open_loop_seam, ("gap at the loop's seam",)),
    ],
)
def test_damaged_leaps_are_refused(
    leap: Clip, damage: Callable[[Clip], Clip], names: tuple[str, ...]
) -> None:
    with pytest.raises(LeapError) as error:
        require_leap(damage(leap))
    for name in names:
        assert name in str(error.value)


def test_a_standing_robot_is_no_leap() -> None:
    pose = np.array([0, 0, A1.home_height, 1, 0, 0, 0, *A1.default_pose])
    qpos = np.repeat(pose[None], 5, axis=0)
    clip = Clip(qpos[:, :3], qpos[:, 3:7], qpos[:, 7:], frame_duration=0.02, name="stand")
    failed = {finding.name for finding in check_leap(clip) if not finding.passed}
    assert {"cycle length", "flight time (from frames)"} <= failed
    dynamics = inverse_dynamics(clip)
    weight = A1.mass * planar.GRAVITY
    np.testing.assert_allclose(dynamics.contact_force[:, :, 2].sum(axis=1), weight, rtol=1e-3)
    assert np.abs(dynamics.torque).max() < 10.0
    with pytest.raises(LeapError, match="must wrap"):
        check_leap(dataclasses.replace(clip, loop="clamp"))


def test_band_margin_is_the_distance_to_the_box() -> None:
    pose = np.array([0, 0, A1.home_height + 0.05, 1, 0, 0, 0, *A1.default_pose])
    qpos = np.repeat(pose[None], 3, axis=0)
    clip = Clip(qpos[:, :3], qpos[:, 3:7], qpos[:, 7:], frame_duration=0.02)
    front = A1.hip_offsets[0, 0]
    margins = band_margins(clip, np.array([front, front + 0.15, front + 0.2]))
    beside = np.hypot(0.05, 0.06) - A1.foot_radius
    np.testing.assert_allclose(margins[:2], [0.04, beside], atol=1e-6)
    assert margins[2] == pytest.approx(np.hypot(0.1, 0.06) - A1.foot_radius, abs=1e-6)


def test_motors_fly_the_leap_without_feedback(leap: Clip) -> None:
    """From half a stance before take-off through the flight, at 20 Hz through the filter."""
    simulated, reference = open_loop(leap, start=0.95, duration=0.6)
    off = simulated - reference
    assert simulated[:, 2].max() > reference[:, 2].max() - 0.06
    assert np.abs(off[:, 2]).max() < 0.06
    pitch_off = 2 * np.abs(np.arcsin(simulated[:, 5]) - np.arcsin(reference[:, 5]))
    assert pitch_off.max() < np.radians(15)
    assert np.sqrt((off[:10, 7:] ** 2).mean(axis=1)).max() < 0.06
    feet = kinematics.foot_positions(A1, simulated[:, 7:])
    turned = feet[..., 2] * (1 - 2 * simulated[:, None, 5] ** 2)
    level = (
        simulated[:, 2, None] + turned - feet[..., 0] * np.sin(2 * np.arcsin(simulated[:, None, 5]))
    )
    assert (level - A1.foot_radius).min(axis=1).max() > 0.04  # all four feet at once


def test_leap_config_refuses_what_was_not_tried() -> None:
    with pytest.raises(ValueError, match=r"flight_time 0\.6 is outside \[0\.2, 0\.5\]"):
        LeapConfig(flight_time=0.6)
    with pytest.raises(ValueError, match="speed 9 is outside"):
        LeapConfig(speed=9)
    with pytest.raises(ValueError, match=r"leaves 0\.92 s for 5 bounds"):
        LeapConfig(run_up_strides=4)


@pytest.mark.slow
def test_make_leap_makes_the_shipped_clip(leap: Clip) -> None:
    made = make_leap(progress=print)
    require_leap(made)
    np.testing.assert_allclose(made.qpos, leap.qpos, atol=0.01)
