"""From one command to a trained policy: source, collection, training; each stage resumes.

``train TASK`` = find or train the source policy -> collect its experience in the target task ->
TWiRL. The variants are settings of the same program (paper, section "Method"). Under a dynamics
shift the source is a finished nominal run of the same task, and its replay is the source data.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from twirl_mjx import exits, records
from twirl_mjx.checks import choose_one
from twirl_mjx.droq.state import DroqState
from twirl_mjx.policies import recorded
from twirl_mjx.policies.foreign import MAX_CLIPPED
from twirl_mjx.policies.resolve import SCRIPTED_SOURCES, Source, resolve_policy
from twirl_mjx.replay import dataset, ring
from twirl_mjx.training import loop, rundir, source_rules
from twirl_mjx.training.checkpoint import has_checkpoint, load_replay
from twirl_mjx.training.config import TrainConfig
from twirl_mjx.training.presets import make_config
from twirl_mjx.training.rundir import Busy, Finished, Foreign, RunDir
from twirl_mjx.training.sinks.base import Sink
from twirl_mjx.training.sinks.registry import resolve
from twirl_mjx.training.source import collect
from twirl_mjx.training.weights import check_weights_fit, source_weights
from twirl_mjx.worlds.make import make_env

Say = Callable[[str], None]


class StoppedError(RuntimeError):
    """A stage was stopped by a signal; the same command resumes."""

    exit_status = exits.STOPPED


def run(
    config: TrainConfig,
    preset: str,
    runs_dir: Path,
    name: str | None,
    say: Say,
    source: Source | None = None,
    sinks: Sequence[str | Sink] = (),
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

    Returns:
        The run directory.

    Raises:
        StoppedError: A signal stopped a stage after saving it.
        ValueError: The variant does not fit the task, or the source does not fit the variant.
        RunMismatchError: Another run lives there, or a finished one that cannot go on.
        RunBusyError: Another process works in the run directory.
    """
    sinks = resolve(sinks)
    run_dir = RunDir(runs_dir / rundir.check_name(name or rundir.default_name(config, preset)))
    check_early(config, preset, run_dir, source)
    if config.variant != "scratch" and source is None:
        if _outlived_its_source(config, preset, runs_dir, run_dir):
            say(f"{run_dir} is finished; its source is no longer there to compare")
            return run_dir
        source = find_source(config, preset, runs_dir, say, sinks)
    with run_dir.exclusive():
        match run_dir.status(config, source.identity if source else None):
            case Foreign(error) | Busy(error):
                raise error
            case Finished():
                say(f"{run_dir} is finished")
            case _ if source is None:
                _train(config, run_dir, None, None, sinks)
            case _ if config.variant == "zero-shot":
                zero_shot(config, run_dir, source, say)
            case _:
                _train_from(config, run_dir, source, say, sinks)
    return run_dir


def check_early(
    config: TrainConfig, preset: str, run_dir: RunDir, source: Source | None = None
) -> None:
    """Refuse what can be refused before a source is found, which may mean to train it for an hour.

    Raises:
        ValueError: Options that do not fit one another, the task or the variant.
        RunMismatchError: Another run lives there, or a finished one that cannot go on.
        RunBusyError: Another process works there.
    """
    if config.variant == "scratch" and source is not None:
        raise ValueError("variant scratch uses no source (nearest: variant 'twirl')")
    source_rules.check_source_is_used(config, preset)
    config.make_task()  # refuses options that only the task can judge
    config.evaluation.make_task()
    if config.variant != "scratch" and source is None:
        check_weights_fit(config, preset)
    match run_dir.status(config):
        case Foreign(error) | Busy(error):
            raise error


def _outlived_its_source(config: TrainConfig, preset: str, runs_dir: Path, run_dir: RunDir) -> bool:
    """Return whether a run is finished and what it started from has been deleted."""
    if not isinstance(run_dir.status(config), Finished):
        return False
    match source_rules.source_of(config, preset):
        case source_rules.Scripted():
            return False
        case source_rules.AtPath(path):
            return not path.exists()
        case source_rules.InFile(reference):
            return not Path(reference.rpartition(":")[0]).expanduser().exists()
        case source_rules.RunOf(first):
            return not (runs_dir / rundir.default_name(first, preset)).exists()
        case source_rules.NominalRun():
            return not _nominal_dir(config, preset, runs_dir).path.exists()


def _train_from(
    config: TrainConfig, run_dir: RunDir, source: Source, say: Say, sinks: Sequence[Sink]
) -> None:
    fresh_weights = config.uses_source_weights and not has_checkpoint(run_dir.path)
    initial = source_weights(config, source, say) if fresh_weights else None
    run_dir.open(config, source.identity)
    data = source_data(config, run_dir, source, say) if config.uses_source_data else None
    _train(config, run_dir, data, initial, sinks)


def _train(
    config: TrainConfig,
    run_dir: RunDir,
    data: ring.RingBuffer | None,
    initial: Callable[[DroqState], DroqState] | None,
    sinks: Sequence[Sink],
) -> None:
    outcome = loop.train(
        config, run_dir, source=data, initial=initial, stage=config.task, sinks=sinks
    )
    if not outcome.finished:
        raise StoppedError(f"{run_dir.name} stopped at {outcome.env_steps:,} transitions")


def find_source(
    config: TrainConfig,
    preset: str,
    runs_dir: Path,
    say: Say,
    sinks: Sequence[Sink] = (),
) -> Source:
    """Return the source of a run (``source_rules`` says which), training it when it is missing.

    Raises:
        StoppedError: Training the source was stopped.
        FileNotFoundError: A path that does not exist, or no finished nominal run under a shift.
        ValueError: The task has no source of its own and none is named.
    """
    noise = config.uses_source_data and config.replay.source_noise

    def at(path: Path) -> Source:
        terms = source_rules.terms_of(config)
        return resolve_policy(str(path), config.evaluation, noise=noise, terms=terms)

    match source_rules.source_of(config, preset):
        case source_rules.NominalRun():
            return at(_nominal_run(config, preset, runs_dir).path)
        case source_rules.Scripted(name):
            return resolve_policy(name, config, terms=source_rules.terms_of(config))
        case source_rules.InFile(reference):
            terms = source_rules.terms_of(config)
            return resolve_policy(reference, config.evaluation, terms=terms)
        case source_rules.AtPath(path, is_shipped):
            if is_shipped:
                shown = f"assets/policies/{path.name}"
                say(f"source: the shipped policy {shown} (--source train trains your own)")
            recorded.refuse_format(str(path))
            if not path.exists():
                raise FileNotFoundError(no_such_source(path, runs_dir))
            return at(path)
        case source_rules.RunOf(first):
            run_dir = runs_dir / rundir.default_name(first, preset)
            say(f"stage 1 of 3: source policy, task {first.task}, in {run_dir}")
            return at(run(first, preset, runs_dir, None, say, sinks=sinks).path)


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
    say(f"stage 2 of 3: collecting {size:,} transitions of {source.origin} in {config.task}")
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
    data, means = collect(env, source.policy, key, size, max_clipped=limit)
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
