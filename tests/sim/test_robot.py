"""Robots as data: any quadruped's MJCF read, put into a scene and simulated."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from twirl_mjx.policies.scripted import BOUND, TROT, action_table
from twirl_mjx.sim import actuation, kinematics, look, robots
from twirl_mjx.sim.dynamics import make_dynamics
from twirl_mjx.sim.engine import MjxEngine, NativeEngine, make_data
from twirl_mjx.sim.robot import Robot, per_joint
from twirl_mjx.sim.robots import A1, get_robot, register_robot
from twirl_mjx.sim.scene import SimOptions, build_scene


def test_facts_read_from_the_file(other: Robot) -> None:
    robot = other
    assert robot.legs == ("FL", "FR", "RR", "RL")
    assert robot.joints[3:6] == ("FR_hip_joint", "FR_thigh_joint", "FR_calf_joint")
    assert robot.links[2] == ("RR_hip", "RR_thigh", "RR_calf")
    assert robot.corners == (1, 0, 2, 3)
    assert robot.front_legs == (1, 0)
    np.testing.assert_array_equal(robot.side_signs, [1, -1, -1, 1])
    np.testing.assert_allclose(robot.hip_offsets[3], [-0.2, 0.06, 0.01])
    lengths = robot.thigh_offset, robot.thigh_length, robot.calf_length, robot.foot_radius
    np.testing.assert_allclose(lengths, [0.09, 0.21, 0.24, 0.025])
    limits = np.degrees(robot.joint_limits[3:6])
    np.testing.assert_allclose(limits, [[-50, 50], [-40, 250], [-160, -50]])
    np.testing.assert_array_equal(robot.torque_limit, np.tile([30.0, 30.0, 30.0], 4))
    assert robot.mass == pytest.approx(6 + 4 * (0.6 + 1.1 + 0.2))
    # hip 1 cm up: 0.21 cos 0.8 + 0.24 cos 0.7 + 0.025 - 0.01
    assert robot.home_height == pytest.approx(0.344871, abs=1e-5)
    trunk = robot.contact_geoms[0]
    assert (trunk.name, trunk.radius) == ("trunk_right_collision", pytest.approx(0.05))
    np.testing.assert_allclose(trunk.endpoints, [[-0.17, -0.03, 0], [0.17, -0.03, 0]])


def test_command_filter_is_scipys(other: Robot) -> None:
    from scipy import signal

    slow = dataclasses.replace(other, control_dt=0.02, cutoff_hz=5.0)
    np.testing.assert_allclose(slow.lowpass, signal.butter(2, 5.0, fs=50.0), atol=5e-9)
    assert A1.lowpass == ((0.20657208, 0.41314417, 0.20657208), (1.0, -0.36952738, 0.19581571))


def test_scene_has_the_robot_and_our_ground_only(made: Robot) -> None:
    robot = made
    built = build_scene(robot=robot, collision="feet")
    model = built.mj_model
    assert (model.nq, model.nv, model.nu) == (19, 18, 12)
    assert (model.nlight, model.nsensor, model.npair) == (1, 0, 0)
    assert [model.body(i).name for i in np.flatnonzero(model.body_parentid == 0)[1:]] == [
        robot.trunk
    ]
    assert model.body_subtreemass[0] == pytest.approx(robot.mass)
    assert [model.geom(i).name for i in np.flatnonzero(model.geom_bodyid == 0)] == ["floor"]
    solid = np.flatnonzero(model.geom_contype | model.geom_conaffinity)
    assert {model.geom(i).name for i in solid} == {"floor", *robot.feet}
    assert (model.geom_group < 3).sum() > 4, "what is seen stays"
    for i, joint in enumerate(robot.joints):
        assert model.joint(joint).qposadr[0] == 7 + i
        assert model.actuator(i).trnid[0] == model.joint(joint).id
        np.testing.assert_allclose(model.joint(joint).range, robot.joint_limits[i])
        gains = [*model.actuator_gainprm[i, :1], *model.actuator_biasprm[i, 1:3]]
        np.testing.assert_allclose(gains, [robot.kp[i], -robot.kp[i], -robot.kd[i]])
        assert model.actuator_forcerange[i, 1] == robot.torque_limit[i]
    np.testing.assert_allclose(model.dof_armature[6:], robot.armature)
    np.testing.assert_allclose(model.dof_damping[6:], robot.damping)
    assert model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
    assert model.opt.impratio == 1.0


def test_home_pose_touches_the_ground_with_four_feet(made: Robot) -> None:
    model = build_scene(robot=made, collision="full").mj_model
    data = mujoco.MjData(model)
    data.qpos[:] = model.key("home").qpos
    data.qpos[2] -= 1e-4
    mujoco.mj_forward(model, data)
    pairs = {model.geom(int(contact.geom[1])).name for contact in data.contact}
    assert pairs == set(made.feet)
    assert data.ncon == 4
    np.testing.assert_allclose([c.dist for c in data.contact], -1e-4, atol=1e-8)


def test_kinematics_agree_with_mujoco(made: Robot) -> None:
    robot = made
    model = build_scene(robot=robot).mj_model
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    for _ in range(20):
        joints = rng.uniform(*robot.joint_limits.T)
        quat = rng.normal(size=4)
        data.qpos[:] = [*rng.uniform(-1, 1, 3), *quat / np.linalg.norm(quat), *joints]
        mujoco.mj_kinematics(model, data)
        with jax.enable_x64(True):
            points = kinematics.forward(robot, jnp.asarray(data.qpos, jnp.float64))
            middles = np.asarray(points.endpoints).mean(axis=1)
            feet = np.asarray(points.feet)
        found = [data.geom(shape.name).xpos for shape in robot.contact_geoms]
        np.testing.assert_allclose(middles, found, atol=1e-6)
        np.testing.assert_allclose(feet, [data.geom(f).xpos for f in robot.feet], atol=1e-6)
    reached = kinematics.foot_positions(robot, robot.default_pose)
    np.testing.assert_allclose(
        kinematics.leg_inverse(robot, reached), robot.default_pose, atol=1e-9
    )


def play(robot: Robot, engine: Any, steps: int, action: np.ndarray) -> np.ndarray:
    """Return qpos [K, 19] of one world that starts at home and is given one action."""
    built = build_scene(robot=robot)
    data = make_data(built, 1)
    home = jnp.asarray(built.mj_model.key("home").qpos, jnp.float32).at[2].add(-0.001)
    data = data.replace(qpos=home[None], ctrl=home[None, 7:])
    dynamics = make_dynamics()
    motors = actuation.motor_init(jax.random.key(0), dynamics)
    worlds = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], dynamics)
    step = jax.jit(engine(built).step)
    wanted = actuation.action_to_target(robot, jnp.asarray(action, jnp.float32))
    state, rows = actuation.filter_init(home[7:]), []
    for _ in range(steps):
        target, state = actuation.filter_step(robot, state, wanted)
        command = actuation.motor_command(robot, motors, target, dynamics)
        data, _ = step(data, jax.tree.map(lambda leaf: leaf[None], command), worlds)
        rows.append(np.asarray(data.qpos[0]))
    return np.array(rows)


@pytest.mark.slow
def test_c_and_mjx_agree_over_twenty_control_steps(made: Robot) -> None:
    action = 0.1 * np.sin(np.arange(12.0))
    native = play(made, lambda built: NativeEngine(built, 1), 20, action)
    ours = play(made, MjxEngine, 20, action)
    assert np.abs(native[-1] - native[0]).max() > 0.02, "it moves"
    np.testing.assert_allclose(ours, native, atol=PARITY)


PARITY = 2e-3
"""m and rad after 1 s on four feet: float32 and solver steps against C."""


def test_zero_action_stands(made: Robot) -> None:
    robot = made
    qpos = play(robot, lambda built: NativeEngine(built, 1), 100, np.zeros(12))
    upright = 1.0 - 2.0 * (qpos[:, 4] ** 2 + qpos[:, 5] ** 2)
    assert upright.min() > 0.98
    assert 0.0 < robot.home_height - qpos[-1, 2] < 0.04
    assert np.abs(qpos[-1] - qpos[-20]).max() < 2e-3, "it is at rest"


def test_gaits_find_the_legs_by_where_they_are(made: Robot) -> None:
    robot = made
    right, left, hind_right, hind_left = (slice(3 * leg, 3 * leg + 3) for leg in robot.corners)
    wide = dataclasses.replace(robot, action_half_range=per_joint(1.2))
    trot, bound = action_table(TROT, wide), action_table(BOUND, wide)
    np.testing.assert_allclose(bound[:, right], bound[:, left], atol=1e-6)
    np.testing.assert_allclose(bound[:, hind_right], bound[:, hind_left], atol=1e-6)
    np.testing.assert_allclose(trot[:, right], np.roll(trot[:, left], 4, axis=0), atol=1e-6)
    assert np.abs(bound[:, right] - bound[:, hind_right]).max() > 0.1


def test_captions_and_colours_name_the_legs_of_the_robot(other: Robot) -> None:
    robot, strength = other, np.array([1.0, 0.5, 1.0, 1.0])
    assert look.describe("weakened", robot, make_dynamics(), strength) == "FR leg at 50 %"
    model = build_scene(robot=robot, meshes=True).mj_model
    plain = model.geom_rgba.copy()
    look.paint(model, robot, make_dynamics(), strength)
    red = np.flatnonzero((model.geom_rgba != plain).any(axis=1))
    assert {model.body(model.geom_bodyid[i]).name for i in red} == set(robot.links[1])


def test_control_step_is_the_robots(other: Robot) -> None:
    quick = dataclasses.replace(other, control_dt=0.02)
    assert build_scene(robot=quick).options.n_substeps == 4
    with pytest.raises(
        ValueError, match=r"sim_dt 0.025 s does not divide the control step of 0.02"
    ):
        build_scene(robot=quick, options=SimOptions(sim_dt=0.025))


def test_registry(monkeypatch: pytest.MonkeyPatch, other: Robot) -> None:
    monkeypatch.setattr(robots.ROBOTS, "_items", {"a1": A1})
    assert get_robot("a1") is A1
    assert register_robot(other) is other
    assert get_robot("other") is register_robot(other)
    with pytest.raises(ValueError, match=r"another robot called 'other'.*nearest: 'my_other'"):
        register_robot(dataclasses.replace(other, cutoff_hz=5.0))
    with pytest.raises(ValueError, match=r"unknown robot 'othr'.*a1, other \(nearest: 'other'\)"):
        get_robot("othr")
