"""Train for a long time and watch the process: memory, open files, disk, cost of checkpoints.

    python tests/faults/soak.py TABLE.csv train --task biped --variant scratch --preset cpu

Writes a row a minute: wall time (s), resident memory (MB), open files, threads, size of the run's
folder (MB), checkpoints so far and the time they took (s). What it trains is an ordinary run.
"""

from __future__ import annotations

import contextlib
import csv
import sys
import threading
import time
from pathlib import Path

import psutil

from twirl_mjx import cli
from twirl_mjx.training.checkpoint import Checkpoints

FIELDS = ("wall_s", "rss_mb", "files", "threads", "disk_mb", "checkpoints", "checkpoint_s")
PERIOD = 60.0


def size_of(folder: Path) -> int:
    """Return the bytes of the files below a folder; those that vanish meanwhile do not count."""
    total = 0
    for path in folder.rglob("*"):
        with contextlib.suppress(OSError):
            total += path.lstat().st_size
    return total


def watch(table: Path, spent: list[float], folders: set[Path]) -> None:
    """Write a row every ``PERIOD`` s, for as long as the process lives."""
    begin, process = time.monotonic(), psutil.Process()
    with table.open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(FIELDS)
        while True:
            megabytes = (process.memory_info().rss / 1e6, sum(map(size_of, folders)) / 1e6)
            rss, disk = (round(size, 1) for size in megabytes)
            wall, handles = round(time.monotonic() - begin, 1), process.num_fds()
            numbers = (wall, rss, handles, process.num_threads(), disk, len(spent))
            rows.writerow((*numbers, round(sum(spent), 3)))
            file.flush()
            time.sleep(PERIOD)


def main(table: Path, argv: list[str]) -> int:
    """Run the command line under watch; return its exit status."""
    spent: list[float] = []
    folders: set[Path] = set()
    save = Checkpoints.save

    def timed(self: Checkpoints, *args: object) -> None:
        folders.add(self._run_dir)
        begin = time.monotonic()
        save(self, *args)  # type: ignore[arg-type]
        spent.append(time.monotonic() - begin)

    Checkpoints.save = timed  # type: ignore[method-assign]
    threading.Thread(target=watch, args=(table, spent, folders), daemon=True).start()
    return cli.main(argv)


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), sys.argv[2:]))
