"""What a reference motion cannot be: gates that catch wrong units, frames and orders.

Every refusal names frame, part, value and limit, the likely mistake, and the option of ``imitate``
that converts.
"""

from __future__ import annotations

import math

import numpy as np

from twirl_mjx.motion.clip import Clip, rotation_of
from twirl_mjx.sim import kinematics

LIMIT_MARGIN = 0.3
"""rad, by which published motions, retargeted from animals, leave the joint limits."""
FRAME_DURATIONS = (0.0005, 0.25)
"""s; faster clips are recorded by nothing, slower ones are no motion of legs."""
MAX_DISTANCE = 1000.0
"""m, of the root from the origin: beyond, float32 places a foot no better than to 0.1 mm."""
MAX_HEIGHT = 3.0
"""m, of the root."""
LOWEST_FOOT = (-0.15, 0.15)
"""m over the ground, where the lowest foot of the whole clip has to be."""
MAX_SPEEDS = {"root": 12.0, "turn": 40.0, "joint": 60.0}
"""m/s, rad/s, rad/s between two frames; a motor of the A1 reaches 21 rad/s."""


def check_plausible(clip: Clip) -> None:
    """Refuse a clip that cannot be a motion of its robot.

    Raises:
        ValueError: One line, see the module.
    """
    for gate in (
        _check_duration, _check_angles, _check_height, _check_distance, _check_root, _check_jumps,
        _check_limits, _check_ground,
    ):  # fmt: skip
        gate(clip)


def _refuse(clip: Clip, frame: int, what: str, limit: str, remedy: str) -> None:
    raise ValueError(f"{clip.name}: frame {frame}: {what}, {limit} ({remedy})")


def _check_angles(clip: Clip) -> None:
    frame, joint = np.unravel_index(int(np.abs(clip.joint_pos).argmax()), clip.joint_pos.shape)
    value = clip.joint_pos[frame, joint]
    if abs(value) > 2 * math.pi:
        _refuse(clip, int(frame), f"joint {clip.robot.joints[joint]} is {value:.4g} rad",
                "limit 6.28", "degrees? --imitate.clip-degrees")  # fmt: skip


def _check_duration(clip: Clip) -> None:
    low, high = FRAME_DURATIONS
    if not low <= clip.frame_duration <= high:
        usual = 1.0 <= clip.frame_duration <= 1000.0
        fps = clip.frame_duration if usual else 1 / (low if clip.frame_duration < low else high)
        raise ValueError(
            f"{clip.name}: FrameDuration is {clip.frame_duration:g} s, limits {low} to {high}"
            f" (frames per second? --imitate.clip-fps {fps:g})"
        )


def _check_height(clip: Clip) -> None:
    frame = int(np.abs(clip.root_pos[:, 2]).argmax())
    height = clip.root_pos[frame, 2]
    if abs(height) > MAX_HEIGHT:
        factor = 0.001 if abs(height) > 100.0 else 0.01
        unit = "millimetres" if factor < 0.01 else "centimetres"
        _refuse(clip, frame, f"root height is {height:.4g} m", f"limit {MAX_HEIGHT:g}",
                f"{unit}? --imitate.clip-metres {factor:g}")  # fmt: skip


def _check_distance(clip: Clip) -> None:
    frame, axis = np.unravel_index(int(np.abs(clip.root_pos).argmax()), clip.root_pos.shape)
    value = clip.root_pos[frame, axis]
    if abs(value) > MAX_DISTANCE:
        _refuse(clip, int(frame), f"the root is at {'xyz'[axis]} = {value:.4g} m",
                f"limit {MAX_DISTANCE:g}", "millimetres? --imitate.clip-metres 0.001")  # fmt: skip


def _check_root(clip: Clip) -> None:
    """Most of the time a quadruped has its back up, and never a flank."""
    axes = rotation_of(clip.root_quat).as_matrix()
    flank, back = axes[:, 2, 1], axes[:, 2, 2]
    if np.median(flank) > 0.7:
        frame = int(flank.argmax())
        _refuse(clip, frame, f"the left flank points up by {flank[frame]:.2f}", "limit 0.7",
                "Laikago root frame? --imitate.clip-root laikago")  # fmt: skip
    if np.median(back) < -0.5:
        frame = int(back.argmin())
        _refuse(clip, frame, f"the robot lies on its back, z-axis up by {back[frame]:.2f}",
                "limit -0.5", "w x y z? --imitate.clip-quaternion wxyz")  # fmt: skip


def _check_jumps(clip: Clip) -> None:
    speeds = {
        "root": np.linalg.norm(np.diff(clip.root_pos, axis=0), axis=1),
        "turn": (
            rotation_of(clip.root_quat[:-1]).inv() * rotation_of(clip.root_quat[1:])
        ).magnitude(),
        "joint": np.abs(np.diff(clip.joint_pos, axis=0)).max(axis=1),
    }
    units = {"root": "m/s", "turn": "rad/s", "joint": "rad/s"}
    for part, moved in speeds.items():
        frame = int(moved.argmax())
        speed = moved[frame] / clip.frame_duration
        if speed > MAX_SPEEDS[part]:
            name = part
            if part == "joint":
                joint = int(np.abs(clip.joint_pos[frame + 1] - clip.joint_pos[frame]).argmax())
                name = f"joint {clip.robot.joints[joint]}"
            _refuse(clip, frame + 1, f"{name} jumps at {speed:.3g} {units[part]}",
                    f"limit {MAX_SPEEDS[part]:g}",
                    "frames missing, or another rate? --imitate.clip-fps")  # fmt: skip


def _check_limits(clip: Clip) -> None:
    low, high = clip.robot.joint_limits.T
    beyond = np.maximum(low - clip.joint_pos, clip.joint_pos - high)
    frame, joint = np.unravel_index(int(beyond.argmax()), beyond.shape)
    if beyond[frame, joint] > LIMIT_MARGIN:
        _refuse(clip, int(frame),
                f"joint {clip.robot.joints[joint]} is {clip.joint_pos[frame, joint]:.3g} rad",
                f"limits {low[joint]:.3g} to {high[joint]:.3g}",
                "another order or sign of joints? --imitate.clip-legs FL FR RL RR")  # fmt: skip


def _check_ground(clip: Clip) -> None:
    arms = kinematics.foot_positions(clip.robot, clip.joint_pos)
    rotation = rotation_of(clip.root_quat).as_matrix()
    heights = (clip.root_pos[:, None] + np.einsum("fij,flj->fli", rotation, arms))[..., 2]
    heights = heights.min(axis=1) - clip.robot.foot_radius
    frame = int(heights.argmin())
    if not LOWEST_FOOT[0] <= heights[frame] <= LOWEST_FOOT[1]:
        _refuse(clip, frame, f"the lowest foot of the clip is {heights[frame]:.3g} m high",
                f"limits {LOWEST_FOOT[0]} to {LOWEST_FOOT[1]}",
                "another scale, robot or height of the root? --imitate.clip-metres")  # fmt: skip
