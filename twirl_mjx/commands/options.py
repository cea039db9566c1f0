"""Options with those of tasks among them: presets first, then every field as an option."""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import re
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import tyro

from twirl_mjx.checks import check_range
from twirl_mjx.commands.console import parse
from twirl_mjx.plugins import is_reference
from twirl_mjx.tasks.registry import TASKS
from twirl_mjx.training.config import TrainConfig
from twirl_mjx.training.presets import default_preset, make_config
from twirl_mjx.worlds.config import NO_OVERRIDES, DynamicsOverrides, WorldConfig


@dataclasses.dataclass(frozen=True)
class CollectOptions:
    """Record the source of a run as a dataset, with every stage before it that is missing."""

    preset: str
    """Settings to start from: paper, cpu, massive or debug (default: cpu without an accelerator,
    else paper)."""
    name: str | None
    """Name of the run; derived from task, variant, preset and seed by default."""
    runs: Path
    """Folder of all runs."""
    log: tuple[str, ...]
    """Where metrics go beside metrics.csv, TensorBoard and the terminal: wandb, trackio or a sink
    of your own, FILE.py:NAME."""
    config: Annotated[TrainConfig, tyro.conf.arg(name="")]


@dataclasses.dataclass(frozen=True)
class TrainOptions(CollectOptions):
    """Train a task, with every stage before it that is missing.

    The same command resumes. RUN --and RUN --and ..., each with options of its own, trains runs
    that differ in --seed, --replay.phi and --source in one program.
    """

    seeds: tuple[int, ...] = ()
    """Several seeds in one program, each with the run directory that --seed gives it; with --name X
    they are X-s0, X-s1, ... Finished ones are skipped, the others go on from the newest checkpoint
    that all of them have."""
    minutes: float | None = None
    """Save and stop after this wall time, when the epoch under way is done; the same command
    resumes (default: no limit)."""


def parse_train(argv: list[str]) -> TrainOptions:
    """Parse the options of ``twirl train``.

    Raises:
        ValueError: Unknown task or preset, a value out of range, or --seed beside --seeds.
    """
    options = _parse(argv, "twirl train", TrainOptions)
    if options.minutes is not None:
        check_range("minutes", options.minutes, 0.001, 1e7)
    if options.seeds and any(word.partition("=")[0] == "--seed" for word in argv):
        seeds = " ".join(map(str, options.seeds))
        raise ValueError(
            f"--seed {options.config.seed} beside --seeds {seeds}: give one of them (nearest:"
            f" --seeds {seeds})"
        )
    return options


def parse_collect(argv: list[str]) -> CollectOptions:
    """Parse the options of ``twirl collect``.

    Raises:
        ValueError: Unknown task or preset, or a value out of range.
    """
    return _parse(argv, "twirl collect", CollectOptions)


def _parse[T: CollectOptions](argv: list[str], prog: str, options: type[T]) -> T:
    """Parse training options: ``--task`` and ``--preset`` choose the defaults of the others."""
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    first.add_argument("--task", default=TrainConfig.task)
    first.add_argument("--preset", default=None)
    first.add_argument("--runs", default="runs")
    first.add_argument("--learner", default=TrainConfig.learner)
    known, _ = first.parse_known_args(argv)
    preset = known.preset or default_preset()
    config = make_config(known.task, preset, known.learner)
    shown = _shown(config)
    kind = dataclasses.make_dataclass(
        options.__name__,
        [("config", Annotated[type(shown), tyro.conf.arg(name="")])],
        bases=(options,),
        frozen=True,
        namespace={"__doc__": options.__doc__},
    )
    found: Any = parse(kind, argv, prog, kind(preset, None, Path(known.runs), (), shown))
    values = {f.name: getattr(found.config, f.name) for f in dataclasses.fields(TrainConfig)}
    given: dict[str, Any] = {f.name: getattr(found, f.name) for f in dataclasses.fields(options)}
    given["config"] = TrainConfig(**values)
    return options(**given)


def _shown(config: TrainConfig) -> TrainConfig:
    """Return a config of a class that shows options of task and learner under their names."""
    sections = [("options", config.task, config.options)]
    if config.task_type.source:
        sections.append(("source_options", config.task_type.source, config.source_options))
    sections.append(("droq", config.learner, config.droq))
    fields: list[Any] = [
        (field, Annotated[type(value), tyro.conf.arg(name=name)], dataclasses.field(default=value))
        for field, name, value in sections
    ]
    hidden = {"uses", "source_options"} - {field for field, _, _ in fields}
    fields += [
        (name, Annotated[Any, tyro.conf.Suppress], dataclasses.field(default=getattr(config, name)))
        for name in hidden
    ]
    kind = dataclasses.make_dataclass(
        TrainConfig.__name__, fields, bases=(TrainConfig,), frozen=True
    )
    return kind(**{f.name: getattr(config, f.name) for f in dataclasses.fields(TrainConfig)})


Overrides = dict[str, dict[str, Any]]
"""Task, ``dynamics`` or ``worlds`` -> option -> value, for the options that were given."""


def parse_in_tasks[T](kind: type[T], argv: list[str], prog: str) -> tuple[T, Overrides]:
    """Parse a command that also takes options of tasks and worlds.

    Such as ``--biped.goal-distance 1``, ``--dynamics.friction 0.3``, ``--randomize payload=0:2``,
    ``--robot go1.py:GO1``.

    Returns:
        The command's own options, and those others that were given.

    Raises:
        ValueError: A task of a user's file that cannot be loaded.
    """
    for before, word in itertools.pairwise(argv):
        if before == "--task" and is_reference(word):
            TASKS.admit(word)
    tasks = [name for name in TASKS.names() if name not in _field_names(kind)]
    asked = {match[1] for word in argv if (match := re.match(r"--([a-z][a-z0-9_]*)\.", word))}
    if not {"-h", "--help"} & set(argv):  # a section that is not asked for costs time to build
        tasks = [name for name in tasks if name in asked]
    fields: list[Any] = [
        ("dynamics", DynamicsOverrides, dataclasses.field(default=NO_OVERRIDES)),
        ("randomize", Annotated[tuple[str, ...], _RANDOMIZE], dataclasses.field(default=())),
    ]
    if picks_robot := "robot" not in _field_names(kind):
        fields.append(("robot", Annotated[str, _ROBOT], dataclasses.field(default="")))
    for name in tasks:
        some = _all_optional(TASKS.get(name).Options)
        fields.append((name, some, dataclasses.field(default=some())))
    shown = dataclasses.make_dataclass(
        kind.__name__, fields, bases=(kind,), frozen=True, namespace={"__doc__": kind.__doc__}
    )
    found: Any = parse(shown, argv, prog)
    own = kind(**{name: getattr(found, name) for name in _field_names(kind)})
    given = {
        name: {k: v for k, v in vars(getattr(found, name)).items() if v is not None}
        for name in ("dynamics", *tasks)
    }
    worlds = {"randomize": found.randomize, "robot": found.robot if picks_robot else ""}
    given["worlds"] = {name: value for name, value in worlds.items() if value}
    return own, {name: values for name, values in given.items() if values}


_RANDOMIZE = tyro.conf.arg(
    help="Physical parameters drawn for every episode: leaf=low:high, friction=0.4:1.25."
)

_ROBOT = tyro.conf.arg(
    help="Robot to act with, by name or file.py:NAME; that of the policy by default."
)


def _field_names(kind: type) -> list[str]:
    return [field.name for field in dataclasses.fields(kind)]


def _all_optional(kind: type) -> type:
    """Return a form of an options class in which every field may be left out (None)."""
    hints = typing.get_type_hints(kind)
    fields: list[Any] = [
        (name, hints[name] | None, dataclasses.field(default=None)) for name in _field_names(kind)
    ]
    return dataclasses.make_dataclass(
        kind.__name__,
        fields,
        bases=(kind,),
        frozen=True,
        namespace={"__doc__": kind.__doc__, "__post_init__": lambda self: None},
    )


def with_overrides[W: WorldConfig](config: W, overrides: Mapping[str, dict[str, Any]]) -> W:
    """Return worlds with options of their task, and of their dynamics, replaced.

    Raises:
        ValueError: Options of another task, or out of range.
    """
    for task, values in overrides.items():
        if task not in (config.task, "dynamics", "worlds"):
            name = next(iter(values))
            raise ValueError(f"{task}.{name} is an option of task {task}, not of {config.task}")
    values = overrides.get(config.task, {})
    return dataclasses.replace(
        config,
        options=dataclasses.replace(config.options, **values),
        dynamics=dataclasses.replace(config.dynamics, **overrides.get("dynamics", {})),
        **overrides.get("worlds", {}),
    )
