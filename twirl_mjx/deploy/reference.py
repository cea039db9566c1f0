"""The tasks once more, in plain numpy, for one robot: what a rehearsal measures and scores.

Written from the specification and not from ``twirl_mjx.tasks``, so that a fault in either shows
as a difference between a rehearsal and an evaluation (and in a test that compares both).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

HISTORY = 3
STAND, BIPED, HURDLES, IMITATE = "stand", "biped", "hurdles", "imitate"
UPRIGHT_TASKS = (STAND, BIPED)
TASKS = (*UPRIGHT_TASKS, HURDLES, IMITATE)
"""Tasks that can be rehearsed."""

STANDING_COSINE = 0.7
LIFTED = 0.01
"""m, clearance over which a front foot counts as off the ground."""
PASSED = 0.4
"""m past a hurdle at which the goal moves on to the next."""

FALL_PARTS = {
    STAND: ("trunk", "head", "hip", "thigh", "calf"),
    BIPED: ("trunk", "head", "hip", "thigh"),
    HURDLES: ("trunk", "head"),
    IMITATE: ("trunk", "head", "hip", "thigh"),
}
"""Parts of the robot whose ground contact ends an episode (docs/decisions.md)."""


NEAR, UPRIGHT, BANDS, LEAPS = 0.14, 12.0, 2, 3
"""What makes an episode a success: m from the goal, s upright, hurdles passed, leaps flown."""


def succeeded(task: str, metrics: Mapping[str, float]) -> bool:
    """Return whether an episode with these metrics met its task's criterion."""
    if task == HURDLES:
        return metrics["hurdles_passed"] >= BANDS
    if task == IMITATE:
        return metrics["flights"] >= LEAPS
    near = task == STAND or metrics["min_distance"] <= NEAR
    return near and metrics["standing_time"] >= UPRIGHT


class Reading(NamedTuple):
    """What the sensors and the state estimate say at one control step."""

    rotation: np.ndarray
    """[3, 3] body to world."""
    angular_velocity: np.ndarray
    """[3] rad/s, body frame."""
    joint_pos: np.ndarray
    """[12] rad."""
    position: np.ndarray
    """[3] m, base in the world frame."""
    velocity: np.ndarray = np.zeros(3)
    """[3] m/s, base in the world frame; our own policies do not look at it."""
    joint_vel: np.ndarray = np.zeros(12)
    """[12] rad/s; neither at this."""


def quaternion_matrix(quat: np.ndarray) -> np.ndarray:
    """Return the rotation matrix [3, 3] of a unit quaternion [4], wxyz."""
    w, v = quat[0], quat[1:]
    cross = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
    return np.eye(3) + 2.0 * w * cross + 2.0 * cross @ cross


def history_frame(reading: Reading, start: np.ndarray, action: np.ndarray) -> np.ndarray:
    """Return one step of the history [31].

    Order: roll, pitch (rad); roll and pitch rate in the body frame (rad/s); joint angles (rad);
    displacement since the start of the episode (m, world); the action that led here.
    """
    r = reading.rotation
    roll, pitch = np.arctan2(r[2, 1], r[2, 2]), -np.arcsin(np.clip(r[2, 0], -1.0, 1.0))
    rates = reading.angular_velocity[:2]
    joints, moved = reading.joint_pos, reading.position - start
    return np.concatenate([[roll, pitch], rates, joints, moved, action])


class Observer:
    """Builds the observation of a task step by step."""

    def __init__(self, task: str, first: Reading) -> None:
        """Begin an episode: the history is filled with the first reading and no action."""
        self._axes = task in UPRIGHT_TASKS
        self._start = first.position.copy()
        self._frames = [history_frame(first, self._start, np.zeros(12))] * HISTORY

    def push(self, reading: Reading, action: np.ndarray) -> None:
        """Add the reading after a control step with the raw action [12] that led to it."""
        self._frames = [*self._frames[1:], history_frame(reading, self._start, action)]

    def observe(self, reading: Reading, goal: np.ndarray) -> np.ndarray:
        """Return the observation, [101] upright tasks or [95] hurdles, float32.

        Args:
            reading: the reading pushed last.
            goal: [2] m, world frame.
        """
        parts = [goal - reading.position[:2], *self._frames]
        if self._axes:
            parts += [reading.rotation[:, 0], reading.rotation[:, 2]]
        return np.concatenate(parts).astype(np.float32)


@dataclasses.dataclass
class Score:
    """Judges one episode from the true state; units in the field documentation."""

    task: str
    """Task name."""
    hurdles: np.ndarray
    """[K] m, x of the hurdle centres; empty for other tasks."""
    height_of: str = "root"
    """Height that ``stand`` rewards: ``root`` or ``front_feet``."""
    reward_sum: float = 0.0
    """Undiscounted return so far."""
    standing_steps: int = 0
    """Control steps upright with both front feet lifted."""
    passed: int = 0
    """Hurdles passed so far; one that the robot moves back over stays passed."""
    min_distance: float = np.inf
    """Smallest planar distance to the goal so far, m."""
    distance_sum: float = 0.0
    """Of the distances to the goal at all steps so far, m."""
    previous_distance: float = np.inf
    """Distance to the goal one control step ago, m."""

    def goal(self, goal: np.ndarray) -> np.ndarray:
        """Return the goal [2] m: the next hurdle where there are hurdles, else ``goal``."""
        if self.task != HURDLES:
            return goal
        return np.array([self.hurdles[min(self.passed, len(self.hurdles) - 1)], 0.0])

    def start(self, position: np.ndarray, goal: np.ndarray) -> None:
        """Note the distance to the goal before the first step."""
        self.previous_distance = self.min_distance = float(np.linalg.norm(goal - position[:2]))

    def step(
        self,
        qpos: np.ndarray,
        qvel: np.ndarray,
        feet: np.ndarray,
        goal: np.ndarray,
        ground: float = 0.0,
    ) -> float:
        """Score one control step.

        Args:
            qpos: [19] true state at its end.
            qvel: [18] true velocities at its end.
            feet: [4] m, height of the lowest point of the feet over the ground, front ones first.
            goal: [2] m, goal of the step.
            ground: height of the ground under the base, m.

        Returns:
            The reward.
        """
        rotation, front_feet = quaternion_matrix(qpos[3:7]), feet[:2]
        cosine = rotation[2, 0]
        if cosine >= STANDING_COSINE and (front_feet > LIFTED).all():
            self.standing_steps += 1
        to_goal = goal - qpos[:2]
        distance = float(np.linalg.norm(to_goal))
        if self.task == HURDLES:
            reward = self._hurdles(qpos, qvel)
        else:
            foot_centre = float(front_feet.mean()) + 0.02
            height = foot_centre if self._rewards_front_feet() else qpos[2] - ground
            reward = (0.5 * cosine + 0.5) ** 2 + np.exp(height) - 1.0
        if self.task == BIPED:
            facing = -rotation[:2, 2] @ to_goal / max(distance, 1e-6)
            nearer = 0.5 if distance < self.previous_distance else 0.0
            progress = 1.0 if distance <= 0.01 else nearer
            reward *= 1.0 + (0.5 * facing + 0.5) ** 2 + progress
        self.previous_distance = distance
        self.min_distance = min(self.min_distance, distance)
        self.distance_sum += distance
        self.reward_sum += float(reward)
        return float(reward)

    def cause(self) -> str | None:
        """Return why the state just scored ends the episode, None where it goes on."""
        return None

    def extra(self, steps: int) -> dict[str, float]:
        """Return what only this task measures, after ``steps`` control steps."""
        return {"hurdles_passed": float(self.passed)} if self.task == HURDLES else {}

    def _rewards_front_feet(self) -> bool:
        return self.task == STAND and self.height_of == "front_feet"

    def _hurdles(self, qpos: np.ndarray, qvel: np.ndarray) -> float:
        """Return the hurdles reward and count the hurdles passed."""
        self.passed = max(self.passed, int(np.sum(qpos[0] > self.hurdles + PASSED)))
        angle = 2.0 * np.arccos(min(abs(qpos[3]), 1.0))
        forward = 1.0 if qvel[0] > 0.5 else 0.007
        calm = np.exp(-0.1 * np.linalg.norm(qvel[6:]))
        return 0.7 * forward + 0.05 * np.exp(-2.0 * angle) + 0.15 * calm + 0.1 * self.passed
