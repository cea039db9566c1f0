"""The compiled A1 against the facts of its record and against statics."""

import itertools

import mujoco
import numpy as np
import pytest

from twirl_mjx.sim.mjcf import robot_model
from twirl_mjx.sim.robot import BODY_CLASSES, CALF, FOOT, HIP, LEG_JOINTS, THIGH, TRUNK
from twirl_mjx.sim.robots import A1

TRUNK_MASS, LINK_MASSES = 4.713, (0.696, 1.013, 0.226)
"""kg: trunk; hip, thigh, calf with foot (sources in ``assets/a1/README.md``)."""


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(A1.model()))


def on_ground(friction: float) -> mujoco.MjModel:
    """The robot on a plane that follows the contact rule of ``a1.xml``."""
    spec = mujoco.MjSpec.from_file(str(A1.model()))
    spec.worldbody.add_geom(
        name="floor",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[0, 0, 0.05],
        contype=1,
        conaffinity=0,
        priority=1,
        friction=[friction, 0.005, 0.0001],
    )
    return spec.compile()


@pytest.fixture(scope="module")
def grounded() -> mujoco.MjModel:
    return on_ground(1.0)


def test_scenes_leave_the_file_as_it_is(model):
    """Shapes and motors are written anew for every robot: the A1's are the file's own."""
    ours = robot_model(A1)
    saved = []
    for made in (model, ours):
        saved.append(np.zeros(mujoco.mj_sizeModel(made), np.uint8))
        mujoco.mj_saveModel(made, None, saved[-1])
    np.testing.assert_array_equal(*saved)


def at_key(model: mujoco.MjModel, name: str) -> mujoco.MjData:
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key(name).id)
    mujoco.mj_forward(model, data)
    return data


def test_joints_and_actuators_are_in_order(model):
    assert (model.nq, model.nv, model.nu) == (19, 18, 12)
    assert model.joint(0).name == "root"
    assert model.joint(0).type[0] == mujoco.mjtJoint.mjJNT_FREE
    for i in range(12):
        joint, actuator = model.joint(i + 1), model.actuator(i)
        assert joint.name == A1.joints[i]
        assert joint.qposadr[0] == 7 + i
        assert actuator.name == A1.actuators[i]
        assert actuator.trnid[0] == joint.id


def test_gains_limits_and_passive_joint_terms(model):
    np.testing.assert_array_equal(model.actuator_gainprm[:, 0], A1.kp[0])
    bias = np.tile([0.0, -A1.kp[0], -A1.kd[0]], (12, 1))
    np.testing.assert_array_equal(model.actuator_biasprm[:, :3], bias)
    limit = np.tile([-A1.torque_limit[0], A1.torque_limit[0]], (12, 1))
    np.testing.assert_array_equal(model.actuator_forcerange, limit)
    assert model.actuator_forcelimited.all()
    np.testing.assert_allclose(model.actuator_ctrlrange, A1.joint_limits)
    np.testing.assert_allclose(model.jnt_range[1:], A1.joint_limits)
    assert model.jnt_limited[1:].all()
    np.testing.assert_array_equal(model.dof_armature, [0] * 6 + [A1.armature[0]] * 12)
    np.testing.assert_array_equal(model.dof_damping, [0] * 6 + [A1.damping[0]] * 12)
    assert not model.dof_frictionloss.any()


def test_angles_are_radians(model):
    # Degrees read as radians would give a range 57 times too small (a1.xml needs its compiler tag).
    assert np.ptp(model.joint("FR_thigh_joint").range) > 5.0
    assert model.joint("FR_calf_joint").range[1] < -0.9


def test_axes_turn_the_leg_as_documented(model):
    data = at_key(model, "home")
    data.qpos[7:] = 0.0
    data.qpos[7] = 0.3  # FR hip: rotation about +x moves the hanging foot to +y
    data.qpos[11] = 0.3  # FL thigh: rotation about +y moves the hanging foot to -x
    mujoco.mj_forward(model, data)
    base = data.qpos[:3]
    fr, fl = data.geom("FR_foot").xpos - base, data.geom("FL_foot").xpos - base
    assert fr[1] > -0.047 - 0.08505 + 0.05
    assert fl[0] < 0.183 - 0.05


def test_masses_and_inertias(model):
    expected = {A1.trunk: TRUNK_MASS}
    for leg in A1.legs:
        parts = zip(LEG_JOINTS, LINK_MASSES, strict=True)
        expected |= {f"{leg}_{part}": mass for part, mass in parts}
    assert model.nbody == 1 + len(expected)
    for name, mass in expected.items():
        assert model.body(name).mass[0] == pytest.approx(mass, abs=1e-9), name
        smallest, middle, largest = np.sort(model.body(name).inertia)
        assert smallest > 0, name
        assert smallest + middle >= largest, name
    assert model.body_mass.sum() == pytest.approx(12.45, abs=0.01)
    assert pytest.approx(model.body_mass.sum(), abs=1e-9) == A1.mass


def test_calf_inertia_is_calf_plus_foot(model):
    """Parallel axes over the URDF's two links: 0.166 kg calf and 0.06 kg foot at its end."""
    masses = np.array([0.166, 0.06])
    centres = np.array([[0.006435, 0.0, -0.107388], [0.0, 0.0, -0.2]])
    own = np.array([0.002997972, 0.003014022, 3.2426e-05]), np.full(3, 9.6e-6)
    centre = masses @ centres / masses.sum()
    tensor = np.zeros((3, 3))
    for mass, c, diagonal in zip(masses, centres, own, strict=True):
        d = c - centre
        tensor += np.diag(diagonal) + mass * (d @ d * np.eye(3) - np.outer(d, d))
    tensor[0, 2] = tensor[2, 0] = tensor[0, 2] - 0.000141163
    for leg in A1.legs:
        body = model.body(f"{leg}_calf")
        np.testing.assert_allclose(body.ipos, centre, atol=1e-8)
        np.testing.assert_allclose(
            np.sort(body.inertia), np.sort(np.linalg.eigvalsh(tensor)), rtol=1e-6
        )


def test_robot_is_symmetric_left_to_right(model):
    for right, left in (("FR", "FL"), ("RR", "RL")):
        for part in LEG_JOINTS:
            a, b = model.body(f"{right}_{part}"), model.body(f"{left}_{part}")
            mirror = np.array([1.0, -1.0, 1.0])
            np.testing.assert_allclose(a.pos, mirror * b.pos, atol=1e-12)
            np.testing.assert_allclose(a.ipos, mirror * b.ipos, atol=1e-12)
            np.testing.assert_allclose(a.inertia, b.inertia, rtol=1e-9)
    assert model.body("FR_hip").pos[1] < 0 < model.body("FL_hip").pos[1]
    for leg, offset in zip(A1.legs, A1.hip_offsets, strict=True):
        np.testing.assert_allclose(model.body(f"{leg}_hip").pos, offset)


def test_contact_table_matches_the_model(model):
    table = {shape.name for shape in A1.contact_geoms}
    assert table == {model.geom(i).name for i in range(model.ngeom) if model.geom_group[i] == 3}
    parts = ("hip_collision", "thigh_collision", "calf_collision", "foot")
    trunk = ("trunk_right", "trunk_left", "head_top", "head_bottom")
    assert table == {f"{name}_collision" for name in trunk} | {
        f"{leg}_{part}" for leg, part in itertools.product(A1.legs, parts)
    }
    for i, shape in enumerate(A1.contact_geoms):
        geom = model.geom(shape.name)
        assert model.body(geom.bodyid[0]).name == A1.body_of(shape)
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, geom.quat)
        sphere = geom.type[0] == mujoco.mjtGeom.mjGEOM_SPHERE
        assert sphere or geom.type[0] == mujoco.mjtGeom.mjGEOM_CAPSULE
        half = np.zeros(3) if sphere else geom.size[1] * rotation.reshape(3, 3)[:, 2]
        ends = np.stack([geom.pos - half, geom.pos + half])
        first, second = np.array(shape.endpoints)
        if np.linalg.norm(ends[1] - first) < np.linalg.norm(ends[0] - first):
            ends = ends[::-1]  # MuJoCo may orient a capsule either way
        np.testing.assert_allclose(ends, [first, second], atol=1e-9, err_msg=shape.name)
        assert geom.size[0] == shape.radius == A1.contact_radii[i]


def test_contact_mask_selects_and_refuses():
    assert A1.contact_mask(FOOT).sum() == 4
    assert A1.contact_mask(TRUNK, HIP, THIGH).sum() == 12
    assert A1.contact_mask(*BODY_CLASSES).all()
    with pytest.raises(ValueError, match="unknown body class 'knee': choose one of trunk, hip"):
        A1.contact_mask("knee")


def test_only_feet_and_calves_meet_the_ground_by_default(model):
    assert not model.geom_contype.any(), "contype 0 everywhere: the robot cannot meet itself"
    able = {model.geom(i).name for i in range(model.ngeom) if model.geom_conaffinity[i]}
    assert able == {*A1.feet, *(f"{leg}_{CALF}_collision" for leg in A1.legs)}
    for name in able:
        geom = model.geom(name)
        assert geom.condim[0] == 3
        assert geom.friction[0] == 1.0
        assert geom.priority[0] == 0
    for leg, name in zip(A1.legs, A1.feet, strict=True):
        np.testing.assert_allclose(model.site(name).pos, model.geom(f"{leg}_foot").pos)


def test_no_self_contact_in_random_poses(model):
    rng = np.random.default_rng(0)
    data = mujoco.MjData(model)
    for _ in range(200):
        data.qpos[:7] = [0, 0, 0.3, 1, 0, 0, 0]
        data.qpos[7:] = rng.uniform(A1.joint_limits[:, 0], A1.joint_limits[:, 1])
        mujoco.mj_forward(model, data)
        assert data.ncon == 0


def test_ground_priority_decides_friction():
    icy = on_ground(0.4)
    data = at_key(icy, "home")
    data.qpos[2] -= 0.001
    mujoco.mj_forward(icy, data)
    assert data.ncon == 4
    for contact in data.contact:
        assert contact.friction[0] == pytest.approx(0.4)


def test_home_pose_settles_and_rests(grounded):
    """Kp 60 carries the weight with a calf torque of about W/4 * 0.157 m, hence 0.08 rad of sag.

    That lowers the base by about 17 mm and, with the feet held by friction, shifts it back by
    about 20 mm; a stiffer or weaker controller, or a slipping foot, falls outside these bounds.
    """
    data = at_key(grounded, "home")
    np.testing.assert_allclose(data.qpos[7:], A1.default_pose)
    assert data.qpos[2] == pytest.approx(A1.home_height, abs=1e-6)
    seconds = round(1.0 / grounded.opt.timestep)
    mujoco.mj_step(grounded, data, nstep=seconds)
    after_one = data.qpos.copy()
    mujoco.mj_step(grounded, data, nstep=seconds)
    assert np.abs(data.qpos[:3] - after_one[:3]).max() < 1e-3, "no drift once settled"
    assert np.abs(data.qvel).max() < 1e-2
    assert -0.025 < data.qpos[0] < -0.015
    assert abs(data.qpos[1]) < 1e-3
    assert 0.013 < A1.home_height - data.qpos[2] < 0.020
    feet = np.array([data.geom(name).xpos for name in A1.feet])
    thighs = A1.hip_offsets[:, :2] + np.outer(A1.side_signs * A1.thigh_offset, [0, 1])
    assert np.abs(feet[:, :2] - thighs).max() < 0.012, "the feet stay where they were put"
    calf_torque = data.actuator_force.reshape(4, 3)[:, 2].mean()
    assert calf_torque == pytest.approx(A1.mass * 9.81 / 4 * 0.2 * np.sin(0.9), rel=0.1)


def test_hind_stand_balances_over_the_hind_feet(grounded):
    data = at_key(grounded, "hind_stand")
    x_axis = data.body(A1.trunk).xmat.reshape(3, 3)[:, 0]
    np.testing.assert_allclose(x_axis, [0, 0, 1], atol=1e-6)
    feet = np.array([data.geom(name).xpos for name in A1.feet])
    hind, front = feet[list(A1.hind_legs)], feet[list(A1.front_legs)]
    np.testing.assert_allclose(hind[:, 2], A1.foot_radius, atol=1e-6)
    assert front[:, 2].min() > 0.5
    com = data.subtree_com[grounded.body(A1.trunk).id]
    assert com[0] == pytest.approx(hind[:, 0].mean(), abs=1e-6)
    assert hind[0, 1] < com[1] < hind[1, 1]
    joints = data.qpos[7:]
    assert (joints > A1.joint_limits[:, 0]).all()
    assert (joints < A1.joint_limits[:, 1]).all()
    assert (np.abs(joints - A1.default_pose) <= A1.action_half_range).all(), "a policy can hold it"
    np.testing.assert_array_equal(joints, data.ctrl)
