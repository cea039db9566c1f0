"""What a quadruped's MJCF says: names, lengths, limits and shapes, for ``Robot.from_mjcf``."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from twirl_mjx.checks import check_choice
from twirl_mjx.sim.robot import (
    CALF,
    FOOT,
    HIP,
    LEG_SIZE,
    NUM_LEGS,
    THIGH,
    TRUNK,
    ContactGeom,
    ModelSource,
    Robot,
    per_joint,
)

FAMILY = "a quadruped with a free trunk and hip (about x), thigh and calf (about y) joints"
TOLERANCE = 1e-6
"""m or 1, how exactly joints and axes have to be where the closed-form kinematics has them."""
FOOT_TOLERANCE = 0.005
"""m, how far beside the axis of its calf the centre of a file's foot may be."""
PER_JOINT = (
    "default_pose", "action_half_range", "kp", "kd", "torque_limit", "armature", "damping"
)  # fmt: skip


def load(name: str, model: ModelSource) -> tuple[mujoco.MjSpec, mujoco.MjModel]:
    """Return the unchanged specification of a robot's file, and what it compiles to.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is not MJCF, or does not compile.
    """
    source = model() if callable(model) else model
    text = source if isinstance(source, str) and source.lstrip().startswith("<") else None
    if text is None and not Path(source).is_file():
        raise FileNotFoundError(f"robot {name!r}: no MJCF file {source}")

    def parsed() -> mujoco.MjSpec:
        return mujoco.MjSpec.from_string(text) if text else mujoco.MjSpec.from_file(str(source))

    try:
        return parsed(), parsed().compile()  # compiling empties the keyframes of a specification
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise ValueError(
            f"robot {name!r}: {source if text is None else 'its XML'}: {reason}"
        ) from None


@dataclass(frozen=True)
class Frame:
    """What the bodies and joints of a compiled model say about a quadruped."""

    trunk: str
    links: tuple[tuple[str, ...], ...]
    hip_offsets: np.ndarray
    thigh_offset: float
    thigh_length: float


def read_frame(name: str, model: mujoco.MjModel, joints: Sequence[str]) -> Frame:
    """Return names and lengths of the bodies that carry ``joints`` [J].

    Raises:
        ValueError: The model is not of the family; the message names what was found.
    """

    def refuse(found: str) -> ValueError:
        return ValueError(f"robot {name!r}: {found}; expected {FAMILY}")

    known = tuple(model.joint(i).name for i in range(model.njnt))
    for joint in joints:
        check_choice(f"joint of robot {name!r}", joint, known)
    moving = [n for i, n in enumerate(known) if model.jnt_type[i] != mujoco.mjtJoint.mjJNT_FREE]
    if moving != list(joints):
        raise refuse(f"the model's joints are {moving}, the record's {list(joints)}")
    if len(joints) != NUM_LEGS * LEG_SIZE:
        raise refuse(f"the model has {len(joints)} joints: {', '.join(joints)}")
    if model.neq or model.ntendon:
        raise refuse(f"the model has {model.neq} equalities and {model.ntendon} tendons")
    ids = np.array([model.joint(joint).id for joint in joints])
    axes = np.tile([[1.0, 0, 0], [0, 1.0, 0], [0, 1.0, 0]], (NUM_LEGS, 1))
    for joint, i, axis in zip(joints, ids, axes, strict=True):
        body = model.jnt_bodyid[i]
        if not np.allclose(model.jnt_axis[i], axis, atol=TOLERANCE):
            raise refuse(f"joint {joint} turns about {model.jnt_axis[i].round(4).tolist()}")
        rest = model.qpos0[model.jnt_qposadr[i]]
        for what, value in (
            ("is placed at", model.jnt_pos[i]),
            ("is at rest at", np.array([rest])),
            ("has a body turned by", model.body_quat[body, 1:]),
        ):
            if np.abs(value).max() > TOLERANCE:
                raise refuse(f"joint {joint} {what} {np.round(value, 4).tolist()}, not 0")
    bodies = model.jnt_bodyid[ids].reshape(NUM_LEGS, LEG_SIZE)
    parents = model.body_parentid[bodies]
    trunk = int(parents[0, 0])
    if (parents[:, 0] != trunk).any() or (parents[:, 1:] != bodies[:, :-1]).any():
        raise refuse(f"joints {', '.join(joints)} are not hip, thigh and calf of one leg each")
    others = [model.jnt_type[j] for j in range(model.njnt) if model.jnt_bodyid[j] == trunk]
    if model.body_parentid[trunk] != 0 or any(t != mujoco.mjtJoint.mjJNT_FREE for t in others):
        raise refuse(f"body {model.body(trunk).name} above the hips does not move freely")
    thighs, calves = model.body_pos[bodies[:, 1]], model.body_pos[bodies[:, 2]]
    hips = model.body_pos[bodies[:, 0]]
    offset, length = abs(float(thighs[0, 1])), -float(calves[0, 2])
    outwards = np.outer(np.sign(hips[:, 1]) * offset, [0.0, 1.0, 0.0])
    for part, found, want in (
        ("thigh", thighs, outwards),
        ("calf", calves, np.tile([0.0, 0.0, -length], (NUM_LEGS, 1))),
    ):
        if not np.allclose(found, want, atol=TOLERANCE):
            raise refuse(f"{part} joints at {found.round(4).tolist()} m, not {want.tolist()}")
    return Frame(
        trunk=model.body(trunk).name,
        links=tuple(tuple(model.body(b).name for b in leg) for leg in bodies),
        hip_offsets=hips,
        thigh_offset=offset,
        thigh_length=length,
    )


def read_facts(
    name: str, model: ModelSource, feet: Sequence[str], given: dict[str, Any]
) -> dict[str, Any]:
    """Return the fields of a :class:`Robot`, see ``Robot.from_mjcf``."""
    allowed = tuple(field.name for field in fields(Robot))
    for fact in given:
        check_choice(f"fact about robot {name!r}", fact, allowed)
    _, raw = load(name, model)
    joints = given.get("joints") or tuple(
        raw.joint(i).name for i in range(raw.njnt) if raw.jnt_type[i] != mujoco.mjtJoint.mjJNT_FREE
    )
    frame = read_frame(name, raw, joints)
    calf_length, foot_radius = _read_feet(name, raw, frame, feet)
    ids = [raw.joint(joint).id for joint in joints]
    dofs = raw.jnt_dofadr[ids]
    facts: dict[str, Any] = {
        "legs": tuple(_common_start(leg) for leg in itertools.batched(joints, LEG_SIZE)),
        "joint_limits": raw.jnt_range[ids],
        "armature": raw.dof_armature[dofs],
        "damping": raw.dof_damping[dofs],
        "calf_length": calf_length,
        "foot_radius": foot_radius,
    } | {field.name: getattr(frame, field.name) for field in fields(Frame)}
    facts |= given
    facts |= {"name": name, "model": model, "joints": tuple(joints)}
    if "torque_limit" not in facts:
        facts["torque_limit"] = _read_torque_limits(name, raw, ids)
    for fact in PER_JOINT:
        facts[fact] = per_joint(facts[fact])
    if "contact_geoms" not in facts:
        facts["contact_geoms"] = _contact_geoms(raw, facts)
    return facts


def _common_start(names: Sequence[str]) -> str:
    """Return what the joint names of a leg begin with: its name."""
    same = itertools.takewhile(lambda letters: len(set(letters)) == 1, zip(*names, strict=False))
    return "".join(letters[0] for letters in same).strip("_")


def _read_feet(
    name: str, raw: mujoco.MjModel, frame: Frame, feet: Sequence[str]
) -> tuple[float, float]:
    """Return the calf length and the foot radius in m that the feet of the file have."""
    if len(feet) != NUM_LEGS:
        raise ValueError(
            f"robot {name!r}: feet are {list(feet)}; need {NUM_LEGS}, one for each leg"
        )
    data = mujoco.MjData(raw)
    mujoco.mj_kinematics(raw, data)
    geoms = [raw.geom(i).name for i in range(raw.ngeom)]
    sites = [raw.site(i).name for i in range(raw.nsite)]
    found = []
    for foot, leg in zip(feet, frame.links, strict=True):
        check_choice(
            f"foot (geom or site) of robot {name!r}", foot, tuple(filter(None, geoms + sites))
        )
        what = "geom" if foot in geoms else "site"
        here, calf = getattr(data, what)(foot).xpos, data.body(leg[-1])
        x, y, z = calf.xmat.reshape(3, 3).T @ (here - calf.xpos)
        if max(abs(x), abs(y)) > FOOT_TOLERANCE or z > 0:
            raise ValueError(
                f"robot {name!r}: foot {foot} is at ({x:.4f}, {y:.4f}, {z:.4f}) m in the frame of"
                f" {leg[-1]}; expected it straight below, within {FOOT_TOLERANCE} m"
            )
        found.append((-float(z), float(getattr(raw, what)(foot).size[0])))
    if np.ptp(np.array(found), axis=0).max() > TOLERANCE:
        raise ValueError(f"robot {name!r}: feet differ (calf length, radius in m): {found}")
    return found[0]


def _read_torque_limits(name: str, raw: mujoco.MjModel, ids: Sequence[int]) -> list[float]:
    """Return the limits [J] in N m of the file's joints, or of its motors."""
    limits = []
    for joint in ids:
        found = [raw.jnt_actfrcrange[joint, 1]] if raw.jnt_actfrclimited[joint] else []
        for motor in range(raw.nu):
            if raw.actuator_trnid[motor, 0] == joint and raw.actuator_forcelimited[motor]:
                found.append(raw.actuator_forcerange[motor, 1])
        if not found:
            raise ValueError(
                f"robot {name!r}: its MJCF has no torque limit for joint {raw.joint(joint).name}:"
                " give torque_limit in N m"
            )
        limits.append(float(min(found)))
    return limits


def _contact_geoms(raw: mujoco.MjModel, facts: dict[str, Any]) -> tuple[ContactGeom, ...]:
    """Return shapes of the A1's proportions: two capsules fill the trunk, four lie on each leg."""
    low, high = _box(raw, raw.body(facts["trunk"]).id)
    radius = (high[2] - low[2]) / 2
    beside = max((high[1] - low[1]) / 2 - radius, 0.0)
    middle = (low + high) / 2
    reach = max((high[0] - low[0]) / 2 - radius, 0.0)
    back, front = float(middle[0] - reach), float(middle[0] + reach)
    shapes = []
    for side, sign in (("right", -1.0), ("left", 1.0)):
        y, z = float(middle[1] + sign * beside), float(middle[2])
        ends = ((back, y, z), (front, y, z))
        shapes.append(ContactGeom(f"trunk_{side}_collision", TRUNK, -1, ends, float(radius)))
    offset, thigh, calf = (facts[k] for k in ("thigh_offset", "thigh_length", "calf_length"))
    zero = (0.0, 0.0, 0.0)
    for leg, name in enumerate(facts["legs"]):
        out = float(np.sign(facts["hip_offsets"][leg][1]))
        foot = (0.0, 0.0, -calf)
        for part, end, size in (
            (HIP, (0.0, out * 0.65 * offset, 0.0), 0.54 * offset),
            (THIGH, (0.0, 0.0, -0.85 * thigh), 0.085 * thigh),
            (CALF, (0.0, 0.0, -0.9 * calf), 0.075 * calf),
        ):
            shapes.append(ContactGeom(f"{name}_{part}_collision", part, leg, (zero, end), size))
        shapes.append(ContactGeom(f"{name}_foot", FOOT, leg, (foot, foot), facts["foot_radius"]))
    return tuple(shapes)


def _box(raw: mujoco.MjModel, body: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners [3], [3] m of a body's box in its frame: of what collides, else of all."""
    mine = np.flatnonzero(raw.geom_bodyid == body)
    solid = mine[(raw.geom_contype[mine] | raw.geom_conaffinity[mine]) > 0]
    chosen = solid if solid.size else mine
    if not chosen.size:
        raise ValueError(
            f"body {raw.body(body).name} has no geom to take its size from: give contact_geoms"
        )
    corners = []
    for geom in chosen:
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, raw.geom_quat[geom])
        rotation = rotation.reshape(3, 3)
        centre = raw.geom_pos[geom] + rotation @ raw.geom_aabb[geom, :3]
        half = np.abs(rotation) @ raw.geom_aabb[geom, 3:]
        corners.append((centre - half, centre + half))
    low, high = np.array(corners).transpose(1, 0, 2)
    return low.min(axis=0), high.max(axis=0)
