"""Task ``imitate`` once more, in plain numpy for one robot; see ``deploy.reference``.

The clip is sampled by ``motion.clip.configurations``, which the simulation does not use.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from twirl_mjx.deploy.reference import HISTORY, LIFTED, Reading, Score, quaternion_matrix
from twirl_mjx.motion.clip import Clip, configurations, frame_velocities
from twirl_mjx.sim import kinematics
from twirl_mjx.tasks.imitate import ImitateOptions, standing_time

CONTROL_DT = 0.05
AHEAD = (1, 2, 7, 20)
"""Control steps ahead of the poses that are shown."""
FLIGHT_STEPS = 4
"""Control steps in a row without a foot on the ground that make a flight."""


def into_heading(rotation: np.ndarray) -> np.ndarray:
    """Return the matrix [3, 3] that turns world vectors into the heading of a base [3, 3]."""
    yaw = np.arctan2(rotation[1, 0], rotation[0, 0])
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """Return rotation matrices [..., 3, 3] as quaternions w x y z [..., 4] with w >= 0."""
    from scipy.spatial.transform import Rotation  # takes long to import

    return Rotation.from_matrix(rotation).as_quat(canonical=True, scalar_first=True)


class Reference:
    """The clip, moved to the robot at the start and whenever a cycle begins."""

    def __init__(self, clip: Clip, position: np.ndarray) -> None:
        """Start at the frame a robot at rest joins best, where ``position`` [3] m is."""
        self._clip = clip
        self._start = standing_time(clip)
        self._velocities = np.concatenate(frame_velocities(clip), axis=1)
        self.step = 0
        self._place(position)

    def advance(self, position: np.ndarray) -> None:
        """Go on by one control step; the robot is at ``position`` [3] m then."""
        before = self.cycles
        self.step += 1
        if self.cycles > before:
            self._place(position)

    @property
    def time(self) -> float:
        """Time within the clip in s, over all cycles."""
        return self._start + self.step * CONTROL_DT

    @property
    def cycles(self) -> int:
        """Cycles begun since the clip's first frame."""
        return int(self.time / self._clip.cycle_duration + 1e-4)

    @property
    def leaps(self) -> int:
        """Whole cycles that the episode has lasted."""
        return int(self.step * CONTROL_DT / self._clip.cycle_duration + 1e-4)

    def poses(self, *ahead: int) -> np.ndarray:
        """Return qpos [K, 19] so many control steps from now."""
        poses = configurations(self._clip, self.time + CONTROL_DT * np.array(ahead))
        poses[:, :2] += self._offset
        return poses

    def velocity(self) -> np.ndarray:
        """Return the velocity now [18]: world, body and joints."""
        duration, turn = self._clip.cycle_duration, self._clip.cycle_displacement[2]
        cycle, inside = divmod(self.time, duration)
        grid = np.linspace(0.0, duration, self._clip.num_frames)
        now = np.array([np.interp(inside, grid, column) for column in self._velocities.T])
        c, s = np.cos(cycle * turn), np.sin(cycle * turn)
        now[:2] = np.array([[c, -s], [s, c]]) @ now[:2]
        return now

    def _place(self, position: np.ndarray) -> None:
        self._offset = np.zeros(2)
        self._offset = position[:2] - self.poses(0)[0, :2]


class Follower:
    """Builds the observation [160] of ``imitate`` step by step; see ``reference.Observer``."""

    def __init__(self, clip: Clip, first: Reading) -> None:
        """Begin an episode at rest."""
        self._reference = Reference(clip, first.position)
        self._frames = [self._frame(first, np.zeros(12))] * HISTORY

    def push(self, reading: Reading, action: np.ndarray) -> None:
        """Add the reading after a control step with the raw action [12] that led to it."""
        self._frames = [*self._frames[1:], self._frame(reading, action)]
        self._reference.advance(reading.position)

    def observe(self, reading: Reading, goal: np.ndarray) -> np.ndarray:
        """Return the observation, float32; the goal is not looked at."""
        del goal
        turn, targets = into_heading(reading.rotation), self._reference.poses(*AHEAD)
        way = (targets[:, :3] - reading.position) @ turn.T
        rotations = np.array([quaternion_matrix(quat) for quat in targets[:, 3:7]])
        shown = np.concatenate([way, quaternion(turn @ rotations), targets[:, 7:]], axis=1)
        return np.concatenate([*self._frames, shown.ravel()]).astype(np.float32)

    @staticmethod
    def _frame(reading: Reading, action: np.ndarray) -> np.ndarray:
        tilt = into_heading(reading.rotation) @ reading.rotation
        return np.concatenate([quaternion(tilt), reading.joint_pos, action])


@dataclasses.dataclass
class FollowScore(Score):
    """Judges an episode of ``imitate`` against the clip."""

    clip: Clip | None = None
    """What is followed."""
    options: ImitateOptions = dataclasses.field(default_factory=ImitateOptions)
    """When the robot is lost."""
    flights: int = 0
    """Cycles with a flight."""
    _reference: Reference | None = None
    _lost: bool = False
    _airborne: int = 0
    _flew: bool = False

    def start(self, position: np.ndarray, goal: np.ndarray) -> None:
        """Put the clip where the robot is."""
        super().start(position, goal)
        assert self.clip is not None, "made with a clip"
        self._reference = Reference(self.clip, position)

    def step(
        self,
        qpos: np.ndarray,
        qvel: np.ndarray,
        feet: np.ndarray,
        goal: np.ndarray,
        ground: float = 0.0,
    ) -> float:
        """Score one control step; arguments as :meth:`Score.step`."""
        del goal, ground
        reference = self._reference
        assert reference is not None, "started"
        leaps = reference.leaps
        reference.advance(qpos[:3])
        wanted, speed = reference.poses(0)[0], reference.velocity()
        ours, theirs = quaternion_matrix(qpos[3:7]), quaternion_matrix(wanted[3:7])
        cosine = 0.5 * (np.trace(theirs.T @ ours) - 1.0)
        angle = float(np.arccos(np.clip(cosine, -1.0, 1.0)))
        error = qpos[:3] - wanted[:3]
        spin = ours @ qvel[3:6] - theirs @ speed[3:6]
        stance = self._feet(qpos) - self._feet(wanted)
        reward = (
            0.5 * np.exp(-5.0 * np.sum((qpos[7:] - wanted[7:]) ** 2))
            + 0.05 * np.exp(-0.1 * np.sum((qvel[6:] - speed[6:]) ** 2))
            + 0.15 * np.exp(-20.0 * error @ error - 10.0 * angle**2)
            + 0.1 * np.exp(-2.0 * np.sum((qvel[:3] - speed[:3]) ** 2) - 0.2 * spin @ spin)
            + 0.2 * np.exp(-40.0 * np.sum(stance**2))
        )
        self._lost = bool(
            np.linalg.norm(error) > self.options.max_root_error
            or angle > self.options.max_root_angle
        )
        self._airborne = self._airborne + 1 if (feet > LIFTED).all() else 0
        self._flew |= self._airborne == FLIGHT_STEPS
        if reference.leaps > leaps:
            self.flights += self._flew
            self._flew = False
        self.reward_sum += float(reward)
        return float(reward)

    def cause(self) -> str | None:
        """Return ``lost`` when the robot is too far from the clip."""
        return "lost" if self._lost else None

    def extra(self, steps: int) -> dict[str, float]:
        """Return how well the clip was followed."""
        assert self._reference is not None, "started"
        return {
            "tracking": self.reward_sum / steps,
            "leaps": float(self._reference.leaps),
            "flights": float(self.flights),
        }

    def _feet(self, qpos: np.ndarray) -> np.ndarray:
        """Return the feet [4, 3] m from the base, in the heading frame."""
        assert self.clip is not None, "made with a clip"
        rotation = quaternion_matrix(qpos[3:7])
        feet = kinematics.foot_positions(self.clip.robot, qpos[7:])
        return feet @ (into_heading(rotation) @ rotation).T
