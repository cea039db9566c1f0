"""From one command to a trained policy: source, collection, training; each stage resumes.

``train TASK`` = find or train the source policy -> collect its experience in the target task ->
TWiRL. The variants are settings of the same program (paper, section "Method"). Under a dynamics
shift the source is a finished nominal run of the same task, and its replay is the source data.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import time
from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np

from twirl_mjx import exits, files
from twirl_mjx.checks import check_once, choose_one
from twirl_mjx.plugins import MINARI
from twirl_mjx.policies import recorded
from twirl_mjx.policies.resolve import SCRIPTED_SOURCES, Source, check_acts, resolve_policy
from twirl_mjx.replay import ring
from twirl_mjx.training import config_json, loop, memory, rundir, sharding, source_rules
from twirl_mjx.training.checkpoint import lacks_replay
from twirl_mjx.training.collection import Collectors, Say, describe, source_data
from twirl_mjx.training.config import TrainConfig, of_program
from twirl_mjx.training.presets import make_config
from twirl_mjx.training.run import Part
from twirl_mjx.training.rundir import Busy, Finished, Foreign, RunDir, Status
from twirl_mjx.training.sinks.base import Sink
from twirl_mjx.training.sinks.registry import resolve_each
from twirl_mjx.training.weights import check_weights_fit, source_weights
from twirl_mjx.worlds.make import make_env


class StoppedError(RuntimeError):
    """A stage was stopped by a signal, or its time was over; the same command resumes."""

    exit_status = exits.STOPPED


def run(
    config: TrainConfig,
    preset: str,
    runs_dir: Path,
    name: str | None,
    say: Say,
    source: Source | None = None,
    sinks: Sequence[str | Sink] = (),
    deadline: float = math.inf,
) -> RunDir:
    """Train a task to its budget, with every stage before it that is missing.

    Args:
        config: The run.
        preset: Preset the config came from; the source run, if one is needed, uses the same.
        runs_dir: Folder of all runs.
        name: Name of the run; derived from the config by default.
        say: Prints one line for a person.
        source: The source itself, instead of what ``config.source`` says.
        sinks: Where metrics go beside the usual three, by name or as objects; see ``sinks``.
        deadline: ``time.monotonic()`` after which a stage saves and stops.

    Returns:
        The run directory.

    Raises:
        StoppedError: A signal or the deadline stopped a stage after saving it.
        ValueError: The variant does not fit the task, or the source does not fit the variant.
        RunMismatchError: Another run lives there, or a finished one that cannot go on.
        RunBusyError: Another process works in the run directory.
    """
    return run_seeds(config, None, preset, runs_dir, name, say, source, sinks, deadline)[0]


def run_seeds(
    config: TrainConfig,
    seeds: Sequence[int] | None,
    preset: str,
    runs_dir: Path,
    name: str | None,
    say: Say,
    source: Source | None = None,
    sinks: Sequence[str | Sink] = (),
    deadline: float = math.inf,
) -> list[RunDir]:
    """Train several seeds of one config in one program; each gets the run it would have alone.

    Finished seeds are left as they are. The others go on together from the newest checkpoint that
    all of them have. Every seed has the source, and the source experience, of its own run.

    Args:
        config: The run; its seed does not matter where ``seeds`` are given.
        seeds: All different; None: the one of ``config``, under the plain ``name``.
        preset: As in :func:`run`, like the rest.
        runs_dir: Folder of all runs.
        name: Seed ``s`` gets ``name-s{s}``; the names they have alone by default.
        say: Prints one line for a person.
        source: The source itself, one for all.
        sinks: Every seed has its own, so a sink is a class here, not an object.
        deadline: ``time.monotonic()`` after which a stage saves and stops.

    Returns:
        The run directories, in the order of the seeds.

    Raises:
        ValueError: As :func:`run`; or no seed, equal seeds, or seeds without a common checkpoint.
    """
    configs = [config]
    names = [name]
    if seeds is not None:
        check_seeds(seeds)
        configs = [dataclasses.replace(config, seed=seed) for seed in seeds]
        names = [name and f"{name}-s{seed}" for seed in seeds]
    return run_together(configs, names, preset, runs_dir, say, source, sinks, deadline)


def run_together(
    configs: Sequence[TrainConfig],
    names: Sequence[str | None],
    preset: str,
    runs_dir: Path,
    say: Say,
    source: Source | None = None,
    sinks: Sequence[str | Sink] = (),
    deadline: float = math.inf,
) -> list[RunDir]:
    """Train runs that differ in seed, phi and source in one program, like :func:`run_seeds`.

    Args:
        configs: The runs.
        names: Their names; None: the one a run has alone.
        preset: As in :func:`run`, like the rest.
        runs_dir: Folder of all runs.
        say: Prints one line for a person.
        source: The source itself, one for all.
        sinks: Every run has its own.
        deadline: ``time.monotonic()`` after which a stage saves and stops.

    Raises:
        ValueError: As :func:`run_seeds`; or runs that differ in more, or that are the same run.
    """
    for config in configs[1:]:
        check_one_program(configs[0], config)
    if source is None:
        source_rules.check_one_guide(configs, preset)
    found = [
        RunDir(runs_dir / rundir.check_name(name or rundir.default_name(config, preset)))
        for config, name in zip(configs, names, strict=True)
    ]
    check_once("the names of the runs", list(map(str, found)))
    sharding.make_cpu_devices(len(found))
    members = [
        Member(*each) for each in zip(configs, found, resolve_each(sinks, len(found)), strict=True)
    ]
    _run_all(members, preset, runs_dir, say, source, deadline)
    return found


def deadline_after(minutes: float | None) -> float:
    """Return the ``time.monotonic()`` at which so many minutes from now are over."""
    return math.inf if minutes is None else time.monotonic() + 60.0 * minutes


def check_seeds(seeds: Sequence[int]) -> None:
    """Check the seeds of a batch.

    Raises:
        ValueError: There is none, or one occurs twice.
    """
    if not seeds:
        raise ValueError("--seeds names no seed: give at least one, --seeds 0 1 2")
    check_once("--seeds", seeds)


def check_one_program(first: TrainConfig, other: TrainConfig) -> None:
    """Check that two runs can be one program.

    Raises:
        ValueError: With every setting in which they differ and must not.
    """
    if lines := config_json.diff(of_program(first), of_program(other)):
        raise ValueError(
            "runs of one program differ in seed, replay.phi and source, and these in"
            f" {'; '.join(lines)} (nearest: a command for each)"
        )


@dataclasses.dataclass(frozen=True)
class Member:
    """One seed of those that are trained together."""

    config: TrainConfig
    """The run, with its own seed."""
    run_dir: RunDir
    """Its directory."""
    sinks: tuple[Sink, ...] = ()
    """Where its metrics go beside the usual three."""
    source: Source | None = None
    """What it starts from, once that is found."""


def _run_all(
    members: list[Member],
    preset: str,
    runs_dir: Path,
    say: Say,
    source: Source | None,
    deadline: float,
) -> None:
    """Train members whose configs differ in what the runs of one program may."""
    found = [check_early(each.config, preset, each.run_dir, source) for each in members]
    count = sum(not isinstance(status, Finished) for status in found)
    if count and members[0].config.variant != "zero-shot":
        mixing = [each.config for each in members if each.config.uses_source_data]
        memory.check_run((mixing or [members[0].config])[0], count)
    if members[0].config.variant != "scratch" and source is None:
        alone = [m for m in members if _outlived_its_source(m.config, preset, runs_dir, m.run_dir)]
        for member in alone:
            say(f"{member.run_dir} is finished; its source is no longer there to compare")
        members = [member for member in members if member not in alone]
        sources = _find_sources(members, preset, runs_dir, say, deadline)
        members = [
            dataclasses.replace(member, source=found)
            for member, found in zip(members, sources, strict=True)
        ]
    elif source is not None:
        members = [dataclasses.replace(member, source=source) for member in members]
    with contextlib.ExitStack() as held:
        missing = []
        for member in members:
            held.enter_context(member.run_dir.exclusive())
            known = member.source.identity if member.source else None
            match member.run_dir.status(member.config, known):
                case Foreign(error) | Busy(error):
                    raise error
                case Finished():
                    say(f"{member.run_dir} is finished")
                case _:
                    missing.append(member)
        if missing:
            _train(missing, say, deadline)


def check_early(
    config: TrainConfig, preset: str, run_dir: RunDir, source: Source | None = None
) -> Status:
    """Refuse what can be refused before a source is found, which may mean to train it for an hour.

    Returns:
        The state of the directory.

    Raises:
        ValueError: Options that do not fit one another, the task or the variant.
        OSError: Nothing can be written there.
        RunMismatchError: Another run lives there, or a finished one that cannot go on.
        RunBusyError: Another process works there.
    """
    if config.variant == "scratch" and source is not None:
        raise ValueError("variant scratch uses no source (nearest: variant 'twirl')")
    source_rules.check_source_is_used(config, preset)
    files.check_target(run_dir.config)
    source_rules.check_guide(config, source)
    if config.variant not in ("scratch", "twirl") and source is None:
        check_acts(config.source)  # networks, or a policy to evaluate, are asked for
    config.make_task()  # refuses options that only the task can judge
    config.evaluation.make_task()
    if config.variant != "scratch" and source is None:
        check_weights_fit(config, preset)
    match run_dir.status(config):
        case Foreign(error) | Busy(error):
            raise error
        case status:
            return status


def _outlived_its_source(config: TrainConfig, preset: str, runs_dir: Path, run_dir: RunDir) -> bool:
    """Return whether a run is finished and what it started from has been deleted."""
    if not isinstance(run_dir.status(config), Finished):
        return False
    match source_rules.source_of(config, preset):
        case source_rules.Scripted():
            return False
        case source_rules.AtPath(path):
            return not _is_there(path)
        case source_rules.InFile(reference):
            return not Path(reference.rpartition(":")[0]).expanduser().exists()
        case source_rules.RunOf(first):
            return not (runs_dir / rundir.default_name(first, preset)).exists()
        case source_rules.NominalRun():
            return not _nominal_dir(config, preset, runs_dir).path.exists()


def _train(members: list[Member], say: Say, deadline: float) -> None:
    """Train members that are new or resumable, from their sources."""
    config = members[0].config
    if config.variant == "zero-shot":
        for member in members:
            assert member.source is not None, "zero-shot has a source"
            zero_shot(member.config, member.run_dir, member.source, say)
        return
    begun = loop.common_step([member.run_dir for member in members])
    rings: dict[str, ring.RingBuffer] = {}
    collectors: Collectors = {}
    parts = []
    for member in members:
        config, run_dir, source = member.config, member.run_dir, member.source
        data = initial = None
        if source is not None:
            if config.uses_source_weights and begun is None:
                initial = source_weights(config, source, say)
            run_dir.open(config, source.identity)
            if config.uses_source_data:
                found = source.data is not None or (config.shift != "none" and source.run_dir)
                place = source.origin if found else str(run_dir)  # what is found serves all seeds
                if place not in rings:
                    rings[place] = source_data(config, run_dir, source, say, collectors)
                data = rings[place]
        policy = source.policy if source is not None and config.guide != "none" else None
        parts.append(Part(config, run_dir, data, initial, member.sinks, policy))
    for run_dir in (part.run_dir for part in parts if part.config.refill):
        if lacks_replay(run_dir.path):
            say(f"{run_dir}: its replay was left behind; gathering as much with its policy first")
    outcomes = loop.train(parts, stage=config.task, deadline=deadline)
    if not all(outcome.finished for outcome in outcomes):
        names = ", ".join(part.run_dir.name for part in parts)
        raise StoppedError(f"{names} stopped at {outcomes[0].env_steps:,} transitions")


def find_source(
    config: TrainConfig,
    preset: str,
    runs_dir: Path,
    say: Say,
    sinks: Sequence[Sink] = (),
    deadline: float = math.inf,
) -> Source:
    """Return the source of a run (``source_rules`` says which), training it when it is missing.

    Raises:
        StoppedError: Training the source was stopped.
        FileNotFoundError: A path that does not exist, or no finished nominal run under a shift.
        ValueError: The task has no source of its own and none is named.
    """
    name = rundir.default_name(config, preset)
    member = Member(config, RunDir(runs_dir / name), tuple(sinks))
    return _find_sources([member], preset, runs_dir, say, deadline)[0]


def _find_sources(
    members: Sequence[Member], preset: str, runs_dir: Path, say: Say, deadline: float
) -> list[Source]:
    """Return the source of every member; those that are missing are trained in one program."""
    rules = [source_rules.source_of(member.config, preset) for member in members]
    first = {
        rundir.default_name(rule.config, preset): Member(
            rule.config,
            RunDir(runs_dir / rundir.default_name(rule.config, preset)),
            member.sinks,
        )
        for rule, member in zip(rules, members, strict=True)
        if isinstance(rule, source_rules.RunOf)
    }
    for each in first.values():
        say(f"stage 1 of 3: source policy, task {each.config.task}, in {each.run_dir}")
    if first:
        _run_all(list(first.values()), preset, runs_dir, say, None, deadline)
    found: dict[tuple[str, bool], Source] = {}  # equal ones are one object, and compiled once
    sources = []
    for rule, member in zip(rules, members, strict=True):
        config = member.config
        name = place_of(rule, config, preset, runs_dir)
        noise = config.uses_source_data and config.replay.source_noise
        if (name, noise) not in found:
            if isinstance(rule, source_rules.AtPath) and rule.is_shipped:
                shown = f"assets/policies/{rule.path.name}"
                say(f"source: the shipped policy {shown} (--source train trains your own)")
            worlds = config if isinstance(rule, source_rules.Scripted) else config.evaluation
            terms = source_rules.terms_of(config)
            found[name, noise] = resolve_policy(name, worlds, noise=noise, terms=terms)
        sources.append(found[name, noise])
    return sources


def place_of(rule: source_rules.Rule, config: TrainConfig, preset: str, runs_dir: Path) -> str:
    """Return what ``resolve_policy`` calls the source of a run.

    Raises:
        FileNotFoundError: A path that does not exist, or no finished nominal run under a shift.
    """
    match rule:
        case source_rules.NominalRun():
            return str(_nominal_run(config, preset, runs_dir).path)
        case source_rules.Scripted(name) | source_rules.InFile(name):
            return name
        case source_rules.AtPath(path):
            recorded.refuse_format(str(path))
            if not _is_there(path):
                raise FileNotFoundError(no_such_source(path, runs_dir))
            return str(path)
        case source_rules.RunOf(first):
            return str(runs_dir / rundir.default_name(first, preset))


def _is_there(path: Path) -> bool:
    """Return whether a source may exist: what Minari keeps has a name and no path."""
    return path.exists() or str(path).startswith(MINARI)


def no_such_source(path: Path, runs_dir: Path) -> str:
    """Return what can be given instead of a source that does not exist."""
    runs = sorted(str(found.parent) for found in runs_dir.glob("*/policy.npz"))
    choices = [*SCRIPTED_SOURCES, *runs]
    return f"there is no source {path}: give a policy file, or {choose_one(path.name, choices)}"


def _nominal_run(config: TrainConfig, preset: str, runs_dir: Path) -> RunDir:
    """Return the finished run of the same task and preset without a shift."""
    run_dir = _nominal_dir(config, preset, runs_dir)
    if run_dir.finished():
        return run_dir
    closed = runs_dir.glob(f"{config.task}-*/{run_dir.episodes.name}")
    others = ", ".join(sorted(path.parent.name for path in closed))
    raise FileNotFoundError(
        f"adapting {config.task} to {config.shift} starts from a finished nominal run; there is"
        f" no {run_dir}. Run `make train TASK={config.task} SEED={config.seed}"
        f' ARGS="--preset {preset}"` first, or name a run or policy with'
        f" --source (finished in {runs_dir}: {others or 'none'})"
    )


def _nominal_dir(config: TrainConfig, preset: str, runs_dir: Path) -> RunDir:
    nominal = dataclasses.replace(make_config(config.task, preset), seed=config.seed)
    return RunDir(runs_dir / rundir.default_name(nominal, preset))


def zero_shot(config: TrainConfig, run_dir: RunDir, source: Source, say: Say) -> None:
    """Evaluate the source policy in the target task without training it."""
    from twirl_mjx.tasks.measures import episode_means

    run_dir.open(config, source.identity)
    key = jax.random.key(config.eval.seed + 1)
    values = evaluate_source(config, source, config.eval.final_episodes, key)
    run_dir.write_episodes(config, 0, values)
    say(f"zero-shot: {describe(episode_means(values))}")


def evaluate_source(
    config: TrainConfig, source: Source, episodes: int, key: jax.Array
) -> dict[str, np.ndarray]:
    """Return every measure of a source that acts, [episodes], in the worlds a run evaluates in."""
    from twirl_mjx.evaluation.rollout import evaluate_policy

    env = make_env(config.evaluation, num_envs=episodes)
    return evaluate_policy(env, source.policy)(key)
