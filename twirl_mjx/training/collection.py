"""The source ring of a run: recorded data, a nominal run's replay, or what is collected for it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from twirl_mjx import records
from twirl_mjx.policies import recorded
from twirl_mjx.policies.foreign import MAX_CLIPPED
from twirl_mjx.policies.resolve import Source
from twirl_mjx.replay import dataset, ring
from twirl_mjx.training import rundir, source_rules
from twirl_mjx.training.checkpoint import load_replay
from twirl_mjx.training.config import TrainConfig
from twirl_mjx.training.rundir import RunDir
from twirl_mjx.training.source import Collector
from twirl_mjx.worlds.make import make_env

Say = Callable[[str], None]
Collectors = dict[int, Collector]
"""id of a policy -> what is compiled to collect with it, for the runs of one program."""


def source_data(
    config: TrainConfig,
    run_dir: RunDir,
    source: Source,
    say: Say,
    collectors: Collectors | None = None,
) -> ring.RingBuffer:
    """Return the frozen source ring: a nominal run's replay, or freshly collected experience.

    Collected data are kept in ``run_dir/source.npz`` and used again while they fit.

    Args:
        config: The run.
        run_dir: Its directory.
        source: Its source.
        say: Prints one line for a person.
        collectors: What was compiled for other runs of the same program; gets what is compiled.
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
    data = write_dataset(config, source, path, digest, say, collectors)
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


def write_dataset(
    config: TrainConfig,
    source: Source,
    path: Path,
    digest: str,
    say: Say,
    collectors: Collectors | None = None,
) -> Any:
    """Collect ``config.replay.source_size`` transitions and write them to ``path``."""
    size = config.replay.source_size
    collectors = {} if collectors is None else collectors
    if (compiled := id(source.policy)) not in collectors:  # kept alive by its collector
        env = make_env(config.evaluation, num_envs=_collecting_worlds(config))
        collectors[compiled] = Collector(env, source.policy)
    collect = collectors[compiled]
    key = jax.random.fold_in(jax.random.key(config.seed), 0x50)
    limit = 1.0 if config.allow_clipping else MAX_CLIPPED
    data, means = collect(key, size, max_clipped=limit, say=say)
    if clipped := means.pop("clipped", 0.0):
        say(f"{clipped:.1%} of the source's joint targets lay outside the action box: clipped")
    say("source policy in the target task: " + describe(means))
    header = dataset.DatasetHeader(
        task=config.task,
        shift=config.shift,
        source=source.origin,
        size=len(data.reward),
        observation_size=collect.env.observation_size,
        action_size=collect.env.action_size,
        mean_return=means.get("return", float("nan")),
        digest=digest,
        run=path.parent.name,
    )
    dataset.write(path, header, data)
    return data


def describe(means: dict[str, float]) -> str:
    """Return measures as one line of text."""
    return ", ".join(f"{k} {v:.3g}" for k, v in means.items()) or "no episode ended"
