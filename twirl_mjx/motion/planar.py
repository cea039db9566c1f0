"""Sagittal-plane model of the A1 used to plan the leap: closed-form leg IK and rigid-body dynamics.

Left and right legs move together, so the robot is five links in the x-z plane: the trunk (with its
hips) and, as pairs, front and hind thighs and calves. Angles are about +y: a positive pitch is nose
down, a positive thigh angle swings the knee backward. Arrays carry any leading axes, then the
frame axis F; pairs are ordered front, hind.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from twirl_mjx.motion.leap_config import ROBOT

REACH = (0.1, 0.356)
"""m, leg lengths (hip to foot centre) the IK is clipped to, inside the calf's joint limits."""
GRAVITY = 9.81
"""m/s^2."""


@dataclass(frozen=True)
class Link:
    """A rigid link, or a pair of links that move together."""

    mass: float
    """kg, of the pair."""
    com: tuple[float, float]
    """m, centre of mass (x, z) in the link frame."""
    inertia: float
    """kg m^2 about y through the centre of mass, of the pair."""


@dataclass(frozen=True)
class PlanarModel:
    """Masses of the five links, read from the robot's MJCF."""

    trunk: Link
    thighs: tuple[Link, Link]
    """Front and hind pair."""
    calves: tuple[Link, Link]
    """Front and hind pair, feet included."""
    armature: float
    """kg m^2 of one joint."""

    @property
    def mass(self) -> float:
        """Total mass in kg."""
        return sum(link.mass for link in (self.trunk, *self.thighs, *self.calves))


@dataclass(frozen=True)
class Pose:
    """Configuration of the planar robot over time."""

    root: np.ndarray
    """[..., F, 2] m, trunk origin (x, z)."""
    pitch: np.ndarray
    """[..., F] rad."""
    thigh: np.ndarray
    """[..., F, 2] rad, joint angles, front and hind."""
    calf: np.ndarray
    """[..., F, 2] rad."""


def planar_model(model: mujoco.MjModel) -> PlanarModel:
    """Project the compiled robot onto the sagittal plane at zero hip angles."""
    data = mujoco.MjData(model)
    data.qpos[3] = 1.0
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)

    def lump(bodies: list[str], anchor: str) -> Link:
        ids = [model.body(name).id for name in bodies]
        masses = model.body_mass[ids]
        coms = data.xipos[ids][:, [0, 2]]
        frames = [data.ximat[i].reshape(3, 3) for i in ids]
        about_y = [
            float((frame[1] ** 2) @ model.body_inertia[i])
            for i, frame in zip(ids, frames, strict=True)
        ]
        com = masses @ coms / masses.sum()
        spread = float(masses @ ((coms - com) ** 2).sum(axis=1))
        local = com - data.xpos[model.body(anchor).id][[0, 2]]
        return Link(float(masses.sum()), (local[0], local[1]), sum(about_y) + spread)

    pairs = [[ROBOT.legs[leg] for leg in legs] for legs in (ROBOT.front_legs, ROBOT.hind_legs)]
    hips = [f"{leg}_hip" for leg in ROBOT.legs]
    thighs = [lump([f"{leg}_thigh" for leg in pair], f"{pair[0]}_thigh") for pair in pairs]
    calves = [lump([f"{leg}_calf" for leg in pair], f"{pair[0]}_calf") for pair in pairs]
    return PlanarModel(
        trunk=lump([ROBOT.trunk, *hips], ROBOT.trunk),
        thighs=(thighs[0], thighs[1]),
        calves=(calves[0], calves[1]),
        armature=float(ROBOT.armature[0]),
    )


def turn(angle: np.ndarray, vec: np.ndarray) -> np.ndarray:
    """Rotate vectors [..., 2] (x, z) about y by ``angle`` [...] rad."""
    c, s = np.cos(angle), np.sin(angle)
    x, z = vec[..., 0], vec[..., 1]
    return np.stack([x * c + z * s, z * c - x * s], axis=-1)


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the y-component of a x b for vectors [..., 2] (x, z)."""
    return a[..., 1] * b[..., 0] - a[..., 0] * b[..., 1]


def hip_positions(root: np.ndarray, pitch: np.ndarray) -> np.ndarray:
    """Return the leg-plane hip joints [..., 2 pairs, 2] of a trunk pose [..., 2], [...]."""
    half = ROBOT.hip_offsets[0, 0]
    forward = np.stack([np.cos(pitch), -np.sin(pitch)], axis=-1) * half
    return np.stack([root + forward, root - forward], axis=-2)


def leg_ik(
    root: np.ndarray, pitch: np.ndarray, feet: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Closed-form inverse kinematics of both leg pairs (equal thigh and calf lengths).

    Args:
        root: [..., 2] m.
        pitch: [...] rad.
        feet: [..., 2, 2] m, foot centres (x, z), front and hind.

    Returns:
        Thigh and calf angles [..., 2] rad, and the unclipped leg lengths [..., 2] m.
    """
    leg = feet - hip_positions(root, pitch)
    length = np.linalg.norm(leg, axis=-1)
    half_knee = np.arccos(np.clip(length, *REACH) / (2.0 * ROBOT.thigh_length))
    direction = np.arctan2(-leg[..., 0], -leg[..., 1]) - pitch[..., None]
    direction = (direction + np.pi) % (2 * np.pi) - np.pi
    return direction + half_knee, -2.0 * half_knee, length


@dataclass(frozen=True)
class LinkStates:
    """Link centres of mass, joints and absolute link angles over time."""

    com: np.ndarray
    """[..., F, 5, 2] m: trunk, front thighs, hind thighs, front calves, hind calves."""
    angle: np.ndarray
    """[..., F, 5] rad."""
    knee: np.ndarray
    """[..., F, 2, 2] m."""
    hip: np.ndarray
    """[..., F, 2, 2] m."""


def link_states(model: PlanarModel, pose: Pose) -> LinkStates:
    """Return where every link is."""
    hip = hip_positions(pose.root, pose.pitch)
    thigh_angle = pose.pitch[..., None] + pose.thigh
    calf_angle = thigh_angle + pose.calf
    knee = hip + turn(thigh_angle, np.array([0.0, -ROBOT.thigh_length]))
    thigh_com = hip + turn(thigh_angle, np.array([link.com for link in model.thighs]))
    calf_com = knee + turn(calf_angle, np.array([link.com for link in model.calves]))
    trunk_com = pose.root + turn(pose.pitch, np.array(model.trunk.com))
    com = np.concatenate([trunk_com[..., None, :], thigh_com, calf_com], axis=-2)
    angle = np.concatenate([pose.pitch[..., None], thigh_angle, calf_angle], axis=-1)
    return LinkStates(com=com, angle=angle, knee=knee, hip=hip)


def _masses(model: PlanarModel) -> tuple[np.ndarray, np.ndarray]:
    links = (model.trunk, *model.thighs, *model.calves)
    return np.array([link.mass for link in links]), np.array([link.inertia for link in links])


def centre_of_mass(model: PlanarModel, states: LinkStates) -> np.ndarray:
    """Return the whole-body centre of mass [..., F, 2] m."""
    mass, _ = _masses(model)
    return np.einsum("l,...lk->...k", mass / mass.sum(), states.com)


def angular_momentum(model: PlanarModel, states: LinkStates, dt: float) -> np.ndarray:
    """Return the angular momentum about the centre of mass at frame midpoints [..., F-1].

    Unit kg m^2/s about +y; velocities are differences of neighbouring frames.
    """
    mass, inertia = _masses(model)
    relative = states.com - centre_of_mass(model, states)[..., None, :]
    middle = 0.5 * (relative[..., 1:, :, :] + relative[..., :-1, :, :])
    velocity = np.diff(relative, axis=-3) / dt
    spin = np.diff(states.angle, axis=-2) / dt
    return (cross(middle, velocity) * mass + spin * inertia).sum(axis=-1)


def joint_torques(
    model: PlanarModel,
    states: LinkStates,
    accel: tuple[np.ndarray, np.ndarray],
    contact: tuple[np.ndarray, np.ndarray],
) -> tuple[np.ndarray, np.ndarray]:
    """Return the joint torques of one leg of each pair by moment balance of its distal links.

    Args:
        model: Masses.
        states: Link states at frames F.
        accel: Linear [..., F, 5, 2] and angular [..., F, 5] accelerations of the links.
        contact: Ground forces on the pairs [..., F, 2, 2] N and where they act, same shape, m.

    Returns:
        Thigh and calf torques [..., F, 2] N m per leg (half of the pair's), without armature.
    """
    mass, inertia = _masses(model)
    load = accel[0] + np.array([0.0, GRAVITY])
    force, point = contact

    def moment(joint: np.ndarray, links: slice) -> np.ndarray:
        arm = states.com[..., links, :] - joint
        return mass[links] * cross(arm, load[..., links, :]) + inertia[links] * accel[1][..., links]

    calf = moment(states.knee, slice(3, 5)) - cross(point - states.knee, force)
    thigh = (
        moment(states.hip, slice(1, 3))
        + moment(states.hip, slice(3, 5))
        - cross(point - states.hip, force)
    )
    return 0.5 * thigh, 0.5 * calf
