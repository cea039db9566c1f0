"""From one command to a trained policy: source, collection, training; each stage resumes.

``train TASK`` = find or train the source policy -> collect its experience in the target task ->
TWiRL. The variants are settings of the same program (paper, section "Method"). Under a dynamics
shift the source is a finished nominal run of the same task, and its replay is the source data.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from twirl_mjx import exits, files, records
from twirl_mjx.checks import check_once, choose_one
from twirl_mjx.policies import recorded, rows
from twirl_mjx.policies.foreign import MAX_CLIPPED
from twirl_mjx.policies.resolve import SCRIPTED_SOURCES, Source, check_acts, resolve_policy
from twirl_mjx.replay import dataset, ring
from twirl_mjx.training import loop, memory, rundir, source_rules
from twirl_mjx.training.checkpoint import load_replay
from twirl_mjx.training.config import TrainConfig
from twirl_mjx.training.presets import make_config
from twirl_mjx.training.run import Part
from twirl_mjx.training.rundir import Busy, Finished, Foreign, RunDir, Status
from twirl_mjx.training.sinks.base import Sink
from twirl_mjx.training.sinks.registry import resolve_each
from twirl_mjx.training.source import collect
from twirl_mjx.training.weights import check_weights_fit, source_weights
from twirl_mjx.worlds.make import make_env

Say = Callable[[str], None]


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
    found = [
        RunDir(runs_dir / rundir.check_name(name or rundir.default_name(config, preset)))
        for config, name in zip(configs, names, strict=True)
    ]
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
    """Train members whose configs differ in their seeds only."""
    found = [check_early(each.config, preset, each.run_dir, source) for each in members]
    count = sum(not isinstance(status, Finished) for status in found)
    if count and members[0].config.variant != "zero-shot":
        memory.check_run(members[0].config, count)
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
                    rings[place] = source_data(config, run_dir, source, say)
                data = rings[place]
        parts.append(Part(config, run_dir, data, initial, member.sinks))
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
    if not members:
        return []
    config = members[0].config
    noise = config.uses_source_data and config.replay.source_noise

    def at(path: Path) -> Source:
        terms = source_rules.terms_of(config)
        return resolve_policy(str(path), config.evaluation, noise=noise, terms=terms)

    rules = [source_rules.source_of(member.config, preset) for member in members]
    match rules[0]:
        case source_rules.NominalRun():
            return [at(_nominal_run(m.config, preset, runs_dir).path) for m in members]
        case source_rules.Scripted(name):
            terms = source_rules.terms_of(config)
            return [resolve_policy(name, config, terms=terms)] * len(members)
        case source_rules.InFile(reference):
            terms = source_rules.terms_of(config)
            return [resolve_policy(reference, config.evaluation, terms=terms)] * len(members)
        case source_rules.AtPath(path, is_shipped):
            if is_shipped:
                shown = f"assets/policies/{path.name}"
                say(f"source: the shipped policy {shown} (--source train trains your own)")
            recorded.refuse_format(str(path))
            if not _is_there(path):
                raise FileNotFoundError(no_such_source(path, runs_dir))
            return [at(path)] * len(members)
        case source_rules.RunOf():
            first = [
                Member(
                    rule.config,
                    RunDir(runs_dir / rundir.default_name(rule.config, preset)),
                    member.sinks,
                )
                for rule, member in zip(rules, members, strict=True)
                if isinstance(rule, source_rules.RunOf)
            ]
            for each in first:
                say(f"stage 1 of 3: source policy, task {each.config.task}, in {each.run_dir}")
            _run_all(first, preset, runs_dir, say, None, deadline)
            return [at(each.run_dir.path) for each in first]


def _is_there(path: Path) -> bool:
    """Return whether a source may exist: what Minari keeps has a name and no path."""
    return path.exists() or str(path).startswith(rows.MINARI)


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


def source_data(config: TrainConfig, run_dir: RunDir, source: Source, say: Say) -> ring.RingBuffer:
    """Return the frozen source ring: a nominal run's replay, or freshly collected experience.

    Collected data are kept in ``run_dir/source.npz`` and used again while they fit.
    """
    for note in source.notes:
        say(f"source {source.origin}: {note}")
    if source.data is not None:
        say(f"source data: {source.origin}, {len(source.data.reward):,} recorded transitions")
        return ring.from_transitions(recorded.as_device(source.data))
    env = make_env(config.evaluation)
    if config.shift != "none" and source.run_dir is not None:
        nominal = RunDir(source.run_dir).read_config()
        source_rules.check_replay_fits(config, nominal, source.run_dir)
        rows = load_replay(source.run_dir, nominal.replay.capacity)
        data = ring.from_rows(jnp.asarray(rows), env.observation_size, env.action_size)
        say(f"source data: the replay of {source.run_dir}, {len(rows):,} transitions")
        return data
    path = run_dir.dataset
    size = config.replay.source_size
    digest = collection_digest(config, source)
    if path.exists():
        header, data = dataset.read(
            path,
            task=config.task,
            observation_size=env.observation_size,
            action_size=env.action_size,
        )
        if header.digest == digest:
            say(f"source data: {path}, {header.size:,} transitions of {header.source}")
            return ring.from_transitions(jax.tree.map(jnp.asarray, data))
        if header.run != run_dir.name:
            raise rundir.RunMismatchError(
                f"{path} holds {header.size:,} transitions of {header.source} that this run did not"
                f" collect{f' (run {header.run} did)' if header.run else ''}; nothing was touched"
                " (nearest: another --name, or move the file and name it with --source)"
            )
        say(f"{path} was collected for other settings: collecting again")
    say(
        f"stage 2 of 3: collecting {size:,} transitions of {source.origin} in {config.task}"
        ", once its worlds are compiled"
    )
    data = write_dataset(config, source, path, digest, say)
    return ring.from_transitions(jax.tree.map(jnp.asarray, data))


def collection_digest(config: TrainConfig, source: Source) -> str:
    """Return a hash of everything that decides a collected dataset."""
    worlds = config.evaluation
    decides = {
        "task": config.task,
        "shift": [config.shift, config.shift_strength],
        "options": records.departures(worlds.options),
        "worlds": [_collecting_worlds(config), worlds.episode_length, worlds.fixed_course],
        "seed": config.seed,
        "size": config.replay.source_size,
        "noise": config.replay.source_noise,
        "source": source.digest,
    }
    return hashlib.sha256(json.dumps(decides, sort_keys=True).encode()).hexdigest()[:12]


def _collecting_worlds(config: TrainConfig) -> int:
    # Whole episodes: with more worlds the data would hold nothing but their beginnings.
    return min(config.num_envs, max(1, config.replay.source_size // config.eval.episode_length))


def write_dataset(config: TrainConfig, source: Source, path: Path, digest: str, say: Say) -> Any:
    """Collect ``config.replay.source_size`` transitions and write them to ``path``."""
    size = config.replay.source_size
    env = make_env(config.evaluation, num_envs=_collecting_worlds(config))
    key = jax.random.fold_in(jax.random.key(config.seed), 0x50)
    limit = 1.0 if config.allow_clipping else MAX_CLIPPED
    data, means = collect(env, source.policy, key, size, max_clipped=limit, say=say)
    if clipped := means.pop("clipped", 0.0):
        say(f"{clipped:.1%} of the source's joint targets lay outside the action box: clipped")
    say("source policy in the target task: " + describe(means))
    header = dataset.DatasetHeader(
        task=config.task,
        shift=config.shift,
        source=source.origin,
        size=len(data.reward),
        observation_size=env.observation_size,
        action_size=env.action_size,
        mean_return=means.get("return", float("nan")),
        digest=digest,
        run=path.parent.name,
    )
    dataset.write(path, header, data)
    return data


def describe(means: dict[str, float]) -> str:
    """Return measures as one line of text."""
    return ", ".join(f"{k} {v:.3g}" for k, v in means.items()) or "no episode ended"


def zero_shot(config: TrainConfig, run_dir: RunDir, source: Source, say: Say) -> None:
    """Evaluate the source policy in the target task without training it."""
    from twirl_mjx.evaluation.rollout import evaluate_policy
    from twirl_mjx.tasks.measures import episode_means

    run_dir.open(config, source.identity)
    env = make_env(config.evaluation, num_envs=config.eval.final_episodes)
    values = evaluate_policy(env, source.policy)(jax.random.key(config.eval.seed + 1))
    run_dir.write_episodes(config, 0, values)
    say(f"zero-shot: {describe(episode_means(values))}")
