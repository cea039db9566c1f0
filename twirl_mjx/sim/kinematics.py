"""Closed-form kinematics of a robot: contact shapes and feet from joint angles, and leg IK.

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

import functools
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from twirl_mjx.sim import frames
from twirl_mjx.sim.robot import CALF, FOOT, HIP, LEG_JOINTS, LEG_SIZE, NUM_LEGS, THIGH, Robot

_TWO_PI = 2.0 * np.pi


def reach_limits(robot: Robot) -> tuple[float, float]:
    """Return (shortest, longest) m from thigh joint to foot centre at the calf joint's limits."""
    l1, l2 = robot.thigh_length, robot.calf_length
    shortest, longest = (
        float(np.sqrt(l1**2 + l2**2 + 2 * l1 * l2 * np.cos(calf)))
        for calf in robot.joint_limits[LEG_SIZE - 1]
    )
    return shortest, longest


class Points(flax.struct.PyTreeNode):
    """World-frame positions of the robot's contact shapes."""

    endpoints: jax.Array
    """[..., G, 2, 3] m, ends of every capsule axis, world frame, order ``Robot.contact_geoms``."""
    feet: jax.Array
    """[..., 4, 3] m, foot centres, world frame, order ``Robot.legs``."""
    base_rotation: jax.Array
    """[..., 3, 3] base to world; its columns are the base axes in the world frame."""


@functools.cache
def _point_table(robot: Robot) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Split the contact shapes into trunk points [K, 3] and leg-point coefficients.

    Returns:
        Trunk points [K, 3] m, and for the P points of a leg: lateral offset [4, P], distance
        along the thigh [P] and along the calf [P], all in m.
    """
    trunk = [point for geom in robot.contact_geoms if geom.leg < 0 for point in geom.endpoints]
    lateral, thigh, calf = [], [], []
    for leg in range(NUM_LEGS):  # the along-link distances are the same for every leg
        geoms = [geom for geom in robot.contact_geoms if geom.leg == leg]
        plane = robot.side_signs[leg] * robot.thigh_offset
        rows = [(geom.body, point) for geom in geoms for point in geom.endpoints]
        lateral.append([p[1] if body == HIP else plane + p[1] for body, p in rows])
        length = robot.thigh_length
        thigh = [{HIP: 0.0, THIGH: -p[2], CALF: length, FOOT: length}[body] for body, p in rows]
        calf = [-p[2] if body in (CALF, FOOT) else 0.0 for body, p in rows]
    return np.array(trunk), np.array(lateral), np.array(thigh), np.array(calf)


def _leg_points(
    robot: Robot,
    joint_pos: Any,
    lateral: np.ndarray,
    along_thigh: np.ndarray,
    along_calf: np.ndarray,
) -> tuple[Any, Any, Any]:
    """Return x, y, z [..., 4, P] m in the base frame of P points on every leg.

    Args:
        robot: Whose legs.
        joint_pos: [..., J] rad, numpy or jax; the result is of the same kind and dtype.
        lateral: [4, P] m, y in the hip frame.
        along_thigh: [P] m from the thigh joint down the thigh.
        along_calf: [P] m from the calf joint down the calf.
    """
    dtype = joint_pos.dtype
    angles = joint_pos.reshape(*joint_pos.shape[:-1], NUM_LEGS, LEG_SIZE)
    in_jax = isinstance(joint_pos, jax.Array)
    xp: Any = jnp if in_jax else np
    # hip angle, then the thigh's and the calf's from the vertical of the leg plane
    angles = xp.concatenate([angles[..., :2], angles[..., 1:2] + angles[..., 2:]], axis=-1)
    sin, cos = xp.sin(angles), xp.cos(angles)
    if in_jax:
        # Left alone, XLA repeats the sines in every point that uses them: five times slower (CPU).
        sin, cos = jax.lax.optimization_barrier((sin, cos))
    a, b = along_thigh.astype(dtype), along_calf.astype(dtype)
    lateral, offsets = lateral.astype(dtype), robot.hip_offsets.astype(dtype)
    x = -a * sin[..., 1:2] - b * sin[..., 2:3]
    z = -a * cos[..., 1:2] - b * cos[..., 2:3]
    sin_hip, cos_hip = sin[..., 0:1], cos[..., 0:1]
    return (
        offsets[:, 0:1] + x,
        offsets[:, 1:2] + cos_hip * lateral - sin_hip * z,
        offsets[:, 2:3] + sin_hip * lateral + cos_hip * z,
    )


def foot_positions(robot: Robot, joint_pos: Any) -> Any:
    """Return the foot centres in the base frame.

    Args:
        robot: Whose legs.
        joint_pos: [..., J] rad, float numpy or jax array; the result is of the same kind.

    Returns:
        [..., 4, 3] m, order ``robot.legs``.
    """
    if not isinstance(joint_pos, jax.Array):
        joint_pos = np.asarray(joint_pos, np.result_type(joint_pos, np.float32))
    lateral = (robot.side_signs * robot.thigh_offset)[:, None]
    link = np.array([robot.thigh_length]), np.array([robot.calf_length])
    xp: Any = jnp if isinstance(joint_pos, jax.Array) else np
    return xp.concatenate(_leg_points(robot, joint_pos, lateral, *link), axis=-1)


def forward(robot: Robot, qpos: jax.Array) -> Points:
    """Return every contact shape and foot in the world frame.

    Args:
        robot: Whose shapes.
        qpos: [..., 7 + J] base position (m), unit quaternion wxyz, joint angles (rad).

    Returns:
        ``Points`` with the same leading axes.
    """
    qpos = jnp.asarray(qpos)
    lead = qpos.shape[:-1]
    trunk_points, *leg_table = _point_table(robot)
    legs = _leg_points(robot, qpos[..., 7:], *leg_table)
    x_axis, y_axis, z_axis = frames.base_axes(qpos[..., 3:7])
    local = []
    for i in range(3):
        trunk = jnp.broadcast_to(trunk_points[:, i].astype(qpos.dtype), (*lead, len(trunk_points)))
        local.append(jnp.concatenate([trunk, legs[i].reshape(*lead, -1)], axis=-1))
    world = [
        qpos[..., i : i + 1]
        + x_axis[..., i : i + 1] * local[0]
        + y_axis[..., i : i + 1] * local[1]
        + z_axis[..., i : i + 1] * local[2]
        for i in range(3)
    ]
    points = jax.lax.optimization_barrier(jnp.stack(world, axis=-1))
    endpoints = points.reshape(*lead, len(robot.contact_geoms), 2, 3)
    return Points(
        endpoints=endpoints,
        feet=endpoints[..., np.flatnonzero(robot.contact_mask(FOOT)), 0, :],
        base_rotation=jnp.stack([x_axis, y_axis, z_axis], axis=-1),
    )


def leg_inverse(
    robot: Robot, foot_pos: np.ndarray, *, above: bool | np.ndarray = False
) -> np.ndarray:
    """Return the joint angles that put the feet where asked (closed form, numpy).

    Of the two hip angles that reach a point, the one with the foot below the hip axis in the
    leg's own plane is taken, or above it where ``above`` is set (a leg folded past horizontal).
    The knee bends backwards, the only way its limits allow.

    Args:
        robot: Whose legs.
        foot_pos: [..., 4, 3] m, foot centres in the base frame, order ``robot.legs``.
        above: bool, or bool array broadcastable to [..., 4].

    Returns:
        [..., J] rad.

    Raises:
        ValueError: a foot is out of reach or an angle outside its limits; the message names
            leg, value and allowed range.
    """
    foot_pos = np.asarray(foot_pos, np.float64)
    if foot_pos.shape[-2:] != (NUM_LEGS, 3):
        raise ValueError(f"foot_pos must have shape [..., 4, 3], got {list(foot_pos.shape)}")
    p = foot_pos - robot.hip_offsets
    lateral = robot.side_signs * robot.thigh_offset
    height_sq = p[..., 1] ** 2 + p[..., 2] ** 2 - lateral**2
    check = functools.partial(_check, robot.legs)
    check(
        np.sqrt(p[..., 1] ** 2 + p[..., 2] ** 2),
        (robot.thigh_offset, np.inf),
        "distance of the foot from the hip axis",
        "m",
    )
    z = np.where(above, 1.0, -1.0) * np.sqrt(np.maximum(height_sq, 0.0))
    distance = np.hypot(p[..., 0], z)
    check(distance, reach_limits(robot), "distance of the foot from the thigh joint", "m")
    hip = np.arctan2(p[..., 2], p[..., 1]) - np.arctan2(z, lateral)
    l1, l2 = robot.thigh_length, robot.calf_length
    cos_calf = (distance**2 - l1**2 - l2**2) / (2 * l1 * l2)
    calf = -np.arccos(np.clip(cos_calf, -1.0, 1.0))
    thigh = np.arctan2(-p[..., 0], -z) - np.arctan2(l2 * np.sin(calf), l1 + l2 * np.cos(calf))
    hip = _wrap(hip, 0.0)
    leg_limits = robot.joint_limits[:LEG_SIZE]
    thigh = _wrap(thigh, float(leg_limits[1].mean()))
    for angle, joint, (low, high) in zip((hip, thigh, calf), LEG_JOINTS, leg_limits, strict=True):
        check(angle, (float(low), float(high)), f"{joint} angle", "rad")
    angles = np.stack([hip, thigh, calf], axis=-1)
    return angles.reshape(*foot_pos.shape[:-2], robot.num_joints)


def _wrap(angle: np.ndarray, centre: float) -> np.ndarray:
    """Return ``angle`` shifted by whole turns into [centre - pi, centre + pi) rad."""
    return (angle - centre + np.pi) % _TWO_PI - np.pi + centre


def _check(
    legs: tuple[str, ...], value: np.ndarray, limits: tuple[float, float], what: str, unit: str
) -> None:
    """Raise unless every ``value`` [..., 4] lies within ``limits`` (1e-9 tolerance)."""
    low, high = limits
    excess = np.maximum(low - value, value - high)
    if not np.all(excess <= 1e-9):
        worst = np.unravel_index(np.argmax(np.where(np.isnan(excess), np.inf, excess)), value.shape)
        bad = float(value[worst])
        nearest = low if bad < low else high
        raise ValueError(
            f"leg {legs[worst[-1]]} at index {tuple(int(i) for i in worst[:-1])}: {what} is "
            f"{bad:.4f} {unit}, allowed [{low:.4f}, {high:.4f}], nearest {nearest:.4f}"
        )
