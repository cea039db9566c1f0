"""Clips of other quadrupeds: the feet are followed, scaled by the length of the legs.

Every foot keeps its way relative to its own thigh joint, times target leg over source leg; the legs
follow by inverse kinematics. The root keeps its orientation, its way over the ground is scaled
alike, and its height is such that the lowest foot is as high over the ground as it was, scaled.
Time is left as it is.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from twirl_mjx.motion.clip import Clip, rotation_of
from twirl_mjx.motion.conversion import AS_IS, Conversion
from twirl_mjx.motion.formats import foot_arms, read_clip
from twirl_mjx.motion.plausible import check_plausible
from twirl_mjx.sim import kinematics
from twirl_mjx.sim.robot import Robot
from twirl_mjx.sim.robots import A1


def read_motion(
    path: str | Path,
    robot: Robot = A1,
    legs: Sequence[str] = (),
    conversion: Conversion = AS_IS,
    recorded_on: Robot | None = None,
) -> Clip:
    """Return the clip in a file as a motion of a robot, checked (``plausible``).

    Args:
        path: The file.
        robot: Whose motion it becomes.
        legs: Order of the legs in the file, by default what it says.
        conversion: Units and frames of the file.
        recorded_on: Robot whose joint angles the file holds, if that is another one.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file is no clip, it cannot be a motion of the robot, or the feet are out of
            that robot's reach.
    """
    clip = read_clip(path, legs, recorded_on or robot, conversion)
    check_plausible(clip)
    if recorded_on is None or recorded_on is robot:
        return clip
    clip = retarget(clip, robot)
    check_plausible(clip)
    return clip


def leg_length(robot: Robot) -> float:
    """Return the length in m of a stretched leg, thigh joint to foot centre."""
    return robot.thigh_length + robot.calf_length


def retarget(clip: Clip, robot: Robot) -> Clip:
    """Return a clip of another robot as a motion of this one, its joints in this one's order.

    Raises:
        ValueError: A foot is out of reach or a joint beyond its limits; the message names leg,
            frame (index), value and range.
    """
    source = clip.robot
    scale = leg_length(robot) / leg_length(source)
    match = np.zeros(len(robot.legs), int)  # the source's legs in the order of the target's
    match[list(robot.corners)] = source.corners
    arms = (foot_arms(clip) - thigh_joints(source))[:, match]
    try:
        joints = kinematics.leg_inverse(robot, thigh_joints(robot) + scale * arms)
    except ValueError as error:
        raise ValueError(
            f"{clip.name}: as a motion of {robot.name!r} (legs of {leg_length(robot):.3g} m instead"
            f" of {leg_length(source):.3g} m): {error}"
        ) from error
    root = scale * clip.root_pos
    lowest = scale * (lowest_feet(clip) - source.foot_radius) + robot.foot_radius
    moved = dataclasses.replace(clip, root_pos=root, joint_pos=joints, robot=robot)
    root[:, 2] += lowest - lowest_feet(moved)
    return dataclasses.replace(moved, root_pos=root)


def thigh_joints(robot: Robot) -> np.ndarray:
    """Return the thigh joints [4, 3] m of a robot in the base frame, hip angles at zero."""
    joints = robot.hip_offsets.copy()
    joints[:, 1] += robot.side_signs * robot.thigh_offset
    return joints


def lowest_feet(clip: Clip) -> np.ndarray:
    """Return the height [F] in m of the centre of the lowest foot."""
    rotation = rotation_of(clip.root_quat).as_matrix()
    heights = clip.root_pos[:, None] + np.einsum("fij,flj->fli", rotation, foot_arms(clip))
    return heights[..., 2].min(axis=1)
