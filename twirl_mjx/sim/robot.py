"""A robot is data: all that scene, kinematics, actuation, observers and tasks know of one.

The family is a quadruped with a free trunk and four hip-thigh-calf legs: the hip turns about x,
thigh and calf about y, and at zero angles a leg hangs straight down. Joint arrays are in the order
of ``qpos``: leg by leg, hip thigh calf within a leg; the legs come in the order of the model.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from etils import epy

from twirl_mjx.checks import check_choice, check_range

with epy.lazy_imports():  # needed by robots, not by options
    import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

LEG_JOINTS = ("hip", "thigh", "calf")
NUM_LEGS = 4
LEG_SIZE = len(LEG_JOINTS)
ROOT_SIZE = 7
"""Numbers of the free trunk in ``qpos``: position and quaternion; in ``qvel`` it has 6."""

TRUNK, HIP, THIGH, CALF, FOOT = "trunk", "hip", "thigh", "calf", "foot"
BODY_CLASSES = (TRUNK, HIP, THIGH, CALF, FOOT)

CONTROL_DT = 0.05
"""s, control step unless a robot says otherwise: 20 Hz (paper, section "Actions")."""
CUTOFF_HZ = 4.0
"""Hz, cut-off of the command filter unless a robot says otherwise (paper, section "Actions")."""

ModelSource = Path | str | Callable[[], Path | str]
"""MJCF as a path, as an XML string, or a function that returns either when first needed."""


@dataclass(frozen=True)
class ContactGeom:
    """One collision shape: a capsule, or a sphere when both endpoints are equal."""

    name: str
    """MuJoCo geom name."""
    body: str
    """One of ``BODY_CLASSES``; a foot is fixed to its calf body."""
    leg: int
    """Index into ``Robot.legs``, -1 for the trunk."""
    endpoints: tuple[tuple[float, float, float], tuple[float, float, float]]
    """[2, 3] m, ends of the capsule axis in the frame of the MuJoCo body that carries it."""
    radius: float
    """m."""


def per_joint(value: ArrayLike) -> np.ndarray:
    """Return an array [J] from one number, from hip thigh calf of a leg [3], or from all [J].

    Raises:
        ValueError: Another shape.
    """
    array = np.asarray(value, np.float64)
    if array.shape == ():
        return np.full(NUM_LEGS * LEG_SIZE, float(array))
    if array.shape == (LEG_SIZE,):
        return np.tile(array, NUM_LEGS)
    if array.shape == (NUM_LEGS * LEG_SIZE,):
        return array
    raise ValueError(
        f"a value per joint has shape {array.shape}: give one number, {LEG_SIZE} (hip thigh calf)"
        f" or {NUM_LEGS * LEG_SIZE} (nearest: one number for all joints)"
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class Robot:
    """Facts of one robot; compared and hashed by identity, so it may be static under jit.

    ``J`` is the number of joints. Arrays become float64 and read-only.
    """

    name: str
    """What it is called on the command line and in files."""
    model: ModelSource
    """Its MJCF; a floor, lights, motors and collision shapes in it are replaced by ours."""
    legs: tuple[str, ...]
    """[4] names of the legs, in the order of the joints."""
    joints: tuple[str, ...]
    """[J] names of the hinge joints in the order of ``qpos``."""
    trunk: str
    """Name of the trunk's body."""
    links: tuple[tuple[str, ...], ...]
    """[4][3] names of the hip, thigh and calf bodies of every leg."""
    default_pose: np.ndarray
    """[J] rad, joint angles of the zero action."""
    action_half_range: np.ndarray
    """[J] rad, joint offset of a unit action."""
    joint_limits: np.ndarray
    """[J, 2] rad, lower and upper limits."""
    kp: np.ndarray
    """[J] N m/rad, position gain of the PD law."""
    kd: np.ndarray
    """[J] N m s/rad, velocity gain of the PD law."""
    torque_limit: np.ndarray
    """[J] N m."""
    armature: np.ndarray
    """[J] kg m^2, reflected rotor inertia."""
    damping: np.ndarray
    """[J] N m s/rad, passive joint damping."""
    hip_offsets: np.ndarray
    """[4, 3] m, hip joints in the base frame; x tells front from hind, y left from right."""
    thigh_offset: float
    """m, lateral distance from the hip axis to the leg plane, outwards."""
    thigh_length: float
    """m, thigh joint to calf joint."""
    calf_length: float
    """m, calf joint to foot centre."""
    foot_radius: float
    """m, radius of the spherical foot."""
    contact_geoms: tuple[ContactGeom, ...]
    """[G] collision shapes, of the trunk first, then leg by leg; one foot a leg."""
    control_dt: float = CONTROL_DT
    """s, control step."""
    cutoff_hz: float = CUTOFF_HZ
    """Hz, cut-off of the second-order low-pass on the joint targets."""

    def __post_init__(self) -> None:
        """Check sizes, ranges and the table of shapes; the model is read when it is needed.

        Raises:
            ValueError: A value is missing, of another size or implausible in its unit.
        """
        check_record(self)

    @classmethod
    def from_mjcf(
        cls,
        name: str,
        model: ModelSource,
        *,
        feet: Sequence[str],
        default_pose: ArrayLike,
        action_half_range: ArrayLike,
        kp: ArrayLike,
        kd: ArrayLike,
        **facts: Any,
    ) -> Robot:
        """Return a robot whose names, geometry and limits are read from its MJCF.

        Values per joint may be one number, three (hip thigh calf) or all; see :func:`per_joint`.

        Args:
            name: Name of the robot.
            model: Its MJCF.
            feet: [4] geoms or sites at the centres of the feet, in the order of the legs.
            default_pose: rad, joint angles of the zero action.
            action_half_range: rad, joint offset of a unit action.
            kp: N m/rad, position gain.
            kd: N m s/rad, velocity gain.
            **facts: Any other field of the record, instead of what is read; ``torque_limit`` has
                to be given where neither joints nor motors of the file have one.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: The model is of another family, or a fact is missing or unknown.
        """
        from twirl_mjx.sim.read_mjcf import read_facts

        facts |= {"default_pose": default_pose, "action_half_range": action_half_range}
        facts |= {"kp": kp, "kd": kd}
        return cls(**read_facts(name, model, feet, facts))

    @property
    def num_joints(self) -> int:
        """J, also the number of actions."""
        return len(self.joints)

    @property
    def nq(self) -> int:
        """Numbers in ``qpos``."""
        return ROOT_SIZE + self.num_joints

    @property
    def actuators(self) -> tuple[str, ...]:
        """[J] names of the motors: those of the joints without ``_joint``."""
        return tuple(joint.removesuffix("_joint") for joint in self.joints)

    @functools.cached_property
    def side_signs(self) -> np.ndarray:
        """[4] sign of y of every leg."""
        return np.sign(self.hip_offsets[:, 1])

    @functools.cached_property
    def corners(self) -> tuple[int, ...]:
        """Indices into ``legs`` of front right, front left, hind right, hind left."""
        x, y = self.hip_offsets[:, 0], self.hip_offsets[:, 1]
        return tuple(int(leg) for leg in np.lexsort((y > 0, x < 0)))

    @property
    def front_legs(self) -> tuple[int, ...]:
        """Indices into ``legs`` of the front legs, right one first."""
        return self.corners[:2]

    @property
    def hind_legs(self) -> tuple[int, ...]:
        """Indices into ``legs`` of the hind legs, right one first."""
        return self.corners[2:]

    @functools.cached_property
    def contact_radii(self) -> np.ndarray:
        """[G] m, radii in the order of ``contact_geoms``."""
        return np.array([geom.radius for geom in self.contact_geoms])

    @property
    def feet(self) -> tuple[str, ...]:
        """[4] geom names of the feet, in the order of ``legs``."""
        return tuple(geom.name for geom in self.contact_geoms if geom.body == FOOT)

    def contact_mask(self, *bodies: str) -> np.ndarray:
        """Return a bool mask [G] over ``contact_geoms`` selecting the named body classes.

        Raises:
            ValueError: A name is not one of ``BODY_CLASSES``.
        """
        for body in bodies:
            check_choice("body class", body, BODY_CLASSES)
        return np.array([geom.body in bodies for geom in self.contact_geoms])

    def body_of(self, geom: ContactGeom) -> str:
        """Return the name of the MuJoCo body that carries a contact shape."""
        if geom.leg < 0:
            return self.trunk
        return self.links[geom.leg][LEG_JOINTS.index(CALF if geom.body == FOOT else geom.body)]

    @functools.cached_property
    def home_height(self) -> float:
        """Base height in m at which the feet just touch flat ground in ``default_pose``."""
        hip, thigh, calf = self.default_pose.reshape(NUM_LEGS, LEG_SIZE).T
        down = self.thigh_length * np.cos(thigh) + self.calf_length * np.cos(thigh + calf)
        lateral = self.side_signs * self.thigh_offset
        foot_z = self.hip_offsets[:, 2] + np.sin(hip) * lateral - np.cos(hip) * down
        return float(self.foot_radius - foot_z.min())

    @functools.cached_property
    def lowpass(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Numerator and denominator of the command filter, a second-order Butterworth low-pass.

        The bilinear transform with the cut-off kept in place, as ``scipy.signal.butter`` has it,
        to eight decimals.
        """
        k = math.tan(math.pi * self.cutoff_hz * self.control_dt)
        scale = 1.0 / (1.0 + math.sqrt(2.0) * k + k * k)
        b = (k * k * scale, 2.0 * k * k * scale, k * k * scale)
        a = (1.0, 2.0 * (k * k - 1.0) * scale, (1.0 - math.sqrt(2.0) * k + k * k) * scale)
        return tuple(round(x, 8) for x in b), tuple(round(x, 8) for x in a)

    @functools.cached_property
    def mass(self) -> float:
        """Total mass in kg, read from the model."""
        from twirl_mjx.sim.mjcf import source_model

        model = source_model(self)
        return float(model.body_subtreemass[model.body(self.trunk).id])


RANGES: dict[str, tuple[float, float]] = {
    "default_pose": (-2 * math.pi, 2 * math.pi),
    "action_half_range": (0.01, math.pi),
    "joint_limits": (-2 * math.pi, 2 * math.pi),
    "kp": (0.1, 5000.0),
    "kd": (0.0, 500.0),
    "torque_limit": (0.1, 2000.0),
    "armature": (0.0, 1.0),
    "damping": (0.0, 50.0),
    "hip_offsets": (-2.0, 2.0),
    "thigh_offset": (0.001, 1.0),
    "thigh_length": (0.02, 2.0),
    "calf_length": (0.02, 2.0),
    "foot_radius": (0.001, 0.2),
    "control_dt": (0.002, 0.2),
}
"""What is plausible in the units of the record: degrees, millimetres or N mm fall outside."""


def check_record(robot: Robot) -> None:
    """Check a record and make its arrays read-only; see ``Robot.__post_init__``."""
    count = NUM_LEGS * LEG_SIZE
    for field, size in (("legs", NUM_LEGS), ("joints", count), ("links", NUM_LEGS)):
        value = getattr(robot, field)
        if len(value) != size or len(set(value)) != size:
            raise ValueError(
                f"robot {robot.name!r}: {field} are {list(value)}; need {size} different ones"
                f" (a quadruped with {LEG_SIZE} joints a leg)"
            )
    shapes = {"joint_limits": (count, 2), "hip_offsets": (NUM_LEGS, 3)}
    for field in fields(robot):
        if field.name not in RANGES:
            continue
        value = np.array(getattr(robot, field.name), np.float64)
        shape = shapes.get(field.name, (count,) if field.type == "np.ndarray" else ())
        if value.shape != shape:
            raise ValueError(
                f"robot {robot.name!r}: {field.name} has shape {value.shape}, need {shape}"
            )
        for number in value.ravel():
            check_range(f"robot {robot.name!r}: {field.name}", float(number), *RANGES[field.name])
        if field.type == "np.ndarray":
            value.flags.writeable = False
            object.__setattr__(robot, field.name, value)
    check_range(f"robot {robot.name!r}: cutoff_hz", robot.cutoff_hz, 0.01, 0.49 / robot.control_dt)
    low, high = robot.joint_limits.T
    for joint, angle, start, stop in zip(robot.joints, robot.default_pose, low, high, strict=True):
        check_range(f"robot {robot.name!r}: default_pose of {joint}", float(angle), start, stop)
    corners = {(x > 0, y > 0) for x, y in robot.hip_offsets[:, :2].tolist() if y != 0}
    if len(corners) != NUM_LEGS:
        raise ValueError(
            f"robot {robot.name!r}: hips at {robot.hip_offsets[:, :2].tolist()} m (x, y); need one"
            " in each of front right, front left, hind right, hind left of the trunk's origin"
        )
    _check_shapes(robot)


def _check_shapes(robot: Robot) -> None:
    """Refuse a table of shapes that kinematics cannot follow: every leg has the same ones."""
    geoms = robot.contact_geoms
    order = [geom.leg for geom in geoms]
    bodies = [[geom.body for geom in geoms if geom.leg == leg] for leg in range(NUM_LEGS)]
    lengths = [
        [[p[2] for p in geom.endpoints] for geom in geoms if geom.leg == leg and geom.body != HIP]
        for leg in range(NUM_LEGS)
    ]
    for geom in geoms:
        check_choice(f"body of contact shape {geom.name!r}", geom.body, BODY_CLASSES)
        check_range(f"radius of contact shape {geom.name!r}", geom.radius, 0.001, 0.5)
    if order != sorted(order) or set(order) != {-1, *range(NUM_LEGS)}:
        raise ValueError(
            f"robot {robot.name!r}: contact_geoms belong to legs {order}; need the trunk's (-1)"
            " first, then those of every leg in order"
        )
    if any(leg != bodies[0] for leg in bodies) or bodies[0].count(FOOT) != 1:
        raise ValueError(
            f"robot {robot.name!r}: contact shapes of the legs are {bodies}; need the same on every"
            " leg, exactly one of them a foot"
        )
    if any(leg != lengths[0] for leg in lengths):
        raise ValueError(
            f"robot {robot.name!r}: contact shapes lie at different heights on the legs: {lengths}"
        )
    if len({geom.name for geom in geoms}) != len(geoms):
        raise ValueError(f"robot {robot.name!r}: two contact shapes have the same name")
