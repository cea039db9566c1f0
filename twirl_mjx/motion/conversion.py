"""What the numbers of a clip file are, where they are not as ours."""

from __future__ import annotations

import dataclasses
from typing import Literal

import numpy as np

from twirl_mjx.checks import check_choice, check_range
from twirl_mjx.sim.robot import LEG_SIZE, NUM_LEGS, ROOT_SIZE

NUM_JOINTS = NUM_LEGS * LEG_SIZE
POSE_SIZE = ROOT_SIZE + NUM_JOINTS
"""Numbers of a configuration."""
LAIKAGO = np.full(4, 0.5)
"""Root of a Laikago that stands upright in files of Peng et al.; ours is the identity then."""


@dataclasses.dataclass(frozen=True)
class Conversion:
    """What a file has other than radians, metres, x y z w, a root with z up and its own rate."""

    degrees: bool = False
    """Joint angles are in degrees."""
    metres: float = 1.0
    """m per unit of the root position: 0.01 for centimetres."""
    quaternion: Literal["xyzw", "wxyz"] = "xyzw"
    """Order of the numbers of a quaternion."""
    root: Literal["a1", "laikago"] = "a1"
    """Frame of the root: x forward and z up, or that of a Laikago."""
    fps: float = 0.0
    """Frames per second, instead of ``FrameDuration``; 0 to keep that."""

    def __post_init__(self) -> None:
        """Check every value, or raise ValueError."""
        check_range("clip metres", self.metres, 1e-6, 100.0)
        check_choice("clip quaternion", self.quaternion, ("xyzw", "wxyz"))
        check_choice("clip root", self.root, ("a1", "laikago"))
        check_range("clip fps", self.fps, 0.0, 10_000.0)

    def apply(self, frames: np.ndarray) -> np.ndarray:
        """Return frames [F, 19 or more] in our units and frames."""
        out = frames.copy()
        out[:, :3] *= self.metres
        if self.quaternion == "wxyz":
            out[:, 3:7] = frames[:, [4, 5, 6, 3]]
        if self.root == "laikago":
            from twirl_mjx.motion.clip import rotation_of  # needs jax, which options do not

            turned = rotation_of(out[:, [6, 3, 4, 5]]) * rotation_of(LAIKAGO).inv()
            out[:, 3:7] = turned.as_quat()
        if self.degrees:
            out[:, ROOT_SIZE:POSE_SIZE] = np.deg2rad(frames[:, ROOT_SIZE:POSE_SIZE])
        return out


AS_IS = Conversion()


@dataclasses.dataclass(frozen=True)
class ClipOptions:
    """How a clip file is read, as options of a task or a command."""

    clip_legs: tuple[str, ...] = ()
    """Order of the legs in the file, FL FR RL RR say; what the file says, else FR FL RR RL."""
    clip_degrees: bool = False
    """The joint angles of the clip are in degrees."""
    clip_metres: float = 1.0
    """m per unit of the clip's root position: 0.01 for centimetres."""
    clip_quaternion: Literal["xyzw", "wxyz"] = "xyzw"
    """Order of the clip's quaternions."""
    clip_root: Literal["a1", "laikago"] = "a1"
    """Root frame of the clip: x forward and z up, or that of a Laikago."""
    clip_fps: float = 0.0
    """Frames per second of the clip, instead of what the file says; 0 to keep that."""
    clip_robot: str = ""
    """Robot the clip was recorded on, by name or file.py:NAME, where it is another one: its feet
    are followed, scaled by the length of the legs."""

    def __post_init__(self) -> None:
        """Check every value, or raise ValueError."""
        _ = self.conversion  # checks itself

    @property
    def conversion(self) -> Conversion:
        """What the numbers of the clip are."""
        return Conversion(
            self.clip_degrees, self.clip_metres, self.clip_quaternion, self.clip_root, self.clip_fps
        )
