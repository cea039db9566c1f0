"""The Python loop around the compiled epoch: logging, evaluation, checkpoints, signals.

It runs a batch of seeds; a run alone is a batch of one (``program``).
"""

from __future__ import annotations

import dataclasses
import math
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from twirl_mjx.policies.learned import NumpyPolicy, load_policy
from twirl_mjx.tasks.measures import episode_means
from twirl_mjx.training import program
from twirl_mjx.training.checkpoint import stored_steps
from twirl_mjx.training.config import of_program
from twirl_mjx.training.guards import (
    FINITE,
    INSERTED,
    DivergedError,
    all_finite,
    check_experience,
    check_finite,
)
from twirl_mjx.training.guidance import Guide
from twirl_mjx.training.learner_check import check_learner
from twirl_mjx.training.logger import RunLogger
from twirl_mjx.training.metrics import FIRST_DROP
from twirl_mjx.training.program import Program
from twirl_mjx.training.run import Part, Run
from twirl_mjx.training.rundir import RunDir
from twirl_mjx.training.signals import stop_on_signal
from twirl_mjx.training.sinks.table import FINAL
from twirl_mjx.training.state import TrainState
from twirl_mjx.worlds.vector import FAULTS


@dataclasses.dataclass(frozen=True)
class Outcome:
    """How a call of :func:`train` ended for one seed."""

    finished: bool
    """False when a signal, or the end of its time, stopped it; the same command resumes it."""
    env_steps: int
    final: dict[str, float]
    """Mean measures of the closing evaluation of the best policy; empty unless finished."""


def common_step(run_dirs: Sequence[RunDir]) -> int | None:
    """Return the newest checkpoint that all runs have; None when none has any.

    A batch that was killed while it saved has written the checkpoint of some seeds and not of
    others: all of them go on from the one before.

    Args:
        run_dirs: Directories of the runs.

    Raises:
        ValueError: They have checkpoints, and none in common.
    """
    stored = {run_dir: stored_steps(run_dir.path) for run_dir in run_dirs}
    if not any(stored.values()):
        return None
    common = set.intersection(*map(set, stored.values()))
    if common:
        return max(common)
    groups: dict[int, list[str]] = {}
    for run_dir, steps in stored.items():
        groups.setdefault(max(steps, default=0), []).append(run_dir.name)
    told = ", ".join(
        f"{' '.join(names)} ({f'at {step:,}' if step else 'without any'})"
        for step, names in sorted(groups.items())
    )
    raise ValueError(
        "one program trains runs that are equally far, and these have no checkpoint in common;"
        f" nothing was touched. Train them in groups: {told}"
    )


class Batch:
    """The seeds of one config under way: the compiled functions and every run's books."""

    def __init__(self, parts: Sequence[Part], stage: str, deadline: float = math.inf) -> None:
        """Build (not compile) everything.

        Args:
            parts: S runs that differ in seed, phi and source only.
            stage: Name shown with the progress.
            deadline: ``time.monotonic()`` after which no epoch is begun.

        Raises:
            ValueError: A function of the learner does not do what ``types.Learner`` says, or the
                configs differ.
        """
        config = parts[0].config
        if any(of_program(part.config) != of_program(config) for part in parts):
            raise ValueError("the runs of one program must differ in nothing but seed and phi")
        self.config = config
        self._parts = parts
        self._deadline = deadline
        rings = [part.source for part in parts if part.source is not None]
        own = any(ring is not rings[0] for ring in rings)
        self.program = Program(
            tuple(part.config for part in parts), own_sources=own, guide=guide_of(parts)
        )
        env = self.program.env
        check_learner(config.droq, env.observation_size, env.action_size)
        self.runs = [Run(part, env, stage) for part in parts]
        self.took_weights = False

    @property
    def live(self) -> list[Run]:
        """The seeds that have not diverged."""
        return [run for run in self.runs if run.fault is None]

    @property
    def resumed_at(self) -> int | None:
        """Transitions of the checkpoint all seeds go on from; None: they begin."""
        return self.runs[0].resumed_at

    @property
    def name(self) -> str:
        """What the runs are called together."""
        if len(self.runs) == 1:
            return self.runs[0].run_dir.name
        first = self.runs[0]
        seed = first.config.seed
        if any(dataclasses.replace(r.config, seed=seed) != first.config for r in self.runs):
            return f"{first.run_dir.name} and {len(self.runs) - 1} more"
        stem = "".join(first.run_dir.name.rsplit(f"-s{first.config.seed}", 1))
        return f"{stem}, seeds {' '.join(str(run.config.seed) for run in self.runs)}"

    def start(self) -> TrainState:
        """Return the state to begin or resume from.

        Raises:
            ValueError: The seeds have checkpoints, and none in common.
        """
        step = common_step([run.run_dir for run in self.runs])
        if step is None:
            states = self.program.init()
            if any(part.initial for part in self._parts):
                fresh = program.split(states.learner, len(self.runs))
                begun = [
                    part.initial(learner) if part.initial else learner
                    for part, learner in zip(self._parts, fresh, strict=True)
                ]
                states = states.replace(learner=program.join(begun))
                self.took_weights = True
        else:
            states = self.program.stack(self._restore(step))
        return self.program.place(states, [part.source for part in self._parts])

    def _restore(self, step: int) -> list[TrainState]:
        """Return the checkpoints of all seeds at ``step``, or before it where one is damaged."""
        templates = [self.program.template(index) for index in range(len(self.runs))]
        while True:
            states = [
                run.restore(template, step, self.program.refill)
                for run, template in zip(self.runs, templates, strict=True)
            ]
            reached = {int(state.env_steps) for state in states}
            if len(reached) == 1:
                return states
            # Damaged ones have been deleted: the others go back to what is left in common.
            found = common_step([run.run_dir for run in self.runs])
            assert found is not None, "every seed has restored one"
            step = found

    def close(self) -> None:
        """Release the checkpoint managers."""
        for run in self.runs:
            run.close()

    def evaluate(self, states: TrainState) -> dict[str, np.ndarray]:
        """Evaluate the deterministic policies on the evaluation seed; keep the best ones.

        Returns:
            Mean measures by name, [S]; NaN where a measure is not defined, or a seed diverged.
        """
        actors = jax.device_put(states.learner.actor, jax.devices()[0])
        found = self.program.evaluate(actors, jax.random.key(self.config.eval.seed))
        counts = {"env_steps": int(states.env_steps), "grad_steps": grad_steps(states)}
        means = [
            run.evaluated(actor, counts, values) if run.fault is None else {}
            for run, actor, values in zip(
                self.runs, program.split(actors, len(self.runs)), found, strict=True
            )
        ]
        return by_name("eval/", means)

    def save(self, states: TrainState) -> None:
        """Write a checkpoint of every seed that has not diverged."""
        for index, run in enumerate(self.runs):
            if run.fault is None:
                run.save(self.program.seed_state(states, index))

    def guard(
        self, states: TrainState, finite: ArrayLike, inserted: ArrayLike, logger: RunLogger
    ) -> None:
        """Take the seeds that diverged out of the books; the others go on.

        Args:
            states: Of all seeds.
            finite: [S] whether every number of a learner is finite.
            inserted: [S] transitions kept so far.
            logger: Told who stops.

        Raises:
            DivergedError: All have.
        """
        finite, inserted = np.atleast_1d(finite), np.atleast_1d(inserted)
        for index, run in enumerate(self.runs):
            if run.fault is not None:
                continue
            try:
                if not finite[index]:
                    check_finite(program.split(states.learner, len(self.runs))[index])
                check_experience(
                    int(inserted[index]),
                    int(states.env_steps),
                    self.config.total_env_steps,
                    run.progress["first_drop"],
                )
            except DivergedError as error:
                run.fault = error
                if self.live:
                    logger.leave(index)
                    logger.announce(f"{run.run_dir.name} stops, the others go on: {error}")
        if not self.live:
            raise self.faults()

    def faults(self) -> DivergedError:
        """Return the error of the seeds that diverged."""
        if len(self.runs) == 1 and self.runs[0].fault:
            return self.runs[0].fault
        told = [f"{run.run_dir.name}: {run.fault}" for run in self.runs if run.fault]
        return DivergedError("\n".join(told))

    def loop(self, states: TrainState, logger: RunLogger, stop: threading.Event) -> TrainState:
        """Run epochs until the budget is spent or it is time to stop; checkpoints on the way."""
        config = self.config
        saved = began = time.monotonic()
        before = self.runs[0].progress["wall_s"]
        first = True
        fixed = {
            "replay_ratio": self.runs[0].replay_ratio,
            "source_rows": np.array([run.source_rows for run in self.runs]),
        }
        if self.took_weights:  # what training has to beat
            learners = program.split(states.learner, len(self.runs))
            self.guard(states, [all_finite(each) for each in learners], states.inserted, logger)
            with logger.aside("evaluating the weights taken over ..."):
                logger.log(0, 0, self.evaluate(states))
        while (steps := int(states.env_steps)) < config.total_env_steps and not (
            stop.is_set() or self.is_late()
        ):
            if first:
                with logger.compiling("train_epoch"):
                    states, metrics = self.program.epoch(states)
                    jax.block_until_ready(metrics)
                first = False
            else:
                states, metrics = self.program.epoch(states)
            values = {name: np.asarray(value) for name, value in metrics.items()} | fixed
            if not self.note_drops(values[FIRST_DROP]):
                del values[FIRST_DROP]
            self.guard(states, values.pop(FINITE), values.pop(INSERTED), logger)
            for run in self.live:
                run.progress["wall_s"] = before + time.monotonic() - began
            now = int(states.env_steps)
            if now // config.eval.every > steps // config.eval.every or (
                now >= config.total_env_steps
            ):
                with logger.aside("evaluating ..."):
                    values |= self.evaluate(states)
            logger.log(now, grad_steps(states), values)
            if time.monotonic() - saved > 60.0 * config.checkpoint_minutes:
                self.save(states)
                saved = time.monotonic()
        now = int(states.env_steps)
        if now >= config.total_env_steps and not all(r.run_dir.policy.exists() for r in self.live):
            with logger.aside("evaluating ..."):  # the budget was lowered to what there is
                logger.log(now, grad_steps(states), self.evaluate(states))
        self.save(states)
        return states

    def note_drops(self, faults: np.ndarray) -> bool:
        """Remember why the first transition of a run was dropped; ``faults`` is [S] or a number.

        Returns:
            Whether any was in this epoch.
        """
        for run, fault in zip(self.runs, np.atleast_1d(faults), strict=True):
            run.progress["first_drop"] = run.progress["first_drop"] or FAULTS[int(fault)]
        return bool(np.any(faults > 0))

    def is_late(self) -> bool:
        """Return whether the time that was given is over."""
        return time.monotonic() >= self._deadline


def guide_of(parts: Sequence[Part]) -> Guide | None:
    """Return who acts beside the learners of all seeds, None if nobody does.

    Raises:
        ValueError: It would have to be another one for every seed, or there is none.
    """
    config, policy = parts[0].config, parts[0].policy
    if config.guide == "none":
        return None
    if policy is None or any(part.policy is not policy for part in parts):
        raise ValueError(
            f"guide {config.guide} needs a source, one for all seeds of a program (nearest: one"
            " seed at a time)"
        )
    return Guide(config, policy)


def grad_steps(states: TrainState) -> int:
    """Return the critic updates of every seed; all have as many."""
    return int(np.max(np.asarray(states.learner.grad_steps)))


def by_name(prefix: str, means: Sequence[Mapping[str, float]]) -> dict[str, np.ndarray]:
    """Return the measures of S seeds as arrays [S], NaN where one is not defined."""
    names = dict.fromkeys(name for each in means for name in each)
    return {prefix + name: np.array([each.get(name, math.nan) for each in means]) for name in names}


def train(
    parts: Sequence[Part], *, stage: str = "train", deadline: float = math.inf
) -> list[Outcome]:
    """Train (or resume) the seeds of one config to their budget, in one program.

    Args:
        parts: The seeds; ``total_env_steps`` is rounded up to whole epochs.
        stage: Name shown with the progress.
        deadline: ``time.monotonic()`` after which no epoch is begun.

    Returns:
        How it ended for every seed.

    Raises:
        DivergedError: The learner of a seed is no longer finite; the others were trained first.
        ValueError: Source data are needed and missing, or the seeds cannot go on together.
    """
    for config, source in ((part.config, part.source) for part in parts):
        if config.uses_source_data and source is None:
            raise ValueError(
                f"variant {config.variant} with phi {config.replay.phi} needs source data"
            )
    for part in parts:
        part.run_dir.open(part.config)
    batch = Batch(parts, stage, deadline)
    try:
        states = batch.start()
        steps = batch.resumed_at or 0
        infos = [run.info() for run in batch.runs]
        sinks = [part.sinks for part in parts]
        with stop_on_signal() as stop, RunLogger(infos, sinks, name=batch.name) as logger:
            if steps:
                logger.announce(f"resuming {batch.name} at {steps:,} transitions")
            if batch.program.idle_devices:
                logger.announce(batch.program.idle_devices)
            for run in batch.runs:
                for note in run.notes:
                    logger.announce(note)
            states = batch.loop(states, logger, stop)
            steps = int(states.env_steps)
            if steps < batch.config.total_env_steps:
                why = "stopped" if stop.is_set() else "the time is over: stopped"
                logger.announce(f"{why} at {steps:,} transitions; the same command resumes")
                return [Outcome(False, steps, {})] * len(parts)
            with logger.aside("final evaluation ..."):
                values = final_evaluation(batch.live)
            closing = map(episode_means, values)
            each = [{} if run.fault else next(closing) for run in batch.runs]
            logger.log(steps, grad_steps(states), by_name(FINAL, each))
            for run, measured in zip(batch.live, values, strict=True):  # last: it says "finished"
                run.run_dir.write_episodes(run.config, steps, measured)
        if len(batch.live) < len(parts):
            raise batch.faults()
        return [Outcome(True, steps, means) for means in each]
    finally:
        batch.close()


def final_evaluation(runs: Sequence[Run]) -> list[dict[str, np.ndarray]]:
    """Evaluate the best policy of every run on fresh seeds; return measures [E] of each."""
    config = runs[0].config
    actors = [actor_of(run.run_dir.policy) for run in runs]
    evaluate = program.compile_evaluation(config, len(runs), config.eval.final_episodes)
    return evaluate(program.join(actors), jax.random.key(config.eval.seed + 1))


def actor_of(path: Path) -> Any:
    """Return the parameters of a policy of a run."""
    policy = load_policy(path)
    assert isinstance(policy, NumpyPolicy), "a run writes .npz policies"
    return jax.tree.map(jnp.asarray, dict(policy.actor_params))
