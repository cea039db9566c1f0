"""Robots as data: any quadruped's MJCF read, put into a scene and simulated; refusals by name."""

from __future__ import annotations

import dataclasses
import functools
import importlib.util
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from twirl_mjx.motion.leap import make_leap
from twirl_mjx.policies.scripted import BOUND, TROT, action_table
from twirl_mjx.sim import actuation, kinematics, look, robots
from twirl_mjx.sim.dynamics import make_dynamics
from twirl_mjx.sim.engine import MjxEngine, NativeEngine, make_data
from twirl_mjx.sim.robot import FOOT, Robot, per_joint
from twirl_mjx.sim.robots import A1, get_robot, register_robot
from twirl_mjx.sim.scene import SimOptions, build_scene
from twirl_mjx.tasks.imitate import load_clip

GO1_FILE = Path(__file__).resolve().parents[2] / "examples" / "go1.py"

LEG = """
<body name="{leg}_hip" pos="{x} {y} 0.01">
  <joint name="{leg}_hip_joint" axis="1 0 0" range="-50 50"/>
  <geom class="seen" type="cylinder" size="0.04 0.03" mass="0.6"/>
  <body name="{leg}_thigh" pos="0 {out} 0">
    <joint name="{leg}_thigh_joint" axis="0 1 0" range="-40 250"/>
    <geom class="seen" type="capsule" size="0.02" fromto="0 0 0 0 0 -0.21" mass="1.1"/>
    <geom class="hidden" name="{leg}_thigh_collision" type="box" size="0.02 0.02 0.1" mass="0"/>
    <body name="{leg}_calf" pos="0 0 -0.21">
      <joint name="{leg}_calf_joint" axis="0 1 0" range="-160 -50" actuatorfrcrange="-40 40"/>
      <inertial pos="0 0 -0.12" mass="0.2" diaginertia="0.002 0.002 0.0001"/>
      <geom class="seen" type="capsule" size="0.01" fromto="0 0 0 0 0 -0.24"/>
      <geom class="hidden" name="{leg}_toe" type="sphere" size="0.025" pos="0.002 0 -0.24"/>
    </body>
  </body>
</body>"""

CORNERS = {"FL": (0.2, 0.06), "FR": (0.2, -0.06), "RR": (-0.2, -0.06), "RL": (-0.2, 0.06)}
"""m, hips in the order of the model; the A1 has its right legs first."""


def quadruped(**changes: tuple[str, str]) -> str:
    """A quadruped's MJCF in degrees, with what scenes bring along; ``changes`` replace text."""
    legs = "".join(
        LEG.format(leg=leg, x=x, y=y, out=0.09 if y > 0 else -0.09)
        for leg, (x, y) in CORNERS.items()
    )
    motors = "".join(  # in another order than the joints
        f'<motor name="{leg}_{part}" joint="{leg}_{part}_joint" forcerange="-30 30"/>'
        for part in ("calf", "hip", "thigh")
        for leg in CORNERS
    )
    xml = f"""<mujoco model="other">
      <option timestep="0.002" cone="elliptic" impratio="10"/>
      <default>
        <default class="seen"><geom group="1" material="ground"/></default>
        <default class="hidden"><geom group="3"/></default>
      </default>
      <asset>
        <texture name="sky" type="skybox" builtin="flat" width="8" height="8"/>
        <material name="ground" rgba="0.2 0.4 0.8 1"/>
      </asset>
      <worldbody>
        <geom name="floor" type="plane" size="1 1 1"/>
        <light pos="0 0 3"/>
        <body name="crate" pos="2 0 0"><geom type="box" size="0.1 0.1 0.1"/></body>
        <body name="base" pos="0 0 0.5">
          <freejoint name="float"/>
          <light pos="0 0 1"/>
          <geom class="seen" name="shell" type="box" size="0.22 0.08 0.05" mass="6"/>
          <site name="imu"/>{legs}
        </body>
      </worldbody>
      <contact><pair geom1="floor" geom2="FL_toe"/></contact>
      <actuator>{motors}</actuator>
      <sensor><gyro site="imu"/><touch site="imu"/></sensor>
      <keyframe><key name="sit" qpos="{" ".join(["0"] * 3 + ["1"] + ["0"] * 15)}"/></keyframe>
    </mujoco>"""
    for old, new in changes.values():
        assert old in xml
        xml = xml.replace(old, new)
    return xml


FACTS: dict[str, Any] = {
    "feet": tuple(f"{leg}_toe" for leg in CORNERS),
    "default_pose": (0.0, 0.8, -1.5),
    "action_half_range": 0.5,
    "kp": (70.0, 80.0, 90.0),
    "kd": 3.0,
    "armature": 0.012,
    "damping": 0.02,
}


@functools.cache
def other() -> Robot:
    return Robot.from_mjcf("other", quadruped(), **FACTS)


@functools.cache
def go1() -> Robot:
    spec = importlib.util.spec_from_file_location("go1", GO1_FILE)
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except FileNotFoundError as error:
        pytest.skip(str(error))
    return module.GO1


ROBOTS = pytest.mark.parametrize("made", [other, go1], ids=["other", "go1"])


def test_facts_read_from_the_file() -> None:
    robot = other()
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


def test_command_filter_is_scipys() -> None:
    from scipy import signal

    slow = dataclasses.replace(other(), control_dt=0.02, cutoff_hz=5.0)
    np.testing.assert_allclose(slow.lowpass, signal.butter(2, 5.0, fs=50.0), atol=5e-9)
    assert A1.lowpass == ((0.20657208, 0.41314417, 0.20657208), (1.0, -0.36952738, 0.19581571))


@ROBOTS
def test_scene_has_the_robot_and_our_ground_only(made: Any) -> None:
    robot = made()
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


@ROBOTS
def test_home_pose_touches_the_ground_with_four_feet(made: Any) -> None:
    model = build_scene(robot=made(), collision="full").mj_model
    data = mujoco.MjData(model)
    data.qpos[:] = model.key("home").qpos
    data.qpos[2] -= 1e-4
    mujoco.mj_forward(model, data)
    pairs = {model.geom(int(contact.geom[1])).name for contact in data.contact}
    assert pairs == set(made().feet)
    assert data.ncon == 4
    np.testing.assert_allclose([c.dist for c in data.contact], -1e-4, atol=1e-8)


@ROBOTS
def test_kinematics_agree_with_mujoco(made: Any) -> None:
    robot = made()
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
    home = jnp.asarray(built.mj_model.key("home").qpos, jnp.float32)
    data = data.replace(qpos=home[None], ctrl=home[None, 7:])
    dynamics = make_dynamics()
    motors = actuation.motor_init(jax.random.key(0), dynamics)
    worlds = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], dynamics)
    step = jax.jit(engine(built).step)
    wanted = actuation.action_to_target(robot, jnp.asarray(action, jnp.float32))
    state, rows = actuation.filter_init(home[7:]), []
    for _ in range(steps):
        target, state = actuation.filter_step(robot, state, wanted)
        command = actuation.motor_command(robot, motors, target)
        data, _ = step(data, jax.tree.map(lambda leaf: leaf[None], command), worlds)
        rows.append(np.asarray(data.qpos[0]))
    return np.array(rows)


@ROBOTS
def test_c_and_mjx_agree_over_twenty_control_steps(made: Any) -> None:
    action = 0.3 * np.sin(np.arange(12.0))
    native = play(made(), lambda built: NativeEngine(built, 1), 20, action)
    ours = play(made(), MjxEngine, 20, action)
    assert np.abs(native[-1] - native[0]).max() > 0.05, "it moves"
    np.testing.assert_allclose(ours, native, atol=PARITY)


PARITY = 2e-3
"""m and rad after 1 s on four feet: float32 and solver steps against C."""


@ROBOTS
def test_zero_action_stands(made: Any) -> None:
    robot = made()
    qpos = play(robot, lambda built: NativeEngine(built, 1), 100, np.zeros(12))
    upright = 1.0 - 2.0 * (qpos[:, 4] ** 2 + qpos[:, 5] ** 2)
    assert upright.min() > 0.98
    assert 0.0 < robot.home_height - qpos[-1, 2] < 0.04
    assert np.abs(qpos[-1] - qpos[-20]).max() < 2e-3, "it is at rest"


@ROBOTS
def test_gaits_find_the_legs_by_where_they_are(made: Any) -> None:
    robot = made()
    right, left, hind_right, hind_left = (slice(3 * leg, 3 * leg + 3) for leg in robot.corners)
    wide = dataclasses.replace(robot, action_half_range=per_joint(1.2))
    trot, bound = action_table(TROT, wide), action_table(BOUND, wide)
    np.testing.assert_allclose(trot[:, right], trot[:, hind_left], atol=1.0)
    np.testing.assert_allclose(bound[:, right], bound[:, left], atol=1e-6)
    np.testing.assert_allclose(bound[:, hind_right], bound[:, hind_left], atol=1e-6)
    np.testing.assert_allclose(trot[:, right], np.roll(trot[:, left], 4, axis=0), atol=1e-6)
    assert np.abs(bound[:, right] - bound[:, hind_right]).max() > 0.1


def test_captions_and_colours_name_the_legs_of_the_robot() -> None:
    robot, strength = other(), np.array([1.0, 0.5, 1.0, 1.0])
    assert look.describe("weakened", robot, make_dynamics(), strength) == "FR leg at 50 %"
    model = build_scene(robot=robot).mj_model
    plain = model.geom_rgba.copy()
    look.paint(model, robot, make_dynamics(), strength)
    red = np.flatnonzero((model.geom_rgba != plain).any(axis=1))
    assert {model.body(model.geom_bodyid[i]).name for i in red} == set(robot.links[1])


def test_control_step_is_the_robots() -> None:
    quick = dataclasses.replace(other(), control_dt=0.02)
    assert build_scene(robot=quick).options.n_substeps == 4
    with pytest.raises(
        ValueError, match=r"sim_dt 0.025 s does not divide the control step of 0.02"
    ):
        build_scene(robot=quick, options=SimOptions(sim_dt=0.025))


def test_registry(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(robots, "ROBOTS", dict(robots.ROBOTS))
    assert get_robot("a1") is A1
    assert register_robot(other()) is other()
    assert get_robot("other") is register_robot(other())
    with pytest.raises(ValueError, match=r"another robot called 'other'.*none of a1, other"):
        register_robot(dataclasses.replace(other()))
    with pytest.raises(ValueError, match=r"unknown robot 'othr'.*a1, other \(nearest: 'other'\)"):
        get_robot("othr")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (('axis="1 0 0"', 'axis="0 0 1"'), r"joint FL_hip_joint turns about \[0.0, 0.0, 1.0\]; "),
        (('pos="0 0 -0.21"', 'pos="0.05 0 -0.21"'), r"calf joints at \[\[0.05, 0.0, -0.21\]"),
        (('<freejoint name="float"/>', '<joint type="slide"/>'), "'sit': invalid qpos size"),
        (('<body name="crate" pos="2 0 0">', '<body pos="2 0 0"><joint name="door"/>'),
         r"the model's joints are \['door', 'FL_hip_joint'.*expected a quadruped"),
        (('axis="1 0 0" range', 'axis="1 0 0" pos="0 0 0.1" range'),
         r"FL_hip_joint is placed at \[0.0, 0.0, 0.1\], not 0"),
        (("</actuator>", '</actuator><equality><weld body1="base"/></equality>'),
         "has 1 equalities and 0 tendons"),
        (("<mujoco model", "<muco model"), "its XML: "),
    ],
)  # fmt: skip
def test_other_families_are_refused(change: tuple[str, str], words: str) -> None:
    joints = [f"{leg}_{part}_joint" for leg in CORNERS for part in ("hip", "thigh", "calf")]
    with pytest.raises(ValueError, match=words) as error:
        Robot.from_mjcf("other", quadruped(change=change), **FACTS, joints=joints)
    assert "\n" not in str(error.value)
    assert "robot 'other'" in str(error.value)


@pytest.mark.parametrize(
    ("facts", "words"),
    [
        ({"feet": ("FL_toe",)}, r"feet are \['FL_toe'\]; need 4"),
        ({"feet": ("FL_tow", "FR_toe", "RR_toe", "RL_toe")}, r"FL_tow.*nearest: 'FL_toe'"),
        ({"feet": ("FL_thigh_collision", "FR_toe", "RR_toe", "RL_toe")}, "straight below"),
        ({"kp": 6e4}, r"kp = 60000.0 is outside \[0.1, 5000.0\]"),
        ({"default_pose": (0, 45.8, -85)}, r"default_pose = 45.8 is outside \[-6.28"),
        ({"default_pose": (0, 0.8, 0.5)}, r"default_pose of FL_calf_joint = 0.5 is outside"),
        ({"default_pose": (0, 0.8)}, r"shape \(2,\)"),
        ({"thigh_length": 213.0}, r"thigh_length = 213.0 is outside"),
        ({"stiffness": 1.0}, r"fact about robot 'other' 'stiffness': choose one of"),
        ({"cutoff_hz": 12.0}, r"cutoff_hz = 12.0 is outside"),
        ({"contact_geoms": A1.contact_geoms[4:]}, r"need the trunk's \(-1\) first"),
    ],
)
def test_implausible_facts_are_refused(facts: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Robot.from_mjcf("other", quadruped(), **FACTS | facts)


def test_missing_things_are_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"robot 'other': no MJCF file .*absent.xml"):
        Robot.from_mjcf("other", tmp_path / "absent.xml", **FACTS)
    weak = quadruped(change=(' forcerange="-30 30"', ""))
    with pytest.raises(
        ValueError, match="no torque limit for joint FL_hip_joint: give torque_limit"
    ):
        Robot.from_mjcf("other", weak, **FACTS)


def test_record_and_file_must_agree() -> None:
    longer = dataclasses.replace(other(), thigh_length=0.22)
    with pytest.raises(ValueError, match=r"thigh_length is 0.22 in the record, 0.21 in its MJCF"):
        build_scene(robot=longer)
    renamed = dataclasses.replace(other(), joints=("FL_hop_joint", *other().joints[1:]))
    with pytest.raises(ValueError, match=r"'FL_hop_joint'.*nearest: 'FL_hip_joint'"):
        build_scene(robot=renamed)


def test_motions_of_the_a1_are_refused_to_others() -> None:
    with pytest.raises(ValueError, match="no leap can be planned for robot 'other': the planner"):
        make_leap(robot=other())
    with pytest.raises(ValueError, match="'leap' is a motion of robot 'a1', not of 'other'"):
        load_clip("leap", other())


def test_a_path_or_a_function_serve_as_well_as_a_string(tmp_path: Path) -> None:
    path = tmp_path / "other.xml"
    path.write_text(quadruped())
    for model in (path, str(path), lambda: path, quadruped):
        robot = Robot.from_mjcf("other", model, **FACTS)
        assert robot.contact_mask(FOOT).sum() == 4
        assert robot.mass == pytest.approx(other().mass)
