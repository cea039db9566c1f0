"""The tidy ``metrics.csv``."""

from __future__ import annotations

import csv
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TextIO

from twirl_mjx import files
from twirl_mjx.training.sinks.base import IDENTITY, RunInfo

FINAL = "eval/final_"
"""How the metrics of the evaluation that closes a run begin."""
CSV_NAME = "metrics.csv"
COLUMNS = (*IDENTITY, "metric", "env_steps", "grad_steps", "wall_s", "value")
"""Columns of ``metrics.csv``, one row per metric and epoch."""


class Table:
    """Appends to ``metrics.csv``, every epoch forced to disk."""

    def open(self, run: RunInfo) -> None:
        """Open the table: from the resumed checkpoint on, or anew.

        Raises:
            ValueError: A table with other columns lies there.
        """
        path = run.directory / CSV_NAME
        resumes = run.resume_env_steps is not None and path.exists()
        self.earlier_s, reached = 0.0, 0
        """``wall_s`` of the last row kept."""
        begin = run.resume_env_steps or 0
        if resumes:
            closes_again = begin >= run.total_env_steps
            self.earlier_s, reached = truncate_csv(path, begin, closes_again=closes_again)
        self.lacks = (
            f"{path} ends at {reached:,} transitions and the run goes on at {begin:,}: the rows"
            " between are lost (its checkpoints and policies are not affected)"
            if reached < begin
            else None
        )
        """What a resumed run finds missing, as a line."""
        self._identity = [run.identity[name] for name in IDENTITY]
        self._file: TextIO = path.open("a" if resumes else "w", newline="")
        self._csv = csv.writer(self._file, lineterminator="\n")
        if not resumes:
            self._csv.writerow(COLUMNS)
            self._sync()
            files.sync(run.directory)  # its name, too, outlives a power cut

    def log(
        self, env_steps: int, grad_steps: int, wall_s: float, values: Mapping[str, float]
    ) -> None:
        """Append one row for each value."""
        for name, value in values.items():
            tail = [name, env_steps, grad_steps, f"{wall_s:.3f}", f"{value:.9g}"]
            self._csv.writerow([*self._identity, *tail])
        self._sync()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _sync(self) -> None:
        self._file.flush()
        os.fsync(self._file.fileno())


def truncate_csv(path: Path, env_steps: int, *, closes_again: bool = False) -> tuple[float, int]:
    """Drop the rows after ``env_steps``, and any row a crash left unfinished.

    Args:
        path: a ``metrics.csv``; the file is replaced whole.
        env_steps: transitions at the checkpoint the run resumes from.
        closes_again: whether nothing is left but the final evaluation, whose rows are dropped too.

    Returns:
        ``wall_s`` and transitions of the last row kept, 0 without rows.

    Raises:
        ValueError: the file has other columns, or a damaged row before its last.
    """
    what = f"a metrics table with columns {','.join(COLUMNS)}"
    rows = files.read_rows(
        path, what, {"env_steps": int, "wall_s": files.number_text}, growing=True
    )
    if rows and tuple(rows[0]) != COLUMNS:
        raise ValueError(f"{path} has columns {list(rows[0])}, expected {list(COLUMNS)}")
    kept = [row for row in rows if row["env_steps"] <= env_steps]
    if closes_again:
        kept = [
            row
            for row in kept
            if row["env_steps"] < env_steps or not row["metric"].startswith(FINAL)
        ]
    files.write_csv(path, [COLUMNS, *(list(row.values()) for row in kept)])
    return (float(kept[-1]["wall_s"]), kept[-1]["env_steps"]) if kept else (0.0, 0)
