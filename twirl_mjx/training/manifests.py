"""Which checkpoints of a run are whole: a manifest for each names its files and their checksums.

``checkpoints/manifests/STEP.json`` is the last thing that a save writes, after everything it names
has been forced to disk, and the first thing that goes when a checkpoint is deleted. A checkpoint
without one is therefore a save that was cut short, and does not count. Those that a version
before 0.2 has left are listed in ``checkpoints/unsealed.json`` and are read unchecked.

Layout: ``checkpoints/orbax/STEP/`` the state, ``checkpoints/replay/rows_FIRST_END.npy`` the rows.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from twirl_mjx import files

WHAT = "the manifest of a checkpoint"
ROWS = "replay/"
"""How the names of files with rows begin."""


class DamagedError(ValueError):
    """A checkpoint with a file that is not what was saved; the message names the file."""


def folder_of(root: Path, step: int) -> Path:
    """Return where the state of a checkpoint lies."""
    return root / "orbax" / str(step)


def path_of(root: Path, step: int) -> Path:
    """Return where the manifest of a checkpoint lies."""
    return root / "manifests" / f"{step}.json"


def stored(root: Path) -> list[int]:
    """Return the steps whose state is there, whole or not, in order."""
    names = (path.name for path in (root / "orbax").glob("*") if path.is_dir())
    return sorted(int(name) for name in names if name.isdecimal())


def visible(root: Path) -> list[int]:
    """Return the steps of the checkpoints that count, in order; nothing is checked or created."""
    if not (root / "manifests").is_dir():
        return stored(root)
    unsealed = _unsealed(root)
    return [s for s in stored(root) if path_of(root, s).exists() or s in unsealed]


def begin(root: Path) -> None:
    """Prepare the folder of a run for sealing: from now on a checkpoint needs a manifest."""
    if (root / "manifests").is_dir():
        return
    if old := stored(root):
        files.write_json(root / "unsealed.json", old)
    files.make_folders(root / "manifests")


def seal(root: Path, step: int, inserted: int, rows: Iterable[Path]) -> None:
    """Force a checkpoint to disk and make it visible.

    Args:
        root: ``checkpoints`` of the run.
        step: Env steps of the checkpoint, whose state is in :func:`folder_of`.
        inserted: Rows inserted so far.
        rows: Files with the rows of its ring, on disk already.
    """
    folder = folder_of(root, step)
    state = sorted(path for path in folder.rglob("*") if path.is_file())
    folders = [path for path in folder.rglob("*") if path.is_dir()]
    for path in (*state, *folders, folder, folder.parent, root):
        files.sync(path)
    known = _sums_of_the_one_before(root, step)
    sums = {}
    for path in (*state, *rows):
        name = path.relative_to(root).as_posix()
        sums[name] = known.get(name) or files.checksum(path)
    record = {"inserted": inserted, "files": sums}
    files.write_json(path_of(root, step), record | {"own": _own_sum(record)})


def inserted_at(root: Path, step: int) -> int | None:
    """Return how many rows had been inserted, None for a checkpoint without a manifest.

    Raises:
        DamagedError: The manifest is damaged.
    """
    return None if _is_unsealed(root, step) else _read(root, step)[0]


def check(root: Path, step: int, *, rows: bool = True) -> None:
    """Compare every file of a checkpoint with its checksum; without a manifest nothing is known.

    Args:
        root: ``checkpoints`` of the run.
        step: Env steps of the checkpoint.
        rows: Whether the rows of its ring are among them.

    Raises:
        DamagedError: A file, or the manifest, is missing or damaged.
    """
    if _is_unsealed(root, step):
        return
    for name, expected in _read(root, step)[1].items():
        if name.startswith(ROWS) and not rows:
            continue
        path = root / name
        if not path.is_file():
            raise DamagedError(f"{path} is missing")
        if files.checksum(path) != expected:
            raise DamagedError(f"{path} is damaged: its checksum is not that of what was saved")


def is_whole(root: Path, step: int, *, rows: bool = True) -> bool:
    """Return whether :func:`check` finds nothing."""
    try:
        check(root, step, rows=rows)
    except DamagedError:
        return False
    return True


def forget(root: Path, step: int) -> None:
    """Make a checkpoint invisible, for good even if the power is cut."""
    if _is_unsealed(root, step):
        files.write_json(root / "unsealed.json", sorted(_unsealed(root) - {step}))
        return
    path_of(root, step).unlink(missing_ok=True)
    files.sync(root / "manifests")


def _unsealed(root: Path) -> set[int]:
    path = root / "unsealed.json"
    if not path.exists():
        return set()
    found = files.read_json(path, "the list of checkpoints without a manifest")
    if not isinstance(found, list) or not all(isinstance(step, int) for step in found):
        raise files.FileError(f"{path} holds {found!r}, expected a list of env steps")
    return set(found)


def _is_unsealed(root: Path, step: int) -> bool:
    return not path_of(root, step).exists() and (
        not (root / "manifests").is_dir() or step in _unsealed(root)
    )


def _read(root: Path, step: int) -> tuple[int, dict[str, str]]:
    path = path_of(root, step)
    try:
        found = files.read_json(path, WHAT)
        if found.pop("own") != _own_sum(found):
            raise ValueError("its checksum is not that of what was saved")
        return int(found["inserted"]), dict(found["files"])
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise DamagedError(f"{path} is damaged: {error}") from error


def _own_sum(record: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()


def _sums_of_the_one_before(root: Path, step: int) -> dict[str, str]:
    """Return the checksums of rows that an earlier checkpoint has already sealed."""
    known: dict[str, str] = {}
    for earlier in visible(root):
        if earlier < step and path_of(root, earlier).exists():
            try:
                sums = _read(root, earlier)[1]
            except DamagedError:
                continue
            known |= {name: value for name, value in sums.items() if name.startswith(ROWS)}
    return known
