"""A source that is only a recording: transitions of the target task from a file.

Read are this project's own datasets (``source.npz`` of any run) and plain ``.npz`` files with the
arrays of ``NAMES``. Rewards are taken as they are recorded, so they have to be those of the target
task; that cannot be checked without the states, which observations do not hold.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from twirl_mjx import array_files, files
from twirl_mjx.checks import choose_one
from twirl_mjx.replay import dataset
from twirl_mjx.replay.dataset import DatasetError
from twirl_mjx.sim.robot import Robot
from twirl_mjx.tasks.observations import Entry, layout_size, layout_slices
from twirl_mjx.types import Transition

NAMES: dict[str, tuple[str, ...]] = {
    "obs": ("obs", "observations"),
    "action": ("action", "actions"),
    "reward": ("reward", "rewards"),
    "terminated": ("terminated", "terminals", "terminations"),
    "next_obs": ("next_obs", "next_observations"),
}
"""Field -> names its array may have."""
TRUNCATIONS = ("truncated", "truncations", "timeouts")
"""Time limits; read for their shape and not needed: a truncated row bootstraps like any other."""
LIMIT_MARGIN = 0.2
"""rad, by which recorded joint angles may lie outside the limits: contacts and impacts do that."""
UNIT_TOLERANCE = 0.02
"""Largest deviation of a recorded unit vector or quaternion from length 1."""
FOREIGN_FORMATS = {
    ".hdf5": "h5py is not among the packages of this project",
    ".h5": "h5py is not among the packages of this project",
    ".pt": "torch is not among the packages of this project",
    ".pkl": "a pickle runs code when it is read",
    ".pickle": "a pickle runs code when it is read",
}
"""Ending -> why such files are not read."""


class RecordedPolicy:
    """Stands for the policy behind a recording, which is not there: it refuses to act."""

    def __init__(self, origin: str) -> None:
        """Name the file."""
        self._origin = origin

    def init(self, state: Any) -> Any:
        """Refuse.

        Raises:
            ValueError: Always.
        """
        del state
        raise ValueError(
            f"{self._origin} is recorded data: it can train a run (twirl train --source), but it"
            " does not act (nearest: the policy that recorded it)"
        )

    def act(self, memory: Any, state: Any, key: jax.Array) -> tuple[jax.Array, Any]:
        """Refuse, as :meth:`init`."""
        del memory, key
        return self.init(state)


def refuse_format(name: str) -> None:
    """Refuse data of formats that are not read, with the reason.

    Raises:
        DatasetError: ``name`` is of such a format.
    """
    reason = FOREIGN_FORMATS.get(Path(name).suffix)
    if name.startswith("minari:"):
        reason = "minari and h5py are not among the packages of this project"
    if reason:
        arrays = ", ".join(names[0] for names in NAMES.values())
        raise DatasetError(
            f"{name} is not read, because {reason} (nearest: the same arrays in an .npz file:"
            f" numpy.savez('data.npz', {arrays}))"
        )


def is_recording(path: Path) -> bool:
    """Return whether a file is an archive of transitions rather than a policy."""
    if path.suffix != ".npz" or not path.is_file():
        return False
    names = array_files.names_in_npz(path, "a source")
    return any(name in names for name in NAMES["obs"] + NAMES["action"])


def read(
    path: Path, *, task: str, layout: tuple[Entry, ...], robot: Robot
) -> tuple[Transition, str, str]:
    """Read transitions and check them against the target task.

    Args:
        path: The file.
        task: Name of the target task.
        layout: What it shows.
        robot: Who acts there.

    Returns:
        Transitions [n, ...] as numpy arrays; a digest of the file; the shift it was recorded
        under ("" where the file does not say).

    Raises:
        DatasetError: Sizes, ranges or values that cannot be of this task; the message names the
            array, the row and the likely mistake.
    """
    sizes = {"observation_size": layout_size(layout), "action_size": robot.num_joints}
    digest = hashlib.sha256(files.read_bytes(path, "a source dataset")).hexdigest()[:12]
    if "header" in array_files.names_in_npz(path, "a source dataset"):
        header, data = dataset.read(path, task=task, **sizes)
        data, shift = jax.tree.map(np.asarray, data), header.shift
    else:
        data, shift = _plain(path, sizes["observation_size"], sizes["action_size"], task), ""
    for name in ("obs", "next_obs"):
        _check_observations(path, name, getattr(data, name), layout, robot)
    return data, digest, shift


def _plain(path: Path, observation_size: int, action_size: int, task: str) -> Transition:
    arrays = array_files.read_npz(path, "a source dataset")
    found = {field: _find(path, arrays, field) for field in NAMES}
    count = len(found["obs"]) if found["obs"].ndim else 0
    shapes = {
        "obs": (count, observation_size),
        "action": (count, action_size),
        "reward": (count,),
        "terminated": (count,),
        "next_obs": (count, observation_size),
    }
    for field, shape in shapes.items():
        array = found[field]
        if field in ("reward", "terminated") and array.shape == (count, 1):
            array = found[field] = array[:, 0]
        if array.shape != shape:
            raise DatasetError(
                f"{path}: {field} has shape {array.shape}, task {task} needs {shape}: observations"
                f" of {observation_size} numbers as {task} shows them, {action_size} joints"
            )
        if array.dtype.kind not in "fiub":
            raise DatasetError(f"{path}: {field} is of type {array.dtype}, need numbers")
        with np.errstate(over="ignore"):  # what float32 cannot hold is infinite
            bad = ~np.isfinite(array.astype(np.float32)).reshape(count, -1).all(axis=1)
        if bad.any():
            raise DatasetError(f"{path}: {field} is not finite in row {int(np.argmax(bad))}")
    if count < 2:
        raise DatasetError(f"{path}: {count} transitions, need at least 2")
    _check_values(path, found)
    for name in TRUNCATIONS:
        if name in arrays and arrays[name].reshape(-1).shape != (count,):
            raise DatasetError(f"{path}: {name} has shape {arrays[name].shape}, need ({count},)")
    values: dict[str, Any] = {
        "obs": found["obs"].astype(np.float32),
        "action": np.clip(found["action"], -1.0, 1.0).astype(np.float32),
        "reward": found["reward"].astype(np.float32),
        "terminated": found["terminated"].astype(bool),
        "next_obs": found["next_obs"].astype(np.float32),
    }
    return Transition(**values)


def _find(path: Path, arrays: Mapping[str, np.ndarray], field: str) -> np.ndarray:
    for name in NAMES[field]:
        if name in arrays:
            return arrays[name]
    if field == "terminated" and {"done", "dones"} & arrays.keys():
        raise DatasetError(
            f"{path}: 'dones' mix ends of the task with time limits, after which learning goes on:"
            " give terminated and truncated apart"
        )
    raise DatasetError(
        f"{path}: there is no array {NAMES[field][0]!r} among {', '.join(sorted(arrays))};"
        f" {choose_one(field, NAMES[field])}"
    )


def _check_values(path: Path, found: Mapping[str, np.ndarray]) -> None:
    largest = float(np.abs(found["action"]).max())
    if largest > 1.0 + 1e-6:
        row = int(np.argmax(np.abs(found["action"]).max(axis=1)))
        raise DatasetError(
            f"{path}: action reaches {largest:.3g} in row {row}, limit 1 (joint angles, or outputs"
            " in units of another action scale? An action is (target - default pose) / half range)"
        )
    ends = found["terminated"]
    if not np.isin(ends, (0, 1)).all():
        raise DatasetError(f"{path}: terminated holds {ends[~np.isin(ends, (0, 1))][0]}, need 0, 1")
    if ends.all():
        raise DatasetError(
            f"{path}: every row is terminated, so nothing would be bootstrapped (a mask of rows"
            " that go on, inverted?)"
        )
    if np.array_equal(found["obs"], found["next_obs"]):
        raise DatasetError(f"{path}: next_obs equals obs in every row: nothing ever moved")


def _check_observations(
    path: Path, name: str, obs: np.ndarray, layout: tuple[Entry, ...], robot: Robot
) -> None:
    """Check entries of an observation whose range the robot or geometry decides."""
    low, high = robot.joint_limits.T
    for entry, part in layout_slices(layout).items():
        values, plain = obs[:, part], entry.partition("[")[0].removeprefix("target_")
        where = f"{path}: {name}, {entry}"
        if plain == "joint_pos":
            _check_range(where, values, low - LIMIT_MARGIN, high + LIMIT_MARGIN, robot.joints)
        elif plain == "previous_action":
            one = np.ones(values.shape[1])
            _check_range(where, values, -one, one, robot.joints)
        elif plain == "roll_pitch":
            most = np.array([math.pi, math.pi / 2]) + 0.01
            _check_range(where, values, -most, most, ("roll", "pitch"))
        elif plain in ("base_x_axis_w", "base_z_axis_w", "base_quat_h"):
            length = np.linalg.norm(values, axis=1)
            row = int(np.argmax(np.abs(length - 1.0)))
            if abs(length[row] - 1.0) > UNIT_TOLERANCE:
                raise DatasetError(
                    f"{where}: length {length[row]:.3g} in row {row}, need 1 (another order of the"
                    " observation, or normalised observations?)"
                )


def _check_range(
    where: str, values: np.ndarray, low: np.ndarray, high: np.ndarray, names: tuple[str, ...]
) -> None:
    beyond = np.maximum(low - values, values - high)
    row, column = np.unravel_index(int(np.argmax(beyond)), beyond.shape)
    if beyond[row, column] > 1e-4:
        value = values[row, column]
        raise DatasetError(
            f"{where}: {names[column]} is {value:.3g} in row {row}, limits {low[column]:.3g} to"
            f" {high[column]:.3g} (degrees, another order of the observation, or normalised"
            " observations?)"
        )


def as_device(data: Transition) -> Transition:
    """Return transitions as device arrays."""
    return jax.tree.map(jnp.asarray, data)
