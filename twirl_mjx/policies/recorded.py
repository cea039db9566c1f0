"""A source that is only a recording: transitions of the target task from a file.

Read are this project's own datasets (``source.npz`` of any run) and the files of ``rows``. Where a
file says that it was recorded in the target task, it is taken at its word. Otherwise its rewards
mean nothing here: it needs physics states, which the target task observes and judges anew.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from twirl_mjx import array_files, files
from twirl_mjx.policies import rows
from twirl_mjx.policies.rows import Recording
from twirl_mjx.replay import dataset
from twirl_mjx.replay.dataset import DatasetError
from twirl_mjx.sim.robot import ROOT_SIZE, Robot
from twirl_mjx.sim.robots import ROBOTS
from twirl_mjx.tasks.observations import Entry, layout_size, layout_slices
from twirl_mjx.types import Transition
from twirl_mjx.worlds import judging
from twirl_mjx.worlds.config import WorldConfig
from twirl_mjx.worlds.make import make_env

LIMIT_MARGIN = 0.2
"""rad, by which recorded joint angles may lie outside the limits: contacts and impacts do that."""
UNIT_TOLERANCE = 0.02
"""Largest deviation of a recorded unit vector or quaternion from length 1."""
MAX_HEIGHT = 3.0
"""m, of a recorded base over the ground."""
RATE_TOLERANCE = 1.5
"""Largest ratio between the time that positions and velocities say lies between states, and a
control step."""
LEAST_SPEED = 0.05
"""m/s, root mean square from which on that time can be told."""
FOREIGN_FORMATS = {
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
    if reason:
        raise DatasetError(
            f"{name} is not read, because {reason} (nearest: its arrays in an .npz or .hdf5 file,"
            " docs/sources.md)"
        )


def read(name: str, config: WorldConfig) -> tuple[Transition, str, tuple[str, ...]]:
    """Read transitions and check them against the target task.

    Args:
        name: A file, or ``minari:ID``.
        config: Worlds of the target task.

    Returns:
        Transitions [n, ...] as numpy arrays; a digest of the file; what a person should know.

    Raises:
        FileNotFoundError: There is no such file or dataset.
        ValueError: It cannot be read, or its sizes, ranges or values cannot be of this task; the
            message names the array, the row and the likely mistake.
    """
    robot, layout = ROBOTS.get(config.robot), config.make_task().observer.layout
    sizes = {"observation_size": layout_size(layout), "action_size": robot.num_joints}
    path = Path(name)
    if path.suffix == ".npz" and "header" in array_files.names_in_npz(path, rows.WHAT):
        header, data = dataset.read(path, task=config.task, **sizes)
        data, digest = jax.tree.map(np.asarray, data), files.checksum(path)[:12]
        _check_observations(name, data, layout, robot)
        return data, digest, _said(header.shift, config)
    recording = rows.load(name)
    _check_rate(recording, robot)
    if recording.task == config.task:
        data, notes = _as_recorded(recording, **sizes)
        _check_observations(name, data, layout, robot)
        return data, recording.digest, (*_said(recording.shift, config), *notes)
    if "qpos" in recording.arrays and "qvel" in recording.arrays:
        data, notes = _from_states(recording, config, robot)
        return data, recording.digest, notes
    where, remedy = f"task {recording.task}", "the states too"
    if not recording.task:
        where = "a task that the file does not name"
        remedy += f", or task='{config.task}' in the file if that is where it was recorded"
    raise DatasetError(
        f"{name}: its rewards are those of {where}, and it holds no states (qpos [n,"
        f" {ROOT_SIZE + robot.num_joints}] and qvel) for task {config.task} to judge (nearest:"
        f" {remedy})"
    )


def _said(shift: str, config: WorldConfig) -> tuple[str, ...]:
    notes = (f"its rewards are taken as they were recorded in task {config.task}",)
    if shift and shift != config.shift:
        notes += (f"it was recorded under shift {shift}, this is shift {config.shift}",)
    return notes


def _check_rate(recording: Recording, robot: Robot) -> None:
    said, here = recording.control_dt, robot.control_dt
    if said is not None and not abs(said - here) <= 1e-3 * here:
        raise DatasetError(
            f"{recording.name}: control_dt is {said:g} s, robot {robot.name} acts every {here:g} s:"
            " an action of another rate is another action (nearest: the policy behind it, asked at"
            " this rate)"
        )


def _as_recorded(
    recording: Recording, observation_size: int, action_size: int
) -> tuple[Transition, tuple[str, ...]]:
    """Return observations, rewards and ends as they stand in the file."""
    name = recording.name
    shapes = {
        "action": (action_size,),
        "obs": (observation_size,),
        "reward": (),
        "terminated": (),
        "next_obs": (observation_size,),
        "truncated": (),
    }
    found = _checked(recording, recording.task, shapes, ("next_obs", "truncated"))
    _check_action(name, found["action"])
    found, keep = _with_successors(name, found, "obs")
    if np.array_equal(found["obs"], found["next_obs"]):
        raise DatasetError(f"{name}: next_obs equals obs in every row: nothing ever moved")
    values: dict[str, Any] = {
        field: found[field][keep].astype(bool if field == "terminated" else np.float32)
        for field in dataset.FIELDS
    }
    values["action"] = np.clip(values["action"], -1.0, 1.0)
    return Transition(**values), _left_out(keep)


def _left_out(keep: np.ndarray) -> tuple[str, ...]:
    count = int((~keep).sum())
    why = "nothing in the file says what followed them"
    return (f"{count:,} of {len(keep):,} rows are left out, because {why}",) if count else ()


def _from_states(
    recording: Recording, config: WorldConfig, robot: Robot
) -> tuple[Transition, tuple[str, ...]]:
    """Return what the target task makes of the states of a file."""
    name, joints = recording.name, robot.num_joints
    qpos, qvel = (ROOT_SIZE + joints,), (ROOT_SIZE - 1 + joints,)
    shapes: dict[str, tuple[int, ...]] = {
        "action": (joints,), "qpos": qpos, "qvel": qvel, "next_qpos": qpos, "next_qvel": qvel,
        "goal": (2,), "terminated": (), "truncated": (),
    }  # fmt: skip
    optional = ("next_qpos", "next_qvel", "goal", "terminated", "truncated")
    found = _checked(recording, config.task, shapes, optional)
    _check_action(name, found["action"])
    ends = found.get("terminated", np.zeros(len(found["action"]))).astype(bool)
    found, keep = _with_successors(name, found | {"terminated": ends}, "qpos", "qvel")
    for field in ("qpos", "next_qpos"):
        _check_states(f"{name}: {field}", found[field][keep], robot)
    ends |= found.get("truncated", ends).astype(bool)
    first = np.ones(len(keep), bool)
    goes_on = np.isclose(found["next_qpos"][:-1], found["qpos"][1:], atol=1e-5).all(axis=1)
    first[1:] = ends[:-1] | ~goes_on
    fields = ("qpos", "qvel", "next_qpos", "next_qvel", "action")
    goal = found["goal"][keep] if "goal" in found else None
    motion = judging.Motion(**{f: found[f][keep] for f in fields}, first=first[keep], goal=goal)
    _check_spacing(name, motion, robot)
    key = jax.random.key(int(recording.digest, 16) % 2**31)
    data, kept = judging.judge(make_env(config, num_envs=1), key, motion)
    notes = f"task {config.task} observed and judged its states, at the end of every control step"
    after = int((~kept).sum())
    ended = (f"{after:,} steps after an end of the task are left out",) if after else ()
    return jax.tree.map(lambda x: x[kept], data), (notes, *_left_out(keep), *ended)


def _checked(
    recording: Recording,
    task: str,
    shapes: Mapping[str, tuple[int, ...]],
    optional: tuple[str, ...],
) -> dict[str, np.ndarray]:
    """Return the fields of a recording that are there, after checking shapes and numbers."""
    name, found = recording.name, {}
    count = recording.arrays["action"].shape[:1] if "action" in recording.arrays else ()
    if count and count[0] < 2:
        raise DatasetError(f"{name}: {count[0]} transitions, need at least 2")
    for field, row in shapes.items():
        if (array := recording.arrays.get(field)) is None:
            if field in optional:
                continue
            raise DatasetError(
                f"{name}: there is no array {field!r} (names: {', '.join(rows.NAMES[field])}) among"
                f" {', '.join(sorted(recording.arrays)) or 'none that is known'}"
            )
        if not row and array.shape == (*count, 1):
            array = array[:, 0]
        if not count or array.shape != (*count, *row):
            need = (*(count or "n"), *row)
            raise DatasetError(
                f"{name}: {field} has shape {array.shape}, task {task} needs {need}: a row per"
                " action, observations as the task shows them, a number for every joint"
            )
        if array.dtype.kind not in "fiub":
            raise DatasetError(f"{name}: {field} is of type {array.dtype}, need numbers")
        with np.errstate(over="ignore"):  # what is too large for float32 is not finite there
            numbers = array.astype(np.float32)
        bad = ~np.isfinite(numbers).reshape(len(array), -1).all(axis=1)
        if bad.any():
            raise DatasetError(f"{name}: {field} is not finite in row {int(np.argmax(bad))}")
        if field in ("terminated", "truncated") and not np.isin(array, (0, 1)).all():
            odd = array[~np.isin(array, (0, 1))][0]
            raise DatasetError(f"{name}: {field} holds {odd}, need 0 or 1")
        found[field] = array
    if "terminated" in found and found["terminated"].all():
        raise DatasetError(
            f"{name}: every row is terminated, so nothing would be bootstrapped (a mask of rows"
            " that go on, inverted?)"
        )
    return found


def _check_action(name: str, action: np.ndarray) -> None:
    largest = float(np.abs(action).max())
    if largest > 1.0 + 1e-6:
        row = int(np.argmax(np.abs(action).max(axis=1)))
        raise DatasetError(
            f"{name}: action reaches {largest:.3g} in row {row}, limit 1 (joint angles, or outputs"
            " in units of another action scale? An action is (target - default pose) / half range)"
        )


def _with_successors(
    name: str, found: dict[str, np.ndarray], *fields: str
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return the arrays with ``next_*`` of every field, and which rows [n] have a successor.

    Where the file does not have them they are taken from the next row, and the last row of an
    episode has none: never the first row of the next episode. An observation of which the task
    ended needs no successor: nothing is bootstrapped from it.
    """
    keep = np.ones(len(found["action"]), bool)
    for field in fields:
        if f"next_{field}" in found:
            continue
        if "truncated" not in found:
            raise DatasetError(
                f"{name}: it has neither next_{field} nor the ends of its episodes: give"
                f" truncated ({', '.join(rows.NAMES['truncated'][1:])}) or next_{field}"
            )
        terminated = found["terminated"].astype(bool)
        ends = terminated | found["truncated"].astype(bool)
        ends[-1] = True
        following = np.concatenate([found[field][1:], found[field][-1:]])
        if field == "obs":
            following[terminated] = found[field][terminated]
            ends &= ~terminated
        found = found | {f"next_{field}": following}
        keep &= ~ends
    if keep.sum() < 2:
        raise DatasetError(f"{name}: {keep.sum()} rows have a successor, need at least 2")
    return found, keep


def _check_states(where: str, qpos: np.ndarray, robot: Robot) -> None:
    """Check configurations [n, 7 + J]: position in m, orientation w x y z, joints in rad."""
    length = np.linalg.norm(qpos[:, 3:7], axis=1)
    row = int(np.argmax(np.abs(length - 1.0)))
    if abs(length[row] - 1.0) > UNIT_TOLERANCE:
        raise DatasetError(
            f"{where}: the quaternion has length {length[row]:.3g} in row {row}, need 1 (another"
            " order: position, then w x y z, then joints?)"
        )
    low, high = robot.joint_limits.T
    _check_range(
        where, qpos[:, 7:], low - LIMIT_MARGIN, high + LIMIT_MARGIN, robot.joints,
        f"degrees, or joints in another order than {robot.joints[0]}, {robot.joints[1]}, ...?",
    )  # fmt: skip
    _check_range(
        where, qpos[:, 2:3], np.array([-MAX_HEIGHT]), np.array([MAX_HEIGHT]), ("height",),
        "another unit than m?",
    )  # fmt: skip


def _check_spacing(name: str, motion: judging.Motion, robot: Robot) -> None:
    """Compare the way of the base between states with its velocity, which tells the rate."""
    way = (motion.next_qpos - motion.qpos)[:, :3]
    speed = 0.5 * (motion.qvel + motion.next_qvel)[:, :3]
    power = float((speed**2).sum(axis=1).mean())
    if power < LEAST_SPEED**2:
        return
    spacing, here = float((way * speed).sum(axis=1).mean()) / power, robot.control_dt
    if not 1.0 / RATE_TOLERANCE < spacing / here < RATE_TOLERANCE:
        raise DatasetError(
            f"{name}: by the way of the base and its velocity, states are {spacing:.3g} s apart,"
            f" and robot {robot.name} acts every {here:g} s (another rate, or velocities that are"
            " not m/s in the world frame?)"
        )


def _check_observations(
    name: str, data: Transition, layout: tuple[Entry, ...], robot: Robot
) -> None:
    """Check entries of both observations whose range the robot or geometry decides."""
    for field in ("obs", "next_obs"):
        _check_entries(f"{name}: {field}", np.asarray(getattr(data, field)), layout, robot)
    part = layout_slices(layout).get("previous_action[0]")
    if part is None:
        return
    action, goes_on = np.asarray(data.action), ~np.asarray(data.terminated)
    shown = np.asarray(data.next_obs)[:, part]
    off = (np.abs(shown - action) > 1e-3).any(axis=1) & goes_on
    if off.any():
        row = int(np.argmax(off))
        raise DatasetError(
            f"{name}: next_obs, previous_action[0]: {shown[row, 0]:.3g} in row {row}, where the"
            f" action is {action[row, 0]:.3g} (rows out of order, or next_obs of another step?)"
        )


def _check_entries(what: str, obs: np.ndarray, layout: tuple[Entry, ...], robot: Robot) -> None:
    low, high = robot.joint_limits.T
    guess = "degrees, another order of the observation, or normalised observations?"
    for entry, part in layout_slices(layout).items():
        values, plain = obs[:, part], entry.partition("[")[0].removeprefix("target_")
        where = f"{what}, {entry}"
        if plain == "joint_pos":
            _check_range(
                where, values, low - LIMIT_MARGIN, high + LIMIT_MARGIN, robot.joints, guess
            )
        elif plain == "previous_action":
            one = np.ones(values.shape[1])
            _check_range(where, values, -one, one, robot.joints, guess)
        elif plain == "roll_pitch":
            most = np.array([math.pi, math.pi / 2]) + 0.01
            _check_range(where, values, -most, most, ("roll", "pitch"), guess)
        elif plain in ("base_x_axis_w", "base_z_axis_w", "base_quat_h"):
            length = np.linalg.norm(values, axis=1)
            row = int(np.argmax(np.abs(length - 1.0)))
            if abs(length[row] - 1.0) > UNIT_TOLERANCE:
                raise DatasetError(
                    f"{where}: length {length[row]:.3g} in row {row}, need 1 (another order of the"
                    " observation, or normalised observations?)"
                )


def _check_range(
    where: str,
    values: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    names: tuple[str, ...],
    guess: str,
) -> None:
    beyond = np.maximum(low - values, values - high)
    row, column = np.unravel_index(int(np.argmax(beyond)), beyond.shape)
    if beyond[row, column] > 1e-4:
        value = values[row, column]
        raise DatasetError(
            f"{where}: {names[column]} is {value:.3g} in row {row}, limits {low[column]:.3g} to"
            f" {high[column]:.3g} ({guess})"
        )


def as_device(data: Transition) -> Transition:
    """Return transitions as device arrays."""
    return jax.tree.map(jnp.asarray, data)
