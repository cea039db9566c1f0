"""Clip files: reader and writer of two published JSON layouts.

Both are a JSON object with ``LoopMode`` ("Wrap" or "Clamp"), ``FrameDuration`` (s),
``EnableCycleOffsetPosition``, ``EnableCycleOffsetRotation`` and ``Frames``. They differ in the
numbers of a frame; quaternions are x y z w in both, joints FR FL RR RL x hip thigh calf:

* ``peng`` (Peng et al. 2020): root position, root quaternion, joint angles.
* ``amp``: the same, then toe positions, linear velocity (3), angular velocity (3), joint velocities
  and toe velocities, as many of each as there are joints. All of this follows from the former: it
  is recomputed on reading and writing. Toes are written in the world frame, as in the A1 files
  this was checked with.

A file of three keys (``FrameDuration``, ``LegOrder``, ``Frames``) wraps, as ``Clip`` does by
default. ``.npy`` and ``.csv`` files hold the frames alone: the numbers of ``peng``, or joint angles
only, for which the robot is put level on its lowest foot.

Without ``LegOrder`` the order of the legs cannot be told: for another one pass ``legs`` to
``read_clip``; for other units and frames a ``Conversion``. A clip has the joints in the order of
its robot. Whether a clip can be a motion at all: ``plausible``.
"""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from twirl_mjx import array_files, files
from twirl_mjx.checks import one_line
from twirl_mjx.motion.clip import Clip, LoopMode, frame_velocities, rotation_of
from twirl_mjx.motion.conversion import AS_IS, NUM_JOINTS, POSE_SIZE, Conversion
from twirl_mjx.sim import kinematics
from twirl_mjx.sim.robot import LEG_SIZE, NUM_LEGS, ROOT_SIZE, Robot
from twirl_mjx.sim.robots import A1

Layout = Literal["peng", "amp"]
FRAME_SIZES: dict[str, int] = {"peng": POSE_SIZE, "amp": POSE_SIZE + 3 * NUM_JOINTS + 6}
"""Numbers in a frame."""
CORNERS = ("FR", "FL", "RR", "RL")
"""Legs of a file in their order: front right, front left, hind right, hind left."""
LOOP_MODES: dict[str, LoopMode] = {"Wrap": "wrap", "Clamp": "clamp"}


def read_clip(
    path: str | Path,
    legs: Sequence[str] = (),
    robot: Robot = A1,
    conversion: Conversion = AS_IS,
) -> Clip:
    """Read a clip of any layout; ending and frame size tell which.

    Args:
        path: The file. Keys other than those of the layout (``MotionWeight``, say) are ignored.
        legs: Order of the legs in the file, a permutation of FR FL RR RL; by default what the file
            says, else that.
        robot: Whose motion it is.
        conversion: What its numbers are.

    Returns:
        The motion, named after the file.

    Raises:
        FileNotFoundError: no such file.
        ValueError: the file is malformed; the message names the file and the line, key or frame.
    """
    path = Path(path)
    data = _table(path) if path.suffix in (".npy", ".csv") else _parse(path)
    legs = legs or _legs(path, data)
    if sorted(legs) != sorted(CORNERS):
        raise ValueError(f"legs {list(legs)} must be a permutation of {', '.join(CORNERS)}")
    frames = _frames(path, data)
    is_bare = frames.shape[1] == NUM_JOINTS
    if is_bare:
        root = np.tile([0.0] * 6 + [1.0], (len(frames), 1))
        frames = np.concatenate([root, frames], axis=1)
        conversion = Conversion(degrees=conversion.degrees, fps=conversion.fps)
    frames = conversion.apply(frames)
    angles = frames[:, ROOT_SIZE:POSE_SIZE].reshape(-1, NUM_LEGS, LEG_SIZE)
    joints = np.zeros_like(angles)
    joints[:, list(robot.corners)] = angles[:, [list(legs).index(leg) for leg in CORNERS]]
    joints = joints.reshape(-1, NUM_JOINTS)
    if is_bare:
        frames[:, 2] = _on_its_feet(robot, joints)
    try:
        return Clip(
            root_pos=frames[:, :3],
            root_quat=frames[:, [6, 3, 4, 5]],
            joint_pos=joints,
            frame_duration=_duration(path, data, conversion),
            loop=_loop(path, data),
            cycle_offset_position=_flag(path, data, "EnableCycleOffsetPosition"),
            cycle_offset_rotation=_flag(path, data, "EnableCycleOffsetRotation"),
            name=path.stem,
            robot=robot,
        )
    except ValueError as error:
        if str(path) in str(error):
            raise
        raise ValueError(f"{path}: {error}") from error


def _parse(path: Path) -> dict[str, Any]:
    data = files.read_json(path, "a clip")
    if not isinstance(data, dict):
        raise ValueError(f"{path}: line 1: need a JSON object, got {type(data).__name__}")
    return data


DEFAULTS: dict[str, Any] = {
    "LoopMode": "Wrap",
    "EnableCycleOffsetPosition": True,
    "EnableCycleOffsetRotation": False,
}
"""What a file with ``LegOrder``, or one of frames alone, does not say."""


def _table(path: Path) -> dict[str, Any]:
    """Return the frames of a ``.npy`` or ``.csv`` file under the keys of a JSON file."""
    if path.suffix == ".npy":
        array = array_files.read_npy(path, "a clip", files.TEXT_LIMIT)
        if array.ndim != 2 or array.dtype.kind not in "fiu":
            raise ValueError(
                f"{path}: an array {array.shape} of {array.dtype}, need [F, N] numbers"
            )
        rows = array.astype(np.float64).tolist()
    else:
        lines = list(csv.reader(files.read_text(path, "a clip").splitlines()))
        lines = [line for line in lines if any(cell.strip() for cell in line)]
        rows = []
        for number, line in enumerate(lines):
            try:
                rows.append([float(cell) for cell in line])
            except ValueError as error:
                if number:  # the first line may be a header
                    raise ValueError(f"{path}: row {number}: {error}") from error
    return DEFAULTS | {"Frames": rows}


def _legs(path: Path, data: dict[str, Any]) -> Sequence[str]:
    """Return the order of the legs that a file says, or the usual one."""
    given = data.get("LegOrder", CORNERS)
    legs = given.replace(",", " ").split() if isinstance(given, str) else given
    if not isinstance(legs, list | tuple) or sorted(map(str, legs)) != sorted(CORNERS):
        raise ValueError(
            f"{path}: key LegOrder is {given!r}, need a permutation of {', '.join(CORNERS)}"
        )
    return legs


def _value(path: Path, data: dict[str, Any], key: str) -> Any:
    if key not in data and "LegOrder" in data and key in DEFAULTS:
        return DEFAULTS[key]
    if key not in data:
        present = one_line(", ".join(data))
        raise ValueError(f"{path}: key {key} is missing (keys present: {present})")
    return data[key]


def _flag(path: Path, data: dict[str, Any], key: str) -> bool:
    value = _value(path, data, key)
    if not isinstance(value, bool):
        raise ValueError(f"{path}: key {key} is {value!r}, need true or false")
    return value


def _duration(path: Path, data: dict[str, Any], conversion: Conversion) -> float:
    if conversion.fps:
        return 1.0 / conversion.fps
    if path.suffix in (".npy", ".csv"):
        raise ValueError(f"{path}: it does not say its rate (nearest: --imitate.clip-fps 50)")
    value = _value(path, data, "FrameDuration")
    if not _is_number(value) or not value > 0:
        raise ValueError(f"{path}: key FrameDuration is {value!r}, need a time in s above 0")
    return float(value)


def _loop(path: Path, data: dict[str, Any]) -> LoopMode:
    value = _value(path, data, "LoopMode")
    if not isinstance(value, str) or value not in LOOP_MODES:
        raise ValueError(f"{path}: key LoopMode is {value!r}, need 'Wrap' or 'Clamp'")
    return LOOP_MODES[value]


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _frames(path: Path, data: dict[str, Any]) -> np.ndarray:
    """Return the frames [F, 7 + J or 13 + 4 J] as the file has them, every number checked."""
    frames = _value(path, data, "Frames")
    if not isinstance(frames, list) or len(frames) < 2:
        raise ValueError(f"{path}: key Frames must be a list of at least 2 frames")
    sizes = " or ".join(f"{size} ({name})" for name, size in FRAME_SIZES.items())
    for index, frame in enumerate(frames):
        if not isinstance(frame, list):
            raise ValueError(f"{path}: frame {index} is no list of numbers")
        alone = {NUM_JOINTS} if path.suffix in (".npy", ".csv") else set()
        expected = {len(frames[0])} if index else {*FRAME_SIZES.values(), *alone}
        if len(frame) not in expected:
            need = f"{len(frames[0])} as in frame 0" if index else sizes
            raise ValueError(f"{path}: frame {index} has {len(frame)} numbers, need {need}")
        for column, value in enumerate(frame):
            if not _is_number(value):
                raise ValueError(f"{path}: frame {index}, number {column} is {value!r}")
    return np.array(frames, np.float64)


def _on_its_feet(robot: Robot, joint_pos: np.ndarray) -> np.ndarray:
    """Return the root heights [F] m at which the lowest foot of a level robot touches ground."""
    feet = kinematics.foot_positions(robot, joint_pos)
    return robot.foot_radius - feet[..., 2].min(axis=1)


def write_clip(clip: Clip, path: str | Path, layout: Layout = "peng") -> None:
    """Write a clip; reading it back gives the same motion to 6 decimals.

    Args:
        clip: The motion.
        path: File to write.
        layout: ``peng`` (small) or ``amp``.

    Raises:
        ValueError: unknown layout.
    """
    if layout not in FRAME_SIZES:
        raise ValueError(f"unknown clip layout {layout!r}: choose {' or '.join(FRAME_SIZES)}")
    columns = [clip.root_pos, clip.root_quat[:, [1, 2, 3, 0]], _by_corner(clip, clip.joint_pos)]
    if layout == "amp":
        columns += _derived(clip)
    rows = np.concatenate(columns, axis=1)
    head = {
        "MadeBy": files.MARK,
        "LoopMode": {mode: name for name, mode in LOOP_MODES.items()}[clip.loop],
        "FrameDuration": clip.frame_duration,
        "EnableCycleOffsetPosition": clip.cycle_offset_position,
        "EnableCycleOffsetRotation": clip.cycle_offset_rotation,
    }
    lines = [f"{json.dumps(key)}: {json.dumps(value)}," for key, value in head.items()]
    frames = [json.dumps([round(float(v), 6) + 0.0 for v in row]) for row in rows]
    body = ",\n".join(f"  {frame}" for frame in frames)
    text = "{\n" + "\n".join(lines) + '\n"Frames": [\n' + body + "\n]\n}\n"
    files.write_text(path, text)


def _by_corner(clip: Clip, values: np.ndarray) -> np.ndarray:
    """Return three numbers a leg, [F, 4, 3] or [F, J], as [F, J] in the files' order of legs."""
    count = clip.num_frames
    return values.reshape(count, NUM_LEGS, LEG_SIZE)[:, list(clip.robot.corners)].reshape(count, -1)


def _derived(clip: Clip) -> list[np.ndarray]:
    """Return what the AMP layout adds to a frame, each [F, K]."""
    rotation = rotation_of(clip.root_quat)
    root_vel, root_ang_vel, joint_vel = frame_velocities(clip)
    arms = np.einsum("fij,flj->fli", rotation.as_matrix(), foot_arms(clip))
    toes = clip.root_pos[:, None] + arms
    ang_vel = rotation.apply(root_ang_vel)
    step = 1e-5  # s, for the toes' velocity within the body
    moved = kinematics.foot_positions(clip.robot, clip.joint_pos + step * joint_vel)
    within = np.einsum("fij,flj->fli", rotation.as_matrix(), (moved - foot_arms(clip)) / step)
    toe_vel = root_vel[:, None] + np.cross(ang_vel[:, None], arms) + within
    first, second, third = (_by_corner(clip, values) for values in (toes, joint_vel, toe_vel))
    return [first, root_vel, ang_vel, second, third]


def foot_arms(clip: Clip) -> np.ndarray:
    """Return the foot centres [F, 4, 3] m in the base frame."""
    return kinematics.foot_positions(clip.robot, clip.joint_pos)


def foot_paths(clip: Clip) -> np.ndarray:
    """Return the foot centres [F, 4, 3] m in the world frame."""
    rotation = rotation_of(clip.root_quat).as_matrix()
    return clip.root_pos[:, None] + np.einsum("fij,flj->fli", rotation, foot_arms(clip))
