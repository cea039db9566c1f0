"""The decisions of a contest (``sweep.contest``): their table, and what follows from it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from twirl_mjx import files
from twirl_mjx.figures.statistics import Interval, bootstrap, mean
from twirl_mjx.figures.wording import interval_text

GOES_ON, DROPPED, OPEN = 1, 0, -1
"""What can become of a candidate: OPEN until its rung is whole."""
ON = "-on"
"""How the run of a candidate ends that learns with the settings of its source."""


class Decision(NamedTuple):
    """How a candidate was judged at the end of a rung; a row of the table."""

    round: int
    """0: a source as it is, which nothing was trained for."""
    rung: int
    """Counts from 1 in every round."""
    run: str
    """Name of the run; empty for a source as it is."""
    stage: str
    """Name of the stage."""
    source: str
    """Name of a source that was given, or of a run of an earlier round."""
    env_steps: int
    """Transitions of the run so far."""
    spent: int
    """Transitions of the contest so far."""
    value: float
    """Mean of the measure; NaN where the run diverged."""
    low: float
    """Lower end of its 95 % interval over episodes."""
    high: float
    """Upper end of it."""
    kept: int = OPEN
    """Whether it goes on."""


CELLS: dict[str, Callable[[str], Any]] = {
    "round": int, "rung": int, "run": str, "stage": str, "source": str, "env_steps": int,
    "spent": int, "value": float, "low": float, "high": float, "kept": int,
}  # fmt: skip
"""Column of the table -> what turns a cell into its value."""


def read_decisions(path: Path) -> list[Decision]:
    """Return the decisions in a table.

    Raises:
        FileError: It is none; the message has the line.
    """
    rows = files.read_rows(path, "the decisions of a contest", CELLS)
    return [Decision(*(row[name] for name in Decision._fields)) for row in rows]


def write_decisions(path: Path, rows: Sequence[Decision], measure: str) -> None:
    """Write decisions as a table that names its measure, whole or not at all."""
    table = [Decision._fields, *([_cell(value) for value in row] for row in rows)]
    files.write_csv(path, table, f"# measure: {measure}\n")


def _cell(value: object) -> object:
    return repr(value) if isinstance(value, float) else value


def estimate(values: np.ndarray) -> tuple[float, float, float]:
    """Return mean and 95 % interval of episodes [E]; those without the measure do not count."""
    measured = np.asarray(values, np.float64)
    measured = measured[~np.isnan(measured)]
    if not len(measured):
        return (np.nan, np.nan, np.nan)
    found = bootstrap([measured], mean)
    return (found.estimate, found.low, found.high)


def shown(row: Decision) -> str:
    """Return the value of a decision with its interval, as text."""
    return interval_text(Interval(row.value, row.low, row.high, "episodes"))


def ancestry(rows: Sequence[Decision], run: str) -> list[Decision]:
    """Return the last decision on every run that leads to ``run``, oldest first."""
    last = {row.run: row for row in rows if row.run}
    line: list[Decision] = []
    while run in last:
        line.append(last[run])
        run = last[run].source
    return line[::-1]
