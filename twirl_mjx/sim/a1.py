"""Facts of the Unitree A1 by MuJoCo name: order, poses, limits, gains, geometry, contact shapes.

Numpy only; nothing is read or started at import. Sources, in brackets below: [U] ``a1.urdf`` of
Unitree's ``unitree_ros``; [M] ``unitree_a1/a1.xml`` of MuJoCo Menagerie; [P] the paper, section
"Actions"; [O] our choice, explained in ``assets/a1/README.md``. Legs go FR FL RR RL, joints
hip thigh calf within a leg; x is forward, y left, z up, so the right legs sit at negative y.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from twirl_mjx.assets import asset_path

LEGS = ("FR", "FL", "RR", "RL")
FRONT_LEGS = (0, 1)
HIND_LEGS = (2, 3)
LEG_JOINTS = ("hip", "thigh", "calf")
JOINT_NAMES = tuple(f"{leg}_{joint}_joint" for leg in LEGS for joint in LEG_JOINTS)
ACTUATOR_NAMES = tuple(f"{leg}_{joint}" for leg in LEGS for joint in LEG_JOINTS)
NUM_JOINTS = 12

TRUNK_BODY = "trunk"
ROOT_JOINT = "root"
IMU_SITE = "imu"
FOOT_GEOMS = tuple(f"{leg}_foot" for leg in LEGS)
FOOT_SITES = FOOT_GEOMS
CALF_GEOMS = tuple(f"{leg}_calf_collision" for leg in LEGS)
THIGH_GEOMS = tuple(f"{leg}_thigh_collision" for leg in LEGS)
HIP_GEOMS = tuple(f"{leg}_hip_collision" for leg in LEGS)
TRUNK_GEOMS = (
    "trunk_right_collision",
    "trunk_left_collision",
    "head_top_collision",
    "head_bottom_collision",
)
HOME_KEY = "home"
HIND_STAND_KEY = "hind_stand"

DEFAULT_POSE = np.tile([0.0, 0.9, -1.8], 4)
"""[12] rad, joint angles of the zero action [P]."""
ACTION_HALF_RANGE = np.tile([0.6, 1.2, 1.2], 4)
"""[12] rad, joint offset of a unit action [P]."""
JOINT_LIMITS = np.tile(
    [
        [-0.802851455917, 0.802851455917],
        [-1.0471975512, 4.18879020479],
        [-2.69653369433, -0.916297857297],
    ],
    (4, 1),
)
"""[12, 2] rad, lower and upper joint limits [U]."""

KP = 60.0
"""N m/rad, position gain of every joint's PD law [P]."""
KD = 3.0
"""N m s/rad, velocity gain of every joint's PD law [P]."""
TORQUE_LIMIT = 33.5
"""N m, torque limit of every joint [U]."""
JOINT_ARMATURE = 0.01
"""kg m^2, reflected rotor inertia of every joint [M]."""
JOINT_DAMPING = 0.01
"""N m s/rad, passive joint damping [U]."""

HIP_OFFSETS = np.array(
    [[0.183, -0.047, 0.0], [0.183, 0.047, 0.0], [-0.183, -0.047, 0.0], [-0.183, 0.047, 0.0]]
)
"""[4, 3] m, hip joint positions in the base frame [M]."""
THIGH_OFFSET = 0.08505
"""m, lateral distance from the hip axis to the leg plane [M]."""
SIDE_SIGNS = np.array([-1.0, 1.0, -1.0, 1.0])
"""[4] sign of y of every leg: the thigh sits at ``SIDE_SIGNS * THIGH_OFFSET`` in the hip frame."""
THIGH_LENGTH = 0.2
"""m, thigh joint to calf joint [U]."""
CALF_LENGTH = 0.2
"""m, calf joint to foot centre [U]."""
FOOT_RADIUS = 0.02
"""m, radius of the spherical foot [U]."""

TRUNK_MASS = 4.713
"""kg [M]."""
HIP_MASS = 0.696
"""kg, each [U]."""
THIGH_MASS = 1.013
"""kg, each [U]."""
CALF_MASS = 0.226
"""kg, each, calf 0.166 plus foot 0.06 [U]."""
TOTAL_MASS = TRUNK_MASS + 4 * (HIP_MASS + THIGH_MASS + CALF_MASS)
"""kg, 12.453."""
HOME_HEIGHT = float(2 * THIGH_LENGTH * np.cos(0.9) + FOOT_RADIUS)
"""m, base height at which the feet just touch flat ground in ``DEFAULT_POSE`` (0.26864)."""

TRUNK, HIP, THIGH, CALF, FOOT = "trunk", "hip", "thigh", "calf", "foot"
BODY_CLASSES = (TRUNK, HIP, THIGH, CALF, FOOT)


@dataclass(frozen=True)
class ContactGeom:
    """One collision shape: a capsule, or a sphere when both endpoints are equal."""

    name: str
    """MuJoCo geom name."""
    body: str
    """One of ``BODY_CLASSES``; a foot is fixed to its calf body."""
    leg: int
    """Index into ``LEGS``, -1 for the trunk."""
    endpoints: tuple[tuple[float, float, float], tuple[float, float, float]]
    """[2, 3] m, ends of the capsule axis in the frame of the MuJoCo body that carries it."""
    radius: float
    """m."""

    @property
    def mujoco_body(self) -> str:
        """Name of the MuJoCo body that carries the geom."""
        if self.leg < 0:
            return TRUNK_BODY
        return f"{LEGS[self.leg]}_{CALF if self.body == FOOT else self.body}"


def _leg_contact_geoms(leg: int) -> tuple[ContactGeom, ...]:
    """Return hip, thigh, calf and foot shapes of one leg."""
    name, side, zero = LEGS[leg], float(SIDE_SIGNS[leg]), (0.0, 0.0, 0.0)
    foot = (0.0, 0.0, -CALF_LENGTH)
    return (
        ContactGeom(f"{name}_hip_collision", HIP, leg, (zero, (0.0, side * 0.055, 0.0)), 0.046),
        ContactGeom(f"{name}_thigh_collision", THIGH, leg, (zero, (0.0, 0.0, -0.17)), 0.017),
        ContactGeom(f"{name}_calf_collision", CALF, leg, (zero, (0.0, 0.0, -0.18)), 0.015),
        ContactGeom(f"{name}_foot", FOOT, leg, (foot, foot), FOOT_RADIUS),
    )


CONTACT_GEOMS: tuple[ContactGeom, ...] = (
    ContactGeom(TRUNK_GEOMS[0], TRUNK, -1, ((-0.1335, -0.04, 0.0), (0.1335, -0.04, 0.0)), 0.057),
    ContactGeom(TRUNK_GEOMS[1], TRUNK, -1, ((-0.1335, 0.04, 0.0), (0.1335, 0.04, 0.0)), 0.057),
    ContactGeom(
        TRUNK_GEOMS[2], TRUNK, -1, ((0.255, -0.052, 0.0355), (0.255, 0.052, 0.0355)), 0.021
    ),
    ContactGeom(TRUNK_GEOMS[3], TRUNK, -1, ((0.245, -0.05, -0.035), (0.245, 0.05, -0.035)), 0.02),
    *(geom for leg in range(4) for geom in _leg_contact_geoms(leg)),
)
"""All 20 collision shapes [U, O]: 4 of the trunk, then hip, thigh, calf, foot of FR FL RR RL."""
NUM_CONTACT_GEOMS = len(CONTACT_GEOMS)
CONTACT_RADII = np.array([geom.radius for geom in CONTACT_GEOMS])
"""[G] m, radii in the order of ``CONTACT_GEOMS``."""


def contact_mask(*bodies: str) -> np.ndarray:
    """Return a bool mask [G] over ``CONTACT_GEOMS`` selecting the named body classes.

    Raises:
        ValueError: a name is not one of ``BODY_CLASSES``.
    """
    for body in bodies:
        if body not in BODY_CLASSES:
            raise ValueError(f"unknown body class {body!r}; choose from {', '.join(BODY_CLASSES)}")
    return np.array([geom.body in bodies for geom in CONTACT_GEOMS])


def xml_path() -> Path:
    """Return the path of the robot's MJCF file.

    Raises:
        FileNotFoundError: the file is in neither place where assets live.
    """
    return asset_path("a1", "a1.xml")
