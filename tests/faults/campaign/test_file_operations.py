"""A run is killed, or its disk refuses, at every file operation: it goes on and ends equal."""

from __future__ import annotations

import errno
import hashlib
import itertools
import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from twirl_mjx import exits, faults

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]


def digest(folder: Path) -> str:
    """Return what tells one state of a folder from another."""
    found = hashlib.sha256()
    for path in sorted(folder.rglob("*")):
        found.update(f"{path.relative_to(folder)}\0".encode())
        if path.is_file():
            found.update(hashlib.sha256(path.read_bytes()).digest())
    return found.hexdigest()


def test_killed_at_any_file_operation(
    small: Any,
    watch: Any,
    tally: Any,
    spread: Any,
    copy_now: Callable[[Path, Path], Path],
    tmp_path: Path,
) -> None:
    """A copy of the folder in the middle of an operation is what SIGKILL would have left then.

    What Python holds in buffers is in neither, and what the kernel holds is in both.
    """
    runs, lock, numbers = tmp_path / "runs", threading.Lock(), itertools.count()
    states: dict[str, Path] = {}

    def keep(event: str, path: str) -> None:
        with lock:
            taken = copy_now(runs, tmp_path / f"state{next(numbers):04d}")
            states.setdefault(digest(taken), taken)

    runs.mkdir()
    with watch.over(runs, keep):
        small.train(runs)
    assert len(states) > 60
    for number, folder in enumerate(spread(states.values())):
        what = f"state {number} in {folder}"
        tally.judge("kill at a file operation of a run", what, lambda f=folder: small.ends_equal(f))
    tally.check()


@pytest.mark.parametrize(
    ("number", "status"), [(errno.ENOSPC, exits.NO_SPACE), (errno.EROFS, exits.UNUSABLE)]
)
def test_a_disk_that_refuses_any_file_operation(
    number: int, status: int, small: Any, watch: Any, tally: Any, spread: Any, tmp_path: Path
) -> None:
    """From one operation on all of them fail: one line, its exit status, and it goes on later."""
    seen: list[str] = []
    with watch.over(tmp_path, lambda event, path: seen.append(path)):
        small.train(tmp_path / "whole")
    name = errno.errorcode[number]
    for point in spread(range(len(seen)), 0.5):
        runs, count = tmp_path / f"runs{point:04d}", [0]

        def refuse(event: str, path: str, point: int = point, count: list[int] = count) -> None:
            count[0] += 1
            if count[0] > point:
                raise OSError(number, os.strerror(number), path)

        runs.mkdir()
        try:
            with watch.over(runs, refuse):
                small.train(runs)
        except Exception as error:
            fault = faults.explain(error)
            good = fault.status == status and "\n" not in fault.text
            if not good:
                what = f"{name} at operation {point}: status {fault.status}: {fault.text}"
                tally.add(f"{name} at a file operation of a run", "fell short", what)
                continue
        what = f"{name} at operation {point}, then space in {runs}"
        kind = f"{name} at a file operation of a run"
        tally.judge(kind, what, lambda runs=runs: small.ends_equal(runs))
    tally.check()


def test_a_power_cut_at_any_moment(
    small: Any, tally: Any, spread: Any, disk: Any, tmp_path: Path
) -> None:
    """What was not forced to disk is lost; what is left goes on to the same end."""
    cuts: dict[str, Path] = {}
    lock, numbers = threading.Lock(), itertools.count()

    def note() -> None:
        with lock:
            taken = tmp_path / f"cut{next(numbers):04d}"
            disk.after_the_cut(taken)
            cuts.setdefault(digest(taken), taken)

    disk.at_sync = note
    small.train(disk.root)
    disk.at_sync = lambda: None
    assert len(cuts) > 20
    for folder in spread(cuts.values()):
        tally.judge("power cut", str(folder), lambda f=folder: small.ends_equal(f))
    tally.check()
