"""Our leap clip: run-up, leap and landing of the A1, planned so that its dynamics add up.

``make_leap`` plans a periodic bound in the sagittal plane (``leap_plan``), solves for ground
forces, footholds and swing paths that keep legs, torques, motor targets and bandwidth within what
the robot and its 20 Hz controller can do (``leap_solver``), and returns the frames as a clip.
Nothing is copied from recorded motion. ``leap_checks.check_leap`` proves the properties of a leap.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

from twirl_mjx import files
from twirl_mjx.assets import asset_path
from twirl_mjx.motion.clip import Clip
from twirl_mjx.motion.leap_config import ROBOT, LeapConfig
from twirl_mjx.motion.leap_plan import Layout, LeapMotion, make_layout
from twirl_mjx.motion.leap_solver import solve_leap
from twirl_mjx.motion.planar import planar_model
from twirl_mjx.sim.mjcf import robot_model
from twirl_mjx.sim.robot import Robot

SHIPPED_PLAN = (ROBOT.name, "leap_plan.json")
"""Asset with the numbers of the shipped leap's plan, by name."""


def make_leap(
    config: LeapConfig | None = None,
    progress: Callable[[str], None] | None = None,
    *,
    cold: bool = False,
    robot: Robot = ROBOT,
) -> Clip:
    """Plan a leap and return it as a wrapping clip.

    Deterministic; takes about half a minute of one core, or two from a cold start.

    Args:
        config: Wishes; the defaults make the shipped clip.
        progress: Called with a line of text after every stage of the solver.
        cold: Start from a plain pronk instead of the shipped plan. Another number of run-up
            strides than the shipped plan's always starts cold.
        robot: Who shall leap; only ``leap_config.ROBOT`` can.

    Returns:
        The clip, starting at take-off.

    Raises:
        ValueError: another robot.
        RuntimeError: no motion with these properties was found; the message says what is missing.
    """
    if robot is not ROBOT:
        raise ValueError(
            f"no leap can be planned for robot {robot.name!r}: the planner's start and bounds are"
            f" those of {ROBOT.name!r} (nearest: a clip file of its own)"
        )
    config = config or LeapConfig()
    model = planar_model(robot_model(ROBOT))
    start = None if cold else shipped_plan(make_layout(config))
    motion, _ = solve_leap(config, model, progress, start)
    return motion_to_clip(motion, config.duration, "leap")


def shipped_plan(layout: Layout) -> np.ndarray | None:
    """Return the shipped plan [P], or None if it has other variables than ``layout``."""
    path = asset_path(*SHIPPED_PLAN)
    numbers = files.read_json(path, "the plan of a leap")
    sizes = {name: place.stop - place.start for name, place in layout.index.items()}
    if {name: len(values) for name, values in numbers.items()} != sizes:
        return None
    params = np.zeros(len(layout.start))
    for name, values in numbers.items():
        params[layout.index[name]] = values
    return params


def write_plan(layout: Layout, params: np.ndarray, path: str | Path) -> None:
    """Write the numbers [P] of a plan by name, for ``shipped_plan``."""
    rows = {name: params[place].round(9).tolist() for name, place in layout.index.items()}
    lines = ",\n".join(f"{json.dumps(name)}: {json.dumps(row)}" for name, row in rows.items())
    files.write_text(path, "{\n" + lines + "\n}\n")


def motion_to_clip(motion: LeapMotion, duration: float, name: str) -> Clip:
    """Return a planned motion (no leading axes) as a clip with straight legs sideways."""
    count = len(motion.times)
    zero = np.zeros(count)
    half = 0.5 * motion.pose.pitch
    front, hind = (
        np.stack([zero, motion.pose.thigh[:, pair], motion.pose.calf[:, pair]], axis=1)
        for pair in (0, 1)
    )
    root = motion.pose.root
    return Clip(
        root_pos=np.stack([root[:, 0], zero, root[:, 1]], axis=1),
        root_quat=np.stack([np.cos(half), zero, np.sin(half), zero], axis=1),
        joint_pos=np.concatenate([front, front, hind, hind], axis=1),
        frame_duration=duration / (count - 1),
        loop="wrap",
        cycle_offset_position=True,
        cycle_offset_rotation=False,
        name=name,
    )
