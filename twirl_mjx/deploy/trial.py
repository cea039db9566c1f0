"""One episode of a policy in the rehearsal's loop, one control step at a time.

Nothing of the training simulation runs here. C MuJoCo advances at 1 ms with every body part
colliding; a 20 Hz loop reads noisy sensors (``deploy.robot``), lets a pilot observe
and decide (``deploy.pilots``), filters the command and, a latency later, hands joint
targets to motors with a PD law and a torque-speed limit.
"""

from __future__ import annotations

import dataclasses
from collections import deque
from typing import NamedTuple

import mujoco
import numpy as np

from twirl_mjx.deploy.conditions import CONTROL_HZ, LIVE, RehearsalConfig
from twirl_mjx.deploy.ground import build_model, err_bodies, ground_height, set_conditions
from twirl_mjx.deploy.imitation import FollowScore
from twirl_mjx.deploy.pilots import Pilot
from twirl_mjx.deploy.reference import HURDLES, IMITATE, Reading, Score, succeeded
from twirl_mjx.deploy.robot import (
    CommandFilter,
    Contacts,
    Encoder,
    Sensors,
    motor_shares,
    motor_torque,
)

BANDS = 24
"""Hurdle bands laid out: more than 20 s at 2 m/s can reach."""
FEET = ("FR_foot", "FL_foot", "RR_foot", "RL_foot")
ROUNDING = 1e-3
"""By which an action may leave [-1, 1] and not count as clipped."""


class Decision(NamedTuple):
    """What a policy was given at a control step, and what it answered."""

    reading: Reading
    """What was measured."""
    observation: np.ndarray
    """[O] what the policy was given; of a foreign one, what the task would have shown."""
    action: np.ndarray
    """[12] in [-1, 1]."""
    target: np.ndarray
    """[12] rad, the joint target that followed, filtered and within the limits."""


@dataclasses.dataclass
class Drive:
    """Totals over the physics steps of an episode."""

    peak: np.ndarray
    """[J] largest torque, N m."""
    work: np.ndarray
    """[J] integral of |torque * speed|, J."""


def draw_goal(config: RehearsalConfig, rng: np.random.Generator) -> np.ndarray:
    """Return a goal [2] m: angle = U(-pi, pi), distance as configured."""
    angle, distance = rng.uniform(-np.pi, np.pi), config.goal_distance
    if distance is None:
        distance = float(np.clip(rng.exponential(1.5), 0.3, 5.0))
    return distance * np.array([np.cos(angle), np.sin(angle)])


def draw_hurdles(config: RehearsalConfig, rng: np.random.Generator) -> np.ndarray:
    """Return hurdle positions [BANDS] m along x: gaps = U(1.6, 2.6) or as configured."""
    gaps = rng.uniform(1.6, 2.6, BANDS) if config.hurdle_gap is None else config.hurdle_gap
    return np.cumsum(np.broadcast_to(gaps, BANDS))


def advance(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    config: RehearsalConfig,
    targets: deque[tuple[int, np.ndarray]],
    contacts: Contacts,
    drive: Drive,
    encoder: Encoder,
) -> str | None:
    """Advance the physics by one control step.

    Args:
        model: the physics.
        data: its state, changed in place.
        config: motors.
        targets: (physics step from which it holds, joint target [J] rad), oldest first; used-up
            entries are removed, the one in force stays in front.
        contacts: contact rules.
        drive: totals, changed in place.
        encoder: what the motors know of the joints; it takes every physics step.

    Returns:
        The cause if the episode ended.
    """
    joint_vel = data.qvel[6:]
    first, share = round(data.time / config.sim_dt), motor_shares(config)
    for now in range(first, first + config.n_substeps):
        while len(targets) > 1 and targets[1][0] <= now:
            targets.popleft()
        torque = motor_torque(config, targets[0][1], *encoder.read(), joint_vel, share)
        data.ctrl[:] = torque
        mujoco.mj_step(model, data)
        encoder.push(data)
        np.maximum(drive.peak, np.abs(torque), out=drive.peak)
        drive.work += np.abs(torque * joint_vel) * config.sim_dt
        if not (np.isfinite(data.qpos).all() and np.isfinite(data.qvel).all()):
            return "diverged"
        cause = contacts.cause(data)
        if cause is not None:
            return cause
    return None


class Trial:
    """One episode from rest on four feet at the origin, facing +x.

    It ends with a ``cause``; until then :meth:`step` advances it. Goal, conditions and a force on
    the trunk may be changed between steps.
    """

    def __init__(
        self, pilot: Pilot, task: str, config: RehearsalConfig, rng: np.random.Generator
    ) -> None:
        """Draw the course and place the robot.

        Args:
            pilot: what decides.
            task: one of ``reference.TASKS``.
            config: conditions.
            rng: draws goal, hurdles and noise.

        Raises:
            ValueError: Ground on which the task is not rehearsed.
        """
        if task == IMITATE and (config.bump_height or config.incline_deg):
            raise ValueError(
                "task imitate is rehearsed on flat ground only (nearest: bump_height 0,"
                " incline_deg 0)"
            )
        self.pilot, self.task, self.config = pilot, task, config
        self.hurdles = draw_hurdles(config, rng) if task == HURDLES else np.zeros(0)
        self._drawn = draw_goal(config, rng)
        self._sensors = Sensors(config, rng)
        later = rng.spawn(1)[0]  # what it draws changes nothing else
        self.model = build_model(config, self.hurdles)
        self._trunk_mass = err_bodies(self.model, config, later)
        angle = later.uniform(-np.pi, np.pi)
        self._goal_step = config.goal_speed / CONTROL_HZ * np.array([np.cos(angle), np.sin(angle)])
        set_conditions(self.model, config, self._trunk_mass)
        self.data = mujoco.MjData(self.model)
        mujoco.mj_resetDataKeyframe(self.model, self.data, self.model.key("home").id)
        mujoco.mj_forward(self.model, self.data)
        self._feet = [self.model.geom(name).id for name in FEET]
        self._raise_to_ground()
        self._contacts = Contacts(self.model, task)
        self._encoder = Encoder(config, self.data)
        self.drive = Drive(np.zeros(self.model.nu), np.zeros(self.model.nu))
        self.score = self._new_score()
        self.score.start(self.data.qpos[:3], self.goal)
        self._reading = self._sensors.read(self.data, self._encoder)
        pilot.reset(self._reading)
        self._command = CommandFilter(self._reading.joint_pos)  # a robot knows what it measures
        self._targets = deque([(0, self.data.qpos[7:].copy())])
        self.steps, self._travelled, self._clipped = 0, 0.0, 0.0
        self.cause: str | None = None
        """Why it ended: ``fall``, ``hurdle``, ``lost`` or ``diverged``; None while it goes on."""

    def _new_score(self) -> Score:
        if self.task == IMITATE:
            return FollowScore(
                self.task, self.hurdles, clip=self.pilot.clip, options=self.pilot.options
            )
        return Score(self.task, self.hurdles, self.config.height_of)

    def _raise_to_ground(self) -> None:
        """Lift the robot by the highest ground under a foot, on bumps."""
        if self.config.bump_height:
            under = ground_height(self.config, self.data.geom_xpos[self._feet, :2])
            self.data.qpos[2] += under.max()
            mujoco.mj_forward(self.model, self.data)

    @property
    def goal(self) -> np.ndarray:
        """[2] m: the next hurdle where there are hurdles, else the goal; world frame."""
        return self.score.goal(self._drawn)

    def aim(self, goal: np.ndarray) -> None:
        """Move the goal to ``goal`` [2] m, world frame; hurdles stay where they are.

        The closest approach and what the next step compares with begin anew.
        """
        self._drawn = np.asarray(goal, float)
        self.score.start(self.data.qpos[:3], self.goal)

    def push(self, force: np.ndarray) -> None:
        """Pull the trunk with ``force`` [3] N, world frame, until the next call."""
        self.data.xfrc_applied[self.model.body("trunk").id, :3] = force

    def change(self, config: RehearsalConfig) -> None:
        """Go on under other conditions.

        Raises:
            ValueError: A setting that shapes the scene differs; the message names it.
        """
        for field in dataclasses.fields(config):
            if field.name not in LIVE and getattr(config, field.name) != getattr(
                self.config, field.name
            ):
                raise ValueError(f"{field.name} needs a new episode")
        self.config = self._sensors.config = config
        set_conditions(self.model, config, self._trunk_mass)

    def decide(self) -> tuple[np.ndarray, np.ndarray]:
        """Ask the pilot: return the task's observation [O] and the action [12], unclipped."""
        return self.pilot.decide(self._reading, self.goal)

    def step(self) -> Decision:
        """Advance by one control step of 0.05 s, of an episode that has not ended."""
        goal, reading = self.goal, self._reading
        obs, wanted = self.decide()
        action = np.clip(wanted, -1.0, 1.0)
        self._clipped += float(np.mean(np.abs(wanted) > 1.0 + ROUNDING))
        target = self._command(action)
        start = self.steps * self.config.n_substeps + self.config.latency_steps
        self._targets.append((start, target))
        self.cause = advance(
            self.model,
            self.data,
            self.config,
            self._targets,
            self._contacts,
            self.drive,
            self._encoder,
        )
        if self.cause != "diverged":
            self._drawn = self._drawn + self._goal_step
            self._judge(goal if self.task == HURDLES else self.goal)
            self.cause = self.cause or self.score.cause()
            self._travelled = float(self.data.qpos[0])
            self._reading = self._sensors.read(self.data, self._encoder)
            self.pilot.push(self._reading, action)
        self.steps += 1
        return Decision(reading, obs, action, target)

    def _judge(self, goal: np.ndarray) -> None:
        feet = self.data.geom_xpos[self._feet]
        places = np.vstack([self.data.qpos[:2], feet[:, :2]])
        ground = ground_height(self.config, places)
        clearance = feet[:, 2] - self.model.geom_size[self._feet, 0] - ground[1:]
        self.score.step(self.data.qpos, self.data.qvel, clearance, goal, ground[0])

    def metrics(self) -> dict[str, float]:
        """Return the measures of what has been so far, of at least one step.

        ``return``, ``episode_length`` (control steps), ``standing_time`` (s), distances (m),
        ``forward_speed`` (m/s), ``peak_torque`` (N m), ``mean_power`` (W).
        """
        score, seconds = self.score, self.steps / CONTROL_HZ
        metrics = {
            "return": score.reward_sum,
            "episode_length": float(self.steps),
            "terminated": float(self.cause is not None),
            "standing_time": score.standing_steps / CONTROL_HZ,
            "min_distance": score.min_distance,
            "mean_distance": score.distance_sum / self.steps,
            "final_distance": score.previous_distance,
            "forward_speed": self._travelled / seconds,
            "peak_torque": float(self.drive.peak.max()),
            "mean_power": float(self.drive.work.sum()) / seconds,
        }
        if self.task == IMITATE:  # it has no goal and nobody stands up
            for name in ("standing_time", "min_distance", "mean_distance", "final_distance"):
                del metrics[name]
        if self.task == HURDLES:
            metrics["hit_hurdle"] = float(self.cause == "hurdle")
        metrics |= {"fall": float(self.cause == "fall"), "clipped": self._clipped / self.steps}
        metrics |= score.extra(self.steps)
        return metrics | {"success": float(succeeded(self.task, metrics))}
