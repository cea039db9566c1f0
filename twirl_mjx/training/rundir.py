"""A run directory: where everything of a run lies, whose it is, and what state it is in."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import importlib.metadata
import json
import os
import platform
import re
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from twirl_mjx import exits, files
from twirl_mjx.checks import check_printable
from twirl_mjx.machine import try_lock
from twirl_mjx.policies.learned import BEST_POLICY, LAST_POLICY
from twirl_mjx.tasks.measures import episode_means
from twirl_mjx.training import config_json
from twirl_mjx.training.checkpoint import has_checkpoint, newest_checkpoint
from twirl_mjx.training.config import TrainConfig
from twirl_mjx.training.presets import make_config

PACKAGES = (
    "twirl-mjx", "mujoco", "mujoco-mjx", "jax", "jaxlib", "brax", "flax", "optax",
    "orbax-checkpoint", "numpy",
)  # fmt: skip
MAY_CHANGE = (
    "total_env_steps:", "checkpoint_minutes:", "refill:", "eval.", "engine:", "source:", "uses:",
    "source_contract:", "source_command:", "allow_clipping:",
)  # fmt: skip
"""How the lines of a difference begin that a resumed run may have: they do not alter what was done
so far. (``source`` and its terms are judged by its digest.)"""
MOST_WORDS = 3
"""Settings that the default name of a run spells out; more are a digest."""
EVAL_COLUMNS = (
    "run", "task", "shift", "variant", "seed", "env_steps", "episode", "metric", "value",
)  # fmt: skip
EVAL_CELLS = {"env_steps": int, "episode": int, "metric": str, "value": float}
"""Columns that are read back, with what turns their cells into values."""
WHOLE = ("return", "episode_length")
"""Measures that every episode has."""
EVALUATE_AGAIN = "delete it, and the command that trained the run evaluates again"
JUDGE_POLICY = "the run is not touched, since its checkpoints are gone; `twirl evaluate` judges its"
"""Where it cannot: that command would train anew."""
SUMS_AGAIN = "delete it: the evaluation counts without it"


class RunMismatchError(ValueError):
    """A run directory that belongs to another configuration."""


class RunBusyError(RuntimeError):
    """A run directory that another process is working on."""

    exit_status = exits.BUSY


@dataclasses.dataclass(frozen=True)
class New:
    """Nothing of a run is there yet."""


@dataclasses.dataclass(frozen=True)
class Resumable:
    """A part of this very run is there."""


@dataclasses.dataclass(frozen=True)
class Finished:
    """This very run, trained and evaluated to its budget."""

    env_steps: int
    """Transitions of the policy that was evaluated."""
    measures: dict[str, float]
    """Means over the closing episodes."""


@dataclasses.dataclass(frozen=True)
class Foreign:
    """Something that this run must not touch."""

    error: RunMismatchError


@dataclasses.dataclass(frozen=True)
class Busy:
    """Another process works there."""

    error: RunBusyError


Status = New | Resumable | Finished | Foreign | Busy


class RunDir:
    """The directory of one run: where everything of it lies, and what state it is in."""

    def __init__(self, path: Path | str) -> None:
        """Name a directory; it need not exist."""
        self.path = Path(path)
        self._is_held = False

    def __str__(self) -> str:
        return str(self.path)

    @property
    def name(self) -> str:
        """Name of the run."""
        return self.path.name

    @property
    def config(self) -> Path:
        """The resolved config, JSON."""
        return self.path / "config.json"

    @property
    def source(self) -> Path:
        """Origin and digest of the source, JSON."""
        return self.path / "source.json"

    @property
    def dataset(self) -> Path:
        """The collected source experience."""
        return self.path / "source.npz"

    @property
    def versions(self) -> Path:
        """Versions of packages, machine and code, JSON."""
        return self.path / "versions.json"

    @property
    def lock(self) -> Path:
        """Held by the process that works here."""
        return self.path / ".lock"

    @property
    def metrics(self) -> Path:
        """Every metric of every epoch, a tidy table."""
        return self.path / "metrics.csv"

    @property
    def checkpoints(self) -> Path:
        """Training states, and the replay as an append-only log."""
        return self.path / "checkpoints"

    @property
    def policy(self) -> Path:
        """The best policy by evaluation return."""
        return self.path / BEST_POLICY

    @property
    def last_policy(self) -> Path:
        """The newest policy that was evaluated."""
        return self.path / LAST_POLICY

    @property
    def episodes(self) -> Path:
        """The closing episodes, a tidy table; its existence closes the run."""
        return self.path / "eval.csv"

    @property
    def sums(self) -> Path:
        """Checksums of the closing episodes by env steps, JSON; written before those."""
        return self.path / "eval.sums.json"

    def status(self, config: TrainConfig, source: dict[str, str] | None = None) -> Status:
        """Judge the directory for a run, once and whole; touches nothing.

        Args:
            config: The run.
            source: ``origin`` and ``digest`` of its source, where they are known.
        """
        if not self._is_held and self.owner():
            return Busy(self.busy())
        work = self._work()
        if not work and self.config.exists() and not self._is_ours():
            return Foreign(RunMismatchError(
                f"{self.config} is there and is not the config of a run; nothing was touched"
                " (nearest: another --name)"
            ))  # fmt: skip
        if not work:
            return New()
        if not self.config.exists():
            names = ", ".join(path.name for path in work)
            return Foreign(RunMismatchError(
                f"{self} holds {names} of a run and no {self.config.name}, so whose they are is"
                " unknown; nothing was touched. Put that file back, or give another --name;"
                f" recorded data can be the source of a run: --source {self.dataset}"
            ))  # fmt: skip
        if lines := self._differences(config, source):
            shown = "\n  ".join(lines)
            return Foreign(RunMismatchError(
                f"{self} holds another run; nothing was touched. Differences (there -> here):"
                f"\n  {shown}\nGive the same settings to resume it, or another --name."
            ))  # fmt: skip
        done = self.finished()
        budget = 0 if config.variant == "zero-shot" else config.total_env_steps
        if done is not None and done.env_steps >= budget:
            return done
        if done is not None and not has_checkpoint(self.path):
            return Foreign(RunMismatchError(
                f"{self} was finished at {done.env_steps:,} transitions and its checkpoints are"
                " gone, so it cannot go on; nothing was touched. Give another --name; its policy"
                f" can start that run: --variant weights --source {self.policy}"
            ))  # fmt: skip
        lost = done is None and self.sums.exists() and not has_checkpoint(self.path)
        if lost and budget and self.policy.exists():
            return Foreign(RunMismatchError(
                f"{self} was finished, and its evaluation and its checkpoints are gone, so it would"
                " be trained anew; nothing was touched. Give another --name; `twirl evaluate"
                f" {self.policy}` judges its policy"
            ))  # fmt: skip
        return Resumable()

    def _is_ours(self) -> bool:
        """Return whether ``config.json`` has the settings of a run, of any version."""
        try:
            found = files.read_json(self.config, "the config of a run")
        except files.FileError:
            return False
        return isinstance(found, dict) and {"task", "variant", "seed"} <= found.keys()

    def _work(self) -> list[Path]:
        """Return what there is of a run that cost something.

        A start that failed leaves a config and what goes with it, which a new start replaces;
        without that config they are somebody's.
        """
        results = (self.dataset, self.policy, self.last_policy, self.episodes)
        work = [path for path in results if path.exists()]
        if not work and not self.config.exists():
            work = [path for path in (self.source, self.versions, self.sums) if path.exists()]
        if has_checkpoint(self.path):
            work.append(self.checkpoints)
        if self.metrics.exists() and not _is_header_only(self.metrics):
            work.append(self.metrics)
        return work

    def _differences(self, config: TrainConfig, source: dict[str, str] | None) -> list[str]:
        """Return what differs between the run that is there and one that is meant."""
        old, free = self.read_config(), may_change(config)
        lines = [li for li in config_json.diff(old, config) if not li.startswith(free)]
        known = self.read_source()
        if source and known and known["digest"] != source["digest"]:
            lines += [f"source {key}: {known[key]!r} -> {source[key]!r}" for key in source]
        return lines

    def finished(self) -> Finished | None:
        """Return how the run was closed, None if it was not.

        Raises:
            FileNotFoundError: There is an evaluation and no config.
            FileError: The evaluation is damaged or not whole; the message has the remedy.
        """
        if not self.episodes.is_file():
            return None
        what = "the evaluation of a run"
        loses = self.policy.exists() and not has_checkpoint(self.path)  # by training anew
        remedy = f"{JUDGE_POLICY} {self.policy.name}" if loses else EVALUATE_AGAIN
        rows = files.read_rows(self.episodes, what, EVAL_CELLS, remedy=remedy)
        config = self.read_config()
        if fault := self._fault_of(rows, config):
            raise files.FileError(f"{self.episodes}: {fault}; {remedy}")
        values: dict[str, list[float]] = {}
        for row in rows:
            values.setdefault(row["metric"], []).append(row["value"])
        means = episode_means({k: np.array(v) for k, v in values.items()})
        return Finished(rows[0]["env_steps"], means)

    def _fault_of(self, rows: list[dict[str, Any]], config: TrainConfig) -> str | None:
        """Return what shows that the closing episodes are not those that were written."""
        steps = {row["env_steps"] for row in rows}
        if len(steps) != 1:
            return f"{len(steps)} different env_steps, expected one"
        known = self._sums().get(str(at := steps.pop()))  # versions before 0.2 have written none
        if known == files.checksum(self.episodes):  # whatever budget the run has been given since
            return None
        most = config.total_env_steps + config.steps_per_epoch * config.num_envs
        most = max(most, newest_checkpoint(self.path) or 0)
        if not 0 <= at <= most:
            return f"env_steps {at:,}, and the run went to {most:,} at most"
        count = config.eval.final_episodes
        for name in WHOLE:
            episodes = sorted(row["episode"] for row in rows if row["metric"] == name)
            if episodes != list(range(count)):
                return f"{len(episodes)} rows of {name}, expected one for each of {count} episodes"
        return None if known is None else "its checksum is not that of what was written"

    def _sums(self) -> dict[str, str]:
        """Return env steps -> checksum of the evaluations that have closed this run."""
        if not self.sums.exists():
            return {}
        found = files.read_json(self.sums, "checksums of evaluations", remedy=SUMS_AGAIN)
        if not isinstance(found, dict):
            raise files.FileError(f"{self.sums} holds {found!r}, expected checksums; {SUMS_AGAIN}")
        return found

    def open(self, config: TrainConfig, source: dict[str, str] | None = None) -> None:
        """Write down config, source and versions of the part of the run that follows."""
        files.make_folders(self.path)
        files.write_text(self.config, config_json.to_json(config))
        if source:
            files.write_json(self.source, source)
        files.write_json(self.versions, versions())

    def read_config(self) -> TrainConfig:
        """Return the config of the run.

        Raises:
            FileNotFoundError: This is no run directory; the message lists the runs beside it.
        """
        if not self.config.exists():
            parent = self.path.parent
            runs = sorted(p.parent.name for p in parent.glob(f"*/{self.config.name}"))
            raise FileNotFoundError(
                f"{self} is not a run: it has no {self.config.name}; runs in {parent}:"
                f" {', '.join(runs) or 'none'}"
            )
        what = "the config of a run"
        record = files.read_json(self.config, what)
        try:
            return config_json.from_record(record)
        except (TypeError, ValueError, AttributeError, KeyError) as error:
            raise ValueError(f"{self.config}: {error}; expected {what}") from error

    def read_source(self) -> dict[str, str] | None:
        """Return ``origin`` and ``digest`` of the source, None when it has (or recorded) none."""
        if not self.source.exists():
            return None
        found = files.read_json(self.source, "the source of a run")
        if not isinstance(found, dict) or not {"origin", "digest"} <= found.keys():
            raise files.FileError(
                f"{self.source} holds {found!r}, expected origin and digest of a source"
            )
        return found

    def identity(self, config: TrainConfig) -> dict[str, str]:
        """Return the identity columns of the run's tables."""
        columns = ("task", "shift", "variant", "seed")
        return {"run": self.name} | {name: str(getattr(config, name)) for name in columns}

    def write_episodes(
        self, config: TrainConfig, env_steps: int, values: dict[str, np.ndarray]
    ) -> None:
        """Write the closing episodes, measures [E], whole or not at all; NaN has no row."""
        identity = self.identity(config).values()
        rows = [
            [*identity, env_steps, episode, name, f"{float(column[episode]):.9g}"]
            for name, column in values.items()
            for episode in np.flatnonzero(~np.isnan(column))
        ]
        table = files.csv_text([EVAL_COLUMNS, *rows])
        files.write_json(
            self.sums, self._sums() | {str(env_steps): hashlib.sha256(table.encode()).hexdigest()}
        )
        files.write_text(self.episodes, table)

    @contextlib.contextmanager
    def exclusive(self, wait_s: float = 1.0) -> Iterator[None]:
        """Hold the directory: nobody else works in it meanwhile; ends with the process at last.

        Raises:
            RunBusyError: Another process holds it; the message names that process.
        """
        files.make_folders(self.path)
        files.sync(self.path.parent)  # a sweep may have made it
        with self.lock.open("a+") as file:
            deadline = time.monotonic() + wait_s
            while not try_lock(file):
                if time.monotonic() > deadline:
                    raise self.busy()
                time.sleep(0.1)
            file.truncate(0)
            file.write(f"process {os.getpid()} on {platform.node()}")
            file.flush()
            self._is_held = True
            try:
                yield
            finally:
                self._is_held = False

    def busy(self) -> RunBusyError:
        """Return the refusal to work in a directory that another process holds."""
        return RunBusyError(
            f"{self} is in use by {self.owner() or 'another process'}: wait for it,"
            " stop it, or give another --name"
        )

    def owner(self) -> str | None:
        """Return who holds the directory, None when nobody does."""
        if not self.lock.is_file():
            return None
        with self.lock.open() as file:
            return None if try_lock(file, shared=True) else file.read() or "a process"


def _is_header_only(path: Path) -> bool:
    """Return whether a table has no row."""
    return path.is_file() and len(files.read_text(path, "a metrics table").splitlines()) < 2


def check_name(name: str) -> str:
    """Return the name of a run, which is that of a folder in the folder of all runs.

    Raises:
        ValueError: It leads elsewhere, or has line breaks or the like.
    """
    check_printable("name", name)
    if name == ".." or name != Path(name).name:
        nearest = Path(name).name.strip(".") or "run"
        raise ValueError(
            f"name {name!r} is no plain folder name (nearest: {nearest!r}; --runs says where runs"
            " are kept)"
        )
    return name


def default_name(config: TrainConfig, preset: str) -> str:
    """Return the name of a run when none is given: that of its preset, and what departs from it.

    What a resumed run may change is no part of it, so the same command resumes.
    """
    shift = "" if config.shift == "none" else f"-{config.shift}"
    plain = f"{config.task}{shift}-{config.variant.replace('+', '_')}-{preset}-s{config.seed}"
    return "-".join([plain, *_words(_settings(config, preset))])


def _settings(config: TrainConfig, preset: str) -> dict[str, Any]:
    """Return the settings by which a run departs from its preset, by their public names."""
    usual = config_json.flatten(make_config(config.task, preset, config.learner))
    said = ("task", "shift", "variant", "seed")  # they are in the name
    free = tuple(name for name in may_change(config) if name != "source:")
    return {
        name: value
        for name, value in config_json.flatten(config).items()
        if value != usual.get(name) and name not in said and not f"{name}:".startswith(free)
    }


def _words(settings: dict[str, Any]) -> list[str]:
    """Return settings as short parts of a file name, as a digest where they are many or long."""
    words = [f"{name.split('.')[-1]}_{value}" for name, value in settings.items()]
    if len(words) <= MOST_WORDS and all(re.fullmatch(r"[\w.]{1,32}", word) for word in words):
        return words
    text = json.dumps(settings, sort_keys=True, default=str)
    return [hashlib.sha256(text.encode()).hexdigest()[:8]]


def digest(config: TrainConfig) -> str:
    """Return a short hash that identifies a resolved config, in later versions too."""
    identity = json.dumps(config_json.departures(config), sort_keys=True)
    return hashlib.sha256(identity.encode()).hexdigest()[:12]


def may_change(config: TrainConfig) -> tuple[str, ...]:
    """Return how the lines begin (``config_json.diff``) in which a resumed run may differ."""
    source = config.task_type.source
    return (*MAY_CHANGE, *([f"{source}."] if source else []))


@functools.cache
def versions() -> dict[str, str]:
    """Return the versions of packages, interpreter, machine and source code.

    Looked up once: a commit made while a process runs is not the code it runs.
    """
    found = {}
    for package in PACKAGES:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            found[package] = "not installed"
    found["python"] = platform.python_version()
    found["machine"] = f"{platform.system()} {platform.machine()}"
    found["commit"] = _commit()
    return found


def _commit() -> str:
    here = Path(__file__).resolve().parent
    try:
        out = subprocess.run(
            ["git", "-C", str(here), "describe", "--always", "--dirty", "--abbrev=12"],
            capture_output=True,
            text=True,
            timeout=10,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return "unknown"
    return out.stdout.strip() or "unknown"
