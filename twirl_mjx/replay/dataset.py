"""A source dataset on disk: transitions of the target task, checked when read."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from twirl_mjx import array_files, files
from twirl_mjx.checks import one_line
from twirl_mjx.types import Transition

FORMAT = "twirl-source-dataset"
VERSION = 1
FIELDS = ("obs", "action", "reward", "terminated", "next_obs")


class DatasetError(ValueError):
    """A file that is not a usable source dataset; the message says why."""


@dataclasses.dataclass(frozen=True)
class DatasetHeader:
    """What a dataset says about itself."""

    task: str
    """Target task whose observations, rewards and terminations were recorded."""
    shift: str
    """Dynamics shift of the worlds."""
    source: str
    """Name or origin of the policy that acted."""
    size: int
    """Transitions."""
    observation_size: int
    """O."""
    action_size: int
    """A."""
    mean_return: float
    """Mean return of the episodes that ended while collecting; NaN if none did."""
    digest: str = ""
    """Digest of what decides the data: policy, task options, shift, seed, size."""
    run: str = ""
    """Name of the run that wrote the file, which alone may replace it."""
    format: str = FORMAT
    version: int = VERSION


def write(path: Path, header: DatasetHeader, data: Transition) -> None:
    """Write a dataset, whole or not at all.

    Args:
        path: Target file, ``.npz``.
        header: Its description.
        data: Transitions [n, ...] as arrays.
    """
    text = json.dumps(dataclasses.asdict(header), sort_keys=True)
    arrays: dict[str, Any] = {name: np.asarray(getattr(data, name)) for name in FIELDS}
    array_files.write_npz(path, {"header": np.array(text)} | arrays)


def read(
    path: Path, *, task: str, observation_size: int, action_size: int
) -> tuple[DatasetHeader, Transition]:
    """Read a dataset and check that it fits the target task.

    Raises:
        FileNotFoundError: No such file.
        DatasetError: Unreadable, of another version or task, of wrong sizes, or not finite.
    """
    if not path.exists():
        raise FileNotFoundError(f"no source dataset at {path}; `twirl collect` makes one")
    header, arrays = _load(path)
    for what, found, need in (
        ("task", header.task, task),
        ("observation size", header.observation_size, observation_size),
        ("action size", header.action_size, action_size),
    ):
        if found != need:
            raise DatasetError(f"{path}: {what} is {found!r}, this run needs {need!r}")
    shapes = {
        "obs": (header.size, observation_size),
        "action": (header.size, action_size),
        "reward": (header.size,),
        "terminated": (header.size,),
        "next_obs": (header.size, observation_size),
    }
    for name, shape in shapes.items():
        if name not in arrays or arrays[name].shape != shape:
            found = arrays[name].shape if name in arrays else "nothing"
            raise DatasetError(f"{path}: {name} has shape {found}, the header says {shape}")
        if arrays[name].dtype.kind not in "fb":
            raise DatasetError(f"{path}: {name} is of type {arrays[name].dtype}, need numbers")
        if arrays[name].dtype.kind == "f":
            with np.errstate(over="ignore"):  # what float32 cannot hold is infinite
                arrays[name] = arrays[name].astype(np.float32)
        bad = ~np.isfinite(arrays[name]).reshape(header.size, -1).all(axis=1)
        if bad.any():
            raise DatasetError(f"{path}: {name} is not finite in row {int(np.argmax(bad))}")
    if np.abs(arrays["action"]).max(initial=0.0) > 1.0 + 1e-6:
        raise DatasetError(f"{path}: actions reach {np.abs(arrays['action']).max():.3g}, limit 1")
    return header, Transition(**{name: jnp.asarray(arrays[name]) for name in FIELDS})


def _load(path: Path) -> tuple[DatasetHeader, dict[str, np.ndarray]]:
    remedy = "remove it and collect again"
    try:
        arrays = array_files.read_npz(path, "a source dataset", remedy=remedy)
        record = json.loads(str(arrays.pop("header")))
    except files.FileError as error:
        raise DatasetError(str(error)) from error
    except (ValueError, KeyError, RecursionError) as error:
        raise DatasetError(f"{path}: no header that can be read: {error}; {remedy}") from error
    if not isinstance(record, dict):
        raise DatasetError(f"{path}: its header is {record!r}, not a JSON object; {remedy}")
    if record.get("format") != FORMAT or record.get("version") != VERSION:
        raise DatasetError(
            f"{path} is {record.get('format')!r} version {record.get('version')}, this program"
            f" reads {FORMAT!r} version {VERSION}: collect it again"
        )
    try:
        return DatasetHeader(**record), arrays
    except TypeError as error:
        raise DatasetError(f"{path}: the header has wrong fields: {one_line(error)}") from error
