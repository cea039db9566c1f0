"""Quaternion helpers against scipy's rotations, on random attitudes."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from twirl_mjx.sim import frames

TOLERANCE = 2e-6  # float32


@pytest.fixture(scope="module")
def quats() -> np.ndarray:
    """Sixteen random attitudes, then identity, a half turn, and nose up by 60 deg."""
    half = np.sqrt(0.5)
    special = [[1, 0, 0, 0], [0, 0, 0, 1], [np.cos(np.pi / 6), 0, -np.sin(np.pi / 6), 0]]
    random = Rotation.random(16, rng=np.random.default_rng(3)).as_quat(scalar_first=True)
    return np.concatenate([random, special, [[half, half, 0, 0]]]).astype(np.float32)


@pytest.fixture(scope="module")
def vectors(quats: np.ndarray) -> np.ndarray:
    return np.random.default_rng(4).standard_normal((len(quats), 3)).astype(np.float32)


def scipy_of(quats: np.ndarray) -> Rotation:
    return Rotation.from_quat(quats, scalar_first=True)


def close(actual: object, expected: np.ndarray, tolerance: float = TOLERANCE) -> None:
    np.testing.assert_allclose(np.asarray(actual), expected, atol=tolerance)


def test_rotate_by_hand() -> None:
    """A quarter turn to the left takes forward to left and left to backward."""
    quat = frames.from_yaw(jnp.float32(np.pi / 2))
    close(frames.rotate(quat, jnp.array([1.0, 0.0, 0.0])), np.array([0, 1, 0]))
    close(frames.rotate(quat, jnp.array([0.0, 1.0, 0.5])), np.array([-1, 0, 0.5]))


def test_pitch_by_hand() -> None:
    """A positive pitch lowers the nose: the base x-axis points down."""
    x_axis, _, z_axis = frames.base_axes(frames.from_pitch(jnp.float32(np.pi / 2)))
    close(x_axis, np.array([0, 0, -1]))
    close(z_axis, np.array([1, 0, 0]))


def test_rotate_and_back(quats: np.ndarray, vectors: np.ndarray) -> None:
    close(frames.rotate(jnp.asarray(quats), vectors), scipy_of(quats).apply(vectors), 1e-5)
    inverse = scipy_of(quats).inv().apply(vectors)
    close(frames.rotate_inverse(jnp.asarray(quats), jnp.asarray(vectors)), inverse, 1e-5)


def test_multiply_applies_the_right_factor_first(quats: np.ndarray, vectors: np.ndarray) -> None:
    product = frames.multiply(jnp.asarray(quats), jnp.asarray(quats[::-1]))
    expected = (scipy_of(quats) * scipy_of(quats[::-1])).apply(vectors)
    close(scipy_of(np.asarray(product)).apply(vectors), expected, 1e-5)


def test_base_axes_are_the_columns_of_the_matrix(quats: np.ndarray) -> None:
    axes = np.stack([np.asarray(axis) for axis in frames.base_axes(jnp.asarray(quats))], axis=-1)
    close(axes, scipy_of(quats).as_matrix())


def test_euler_angles(quats: np.ndarray) -> None:
    yaw, pitch, roll = scipy_of(quats).as_euler("ZYX").T
    close(frames.roll_pitch(jnp.asarray(quats)), np.stack([roll, pitch], axis=-1), 1e-5)
    turn = np.asarray(frames.yaw(jnp.asarray(quats))) - yaw
    close(np.arctan2(np.sin(turn), np.cos(turn)), np.zeros(len(quats)), 1e-5)


def test_roll_and_pitch_are_finite_straight_up() -> None:
    quat = jnp.array([np.sqrt(0.5), 0.0, -np.sqrt(0.5), 0.0], jnp.float32)
    roll, pitch = frames.roll_pitch(quat)
    assert np.isfinite(roll)
    close(pitch, np.array(-np.pi / 2), 1e-3)  # arcsin near 1 loses half the digits


def test_rotation_angle(quats: np.ndarray) -> None:
    close(frames.rotation_angle(jnp.asarray(quats)), scipy_of(quats).magnitude(), 1e-5)
    close(frames.rotation_angle(-jnp.asarray(quats)), scipy_of(quats).magnitude(), 1e-5)
