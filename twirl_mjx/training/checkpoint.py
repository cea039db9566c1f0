"""Checkpoints of a run: Orbax for the state, an append-only log for the online ring.

``checkpoints/policy`` holds the actor alone, ``checkpoints/train_state`` everything else that a
run needs to go on bit for bit. The online ring would dominate both wall time and disk, so each
checkpoint only writes the rows inserted since the last one (``checkpoints/replay``), and rows the
ring has overwritten are deleted. The frozen source ring is not stored: it is read again from its
dataset.

A checkpoint counts once its manifest is written, which is last (``manifests``): rows, state,
manifest, each forced to disk before the next. Then what is no longer needed goes, in the opposite
order. A damaged checkpoint is stepped over.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator, Set
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

from twirl_mjx import array_files, files
from twirl_mjx.policies.learned import BEST_POLICY
from twirl_mjx.training import manifests
from twirl_mjx.training.manifests import DamagedError
from twirl_mjx.training.state import TrainState

Refill = Callable[[TrainState], jax.Array]
"""Gives the rows [C, W] of an online ring for a state that was stored without them."""
KEEP = 2
"""Checkpoints kept, newest first; an interrupted write falls back on the one before."""


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _flatten(tree: Any) -> dict[str, np.ndarray]:
    """Return the leaves of a pytree by path, PRNG keys as their raw words, none without size."""
    leaves = jax.tree_util.tree_flatten_with_path(tree)[0]
    return {
        jax.tree_util.keystr(path, simple=True, separator="."): np.asarray(
            jax.random.key_data(leaf) if _is_key(leaf) else leaf
        )
        for path, leaf in leaves
        if leaf.size
    }


def _abstract(tree: Any) -> dict[str, jax.ShapeDtypeStruct]:
    """Return shapes and dtypes of what :func:`_flatten` gives, without any array."""

    def words(leaf: Any) -> Any:
        return jax.random.key_data(leaf) if _is_key(leaf) else leaf

    leaves = jax.tree_util.tree_flatten_with_path(
        jax.eval_shape(lambda t: jax.tree.map(words, t), tree)
    )[0]
    return {
        jax.tree_util.keystr(path, simple=True, separator="."): leaf
        for path, leaf in leaves
        if leaf.size
    }


def _unflatten(template: Any, values: dict[str, np.ndarray]) -> Any:
    """Return ``template`` with its leaves replaced by ``values`` of the same paths."""
    paths, treedef = jax.tree_util.tree_flatten_with_path(template)
    leaves = []
    for path, leaf in paths:
        name = jax.tree_util.keystr(path, simple=True, separator=".")
        if not leaf.size:
            leaves.append(jnp.zeros(leaf.shape, leaf.dtype))
            continue
        if name not in values:
            raise ValueError(f"the checkpoint has no {name}: it is of another version or task")
        value = values[name]
        if _is_key(leaf):
            leaves.append(jax.random.wrap_key_data(jnp.asarray(value)))
            continue
        if value.shape != leaf.shape:
            raise ValueError(f"checkpoint {name} has shape {value.shape}, need {leaf.shape}")
        leaves.append(jnp.asarray(value, leaf.dtype))
    return jax.tree.unflatten(treedef, leaves)


class Checkpoints:
    """The checkpoints of one run directory."""

    def __init__(self, run_dir: Path) -> None:
        """Open (and create) ``run_dir/checkpoints``; leftovers of a killed save are deleted."""
        self._run_dir = run_dir
        self._root = (run_dir / "checkpoints").resolve()
        self._replay = self._root / "replay"
        files.make_folders(self._replay)
        manifests.begin(self._root)
        self.stepped_over: str | None = None
        """What :meth:`restore` found damaged and where it went on from, as a line."""
        self.refilled = False
        """Whether :meth:`restore` had the rows of the ring gathered anew."""
        cut_short = set(manifests.stored(self._root)) - set(manifests.visible(self._root))
        for folder in (
            *self._root.glob("orbax/*.orbax-checkpoint-tmp*"),
            *(manifests.folder_of(self._root, step) for step in cut_short),
        ):
            shutil.rmtree(folder)
        self._manager = ocp.CheckpointManager(
            self._root / "orbax",
            item_names=("policy", "train_state", "progress"),
            options=ocp.CheckpointManagerOptions(  # all are kept here: a save prunes once sealed
                max_to_keep=None, create=True, enable_async_checkpointing=False
            ),
        )

    def latest(self) -> int | None:
        """Return the env steps of the newest checkpoint, None without one."""
        return newest_checkpoint(self._run_dir)

    def back_to(self, step: int, *, rows: bool = True) -> None:
        """Delete the checkpoints after ``step``, which is one of them.

        Args:
            step: Env steps at which the run goes on, because others have nothing newer.
            rows: Whether the rows of the replay have to be whole, too.

        Raises:
            DamagedError: There are later ones, and none up to ``step`` is whole; all are kept.
        """
        steps = manifests.visible(self._root)
        later = [kept for kept in steps if kept > step]
        if later and not any(
            manifests.is_whole(self._root, kept, rows=rows) for kept in steps if kept <= step
        ):
            raise DamagedError(
                f"{self._run_dir}: its checkpoint at {step:,} transitions, the newest that all runs"
                f" have, is damaged; nothing was deleted (nearest: train it alone, from"
                f" {later[-1]:,})"
            )
        for newer in reversed(later):
            self._delete(newer)

    def save(self, state: TrainState, progress: dict[str, Any]) -> None:
        """Write a checkpoint; a second save at the same env steps does nothing.

        Args:
            state: State of one run.
            progress: JSON-able facts of the Python loop (best score, wall time, ...).
        """
        step = int(state.env_steps)
        if step in manifests.visible(self._root):
            return
        kept = self.latest()
        try:
            self._write(step, state, progress)
        except Exception as error:
            at = "no checkpoint yet" if kept is None else f"the checkpoint at {kept:,} transitions"
            error.add_note(f"saved: {at}")
            if isinstance(error, OSError) and error.filename is None:
                error.filename = f"{self._root}{os.sep}"  # a write that failed names no file
            raise
        self._prune(state.replay.online.capacity)

    def _write(self, step: int, state: TrainState, progress: dict[str, Any]) -> None:
        """Write the rows, then the state, then the manifest."""
        self._append_rows(state)
        bare = state.replace(replay=state.replay.replace(source=None, online=_bare(state)))
        self._manager.save(
            step,
            args=ocp.args.Composite(
                policy=ocp.args.StandardSave(_flatten(state.learner.actor)),
                train_state=ocp.args.StandardSave(_flatten(bare)),
                progress=ocp.args.JsonSave(progress),
            ),
        )
        self._manager.wait_until_finished()
        total = int(state.inserted)
        begin = total - state.replay.online.capacity
        rows = [path for _, end, path in _segments(self._replay) if end > begin]
        manifests.seal(self._root, step, total, rows)

    def restore(
        self, template: TrainState, refill: Refill | None = None
    ) -> tuple[TrainState, dict[str, Any]]:
        """Return the newest good checkpoint as a state shaped like ``template``, and its progress.

        Damaged ones are stepped over: ``stepped_over`` says so, and they are deleted, since the
        run will write them again. The source ring is taken from ``template``. With ``refill`` a
        checkpoint is good whose rows alone are missing or damaged: they are gathered anew and
        stored, and the older checkpoints, which need the old ones, are deleted.

        Raises:
            FileNotFoundError: There is none.
            DamagedError: None is whole; nothing is deleted.
            ValueError: It does not fit the template.
        """
        steps = manifests.visible(self._root)
        if not steps:
            raise FileNotFoundError(f"no checkpoint in {self._root}")
        damage: list[str] = []
        for step in reversed(steps):
            try:
                manifests.check(self._root, step, rows=refill is None)
                found = self._read(step, template, refill)
            except DamagedError as error:
                damage.append(str(error))
                continue
            if damage:
                for bad in steps[steps.index(step) + 1 :]:
                    self._delete(bad)
                self.stepped_over = (
                    f"{damage[0]}; going on from the checkpoint before it, at {step:,} transitions"
                )
            return found
        told = f"{damage[0]}; no checkpoint of {self._run_dir} is whole, so it cannot go on. "
        if refill is None and any(
            manifests.is_whole(self._root, step, rows=False) for step in steps
        ):
            raise DamagedError(
                told + "Only its replay is missing or damaged (nearest: --refill, which gathers as"
                " much anew with its policy)"
            )
        raise DamagedError(
            told + "Give another --name; its policy can start that run: --variant weights --source"
            f" {self._run_dir / BEST_POLICY}"
        )

    def _read(
        self, step: int, template: TrainState, refill: Refill | None
    ) -> tuple[TrainState, dict[str, Any]]:
        """Return one checkpoint; rows that are not whole come from ``refill``, and are stored."""
        bare = template.replace(replay=template.replay.replace(source=None, online=_bare(template)))
        flat = _abstract(bare)
        try:
            found = self._manager.restore(
                step,
                args=ocp.args.Composite(
                    train_state=ocp.args.StandardRestore(flat), progress=ocp.args.JsonRestore()
                ),
            )
        except ValueError:
            self._check_parts(step, flat.keys())
            raise
        state = _unflatten(bare, {k: np.asarray(v) for k, v in found["train_state"].items()})
        if refill is None or manifests.is_whole(self._root, step):
            rows = self._read_rows(state, template)
        else:
            rows = refill(state)
            self._store_anew(step, int(state.inserted), np.asarray(rows))
        replay = template.replay.replace(online=state.replay.online.replace(rows=rows))
        return state.replace(replay=replay), dict(found["progress"])

    def _store_anew(self, step: int, total: int, rows: np.ndarray) -> None:
        """Put the rows of a ring [C, W] in the place of the log, for one checkpoint alone."""
        for older in manifests.visible(self._root):
            if older < step:
                self._delete(older)
        for _, _, path in _segments(self._replay):
            path.unlink()
        first = max(0, total - len(rows))
        target = self._segment(first, total)
        array_files.write_npy(target, rows[np.arange(first, total) % len(rows)])
        manifests.seal(self._root, step, total, [target])
        self.refilled = True

    def _segment(self, first: int, end: int) -> Path:
        return self._replay / f"rows_{first:012d}_{end:012d}.npy"

    def _check_parts(self, step: int, names: Set[str]) -> None:
        """Raise ValueError where a stored state has other parts than ``names``."""
        stored = _train_state(self._manager, step).keys()
        if other := sorted(stored ^ names):
            where = "only in the checkpoint" if other[0] in stored else "not in the checkpoint"
            raise ValueError(
                f"{self._run_dir} was written by another version of this program (versions.json):"
                f" {len(other)} parts of the state differ ({other[0]} is {where}). Go on with that"
                " version, or give another --name"
            )

    def close(self) -> None:
        """Release the manager."""
        self._manager.close()

    def _append_rows(self, state: TrainState) -> None:
        """Write the online rows inserted since the last checkpoint."""
        total = int(state.inserted)
        capacity = state.replay.online.capacity
        latest = self.latest()
        logged = 0 if latest is None else self._logged(latest)
        for first, _, path in _segments(self._replay):  # left by a run that died after writing them
            if first >= logged:
                path.unlink()
        stored = max([end for _, end, _ in _segments(self._replay)], default=0)
        first = max(stored, total - capacity)
        if first >= total:
            return
        rows = np.asarray(state.replay.online.rows)[np.arange(first, total) % capacity]
        array_files.write_npy(self._segment(first, total), rows)

    def _logged(self, step: int) -> int:
        """Return how many rows had been inserted at a checkpoint."""
        sealed = manifests.inserted_at(self._root, step)
        return _inserted(self._manager, step) if sealed is None else sealed

    def _read_rows(self, state: TrainState, template: TrainState) -> jax.Array:
        """Rebuild the rows of the online ring from the log."""
        online = template.replay.online
        total, capacity = int(state.inserted), online.capacity
        rows = np.zeros(online.rows.shape, np.float32)
        begin = max(0, total - capacity)
        for first, part in _stored_rows(self._replay, begin, total):
            rows[np.arange(first, first + len(part)) % capacity] = part
        return jnp.asarray(rows)

    def _prune(self, capacity: int) -> None:
        """Delete all but the newest checkpoints, then the rows that none of those needs."""
        steps = manifests.visible(self._root)
        for step in steps[:-KEEP]:
            self._delete(step)
        oldest = min(self._logged(step) for step in steps[-KEEP:])
        for _, end, path in _segments(self._replay):
            if end <= oldest - capacity:
                path.unlink()

    def _delete(self, step: int) -> None:
        manifests.forget(self._root, step)
        self._manager.delete(step)


def _inserted(manager: ocp.CheckpointManager, step: int) -> int:
    """Return how many rows had been inserted, as the state of a checkpoint tells."""
    found = manager.restore(step, args=ocp.args.Composite(progress=ocp.args.JsonRestore()))
    return int(found["progress"]["inserted"])


def _segments(folder: Path) -> list[tuple[int, int, Path]]:
    """Return (first, end, path) of the row ranges in a replay log, in order."""
    found = []
    for path in folder.glob("rows_*.npy"):
        first, end = map(int, path.stem.split("_")[1:])
        found.append((first, end, path))
    return sorted(found)


def _stored_rows(folder: Path, begin: int, end: int) -> Iterator[tuple[int, np.ndarray]]:
    """Yield the rows ``begin`` to ``end`` of a replay log piece by piece, each with its first row.

    Between two checkpoints the ring may have gone round, so a log has gaps; none is in the range
    that the ring of a checkpoint holds.

    Raises:
        ValueError: A row of the range is missing.
    """
    have = begin
    for first, last, path in _segments(folder):
        if last <= have or first >= end:
            continue
        if first > have:
            break
        part = array_files.read_npy(path, "rows of a replay log")[have - first : end - first]
        yield have, part
        have += len(part)
    if have < end:
        raise ValueError(f"the replay log in {folder} lacks row {have} of {begin} to {end - 1}")


def _bare(state: TrainState) -> Any:
    """Return the online ring without its rows."""
    return state.replay.online.replace(rows=jnp.zeros((0, 0), jnp.float32))


def has_checkpoint(run_dir: Path) -> bool:
    """Return whether a run can be resumed; nothing is created."""
    return newest_checkpoint(run_dir) is not None


def lacks_replay(run_dir: Path) -> bool:
    """Return whether a run can be resumed, but for its replay, of which nothing is there."""
    return has_checkpoint(run_dir) and not _segments(run_dir / "checkpoints" / "replay")


def newest_checkpoint(run_dir: Path) -> int | None:
    """Return the env steps of a run's newest checkpoint, None without one; nothing is created."""
    return max(stored_steps(run_dir), default=None)


def stored_steps(run_dir: Path) -> list[int]:
    """Return the env steps of the checkpoints of a run, oldest first; nothing is created."""
    return manifests.visible((run_dir / "checkpoints").resolve())


def _open(run_dir: Path) -> tuple[ocp.CheckpointManager, int]:
    """Return the manager of a run and the step of its newest checkpoint, checked.

    Raises:
        FileNotFoundError: The run has no checkpoint.
        DamagedError: The newest is damaged. An older one would be another source.
    """
    root = (run_dir / "checkpoints").resolve()
    steps = manifests.visible(root)
    if not steps:
        raise FileNotFoundError(f"{run_dir} has no checkpoint: its train state is needed here")
    manifests.check(root, steps[-1])
    items = ("policy", "train_state", "progress")
    return ocp.CheckpointManager(root / "orbax", item_names=items), steps[-1]


def _train_state(manager: ocp.CheckpointManager, step: int) -> dict[str, Any]:
    """Return the stored arrays by their names, whatever they are."""
    args = ocp.args.Composite(train_state=ocp.args.StandardRestore())
    return manager.restore(step, args=args)["train_state"]


def load_learner(run_dir: Path) -> dict[str, Any]:
    """Return actor, critic, target_critic and log_temperature of a run's newest checkpoint.

    Raises:
        FileNotFoundError: The run has no checkpoint.
        DamagedError: The newest is damaged.
    """
    manager, step = _open(run_dir)
    flat = _train_state(manager, step)
    manager.close()
    nested: dict[str, Any] = {}
    for name, value in flat.items():
        parts = name.split(".")
        if parts[0] != "learner":
            continue
        node = nested
        for part in parts[1:-1]:
            node = node.setdefault(part, {})
        node[parts[-1]] = jnp.asarray(value)
    return {k: nested[k] for k in ("actor", "critic", "target_critic", "log_temperature")}


def load_replay(run_dir: Path, capacity: int) -> np.ndarray:
    """Return the packed rows [n, W] of the online ring at a run's newest checkpoint, in order.

    The log also keeps rows that the ring has overwritten since; they are left out.

    Args:
        run_dir: Directory of the run.
        capacity: Rows that its ring holds.

    Raises:
        FileNotFoundError: The run has no checkpoint or no stored experience.
        DamagedError: The newest checkpoint is damaged.
        ValueError: Rows of the replay log are missing.
    """
    manager, step = _open(run_dir)
    total = _inserted(manager, step)
    manager.close()
    folder = run_dir / "checkpoints" / "replay"
    if not _segments(folder):
        raise FileNotFoundError(f"{run_dir} has no stored experience")
    begin = max(0, total - capacity)
    return np.concatenate([part for _, part in _stored_rows(folder, begin, total)])
