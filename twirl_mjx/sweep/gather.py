"""From finished runs to the committed tables: ``experiments/results/<grid>/<arm>.csv``.

Per arm a curve table (main metrics, at most ``MAX_POINTS`` rows each) and an episode table,
with comment lines that say what was reduced and which command makes the rows again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from twirl_mjx import files
from twirl_mjx.figures.style import METRICS
from twirl_mjx.figures.tables import CURVE_COLUMNS, EPISODE_COLUMNS
from twirl_mjx.sweep.grid import Grid
from twirl_mjx.sweep.plan import Cell, is_finished
from twirl_mjx.training.rundir import RunDir

MAX_POINTS = 100
"""Most rows of one metric of one run."""
EVALUATION = "eval/"
SETTING_COLUMNS = {"phi": "replay.phi", "utd": "droq.utd"}
"""Column -> config field; a table has the columns whose field varies in the grid."""

Row = dict[str, str]


def cells_of(columns: Sequence[str]) -> dict[str, Callable[[str], str]]:
    """Return the check of every column of a run's table: numbers keep their digits."""
    numbers = ("env_steps", "grad_steps", "wall_s", "value")
    return {name: files.number_text if name in numbers else str for name in columns}


def gather(grid: Grid, cells: Sequence[Cell], runs: Path, results: Path) -> list[Path]:
    """Write the tables of every arm with a finished run; drop those of arms or forms that are gone.

    Args:
        grid: The grid.
        cells: Its plan.
        runs: Folder of all runs.
        results: ``experiments/results``; the tables go into a folder of the grid in it.

    Returns:
        The files written.
    """
    folder = results / grid.results_name
    written = []
    columns = tuple(c for c, field in SETTING_COLUMNS.items() if field in grid.varied)
    arms = dict.fromkeys(cell.arm for cell in cells if cell.arm)
    for arm in arms:
        mine = [cell for cell in cells if cell.arm == arm]
        finished = [cell for cell in mine if is_finished(cell, runs)]
        if not finished:
            continue
        notes = notes_of(grid, len(finished), len(mine)) + nominal_notes(finished)
        curves = [row for cell in finished for row in curve_rows(cell, runs, columns)]
        episodes = [row for cell in finished for row in episode_rows(cell, runs, columns)]
        for suffix, header, rows in (
            ("", CURVE_COLUMNS, curves),
            (".episodes", EPISODE_COLUMNS, episodes),
        ):
            path = folder / f"{arm}{suffix}.csv"
            write_table(path, notes, (*header, *columns), rows)
            written.append(path)
    for path in stale_tables(folder, grid, set(arms)):
        path.unlink()
    return written


def notes_of(grid: Grid, finished: int, expected: int) -> list[str]:
    """Return the comment lines of a table."""
    lines = [f"# reduced: {grid.note}"] if grid.reduced else []
    lines += [f"# command: {grid.command}", f"# grid: {grid.results_name}"]
    if finished < expected:
        lines.append(f"# incomplete: {finished} of {expected} seeds")
    return lines


def nominal_notes(cells: Sequence[Cell]) -> list[str]:
    """Return the comment line that names the runs whose skill was adapted; none without a shift."""
    adapted = [Path(cell.source).name for cell in cells if cell.is_shifted]
    return [f"# nominal: {', '.join(dict.fromkeys(adapted))}"] if adapted else []


def stale_tables(folder: Path, grid: Grid, arms: set[str]) -> list[Path]:
    """Return tables this grid has written for arms, or in a form, that it no longer has."""
    expected = set(notes_of(grid, 1, 1))
    mark = f"# grid: {grid.results_name}"
    stale = []
    for path in sorted(folder.glob("*.csv")):
        notes = files.read_text(path, "a result table")[:2000].splitlines()
        arm = path.name.removesuffix(".csv").removesuffix(".episodes")
        if mark in notes and (arm not in arms or not expected.issubset(notes)):
            stale.append(path)
    return stale


def curve_rows(cell: Cell, runs: Path, columns: Sequence[str]) -> list[Row]:
    """Return the main metrics of a run; those of the evaluation at 0 where nothing was trained."""
    path = RunDir(runs / cell.name).metrics
    if cell.config.variant == "zero-shot" or not path.is_file():
        return _untrained_rows(cell, runs, columns)
    series: dict[str, list[Row]] = {}
    for row in files.read_rows(path, "the metrics of a run", cells_of(CURVE_COLUMNS)):
        name = row["metric"]
        if name.removeprefix(EVALUATION) in METRICS:
            series.setdefault(name, []).append(row | _settings(cell, columns))
    return [row for rows in series.values() for row in thin(rows)]


def _untrained_rows(cell: Cell, runs: Path, columns: Sequence[str]) -> list[Row]:
    values: dict[str, list[float]] = {}
    rows = episode_rows(cell, runs, columns)
    for row in rows:
        values.setdefault(row["metric"], []).append(float(row["value"]))
    return [
        {c: rows[0][c] for c in (*EPISODE_COLUMNS[:5], *columns)}
        | {"metric": EVALUATION + name, "env_steps": "0", "grad_steps": "0", "wall_s": "0"}
        | {"value": f"{sum(column) / len(column):.6g}"}
        for name, column in values.items()
    ]


def episode_rows(cell: Cell, runs: Path, columns: Sequence[str]) -> list[Row]:
    """Return the main metrics of every episode of a run's final evaluation."""
    path = RunDir(runs / cell.name).episodes
    rows = files.read_rows(path, "the evaluation of a run", cells_of(EPISODE_COLUMNS))
    return [row | _settings(cell, columns) for row in rows if row["metric"] in METRICS]


def _settings(cell: Cell, columns: Sequence[str]) -> Row:
    values = {"phi": cell.config.effective_phi, "utd": cell.config.droq.utd}
    trained = cell.config.variant != "zero-shot"
    return {column: f"{values[column]:g}" if trained else "" for column in columns}


def thin(rows: Sequence[Row], points: int = MAX_POINTS) -> list[Row]:
    """Return at most ``points`` rows, evenly spread, the first and the last among them."""
    if len(rows) <= points:
        return list(rows)
    last = len(rows) - 1
    return [rows[round(i * last / (points - 1))] for i in range(points)]


def write_table(
    path: Path, notes: Sequence[str], columns: Sequence[str], rows: Sequence[Row]
) -> None:
    """Write comment lines and rows, whole or not at all; numbers with six digits."""
    digits = {"value": ".6g", "wall_s": ".1f"}
    cells = [
        [format(float(row[c]), digits[c]) if c in digits else row.get(c, "") for c in columns]
        for row in rows
    ]
    files.write_csv(path, [columns, *cells], notes="".join(f"{line}\n" for line in notes))
