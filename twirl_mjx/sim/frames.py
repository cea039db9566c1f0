"""Quaternion and frame helpers (quaternions are [w, x, y, z], unit, body to world)."""

from __future__ import annotations

import jax
import jax.numpy as jnp


def rotate(quat: jax.Array, vec: jax.Array) -> jax.Array:
    """Rotate body-frame vectors into the world frame.

    Args:
        quat: [..., 4] unit quaternions.
        vec: [..., 3] vectors in the body frame.

    Returns:
        [..., 3] the same vectors in the world frame.
    """
    w, u = quat[..., :1], quat[..., 1:]
    t = 2.0 * jnp.cross(u, vec)
    return vec + w * t + jnp.cross(u, t)


def conjugate(quat: jax.Array) -> jax.Array:
    """Return the inverse rotation of unit quaternions [..., 4]."""
    return quat * jnp.array([1.0, -1.0, -1.0, -1.0], quat.dtype)


def rotate_inverse(quat: jax.Array, vec: jax.Array) -> jax.Array:
    """Rotate world-frame vectors [..., 3] into the body frame of ``quat`` [..., 4]."""
    return rotate(conjugate(quat), vec)


def multiply(a: jax.Array, b: jax.Array) -> jax.Array:
    """Return the Hamilton product ``a * b`` of quaternions [..., 4] (``b`` is applied first)."""
    aw, ax, ay, az = a[..., 0], a[..., 1], a[..., 2], a[..., 3]
    bw, bx, by, bz = b[..., 0], b[..., 1], b[..., 2], b[..., 3]
    return jnp.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def base_axes(quat: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return the base x-, y- and z-axes in the world frame, three arrays [..., 3]."""
    w, x, y, z = quat[..., 0], quat[..., 1], quat[..., 2], quat[..., 3]
    x_axis = jnp.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], axis=-1)
    y_axis = jnp.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], axis=-1)
    z_axis = jnp.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=-1)
    return x_axis, y_axis, z_axis


def roll_pitch(quat: jax.Array) -> jax.Array:
    """Return roll and pitch [..., 2] in rad of the intrinsic yaw-pitch-roll (ZYX) angles.

    At pitch = +-90 deg roll is ill defined; ``arctan2`` still returns a finite number there.
    """
    w, x, y, z = quat[..., 0], quat[..., 1], quat[..., 2], quat[..., 3]
    roll = jnp.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = jnp.arcsin(jnp.clip(2 * (w * y - z * x), -1.0, 1.0))
    return jnp.stack([roll, pitch], axis=-1)


def yaw(quat: jax.Array) -> jax.Array:
    """Return the yaw [...] in rad of the ZYX Euler angles."""
    w, x, y, z = quat[..., 0], quat[..., 1], quat[..., 2], quat[..., 3]
    return jnp.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def from_yaw(angle: jax.Array) -> jax.Array:
    """Return the quaternion [..., 4] of a rotation by ``angle`` [...] rad about world z."""
    zero = jnp.zeros_like(angle)
    return jnp.stack([jnp.cos(angle / 2), zero, zero, jnp.sin(angle / 2)], axis=-1)


def from_pitch(angle: jax.Array) -> jax.Array:
    """Return the quaternion [..., 4] of a rotation by ``angle`` [...] rad about y."""
    zero = jnp.zeros_like(angle)
    return jnp.stack([jnp.cos(angle / 2), zero, jnp.sin(angle / 2), zero], axis=-1)


def rotation_angle(quat: jax.Array) -> jax.Array:
    """Return the rotation angle [...] in [0, pi] rad of unit quaternions [..., 4]."""
    return 2.0 * jnp.arctan2(jnp.linalg.norm(quat[..., 1:], axis=-1), jnp.abs(quat[..., 0]))
