"""Rehearsal: episodes of a policy in a control loop of its own, before it meets a robot.

The loop is ``deploy.trial``.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from twirl_mjx.deploy.conditions import CONTROL_HZ, IDEAL, RehearsalConfig
from twirl_mjx.deploy.pilots import Pilot, find_pilot
from twirl_mjx.deploy.reference import Reading
from twirl_mjx.deploy.trial import Trial
from twirl_mjx.figures import statistics
from twirl_mjx.policies.resolve import PLAIN, Terms
from twirl_mjx.sim.engine import silence

__all__ = ["IDEAL", "Episode", "Rehearsal", "RehearsalConfig", "Row", "rehearse"]

UNITS = {
    "return": "1",
    "episode_length": "control steps",
    "terminated": "1",
    "standing_time": "s",
    "min_distance": "m",
    "mean_distance": "m",
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
    trial = Trial(pilot, task, config, rng)
    qpos, goals = [trial.data.qpos.copy()], [trial.goal]
    decisions = []
    while trial.cause is None and trial.steps < round(config.episode_s * CONTROL_HZ):
        decisions.append(trial.step())
        if trial.cause != "diverged":
            qpos.append(trial.data.qpos.copy())
            goals.append(trial.goal)
    readings, observations, actions, targets = zip(*decisions, strict=True)
    arrays = (np.array(x) for x in (qpos, goals, observations, actions))
    return Episode(
        trial.metrics(),
        trial.cause or "time",
        *arrays,
        readings=list(readings),
        targets=np.array(targets),
        hurdles=trial.hurdles,
    )


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
