"""From one command to a trained policy: source, collection, training; each stage resumes.

``train TASK`` = find or train the source policy -> collect its experience in the target task ->
TWiRL. The variants are settings of the same program (paper, section "Method"). Under a dynamics
shift the source is a finished nominal run of the same task, and its replay is the source data.
"""

from __future__ import annotations

import dataclasses
import difflib
import hashlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from twirl_mjx import config_json, exits
from twirl_mjx.config import SCRIPTED_SOURCES, TrainConfig
from twirl_mjx.droq.state import DroqState
from twirl_mjx.policies.resolve import resolve_policy
from twirl_mjx.presets import make_config
from twirl_mjx.replay import dataset, ring
from twirl_mjx.tasks.imitate import load_clip
from twirl_mjx.tasks.registry import make_env, make_task
from twirl_mjx.training import loop, rundir, source_rules
from twirl_mjx.training.checkpoint import has_checkpoint, load_replay
from twirl_mjx.training.sinks.base import Sink
from twirl_mjx.training.sinks.registry import resolve
from twirl_mjx.training.source import Source, collect
from twirl_mjx.training.weights import check_weights_fit, source_weights

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
    sinks: Sequence[str | Sink] = (),
) -> Path:
    """Train a task to its budget, with every stage before it that is missing.

    Args:
        config: The run.
        preset: Preset the config came from; the source run, if one is needed, uses the same.
        runs_dir: Folder of all runs.
        name: Name of the run; derived from the config by default.
        say: Prints one line for a person.
        sinks: Where metrics go beside the usual three, by name or as objects; see ``sinks``.

    Returns:
        The run directory.

    Raises:
        StoppedError: A signal stopped a stage after saving it.
        ValueError: The variant does not fit the task, or the source does not fit the variant.
        RunBusyError: Another process works in the run directory.
    """
    sinks = resolve(sinks)
    run_dir = runs_dir / rundir.check_name(name or rundir.default_name(config, preset))
    source_rules.check_source_is_used(config, preset)
    make_task(config)  # refuses options that only the task can judge
    if config.variant == "scratch":
        with rundir.exclusive(run_dir):
            if is_finished(config, run_dir, None, say):
                return run_dir
            return _train(config, run_dir, None, None, sinks)
    check_weights_fit(config, preset)
    refuse_early(config, run_dir)
    if _outlived_its_source(config, preset, runs_dir, run_dir):
        say(f"{run_dir} is finished; its source is no longer there to compare")
        return run_dir
    source = find_source(config, preset, runs_dir, say, sinks)
    fresh_weights = config.uses_source_weights and not has_checkpoint(run_dir)
    initial = source_weights(config, source, say) if fresh_weights else None
    with rundir.exclusive(run_dir):
        if is_finished(config, run_dir, source, say):
            return run_dir
        rundir.open_run(run_dir, config, source.identity)
        if config.variant == "zero-shot":
            return zero_shot(config, run_dir, source, say)
        data = source_data(config, run_dir, source, say) if config.uses_source_data else None
        return _train(config, run_dir, data, initial, sinks)


def refuse_early(config: TrainConfig, run_dir: Path) -> None:
    """Refuse what needs no source to be refused: finding one may mean to train it for an hour.

    Raises:
        RunMismatchError: Another run lives there, or a finished one that cannot go on.
        RunBusyError: Another process works there.
    """
    rundir.check_run(run_dir, config)
    if rundir.owner(run_dir):
        raise rundir.busy(run_dir)
    if config.variant != "zero-shot" and not loop.finished(run_dir, config.total_env_steps):
        loop.check_resumable(run_dir)


def _outlived_its_source(config: TrainConfig, preset: str, runs_dir: Path, run_dir: Path) -> bool:
    """Return whether a run is finished and what it started from has been deleted."""
    if config.variant == "zero-shot" or not loop.finished(run_dir, config.total_env_steps):
        return False
    match source_rules.source_of(config, preset):
        case source_rules.Scripted():
            return False
        case source_rules.AtPath(path):
            return not path.exists()
        case source_rules.RunOf(first):
            return not (runs_dir / rundir.default_name(first, preset)).exists()
        case source_rules.NominalRun():
            return not _nominal_dir(config, preset, runs_dir).exists()


def is_finished(config: TrainConfig, run_dir: Path, source: Source | None, say: Say) -> bool:
    """Return whether a run was trained and evaluated to its budget; nothing in it is touched.

    Raises:
        RunMismatchError: Another run lives there.
    """
    rundir.check_run(run_dir, config, source.identity if source else None)
    if config.variant == "zero-shot" or not loop.finished(run_dir, config.total_env_steps):
        return False
    say(f"{run_dir} is finished")
    return True


def _train(
    config: TrainConfig,
    run_dir: Path,
    data: ring.RingBuffer | None,
    initial: Callable[[DroqState], DroqState] | None,
    sinks: Sequence[Sink],
) -> Path:
    outcome = loop.train(
        config, run_dir, source=data, initial=initial, stage=config.task, sinks=sinks
    )
    if not outcome.finished:
        raise StoppedError(f"{run_dir.name} stopped at {outcome.env_steps:,} transitions")
    return run_dir


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
    match source_rules.source_of(config, preset):
        case source_rules.NominalRun():
            return _nominal_run(config, preset, runs_dir)
        case source_rules.Scripted(name):
            found = resolve_policy(name, config)
            return Source(found.policy, found.origin, scripted_digest(config))
        case source_rules.AtPath(path, is_shipped):
            if is_shipped:
                shown = f"assets/policies/{path.name}"
                say(f"source: the shipped policy {shown} (--source train trains your own)")
            if not path.exists():
                raise FileNotFoundError(no_such_source(path, runs_dir))
            return _from_path(config, path)
        case source_rules.RunOf(first):
            run_dir = runs_dir / rundir.default_name(first, preset)
            say(f"stage 1 of 3: source policy, task {first.task}, in {run_dir}")
            return _from_path(config, run(first, preset, runs_dir, None, say, sinks))


def no_such_source(path: Path, runs_dir: Path) -> str:
    """Return what can be given instead of a source that does not exist."""
    runs = sorted(str(found.parent) for found in runs_dir.glob("*/policy.npz"))
    choices = [*SCRIPTED_SOURCES, *runs]
    nearest = difflib.get_close_matches(str(path), choices, n=1, cutoff=0.0)[0]
    return (
        f"there is no source {path}: give a policy file, or one of {', '.join(choices)}"
        f" (nearest: {nearest})"
    )


def scripted_digest(config: TrainConfig) -> str:
    """Return what identifies a scripted source: its name, and the content of a clip it plays."""
    if config.source != "clip":
        return config.source
    content = load_clip(config.imitate.clip).qpos.tobytes()
    return f"clip {hashlib.sha256(content).hexdigest()[:12]}"


def _nominal_run(config: TrainConfig, preset: str, runs_dir: Path) -> Source:
    """Return the finished run of the same task and preset without a shift."""
    run_dir = _nominal_dir(config, preset, runs_dir)
    if (run_dir / loop.EVAL_CSV).is_file():
        return _from_path(config, run_dir)
    others = sorted(path.parent.name for path in runs_dir.glob(f"{config.task}-*/{loop.EVAL_CSV}"))
    raise FileNotFoundError(
        f"adapting {config.task} to {config.shift} starts from a finished nominal run; there is"
        f" no {run_dir}. Run `make train TASK={config.task} SEED={config.seed}"
        f' ARGS="--preset {preset}"` first, or name a run or policy with'
        f" --source (finished in {runs_dir}: {', '.join(others) or 'none'})"
    )


def _nominal_dir(config: TrainConfig, preset: str, runs_dir: Path) -> Path:
    variant = make_config(config.task, preset).variant
    nominal = dataclasses.replace(config, shift="none", variant=variant)
    return runs_dir / rundir.default_name(nominal, preset)


def _from_path(config: TrainConfig, path: Path) -> Source:
    noise = config.uses_source_data and config.replay.source_noise
    found = resolve_policy(str(path), config, noise=noise)
    if path.is_dir():
        progress = found.loaded.header.card.get("env_steps")
        digest = f"{rundir.digest(rundir.read_config(path))}@{progress}"
        return Source(found.policy, str(path), digest, found.loaded, path)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()[:12]
    return Source(found.policy, str(path), digest, found.loaded)


def source_data(config: TrainConfig, run_dir: Path, source: Source, say: Say) -> ring.RingBuffer:
    """Return the frozen source ring: a nominal run's replay, or freshly collected experience.

    Collected data are kept in ``run_dir/source.npz`` and used again while they fit.
    """
    env = make_env(config)
    if config.shift != "none" and source.run_dir is not None:
        source_rules.check_replay_fits(config, rundir.read_config(source.run_dir), source.run_dir)
        rows = load_replay(source.run_dir)
        data = ring.from_rows(jnp.asarray(rows), env.observation_size, env.action_size)
        say(f"source data: the replay of {source.run_dir}, {len(rows):,} transitions")
        return data
    path = run_dir / "source.npz"
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
        say(f"{path} was collected for other settings: collecting again")
    say(f"stage 2 of 3: collecting {size:,} transitions of {source.origin} in {config.task}")
    data = write_dataset(config, source, path, digest, say)
    return ring.from_transitions(jax.tree.map(jnp.asarray, data))


def collection_digest(config: TrainConfig, source: Source) -> str:
    """Return a hash of everything that decides a collected dataset."""
    env = config_json.departures(config.env)
    decides = {
        "task": config.task,
        "shift": [config.shift, config.shift_strength],
        "options": config_json.departures(getattr(config, config.task)),
        "env": {k: v for k, v in env.items() if k != "engine"},
        "seed": config.seed,
        "size": config.replay.source_size,
        "noise": config.replay.source_noise,
        "source": source.digest,
    }
    return hashlib.sha256(json.dumps(decides, sort_keys=True).encode()).hexdigest()[:12]


def write_dataset(config: TrainConfig, source: Source, path: Path, digest: str, say: Say) -> Any:
    """Collect ``config.replay.source_size`` transitions and write them to ``path``."""
    size = config.replay.source_size
    # Whole episodes: with more worlds the data would hold nothing but their beginnings.
    worlds = min(config.env.num_envs, max(1, size // config.env.episode_length))
    env = make_env(config, num_envs=worlds)
    key = jax.random.fold_in(jax.random.key(config.seed), 0x50)
    data, means = collect(env, source.policy, key, size)
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
    )
    dataset.write(path, header, data)
    return data


def describe(means: dict[str, float]) -> str:
    """Return measures as one line of text."""
    return ", ".join(f"{k} {v:.3g}" for k, v in means.items()) or "no episode ended"


def zero_shot(config: TrainConfig, run_dir: Path, source: Source, say: Say) -> Path:
    """Evaluate the source policy in the target task without training it."""
    from twirl_mjx.evaluation.measures import episode_means
    from twirl_mjx.evaluation.rollout import make_evaluate

    env = make_env(config, num_envs=config.eval.final_episodes)

    def act(params: Any, memory: Any, state: Any, key: jax.Array) -> tuple[jax.Array, Any]:
        return source.policy.act(memory, state, key)

    evaluate = make_evaluate(env, source.policy.init, act)
    values = evaluate(None, jax.random.key(config.eval.seed + 1))
    loop.write_episodes(run_dir / loop.EVAL_CSV, rundir.identity(run_dir, config), 0, values)
    say(f"zero-shot: {describe(episode_means(values))}")
    return run_dir
