"""Rehearsal: an exported policy in a control loop of its own, before it meets a robot.

Nothing of the training simulation runs here. C MuJoCo advances at 1 ms with every body part
colliding; a 20 Hz loop reads noisy sensors, builds the observation (``deploy.reference``), asks
the policy, filters the command and, a latency later, hands joint targets to motors with a PD law
and a torque-speed limit (``deploy.robot``).
"""

from __future__ import annotations

import dataclasses
from collections import deque
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from twirl_mjx.deploy.reference import TASKS, Observer, Score
from twirl_mjx.deploy.robot import (
    CONTROL_HZ,
    IDEAL,
    CommandFilter,
    Contacts,
    RehearsalConfig,
    Sensors,
    build_model,
    motor_torque,
)
from twirl_mjx.policies.learned import load_policy

__all__ = ["IDEAL", "Episode", "Rehearsal", "RehearsalConfig", "rehearse"]

BANDS = 24
"""Hurdle bands laid out: more than 20 s at 2 m/s can reach."""
FRONT_FEET = ("FR_foot", "FL_foot")


@dataclasses.dataclass(frozen=True)
class Episode:
    """One rehearsed episode."""

    metrics: dict[str, float]
    """``return``, ``episode_length`` (control steps), ``standing_time`` (s) and more."""
    cause: str
    """Why it ended: ``time``, ``fall``, ``hurdle`` or ``diverged``."""
    qpos: np.ndarray
    """[T + 1, 7 + J] true state at every control step, for rendering."""
    goals: np.ndarray
    """[T + 1, 2] m, goal at every control step, world frame."""
    observations: np.ndarray
    """[T, O] what the policy was given."""
    actions: np.ndarray
    """[T, A] what it answered."""


@dataclasses.dataclass(frozen=True)
class Rehearsal:
    """All episodes of one rehearsal."""

    task: str
    """Task name."""
    config: RehearsalConfig
    """Conditions."""
    episodes: list[Episode]
    """One entry per episode."""

    def summary(self) -> dict[str, float]:
        """Return the mean of every metric and the share of every cause of an end."""
        names = self.episodes[0].metrics
        mean = {n: float(np.mean([e.metrics[n] for e in self.episodes])) for n in names}
        causes = sorted({e.cause for e in self.episodes})
        count = len(self.episodes)
        shares = {f"ended/{c}": sum(e.cause == c for e in self.episodes) / count for c in causes}
        return mean | shares


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

    Returns:
        The cause if the episode ended.
    """
    joint_pos, joint_vel = data.qpos[7:], data.qvel[6:]
    first = round(data.time / config.sim_dt)
    for now in range(first, first + config.n_substeps):
        while len(targets) > 1 and targets[1][0] <= now:
            targets.popleft()
        torque = motor_torque(config, targets[0][1], joint_pos, joint_vel)
        data.ctrl[:] = torque
        mujoco.mj_step(model, data)
        np.maximum(drive.peak, np.abs(torque), out=drive.peak)
        drive.work += np.abs(torque * joint_vel) * config.sim_dt
        cause = contacts.cause(data)
        if cause is not None:
            return cause
    if not (np.isfinite(data.qpos).all() and np.isfinite(data.qvel).all()):
        return "diverged"
    return None


def run_episode(
    policy: Any, task: str, config: RehearsalConfig, rng: np.random.Generator
) -> Episode:
    """Rehearse one episode from rest on four feet at the origin, facing +x.

    Args:
        policy: ``act(obs [O]) -> action [A]``; ``reset()`` is called first when it has one.
        task: one of ``reference.TASKS``.
        config: conditions.
        rng: draws goal, hurdles and noise.
    """
    if hasattr(policy, "reset"):
        policy.reset()
    hurdles = draw_hurdles(config, rng) if task == "hurdles" else np.zeros(0)
    drawn = draw_goal(config, rng)
    model = build_model(config, hurdles)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
    mujoco.mj_forward(model, data)
    sensors, contacts = Sensors(config, rng), Contacts(model, task)
    drive = Drive(np.zeros(model.nu), np.zeros(model.nu))
    score = Score(task, hurdles, config.height_of)
    score.start(data.qpos[:3], score.goal(drawn))
    reading = sensors.read(data)
    observer, command = Observer(task, reading), CommandFilter(data.qpos[7:])
    targets = deque([(0, data.qpos[7:].copy())])
    feet = [model.geom(name).id for name in FRONT_FEET]
    radii = model.geom_size[feet, 0]
    qpos, goals, observations, actions = [data.qpos.copy()], [score.goal(drawn)], [], []
    cause, step = None, 0
    while cause is None and step < round(config.episode_s * CONTROL_HZ):
        goal = score.goal(drawn)
        obs = observer.observe(reading, goal)
        action = np.clip(policy.act(obs), -1.0, 1.0)
        start = step * config.n_substeps + config.latency_steps
        targets.append((start, command(action)))
        cause = advance(model, data, config, targets, contacts, drive)
        if cause != "diverged":
            score.step(data.qpos, data.qvel, data.geom_xpos[feet, 2] - radii, goal)
            reading = sensors.read(data)
            observer.push(reading, action)
            qpos.append(data.qpos.copy())
            goals.append(score.goal(drawn))
        observations.append(obs)
        actions.append(action)
        step += 1
    metrics = _metrics(score, np.array(qpos), step, cause, drive)
    arrays = (np.array(x) for x in (qpos, goals, observations, actions))
    return Episode(metrics, cause or "time", *arrays)


def _metrics(
    score: Score, qpos: np.ndarray, steps: int, cause: str | None, drive: Drive
) -> dict[str, float]:
    """Collect the metrics of an episode of ``steps`` control steps."""
    seconds = steps / CONTROL_HZ
    metrics = {
        "return": score.reward_sum,
        "episode_length": float(steps),
        "terminated": float(cause is not None),
        "standing_time": score.standing_steps / CONTROL_HZ,
        "min_distance": score.min_distance,
        "final_distance": score.previous_distance,
        "forward_speed": float(qpos[-1, 0] - qpos[0, 0]) / seconds,
        "peak_torque": float(drive.peak.max()),
        "mean_power": float(drive.work.sum()) / seconds,
    }
    if score.task == "hurdles":
        metrics["hurdles_passed"] = float(score.passed)
    return metrics


def rehearse(
    policy: Any,
    *,
    task: str | None = None,
    episodes: int = 8,
    seed: int = 0,
    config: RehearsalConfig | None = None,
) -> Rehearsal:
    """Rehearse a policy.

    Args:
        policy: a policy file (``.npz``, ``.onnx``), a run directory, or an object with ``act``.
        task: the task; by default the one the policy file names.
        episodes: number of episodes; episode ``i`` depends on ``seed`` and ``i`` only.
        seed: seed of goals, hurdles and noise.
        config: conditions; the defaults are like the real robot's, ``IDEAL`` is without them.

    Raises:
        ValueError: a task that cannot be rehearsed, or a policy for another observation.
    """
    loaded = load_policy(policy) if isinstance(policy, str | Path) else policy
    header = getattr(loaded, "header", None)
    task = task or (header.task if header else None)
    if task not in TASKS:
        raise ValueError(
            f"cannot rehearse task {task!r}; choose one of {', '.join(TASKS)}"
            + ("" if task else " (the policy does not name its task)")
        )
    if episodes < 1:
        raise ValueError(f"episodes must be at least 1, got {episodes}")
    config = config or RehearsalConfig()
    results = [
        run_episode(loaded, task, config, np.random.default_rng([seed, i])) for i in range(episodes)
    ]
    return Rehearsal(task, config, results)
