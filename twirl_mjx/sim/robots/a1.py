"""The Unitree A1, data only.

Sources, in brackets below: [U] ``a1.urdf`` of Unitree's ``unitree_ros``; [M] ``unitree_a1/a1.xml``
of MuJoCo Menagerie; [P] the paper, section "Actions"; [O] our choice, explained in
``assets/a1/README.md``. Legs go FR FL RR RL; x is forward, y left, z up, so the right legs sit at
negative y.
"""

from __future__ import annotations

import numpy as np

from twirl_mjx.assets import asset_path
from twirl_mjx.sim.robot import (
    CALF,
    FOOT,
    HIP,
    LEG_JOINTS,
    THIGH,
    TRUNK,
    ContactGeom,
    Robot,
    per_joint,
)

LEGS = ("FR", "FL", "RR", "RL")
CALF_LENGTH = 0.2
FOOT_RADIUS = 0.02


def _leg_contact_geoms(leg: int) -> tuple[ContactGeom, ...]:
    """Return hip, thigh, calf and foot shapes of one leg [U, O]."""
    name, side, zero = LEGS[leg], 1.0 if leg % 2 else -1.0, (0.0, 0.0, 0.0)
    foot = (0.0, 0.0, -CALF_LENGTH)
    return (
        ContactGeom(f"{name}_hip_collision", HIP, leg, (zero, (0.0, side * 0.055, 0.0)), 0.046),
        ContactGeom(f"{name}_thigh_collision", THIGH, leg, (zero, (0.0, 0.0, -0.17)), 0.017),
        ContactGeom(f"{name}_calf_collision", CALF, leg, (zero, (0.0, 0.0, -0.18)), 0.015),
        ContactGeom(f"{name}_foot", FOOT, leg, (foot, foot), FOOT_RADIUS),
    )


def _trunk_geom(
    name: str, start: tuple[float, float, float], end: tuple[float, float, float], radius: float
) -> ContactGeom:
    return ContactGeom(f"{name}_collision", TRUNK, -1, (start, end), radius)


A1 = Robot(
    name="a1",
    model=lambda: asset_path("a1", "a1.xml"),
    legs=LEGS,
    joints=tuple(f"{leg}_{joint}_joint" for leg in LEGS for joint in LEG_JOINTS),
    trunk="trunk",
    links=tuple(tuple(f"{leg}_{joint}" for joint in LEG_JOINTS) for leg in LEGS),
    default_pose=per_joint([0.0, 0.9, -1.8]),  # [P]
    action_half_range=per_joint([0.6, 1.2, 1.2]),  # [P]
    joint_limits=np.tile(  # [U]
        [
            [-0.802851455917, 0.802851455917],
            [-1.0471975512, 4.18879020479],
            [-2.69653369433, -0.916297857297],
        ],
        (len(LEGS), 1),
    ),
    kp=per_joint(60.0),  # [P]
    kd=per_joint(3.0),  # [P]
    torque_limit=per_joint(33.5),  # [U]
    armature=per_joint(0.01),  # [M]
    damping=per_joint(0.01),  # [U]
    hip_offsets=np.array(  # [M]
        [[0.183, -0.047, 0.0], [0.183, 0.047, 0.0], [-0.183, -0.047, 0.0], [-0.183, 0.047, 0.0]]
    ),
    thigh_offset=0.08505,  # [M]
    thigh_length=0.2,  # [U]
    calf_length=CALF_LENGTH,  # [U]
    foot_radius=FOOT_RADIUS,  # [U]
    contact_geoms=(  # [U, O]
        _trunk_geom("trunk_right", (-0.1335, -0.04, 0.0), (0.1335, -0.04, 0.0), 0.057),
        _trunk_geom("trunk_left", (-0.1335, 0.04, 0.0), (0.1335, 0.04, 0.0), 0.057),
        _trunk_geom("head_top", (0.255, -0.052, 0.0355), (0.255, 0.052, 0.0355), 0.021),
        _trunk_geom("head_bottom", (0.245, -0.05, -0.035), (0.245, 0.05, -0.035), 0.02),
        *(geom for leg in range(len(LEGS)) for geom in _leg_contact_geoms(leg)),
    ),
)
"""The robot of the paper."""
