"""Our leap clip: run-up, leap and landing of the A1, planned so that its dynamics add up.

``make_leap`` plans a periodic bound in the sagittal plane (``leap_plan``), solves for ground
forces, footholds and swing paths that keep legs, torques, motor targets and bandwidth within what
the robot and its 20 Hz controller can do (``leap_solver``), and returns the frames as a clip.
Nothing is copied from recorded motion. ``leap_checks.check_leap`` proves the properties of a leap.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np

from twirl_mjx.motion.clip import Clip
from twirl_mjx.motion.leap_plan import LeapMotion
from twirl_mjx.motion.leap_solver import solve_leap
from twirl_mjx.motion.planar import planar_model
from twirl_mjx.sim import a1


@dataclass(frozen=True)
class LeapConfig:
    """What the leap shall be like; the defaults made the shipped clip."""

    speed: float = 1.68
    """m/s, mean forward speed."""
    cycle_length: float = 2.1
    """m from one leap to the next: the mean hurdle spacing of the paper."""
    flight_time: float = 0.33
    """s with all four feet off the ground during the leap; the centre of mass is ballistic."""
    run_up_strides: int = 2
    """Short bounds between landing and take-off, the landing one included."""
    band_length: float = 0.3
    """m, length of the strip of ground under the leap that every foot must clear by
    ``foot_clearance``: a hurdle's 0.2 m and room for a badly timed take-off."""
    foot_clearance: float = 0.06
    """m, least height of the feet's lowest point over that strip."""
    run_up_foot_height: float = 0.1
    """m, lower bound of the inner control points of the feet's height in every swing."""
    max_pitch: float = 0.35
    """rad, largest nose-up or nose-down angle."""
    friction: float = 0.5
    """Largest ratio of horizontal to vertical ground force."""
    torque_share: float = 0.8
    """Share of the motors' torque limit the plan may use."""
    frame_rate: float = 80.0
    """Frames per second of plan and clip; the nearest rate with whole frames is taken."""

    def __post_init__(self) -> None:
        """Check ranges.

        Raises:
            ValueError: a value is outside the range in which the planner was tried.
        """
        ranges = {
            "speed": (1.2, 2.4),
            "cycle_length": (1.4, 3.2),
            "flight_time": (0.2, 0.5),
            "run_up_strides": (1, 4),
            "band_length": (0.2, 0.5),
            "foot_clearance": (0.02, 0.15),
            "run_up_foot_height": (0.0, 0.2),
            "max_pitch": (0.1, 0.8),
            "friction": (0.2, 1.0),
            "torque_share": (0.3, 1.0),
            "frame_rate": (50.0, 200.0),
        }
        for name, (low, high) in ranges.items():
            value = getattr(self, name)
            if not low <= value <= high:
                nearest = low if value < low else high
                raise ValueError(f"{name} {value} is outside [{low}, {high}] (nearest: {nearest})")
        ground = self.duration - self.flight_time
        if not 0.2 <= ground / (1 + self.run_up_strides) <= 0.5:
            raise ValueError(
                f"a cycle of {self.cycle_length} m at {self.speed} m/s leaves {ground:.2f} s for "
                f"{self.run_up_strides + 1} bounds beside the flight of {self.flight_time} s; "
                "0.2 to 0.5 s each are needed: change run_up_strides, speed or cycle_length"
            )

    @property
    def duration(self) -> float:
        """Duration of a cycle in s."""
        return self.cycle_length / self.speed

    @property
    def num_frames(self) -> int:
        """Frame intervals in a cycle."""
        return round(self.duration * self.frame_rate)


def make_leap(
    config: LeapConfig | None = None, progress: Callable[[str], None] | None = None
) -> Clip:
    """Plan a leap and return it as a wrapping clip.

    Deterministic; takes one to a few minutes of one core.

    Args:
        config: Wishes; the defaults make the shipped clip.
        progress: Called with a line of text after every stage of the solver.

    Returns:
        The clip, starting at take-off.

    Raises:
        RuntimeError: no motion with these properties was found; the message says what is missing.
    """
    config = config or LeapConfig()
    model = planar_model(mujoco.MjModel.from_xml_path(str(a1.xml_path())))
    motion, _ = solve_leap(config, model, progress)
    return motion_to_clip(motion, config.duration, "leap")


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
