"""Closed-form kinematics against C MuJoCo, and the leg IK against its own forward kinematics."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from twirl_mjx.sim import kinematics
from twirl_mjx.sim.robots import A1

TOLERANCE = 1e-5
"""m: float32 positions a few metres from the origin; C MuJoCo works in float64."""


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(A1.model()))


def random_qpos(rng: np.random.Generator, count: int) -> np.ndarray:
    """Random poses [count, 19]: position = U(-3, 3) m, uniform rotation, joints in their limits."""
    quat = rng.normal(size=(count, 4))
    quat /= np.linalg.norm(quat, axis=-1, keepdims=True)
    joints = rng.uniform(A1.joint_limits[:, 0], A1.joint_limits[:, 1], size=(count, 12))
    return np.concatenate([rng.uniform(-3, 3, (count, 3)), quat, joints], axis=-1)


def reference(model: mujoco.MjModel, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Capsule ends [B, G, 2, 3], feet [B, 4, 3] and base rotation [B, 3, 3] from C MuJoCo."""
    data = mujoco.MjData(model)
    ends, feet, rotation = [], [], []
    for row in qpos:
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        pair = []
        for shape in A1.contact_geoms:
            geom = data.geom(shape.name)
            is_capsule = model.geom(shape.name).type[0] == mujoco.mjtGeom.mjGEOM_CAPSULE
            half = model.geom(shape.name).size[1] if is_capsule else 0.0
            axis = geom.xmat.reshape(3, 3)[:, 2] * half
            # MuJoCo is free to orient a capsule either way: take the table's orientation.
            body = data.body(A1.body_of(shape))
            first = body.xpos + body.xmat.reshape(3, 3) @ np.array(shape.endpoints[0])
            both = [geom.xpos - axis, geom.xpos + axis]
            if np.linalg.norm(both[1] - first) < np.linalg.norm(both[0] - first):
                both.reverse()
            pair.append(both)
        ends.append(pair)
        feet.append([data.geom(name).xpos.copy() for name in A1.feet])
        rotation.append(data.body(A1.trunk).xmat.reshape(3, 3).copy())
    return np.array(ends), np.array(feet), np.array(rotation)


def test_forward_agrees_with_mujoco(model):
    qpos = random_qpos(np.random.default_rng(0), 50)
    ends, feet, rotation = reference(model, qpos)
    points = jax.jit(functools.partial(kinematics.forward, A1))(jnp.asarray(qpos, jnp.float32))
    np.testing.assert_allclose(points.endpoints, ends, atol=TOLERANCE)
    np.testing.assert_allclose(points.feet, feet, atol=TOLERANCE)
    np.testing.assert_allclose(points.base_rotation, rotation, atol=TOLERANCE)


def test_forward_takes_any_leading_axes():
    qpos = jnp.asarray(random_qpos(np.random.default_rng(1), 6), jnp.float32)
    flat = kinematics.forward(A1, qpos)
    nested = kinematics.forward(A1, qpos.reshape(2, 3, 19))
    single = kinematics.forward(A1, qpos[4])
    assert flat.endpoints.dtype == jnp.float32
    assert nested.endpoints.shape == (2, 3, len(A1.contact_geoms), 2, 3)
    assert single.feet.shape == (4, 3)
    np.testing.assert_allclose(nested.endpoints.reshape(flat.endpoints.shape), flat.endpoints)
    np.testing.assert_allclose(single.feet, flat.feet[4], atol=1e-6)


def test_foot_positions_numpy_and_jax_agree_with_forward():
    qpos = random_qpos(np.random.default_rng(2), 8)
    qpos[:, :7] = [0, 0, 0, 1, 0, 0, 0]
    feet = kinematics.foot_positions(A1, qpos[:, 7:])
    assert isinstance(feet, np.ndarray)
    assert feet.dtype == np.float64
    in_jax = kinematics.foot_positions(A1, jnp.asarray(qpos[:, 7:], jnp.float32))
    assert isinstance(in_jax, jax.Array)
    np.testing.assert_allclose(in_jax, feet, atol=TOLERANCE)
    points = kinematics.forward(A1, jnp.asarray(qpos, jnp.float32))
    np.testing.assert_allclose(points.feet, feet, atol=TOLERANCE)


def test_default_pose_puts_the_feet_below_the_thighs():
    feet = kinematics.foot_positions(A1, A1.default_pose)
    expected_y = A1.hip_offsets[:, 1] + A1.side_signs * A1.thigh_offset
    np.testing.assert_allclose(feet[:, 0], A1.hip_offsets[:, 0], atol=1e-12)
    np.testing.assert_allclose(feet[:, 1], expected_y, atol=1e-12)
    np.testing.assert_allclose(feet[:, 2], A1.foot_radius - A1.home_height, atol=1e-12)


def test_inverse_recovers_joint_angles():
    rng = np.random.default_rng(3)
    joints = rng.uniform(A1.joint_limits[:, 0], A1.joint_limits[:, 1], size=(500, 12))
    legs = joints.reshape(-1, 4, 3)
    above = np.cos(legs[..., 1]) + np.cos(legs[..., 1] + legs[..., 2]) < 0
    assert 0.1 < above.mean() < 0.9, "both branches must be drawn"
    solved = kinematics.leg_inverse(A1, kinematics.foot_positions(A1, joints), above=above)
    np.testing.assert_allclose(solved, joints, atol=1e-6)


def test_inverse_round_trip_on_positions():
    rng = np.random.default_rng(4)
    feet = kinematics.foot_positions(A1, A1.default_pose) + rng.uniform(-0.06, 0.06, (7, 5, 4, 3))
    joints = kinematics.leg_inverse(A1, feet)
    assert joints.shape == (7, 5, 12)
    np.testing.assert_allclose(kinematics.foot_positions(A1, joints), feet, atol=1e-9)


@pytest.mark.parametrize(
    ("shift", "words"),
    [
        ((0.0, 0.0, -0.2), "leg RR.*from the thigh joint is 0.4486 m, allowed .0.0883, 0.3587"),
        ((0.0, 0.0, 0.2), "leg RR.*from the thigh joint is 0.0486 m, allowed .0.0883, 0.3587"),
        ((0.0, 0.0851, 0.2486), "leg RR.*from the hip axis is 0.00.*allowed .0.0851, inf"),
        ((0.0, -0.25, 0.1), "leg RR.*hip angle is .*allowed .-0.8029, 0.8029"),
        ((np.nan, 0.0, 0.0), "leg RR.*is nan m"),
    ],
)
def test_inverse_names_what_is_out_of_reach(shift, words):
    feet = np.tile(kinematics.foot_positions(A1, A1.default_pose), (3, 1, 1))
    feet[1, 2] += shift
    with pytest.raises(ValueError, match=words) as error:
        kinematics.leg_inverse(A1, feet)
    assert "index (1,)" in str(error.value)


def test_inverse_refuses_a_wrong_shape():
    with pytest.raises(ValueError, match=r"\[\.\.\., 4, 3\], got \[12\]"):
        kinematics.leg_inverse(A1, np.zeros(12))
