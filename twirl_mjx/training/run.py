"""One seed of a batch on disk: its directory, its checkpoints, its policies."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from twirl_mjx.droq import forms
from twirl_mjx.droq.config import DroqConfig
from twirl_mjx.policies.learned import PolicyHeader, save_policy
from twirl_mjx.replay.ring import RingBuffer
from twirl_mjx.sim.robots import ROBOTS
from twirl_mjx.tasks.measures import episode_means, measures_of
from twirl_mjx.tasks.observations import layout_slices
from twirl_mjx.training import config_json, rundir
from twirl_mjx.training.checkpoint import Checkpoints, Refill
from twirl_mjx.training.config import TrainConfig
from twirl_mjx.training.guards import DivergedError
from twirl_mjx.training.learners import learner_of
from twirl_mjx.training.rundir import RunDir
from twirl_mjx.training.sinks.base import RunInfo, Sink
from twirl_mjx.training.state import TrainState
from twirl_mjx.types import MetricInfo, SourcePolicy
from twirl_mjx.worlds.vector import VectorEnv


@dataclasses.dataclass(frozen=True)
class Part:
    """What one seed of a batch is given to train with."""

    config: TrainConfig
    """The run, with its own seed."""
    run_dir: RunDir
    """Its directory, judged to be new or resumable (``RunDir.status``)."""
    source: RingBuffer | None = None
    """Frozen source experience; needed when ``config.uses_source_data``."""
    initial: Callable[[Any], Any] | None = None
    """Changes the fresh learner before the first transition."""
    sinks: tuple[Sink, ...] = ()
    """Where metrics go beside ``metrics.csv``, TensorBoard and the terminal."""
    policy: SourcePolicy | None = None
    """The source itself; needed when ``config.guide`` is not ``none``."""


def make_header(config: TrainConfig, env: VectorEnv, card: dict[str, Any]) -> PolicyHeader:
    """Return the header of a policy file of this run."""
    layout = env.task.observer.layout
    slices = layout_slices(layout)
    return PolicyHeader(
        task=config.task,
        observation_size=env.observation_size,
        action_size=env.action_size,
        control_dt=env.control_dt,
        observation_layout=tuple(
            (e.name, slices[e.name].start, slices[e.name].stop, e.unit) for e in layout
        ),
        config_digest=rundir.digest(config),
        versions=rundir.versions(),
        card=card,
    )


class Run:
    """The books of one seed; it compiles nothing and knows of no other seed."""

    def __init__(self, part: Part, env: VectorEnv, stage: str) -> None:
        """Open the checkpoints of a run directory.

        Args:
            part: The seed.
            env: Its worlds.
            stage: Name shown with the progress.
        """
        self.config, self.run_dir = part.config, part.run_dir
        self.checkpoints = Checkpoints(self.run_dir.path)
        self.replay_ratio = self.config.droq.utd * self.config.droq.batch_size
        self.source_rows = 0.0 if part.source is None else float(part.source.size)
        self.resumed_at: int | None = None
        self.notes: list[str] = []
        """What was unusual about how this seed resumed, as lines."""
        self.fault: DivergedError | None = None
        """Why this seed goes on no more, although others may."""
        self.progress: dict[str, Any] = {
            "best": -math.inf,
            "wall_s": 0.0,
            "inserted": 0,
            "first_drop": "",
            "refilled": [],
        }
        """What a checkpoint holds beside the state; ``first_drop``: why, empty if none was;
        ``refilled``: transitions at which the replay was gathered anew."""
        self._env = env
        self._stage = stage

    def info(self) -> RunInfo:
        """Return what sinks are told; call it after a possible :meth:`restore`."""
        measures = measures_of(self._env.task).items()
        return RunInfo(
            directory=self.run_dir.path,
            identity=self.run_dir.identity(self.config),
            total_env_steps=self.config.total_env_steps,
            stage=self._stage,
            resume_env_steps=self.resumed_at,
            measures={name: MetricInfo(measure.about, measure.unit) for name, measure in measures},
            learning=learner_of(self.config.droq).metrics,
            config=config_json.flatten(self.config),
        )

    def restore(self, template: TrainState, step: int, refill: Refill) -> TrainState:
        """Return the checkpoint at ``step``; later ones are deleted.

        Raises:
            DamagedError: None up to it is whole.
        """
        self.checkpoints.back_to(step, rows=not self.config.refill)
        state, progress = self.checkpoints.restore(template, refill if self.config.refill else None)
        self.resumed_at = int(state.env_steps)
        self.progress |= progress
        if self.checkpoints.stepped_over:
            self.notes.append(self.checkpoints.stepped_over)
        if self.checkpoints.refilled:
            self.progress["refilled"] = [*self.progress["refilled"], self.resumed_at]
            self.notes.append(
                f"the replay of {self.run_dir.name} was not whole:"
                f" {int(state.replay.online.size):,} transitions were gathered anew with its policy"
            )
        return state

    def evaluated(
        self, actor: Any, counts: dict[str, int], values: dict[str, np.ndarray]
    ) -> dict[str, float]:
        """Take an evaluation, measures [E], and return means; keep the newest policy.

        It is the policy of the run, too, if ``eval.keep`` says so or its return is the best.
        """
        means = episode_means(values)
        self.save_policy(self.run_dir.last_policy, actor, counts, means)
        if means["return"] > self.progress["best"] or self.config.eval.keep == "last":
            self.progress["best"] = max(means["return"], self.progress["best"])
            self.save_policy(self.run_dir.policy, actor, counts, means)
        return means

    def save_policy(
        self, path: Path, actor: Any, counts: dict[str, int], means: dict[str, float]
    ) -> None:
        """Write an actor as a policy file of the run.

        Args:
            path: The file.
            actor: Parameters of the actor.
            counts: ``env_steps`` and ``grad_steps`` it was trained for.
            means: Its evaluation.
        """
        card = {
            "seed": self.config.seed,
            "variant": self.config.variant,
            "shift": self.config.shift,
            **counts,
            "replay_ratio": self.replay_ratio,
            "wall_s": round(self.progress["wall_s"], 1),
            "options": dataclasses.asdict(self.config.options),
            "robot": ROBOTS.reference(self.config.robot) or self.config.robot,
            "evaluation": means,
        }
        if isinstance(self.config.droq, DroqConfig):  # what ``auto`` meant on this machine
            card["form"] = forms.name_of(self.config.droq)
        if self.progress["refilled"]:
            card["replay_refilled_at"] = self.progress["refilled"]
        header = make_header(self.config, self._env, card)
        save_policy(path, jax.tree.map(np.asarray, actor), header)

    def save(self, state: TrainState) -> None:
        """Write a checkpoint of a state that was found to be finite."""
        self.progress["inserted"] = int(state.inserted)
        self.checkpoints.save(state, self.progress)

    def close(self) -> None:
        """Release the checkpoint manager."""
        self.checkpoints.close()
