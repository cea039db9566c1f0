"""A run directory: its resolved config, what may change on resume, versions of everything."""

from __future__ import annotations

import contextlib
import dataclasses
import fcntl
import functools
import hashlib
import importlib.metadata
import json
import os
import platform
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

from twirl_mjx import config_json, exits, files
from twirl_mjx.config import TASKS, TrainConfig

CONFIG_NAME = "config.json"
SOURCE_NAME = "source.json"
VERSIONS_NAME = "versions.json"
LOCK_NAME = ".lock"
PACKAGES = (
    "twirl-mjx", "mujoco", "mujoco-mjx", "jax", "jaxlib", "brax", "flax", "optax",
    "orbax-checkpoint", "numpy",
)  # fmt: skip
MAY_CHANGE = ("total_env_steps", "checkpoint_minutes", "eval.", "env.engine", "source")
"""Fields a resumed run may have changed: they do not alter what was done so far."""
WORK = ("source.npz", "checkpoints", "metrics.csv", "policy.npz", "eval.csv")
"""What a stage leaves behind; without any of it a directory may be given to another config."""
READS_OPTIONS_OF = {"stand": ("stand", "biped")}
"""Tasks whose options a task reads, where these are not its own alone (stand shows a goal)."""


class RunMismatchError(ValueError):
    """A run directory that belongs to another configuration."""


class RunBusyError(RuntimeError):
    """A run directory that another process is working on."""

    exit_status = exits.BUSY


@contextlib.contextmanager
def exclusive(run_dir: Path, wait_s: float = 1.0) -> Iterator[None]:
    """Hold a run directory: nobody else trains in it meanwhile; ends with the process at last.

    Raises:
        RunBusyError: Another process holds it; the message names that process.
    """
    run_dir.mkdir(parents=True, exist_ok=True)
    with (run_dir / LOCK_NAME).open("a+") as file:
        deadline = time.monotonic() + wait_s
        while not _try_lock(file.fileno(), fcntl.LOCK_EX):
            if time.monotonic() > deadline:
                raise busy(run_dir)
            time.sleep(0.1)
        file.truncate(0)
        file.write(f"process {os.getpid()} on {platform.node()}")
        file.flush()
        yield


def busy(run_dir: Path) -> RunBusyError:
    """Return the refusal to work in a directory that another process holds."""
    return RunBusyError(
        f"{run_dir} is in use by {owner(run_dir) or 'another process'}: wait for it,"
        " stop it, or give another --name"
    )


def owner(run_dir: Path) -> str | None:
    """Return who holds a run directory, None when nobody does."""
    path = run_dir / LOCK_NAME
    if not path.is_file():
        return None
    with path.open() as file:
        return None if _try_lock(file.fileno(), fcntl.LOCK_SH) else file.read() or "a process"


def _try_lock(descriptor: int, kind: int) -> bool:
    """Try to take a lock that the kernel releases when the file is closed or the process ends."""
    try:
        fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def check_name(name: str) -> str:
    """Return the name of a run, which is that of a folder in the folder of all runs.

    Raises:
        ValueError: It leads elsewhere.
    """
    if name == ".." or name != Path(name).name:
        nearest = Path(name).name.strip(".") or "run"
        raise ValueError(
            f"name {name!r} is no plain folder name (nearest: {nearest!r}; --runs says where runs"
            " are kept)"
        )
    return name


def default_name(config: TrainConfig, preset: str) -> str:
    """Return the name of a run when none is given."""
    shift = "" if config.shift == "none" else f"-{config.shift}"
    return f"{config.task}{shift}-{config.variant.replace('+', '_')}-{preset}-s{config.seed}"


def digest(config: TrainConfig) -> str:
    """Return a short hash that identifies a resolved config, in later versions too."""
    identity = json.dumps(config_json.departures(config), sort_keys=True)
    return hashlib.sha256(identity.encode()).hexdigest()[:12]


def may_change(config: TrainConfig) -> tuple[str, ...]:
    """Return how the names of the fields begin that a resumed run may have changed."""
    read = READS_OPTIONS_OF.get(config.task, (config.task,))
    return (*MAY_CHANGE, *(f"{task}." for task in TASKS if task not in read))


def check_run(run_dir: Path, config: TrainConfig, source: dict[str, str] | None = None) -> None:
    """Check that a run directory belongs to this config, or holds no work yet; touches nothing.

    Args:
        run_dir: The directory.
        config: The run.
        source: ``origin`` and ``digest`` of the source, where the run has one.

    Raises:
        RunMismatchError: Another task, config or source lives there; the message has the
            differences.
    """
    path = run_dir / CONFIG_NAME
    if path.exists() and any((run_dir / name).exists() for name in WORK):
        old = _read_config(path)
        changed, free = config_json.diff(old, config), may_change(config)
        lines = [line for line in changed if not line.startswith(free)]
        known = read_source(run_dir)
        if source and known and known["digest"] != source["digest"]:
            lines += [f"source {key}: {known[key]!r} -> {source[key]!r}" for key in source]
        if lines:
            shown = "\n  ".join(lines)
            raise RunMismatchError(
                f"{run_dir} holds another run; nothing was touched. Differences (there -> here):"
                f"\n  {shown}\nGive the same settings to resume it, or another --name."
            )


def open_run(run_dir: Path, config: TrainConfig, source: dict[str, str] | None = None) -> None:
    """Create a run directory, or go on with one that belongs to this config.

    Args and errors are those of :func:`check_run`. What is written is of today: config, source and
    versions of the part of the run that follows.
    """
    check_run(run_dir, config, source)
    run_dir.mkdir(parents=True, exist_ok=True)
    files.write_text(run_dir / CONFIG_NAME, config_json.to_json(config))
    if source:
        files.write_json(run_dir / SOURCE_NAME, source)
    files.write_json(run_dir / VERSIONS_NAME, versions())


def read_source(run_dir: Path) -> dict[str, str] | None:
    """Return ``origin`` and ``digest`` of a run's source, None when it has (or recorded) none."""
    path = run_dir / SOURCE_NAME
    if not path.exists():
        return None
    found = files.read_json(path, "the source of a run")
    if not isinstance(found, dict) or not {"origin", "digest"} <= found.keys():
        raise files.FileError(f"{path} holds {found!r}, expected origin and digest of a source")
    return found


def read_config(run_dir: Path) -> TrainConfig:
    """Return the config of a run.

    Raises:
        FileNotFoundError: ``run_dir`` is no run directory; the message lists the runs beside it.
    """
    path = run_dir / CONFIG_NAME
    if not path.is_file():
        parent = run_dir.parent
        runs = sorted(p.parent.name for p in parent.glob(f"*/{CONFIG_NAME}"))
        raise FileNotFoundError(
            f"{run_dir} is not a run: it has no {CONFIG_NAME}; runs in {parent}:"
            f" {', '.join(runs) or 'none'}"
        )
    return _read_config(path)


def _read_config(path: Path) -> TrainConfig:
    what = "the config of a run"
    record = files.read_json(path, what)
    try:
        return config_json.from_dict(TrainConfig, record)
    except (TypeError, ValueError, AttributeError) as error:
        raise ValueError(f"{path}: {error}; expected {what}") from error


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


def identity(run_dir: Path, config: TrainConfig) -> dict[str, str]:
    """Return the identity columns of the run's tables."""
    fields = dataclasses.asdict(config)
    return {"run": run_dir.name} | {
        name: str(fields[name]) for name in ("task", "shift", "variant", "seed")
    }
