"""Closed-form kinematics of the A1: contact shapes and feet from joint angles, and leg IK.

Engine-independent, so that ground, hurdle and flight tests can run at every physics substep, and
motions can be made without a simulator. Any leading axes are allowed and the four legs are an
axis, not a loop. A leg is a hip rotation about x, then a thigh and a calf that both turn about y;
with ``t`` the thigh and ``k`` the calf angle, a point at ``along_thigh`` and ``along_calf`` metres
down the two links has in the hip frame

    x = -along_thigh sin(t) - along_calf sin(t + k)
    z = -along_thigh cos(t) - along_calf cos(t + k)

and a constant y.
"""

from __future__ import annotations

from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from twirl_mjx.sim import a1, frames

_TWO_PI = 2.0 * np.pi
_THIGH_CENTRE = float(a1.JOINT_LIMITS[1].mean())


def _reach(calf: float) -> float:
    """Return the distance in m from thigh joint to foot centre at a calf angle in rad."""
    l1, l2 = a1.THIGH_LENGTH, a1.CALF_LENGTH
    return float(np.sqrt(l1**2 + l2**2 + 2 * l1 * l2 * np.cos(calf)))


REACH_LIMITS = (_reach(a1.JOINT_LIMITS[2, 0]), _reach(a1.JOINT_LIMITS[2, 1]))
"""(shortest, longest) m, thigh joint to foot centre at the calf joint's limits."""


class Points(flax.struct.PyTreeNode):
    """World-frame positions of the robot's contact shapes."""

    endpoints: jax.Array
    """[..., G, 2, 3] m, ends of every capsule axis, world frame, order ``a1.CONTACT_GEOMS``."""
    feet: jax.Array
    """[..., 4, 3] m, foot centres, world frame, order ``a1.LEGS``."""
    base_rotation: jax.Array
    """[..., 3, 3] base to world; its columns are the base axes in the world frame."""


def _point_table() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Split ``a1.CONTACT_GEOMS`` into trunk points [K, 3] and leg-point coefficients.

    Returns:
        Trunk points [K, 3] m, and for the P points of a leg: lateral offset [4, P], distance
        along the thigh [P] and along the calf [P], all in m.
    """
    trunk = [point for geom in a1.CONTACT_GEOMS if geom.leg < 0 for point in geom.endpoints]
    lateral, thigh, calf = [], [], []
    for leg in range(4):  # the along-link distances are the same for every leg
        geoms = [geom for geom in a1.CONTACT_GEOMS if geom.leg == leg]
        plane = a1.SIDE_SIGNS[leg] * a1.THIGH_OFFSET
        rows = [(geom.body, point) for geom in geoms for point in geom.endpoints]
        lateral.append([p[1] if body == a1.HIP else plane + p[1] for body, p in rows])
        thigh = [
            {a1.HIP: 0.0, a1.THIGH: -p[2], a1.CALF: a1.THIGH_LENGTH, a1.FOOT: a1.THIGH_LENGTH}[body]
            for body, p in rows
        ]
        calf = [-p[2] if body in (a1.CALF, a1.FOOT) else 0.0 for body, p in rows]
    return np.array(trunk), np.array(lateral), np.array(thigh), np.array(calf)


_FOOT_INDEX = np.flatnonzero(a1.contact_mask(a1.FOOT))
_TRUNK_POINTS, _LATERAL, _ALONG_THIGH, _ALONG_CALF = _point_table()


def _leg_points(
    joint_pos: Any, lateral: np.ndarray, along_thigh: np.ndarray, along_calf: np.ndarray
) -> tuple[Any, Any, Any]:
    """Return x, y, z [..., 4, P] m in the base frame of P points on every leg.

    Args:
        joint_pos: [..., 12] rad, numpy or jax; the result is of the same kind and dtype.
        lateral: [4, P] m, y in the hip frame.
        along_thigh: [P] m from the thigh joint down the thigh.
        along_calf: [P] m from the calf joint down the calf.
    """
    dtype = joint_pos.dtype
    angles = joint_pos.reshape(*joint_pos.shape[:-1], 4, 3)
    in_jax = isinstance(joint_pos, jax.Array)
    xp: Any = jnp if in_jax else np
    # hip angle, then the thigh's and the calf's from the vertical of the leg plane
    angles = xp.concatenate([angles[..., :2], angles[..., 1:2] + angles[..., 2:]], axis=-1)
    sin, cos = xp.sin(angles), xp.cos(angles)
    if in_jax:
        # Left alone, XLA repeats the sines in every point that uses them: five times slower (CPU).
        sin, cos = jax.lax.optimization_barrier((sin, cos))
    a, b = along_thigh.astype(dtype), along_calf.astype(dtype)
    lateral, offsets = lateral.astype(dtype), a1.HIP_OFFSETS.astype(dtype)
    x = -a * sin[..., 1:2] - b * sin[..., 2:3]
    z = -a * cos[..., 1:2] - b * cos[..., 2:3]
    sin_hip, cos_hip = sin[..., 0:1], cos[..., 0:1]
    return (
        offsets[:, 0:1] + x,
        offsets[:, 1:2] + cos_hip * lateral - sin_hip * z,
        offsets[:, 2:3] + sin_hip * lateral + cos_hip * z,
    )


def foot_positions(joint_pos: Any) -> Any:
    """Return the foot centres in the base frame.

    Args:
        joint_pos: [..., 12] rad, float numpy or jax array; the result is of the same kind.

    Returns:
        [..., 4, 3] m, order ``a1.LEGS``.
    """
    if not isinstance(joint_pos, jax.Array):
        joint_pos = np.asarray(joint_pos, np.result_type(joint_pos, np.float32))
    lateral = (a1.SIDE_SIGNS * a1.THIGH_OFFSET)[:, None]
    link = np.array([a1.THIGH_LENGTH]), np.array([a1.CALF_LENGTH])
    xp: Any = jnp if isinstance(joint_pos, jax.Array) else np
    return xp.concatenate(_leg_points(joint_pos, lateral, *link), axis=-1)


def forward(qpos: jax.Array) -> Points:
    """Return every contact shape and foot in the world frame.

    Args:
        qpos: [..., 19] base position (m), unit quaternion wxyz, 12 joint angles (rad).

    Returns:
        ``Points`` with the same leading axes.
    """
    qpos = jnp.asarray(qpos)
    lead = qpos.shape[:-1]
    legs = _leg_points(qpos[..., 7:], _LATERAL, _ALONG_THIGH, _ALONG_CALF)
    x_axis, y_axis, z_axis = frames.base_axes(qpos[..., 3:7])
    local = []
    for i in range(3):
        trunk = jnp.broadcast_to(
            _TRUNK_POINTS[:, i].astype(qpos.dtype), (*lead, len(_TRUNK_POINTS))
        )
        local.append(jnp.concatenate([trunk, legs[i].reshape(*lead, -1)], axis=-1))
    world = [
        qpos[..., i : i + 1]
        + x_axis[..., i : i + 1] * local[0]
        + y_axis[..., i : i + 1] * local[1]
        + z_axis[..., i : i + 1] * local[2]
        for i in range(3)
    ]
    points = jax.lax.optimization_barrier(jnp.stack(world, axis=-1))
    endpoints = points.reshape(*lead, a1.NUM_CONTACT_GEOMS, 2, 3)
    return Points(
        endpoints=endpoints,
        feet=endpoints[..., _FOOT_INDEX, 0, :],
        base_rotation=jnp.stack([x_axis, y_axis, z_axis], axis=-1),
    )


def leg_inverse(foot_pos: np.ndarray, *, above: bool | np.ndarray = False) -> np.ndarray:
    """Return the joint angles that put the feet where asked (closed form, numpy).

    Of the two hip angles that reach a point, the one with the foot below the hip axis in the
    leg's own plane is taken, or above it where ``above`` is set (a leg folded past horizontal).
    The knee bends backwards, the only way its limits allow.

    Args:
        foot_pos: [..., 4, 3] m, foot centres in the base frame, order ``a1.LEGS``.
        above: bool, or bool array broadcastable to [..., 4].

    Returns:
        [..., 12] rad.

    Raises:
        ValueError: a foot is out of reach or an angle outside its limits; the message names
            leg, value and allowed range.
    """
    foot_pos = np.asarray(foot_pos, np.float64)
    if foot_pos.shape[-2:] != (4, 3):
        raise ValueError(f"foot_pos must have shape [..., 4, 3], got {list(foot_pos.shape)}")
    p = foot_pos - a1.HIP_OFFSETS
    lateral = a1.SIDE_SIGNS * a1.THIGH_OFFSET
    height_sq = p[..., 1] ** 2 + p[..., 2] ** 2 - lateral**2
    _check(
        np.sqrt(p[..., 1] ** 2 + p[..., 2] ** 2),
        (a1.THIGH_OFFSET, np.inf),
        "distance of the foot from the hip axis",
        "m",
    )
    z = np.where(above, 1.0, -1.0) * np.sqrt(np.maximum(height_sq, 0.0))
    distance = np.hypot(p[..., 0], z)
    _check(distance, REACH_LIMITS, "distance of the foot from the thigh joint", "m")
    hip = np.arctan2(p[..., 2], p[..., 1]) - np.arctan2(z, lateral)
    l1, l2 = a1.THIGH_LENGTH, a1.CALF_LENGTH
    cos_calf = (distance**2 - l1**2 - l2**2) / (2 * l1 * l2)
    calf = -np.arccos(np.clip(cos_calf, -1.0, 1.0))
    thigh = np.arctan2(-p[..., 0], -z) - np.arctan2(l2 * np.sin(calf), l1 + l2 * np.cos(calf))
    hip = _wrap(hip, 0.0)
    thigh = _wrap(thigh, _THIGH_CENTRE)
    for angle, joint, limits in zip(
        (hip, thigh, calf), a1.LEG_JOINTS, a1.JOINT_LIMITS[:3], strict=True
    ):
        _check(angle, (float(limits[0]), float(limits[1])), f"{joint} angle", "rad")
    return np.stack([hip, thigh, calf], axis=-1).reshape(*foot_pos.shape[:-2], 12)


def _wrap(angle: np.ndarray, centre: float) -> np.ndarray:
    """Return ``angle`` shifted by whole turns into [centre - pi, centre + pi) rad."""
    return (angle - centre + np.pi) % _TWO_PI - np.pi + centre


def _check(value: np.ndarray, limits: tuple[float, float], what: str, unit: str) -> None:
    """Raise unless every ``value`` [..., 4] lies within ``limits`` (1e-9 tolerance)."""
    low, high = limits
    excess = np.maximum(low - value, value - high)
    if not np.all(excess <= 1e-9):
        worst = np.unravel_index(np.argmax(np.where(np.isnan(excess), np.inf, excess)), value.shape)
        bad = float(value[worst])
        nearest = low if bad < low else high
        raise ValueError(
            f"leg {a1.LEGS[worst[-1]]} at index {tuple(int(i) for i in worst[:-1])}: {what} is "
            f"{bad:.4f} {unit}, allowed [{low:.4f}, {high:.4f}], nearest {nearest:.4f}"
        )
