"""Which source a run starts from, decided by its config alone: nothing is opened or trained.

The pipeline acts on the answer, and a sweep plans with it what has to be run first.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from twirl_mjx.assets import asset_path
from twirl_mjx.plugins import is_reference
from twirl_mjx.policies.resolve import SCRIPTED_SOURCES, Source, Terms, check_acts
from twirl_mjx.training.config import TrainConfig
from twirl_mjx.training.learners import learner_of
from twirl_mjx.training.presets import make_config, source_task_of, starts_from_nominal_run


@dataclasses.dataclass(frozen=True)
class NominalRun:
    """The finished run of the same task without the shift; its replay is the source data."""


@dataclasses.dataclass(frozen=True)
class Scripted:
    """A scripted controller."""

    name: str


@dataclasses.dataclass(frozen=True)
class InFile:
    """A function or policy object in a user's file."""

    reference: str
    """``file.py:name``."""


@dataclasses.dataclass(frozen=True)
class AtPath:
    """A policy file, recorded data or a run directory that exists, or should."""

    path: Path
    is_shipped: bool = False
    """Whether it is the policy of the source task in ``assets/policies``."""


@dataclasses.dataclass(frozen=True)
class RunOf:
    """A run of the source task, trained first when it is missing."""

    config: TrainConfig


Rule = NominalRun | Scripted | InFile | AtPath | RunOf
"""Where the source of a run is found."""


def check_replay_fits(config: TrainConfig, nominal: TrainConfig, run_dir: Path) -> None:
    """Check that the replay of a nominal run is experience of the task of ``config``.

    Its transitions keep the rewards they were paid (paper Alg. 1: those of the target task).

    Args:
        config: The run that adapts.
        nominal: Config of the run it adapts from.
        run_dir: Directory of that run.

    Raises:
        ValueError: Another task, or options by which other rewards are paid.
    """
    task = config.task
    what = f" of task {nominal.task}" if nominal.task != task else ""
    if not what:
        ours, theirs = vars(config.options), vars(nominal.options)
        course = config.task_type.course_options
        different = [k for k in ours if ours[k] != theirs[k] and k not in course]
        what = ", ".join(f" with {task}.{k} {theirs[k]!r} (here {ours[k]!r})" for k in different)
    if what:
        raise ValueError(
            f"{run_dir} is a run{what}: its replay is no experience of this {task} (nearest: a run"
            f" of the same task, or the policy file {run_dir / 'policy.npz'}, which is rolled out"
            " anew)"
        )


def check_source_is_used(config: TrainConfig, preset: str) -> None:
    """Refuse a source that would have no effect.

    Raises:
        ValueError: The variant is ``scratch`` and a source is named that the preset does not name,
            or there is a contract or a command and no source that could have one.
    """
    for option, value in (("contract", config.source_contract), ("command", config.source_command)):
        if value and (config.variant == "scratch" or config.source in ("auto", "train")):
            raise ValueError(
                f"--source-{option} {value} would do nothing without a foreign source (nearest:"
                " --source FILE.onnx, or file.py:function)"
            )
    if config.variant == "scratch" and config.source not in (
        "auto",
        make_config(config.task, preset).source,
    ):
        raise ValueError(
            f"variant scratch uses no source: --source {config.source} would do nothing"
            " (nearest: --variant twirl)"
        )


def check_guide(config: TrainConfig, source: Source | None) -> None:
    """Refuse a guide that cannot act, or that asks a critic which the learner has not.

    Args:
        config: The run.
        source: The source itself, where it is not ``config.source`` that names it.

    Raises:
        ValueError: It is recorded data, or the learner has no ``value``.
    """
    if config.guide == "none":
        return
    if source is not None and source.data is not None:
        raise ValueError(
            f"guide {config.guide} asks the source for actions, and {source.origin} is recorded"
            " data, which does not act (nearest: guide none)"
        )
    if source is None:
        check_acts(config.source)
    if (learner := learner_of(config.droq)).value is None:
        raise ValueError(
            f"guide {config.guide} asks the critic, and learner {learner.name} has no value"
            " (nearest: guide none)"
        )


def check_one_guide(configs: Sequence[TrainConfig], preset: str) -> None:
    """Refuse a guide that differs from run to run of one program.

    Raises:
        ValueError: Every run has a run of its own as its source, or names another one.
    """
    config = configs[0]
    if config.guide == "none" or len(configs) < 2:
        return
    others = any(other.source != config.source for other in configs)
    if others or isinstance(source_of(config, preset), NominalRun | RunOf):
        raise ValueError(
            f"guide {config.guide} needs one source for all runs of a program, and each would have"
            f" one of its own (nearest: --seed {config.seed})"
        )


def terms_of(config: TrainConfig) -> Terms:
    """Return how a foreign source is to be used."""
    return Terms(config.source_contract, config.source_command, config.allow_clipping)


def source_of(config: TrainConfig, preset: str) -> Rule:
    """Return the source of a run that has one.

    ``config.source`` is ``auto`` (the shipped policy, else a run of the source task), ``train``
    (such a run always), the name of a scripted controller, or a path. Shipped policies are of no
    use to the preset ``debug``, whose networks are smaller, or with other options of the source
    task. The source's own run has the same preset and seed, and may have a source itself.

    Raises:
        ValueError: The task has no source of its own and none is named.
    """
    if starts_from_nominal_run(config, preset):
        return NominalRun()
    if config.source in SCRIPTED_SOURCES:
        return Scripted(config.source)
    if is_reference(config.source):
        return InFile(config.source)
    if config.source not in ("auto", "train"):
        return AtPath(Path(config.source))
    task = source_task_of(config)
    plain = make_config(task, preset, config.learner)
    options = config.source_options
    if config.source == "auto" and preset != "debug" and options == plain.options:
        try:
            return AtPath(asset_path("policies", f"{task}.npz"), is_shipped=True)
        except FileNotFoundError:
            pass
    return RunOf(dataclasses.replace(plain, seed=config.seed, options=options))
