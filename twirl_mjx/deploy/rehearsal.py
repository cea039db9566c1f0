"""Rehearsal: episodes of an exported policy in a control loop of its own (``deploy.trial``)."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from twirl_mjx.deploy.conditions import CONTROL_HZ, IDEAL, RehearsalConfig
from twirl_mjx.deploy.reference import TASKS
from twirl_mjx.deploy.trial import Trial
from twirl_mjx.policies.learned import load_policy

__all__ = ["IDEAL", "Episode", "Rehearsal", "RehearsalConfig", "rehearse"]


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
    trial = Trial(policy, task, config, rng)
    qpos, goals = [trial.data.qpos.copy()], [trial.goal]
    decisions = []
    while trial.cause is None and trial.steps < round(config.episode_s * CONTROL_HZ):
        decisions.append(trial.step())
        if trial.cause != "diverged":
            qpos.append(trial.data.qpos.copy())
            goals.append(trial.goal)
    observations, actions = zip(*decisions, strict=True)
    arrays = (np.array(x) for x in (qpos, goals, observations, actions))
    return Episode(trial.metrics(), trial.cause or "time", *arrays)


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
