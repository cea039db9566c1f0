"""Rehearsal: a policy in a control loop of its own, before it meets a robot.

Nothing of the training simulation runs here. C MuJoCo advances at 1 ms with every body part
colliding; a 20 Hz loop reads noisy sensors, builds the observation (``deploy.pilots``), asks the
policy, filters the command and, a latency later, hands joint targets to motors with a PD law and a
torque-speed limit (``deploy.robot``).
"""

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np

from twirl_mjx.deploy.conditions import CONTROL_HZ, IDEAL, RehearsalConfig
from twirl_mjx.deploy.imitation import FollowScore
from twirl_mjx.deploy.pilots import Pilot, find_pilot
from twirl_mjx.deploy.reference import Reading, Score
from twirl_mjx.deploy.robot import CommandFilter, Contacts, Sensors, build_model, motor_torque
from twirl_mjx.figures import statistics
from twirl_mjx.policies.resolve import PLAIN, Terms
from twirl_mjx.sim.engine import silence

__all__ = ["IDEAL", "Episode", "Rehearsal", "RehearsalConfig", "Row", "rehearse"]

BANDS = 24
"""Hurdle bands laid out: more than 20 s at 2 m/s can reach."""
FEET = ("FR_foot", "FL_foot", "RR_foot", "RL_foot")
UNITS = {
    "return": "1",
    "episode_length": "control steps",
    "terminated": "1",
    "standing_time": "s",
    "min_distance": "m",
    "final_distance": "m",
    "forward_speed": "m/s",
    "peak_torque": "N m",
    "mean_power": "W",
    "clipped": "1",
    "hurdles_passed": "hurdles",
    "tracking": "1",
    "leaps": "cycles",
    "flights": "cycles",
}
"""Metric -> unit."""


@dataclasses.dataclass(frozen=True)
class Episode:
    """One rehearsed episode."""

    metrics: dict[str, float]
    """``return``, ``episode_length`` (control steps), ``standing_time`` (s) and more."""
    cause: str
    """Why it ended: ``time``, ``fall``, ``hurdle``, ``lost`` or ``diverged``."""
    qpos: np.ndarray
    """[T + 1, 7 + J] true state at every control step, for rendering."""
    goals: np.ndarray
    """[T + 1, 2] m, goal at every control step, world frame."""
    observations: np.ndarray
    """[T, O] what the policy was given; of a foreign one, what the task would have shown."""
    actions: np.ndarray
    """[T, A] what it answered."""
    readings: list[Reading] = dataclasses.field(default_factory=list)
    """[T] what was measured at every decision."""
    targets: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 12)))
    """[T, 12] rad, joint targets that followed, filtered and within the limits."""
    hurdles: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0))
    """[K] m, x of the hurdles."""


@dataclasses.dataclass(frozen=True)
class Row:
    """One line of a rehearsal's table."""

    metric: str
    unit: str
    mean: float
    """Over the episodes."""
    low: float
    """Lower end of the 95 % bootstrap interval of the mean over episodes; NaN for one episode."""
    high: float
    """Upper end."""


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

    def table(self) -> list[Row]:
        """Return mean and interval of every metric, and of every cause of an end."""
        columns = {n: [e.metrics[n] for e in self.episodes] for n in self.episodes[0].metrics}
        for cause in sorted({e.cause for e in self.episodes}):
            columns[f"ended/{cause}"] = [float(e.cause == cause) for e in self.episodes]
        rows = []
        for name, values in columns.items():
            found = statistics.bootstrap([np.array(values)], statistics.mean)
            unit = UNITS.get(name, "1")
            rows.append(Row(name, unit, found.estimate, found.low, found.high))
        return rows


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
    pilot: Pilot, task: str, config: RehearsalConfig, rng: np.random.Generator
) -> Episode:
    """Rehearse one episode from rest on four feet at the origin, facing +x.

    Args:
        pilot: What decides.
        task: one of ``reference.TASKS``.
        config: conditions.
        rng: draws goal, hurdles and noise.
    """
    hurdles = draw_hurdles(config, rng) if task == "hurdles" else np.zeros(0)
    drawn = draw_goal(config, rng)
    model = build_model(config, hurdles)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
    mujoco.mj_forward(model, data)
    sensors, contacts = Sensors(config, rng), Contacts(model, task)
    drive = Drive(np.zeros(model.nu), np.zeros(model.nu))
    score = _score(pilot, task, hurdles, config)
    score.start(data.qpos[:3], score.goal(drawn))
    reading = sensors.read(data)
    pilot.reset(reading)
    command = CommandFilter(reading.joint_pos)  # a robot knows what it measures
    targets = deque([(0, data.qpos[7:].copy())])
    feet = [model.geom(name).id for name in FEET]
    radii = model.geom_size[feet, 0]
    qpos, goals = [data.qpos.copy()], [score.goal(drawn)]
    decisions: list[tuple[np.ndarray, ...]] = []
    readings: list[Reading] = []
    cause, step, clipped = None, 0, 0.0
    while cause is None and step < round(config.episode_s * CONTROL_HZ):
        goal = score.goal(drawn)
        obs, wanted = pilot.decide(reading, goal)
        action = np.clip(wanted, -1.0, 1.0)
        clipped += float(np.mean(np.abs(wanted) > 1.0 + 1e-3))
        target = command(action)
        targets.append((step * config.n_substeps + config.latency_steps, target))
        decisions.append((obs, action, target))
        readings.append(reading)
        cause = advance(model, data, config, targets, contacts, drive)
        if cause != "diverged":
            score.step(data.qpos, data.qvel, data.geom_xpos[feet, 2] - radii, goal)
            cause = cause or score.cause()
            reading = sensors.read(data)
            pilot.push(reading, action)
            qpos.append(data.qpos.copy())
            goals.append(score.goal(drawn))
        step += 1
    metrics = _metrics(score, np.array(qpos), step, cause, drive) | {"clipped": clipped / step}
    observations, actions, followed = (np.array(x) for x in zip(*decisions, strict=True))
    return Episode(metrics, cause or "time", np.array(qpos), np.array(goals), observations, actions,
                   readings, followed, hurdles)  # fmt: skip


def _score(pilot: Pilot, task: str, hurdles: np.ndarray, config: RehearsalConfig) -> Score:
    if task == "imitate":
        return FollowScore(task, hurdles, clip=pilot.clip, options=pilot.options)
    return Score(task, hurdles, config.height_of)


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
    if score.task == "imitate":  # it has no goal and nobody stands up
        for name in ("standing_time", "min_distance", "final_distance"):
            del metrics[name]
    return metrics | score.extra(steps)


def rehearse(
    policy: Any,
    *,
    task: str | None = None,
    episodes: int = 8,
    seed: int = 0,
    config: RehearsalConfig | None = None,
    options: Any = None,
    terms: Terms = PLAIN,
    say: Callable[[str], None] = print,
) -> Rehearsal:
    """Rehearse a policy.

    Args:
        policy: a policy file (``.npz``, ``.onnx``), a run directory, anything else that
            ``--source`` takes and that acts, or an object with ``act``.
        task: the task; by default the one the policy file names.
        episodes: number of episodes; episode ``i`` depends on ``seed`` and ``i`` only.
        seed: seed of goals, hurdles and noise.
        config: conditions; the defaults are like the real robot's, ``IDEAL`` is without them.
        options: options of the task (the clip of ``imitate``); those on the policy's card, else
            the paper's, by default.
        terms: contract and command of a foreign policy.
        say: prints what a person should know of a foreign policy, a line each.

    Raises:
        ValueError: a task that cannot be rehearsed, a policy for another observation or of another
            robot, or one that does not act.
    """
    if episodes < 1:
        raise ValueError(f"episodes must be at least 1, got {episodes}")
    silence()
    pilot, task = find_pilot(policy, task, options, terms, say)
    config = config or RehearsalConfig()
    results = [
        run_episode(pilot, task, config, np.random.default_rng([seed, i])) for i in range(episodes)
    ]
    return Rehearsal(task, config, results)
