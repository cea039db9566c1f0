"""Rows of a recording, whatever file they lie in: ``.npz``, HDF5, or a dataset of Minari.

Layouts: one array per field, a row per control step (ours, D4RL's), or the groups ``episode_0``,
``episode_1``, ... of Minari, whose observations have one row more than the actions. All of them
become the same arrays; ``recorded`` checks these against a task.
"""

from __future__ import annotations

import dataclasses
import re
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from twirl_mjx import array_files, files, plugins
from twirl_mjx.checks import choose_one
from twirl_mjx.plugins import MINARI
from twirl_mjx.replay.dataset import DatasetError

NAMES: dict[str, tuple[str, ...]] = {
    "obs": ("obs", "observations"),
    "action": ("action", "actions"),
    "reward": ("reward", "rewards"),
    "terminated": ("terminated", "terminals", "terminations"),
    "truncated": ("truncated", "truncations", "timeouts"),
    "next_obs": ("next_obs", "next_observations"),
    "qpos": ("qpos", "infos/qpos"),
    "qvel": ("qvel", "infos/qvel"),
    "next_qpos": ("next_qpos", "infos/next_qpos"),
    "next_qvel": ("next_qvel", "infos/next_qvel"),
    "goal": ("goal", "infos/goal"),
}
"""Field -> names its array may have."""
INSTANTS = ("obs", "qpos", "qvel")
"""Fields of an instant; what they were a control step later stands in ``next_*``."""
HDF5 = (".hdf5", ".h5")
MINARI_FILE = "main_data.hdf5"
WHAT = "a source dataset"
OUR_WORLDS = "twirl_mjx.worlds.adapters:to_gymnasium"
"""Entry point by which gymnasium makes the tasks of this project."""
PLAIN_WORLDS = {"task", "shift", "engine", "render_mode"}
"""Its settings that leave a task's rewards as they are; with others the dataset is a stranger's."""


@dataclasses.dataclass(frozen=True)
class Recording:
    """What a file holds."""

    name: str
    """For messages."""
    digest: str
    """Changes with the file."""
    arrays: Mapping[str, np.ndarray]
    """Field -> [n, ...]; fields that the file does not have are left out."""
    task: str = ""
    """Task in which it was recorded, if the file says so."""
    shift: str = ""
    """Dynamics shift, if the file says so."""
    control_dt: float | None = None
    """s between rows, if the file says so."""


def is_recording(name: str) -> bool:
    """Return whether a name is that of recorded data rather than of a policy."""
    path = Path(name)
    if name.startswith(MINARI) or path.suffix in HDF5:
        return True
    if path.suffix != ".npz" or not path.is_file():
        return False
    found = array_files.names_in_npz(path, "a source")
    return any(name in found for field in ("obs", "action", "qpos") for name in NAMES[field])


def load(name: str) -> Recording:
    """Return the rows of a file, or of ``minari:ID``.

    Raises:
        FileNotFoundError: There is none.
        FileError: It cannot be read.
        DatasetError: Its arrays make no rows.
        ValueError: A package that reads it is not installed.
    """
    path, said = find_minari(name) if name.startswith(MINARI) else (Path(name), {})
    read = array_files.read_hdf5 if path.suffix in HDF5 else array_files.read_npz
    arrays = read(path, WHAT)
    said = {key: v.item() for key, v in arrays.items() if v.ndim == 0} | said
    digest = files.checksum(path)[:12]
    control_dt = said.get("control_dt")
    return Recording(
        name=name,
        digest=digest,
        arrays=_by_field(name, arrays),
        task=str(said.get("task", "")),
        shift=str(said.get("shift", "")),
        control_dt=float(control_dt) if isinstance(control_dt, int | float) else None,
    )


def find_minari(name: str) -> tuple[Path, dict[str, Any]]:
    """Return where the data of ``minari:ID`` lie, and what its metadata say.

    Raises:
        FileNotFoundError: There is no such dataset; nothing is fetched.
        DatasetError: It is kept in another format than HDF5.
        ValueError: The package minari is not installed.
    """
    identity = name.removeprefix(MINARI)
    minari = plugins.required("minari", name)
    try:
        dataset = minari.load_dataset(identity)
    except Exception as error:  # its readers raise whatever their parsers do
        try:
            known = sorted(minari.list_local_datasets())
        except Exception:
            known = []
        why = f"cannot be read ({' '.join(str(error).split())})"
        if isinstance(error, FileNotFoundError):
            why = "is not on this machine (`minari download` fetches published datasets)"
        raise FileNotFoundError(f"{name} {why}: {choose_one(identity, known)}") from error
    path = Path(dataset.storage.data_path) / MINARI_FILE
    if not path.is_file():
        raise DatasetError(
            f"{name} is kept as {dataset.storage.FORMAT!r}, which is not read (nearest: the format"
            " 'hdf5', data_format='hdf5' when it is made)"
        )
    spec = dataset.spec.env_spec
    if spec is None or spec.entry_point != OUR_WORLDS or spec.kwargs.keys() - PLAIN_WORLDS:
        return path, {}
    return path, dict(spec.kwargs)


def _by_field(name: str, arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    episodes: dict[int, dict[str, np.ndarray]] = defaultdict(dict)
    for path, array in arrays.items():
        if match := re.fullmatch(r"episode_(\d{1,9})/(.+)", path):
            episodes[int(match[1])][match[2]] = array
    if not episodes:
        return _named_rows(name, arrays)
    parts = [_rows_of_episode(f"{name}: episode_{i}", episodes[i]) for i in sorted(episodes)]
    for number, part in zip(sorted(episodes), parts, strict=True):
        if part.keys() != parts[0].keys():
            odd = ", ".join(sorted(part.keys() ^ parts[0].keys()))
            raise DatasetError(f"{name}: some episodes have {odd} and episode_{number} differs")
    return {field: _joined(name, field, [part[field] for part in parts]) for field in parts[0]}


def _joined(name: str, field: str, parts: list[np.ndarray]) -> np.ndarray:
    shapes = {part.shape[1:] for part in parts}
    if len(shapes) > 1:
        raise DatasetError(f"{name}: {field} has rows of the shapes {sorted(shapes)}")
    return np.concatenate(parts)


def _named_rows(where: str, arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the arrays that are fields, by field."""
    found = {}
    for field, names in NAMES.items():
        here = [name for name in names if name in arrays]
        if len(here) > 1:
            raise DatasetError(f"{where}: {' and '.join(here)} are both {field}: leave one out")
        if here:
            found[field] = arrays[here[0]]
        elif parts := [name for name in arrays for n in names if name.startswith(f"{n}/")]:
            raise DatasetError(
                f"{where}: {field} is a group of {len(parts)} arrays ({parts[0]}, ...), need one"
                " array with a row per control step"
            )
    if "terminated" not in found and {"done", "dones"} & arrays.keys():
        raise DatasetError(
            f"{where}: 'dones' mix ends of the task with time limits, after which learning goes on:"
            " give terminated and truncated apart"
        )
    return found


def _rows_of_episode(where: str, arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the fields [T, ...] of an episode whose instants have T + 1 rows."""
    rows = _named_rows(where, arrays)
    for field in ("action", "terminated", "truncated"):
        if field not in rows:
            raise DatasetError(f"{where}: there is no array {NAMES[field][-1]!r}")
    steps = rows["action"].shape[0] if rows["action"].ndim else 0
    for field in (*INSTANTS, "goal"):
        if field not in rows:
            continue
        if rows[field].shape[:1] != (steps + 1,):
            raise DatasetError(
                f"{where}: {field} has shape {rows[field].shape}, need {steps + 1} rows for"
                f" {steps} actions: the last one is what followed the last action"
            )
        if field != "goal":
            rows[f"next_{field}"] = rows[field][1:]
        rows[field] = rows[field][:-1]
    for field in ("terminated", "truncated"):
        if rows[field].reshape(-1).shape != (steps,):
            raise DatasetError(f"{where}: {field} has shape {rows[field].shape}, need ({steps},)")
        rows[field] = rows[field].reshape(-1)
    if steps and not rows["terminated"][-1]:  # it was cut off at the latest here
        rows["truncated"] = np.append(rows["truncated"][:-1], True)
    return rows
