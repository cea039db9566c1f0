"""From finished runs to the committed tables: ``experiments/results/<grid>/<arm>.csv``.

Per arm a curve table (what is measured of episodes, at most ``MAX_POINTS`` rows each) and an
episode table, with comment lines that say what was reduced and which command makes the rows again.
An axis of the grid that tells apart arms which task, shift and variant do not is a column of both,
such as ``phi``. ``grid.json`` beside them says what the figures need to know of the grid. Tables of
a smoke grid are no results: they stay in ``runs/smoke/``.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path

from twirl_mjx import files
from twirl_mjx.figures.facts import EVALUATION, FILE
from twirl_mjx.figures.tables import CURVE_COLUMNS, EPISODE_COLUMNS
from twirl_mjx.sweep.describe import describe, facts, text_of
from twirl_mjx.sweep.grid import Grid
from twirl_mjx.sweep.plan import Cell, is_finished
from twirl_mjx.training.rundir import RunDir

MAX_POINTS = 100
"""Most rows of one metric of one run."""
_TAKEN = {*CURVE_COLUMNS, *EPISODE_COLUMNS, "arm", "label"}

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
        The tables written.
    """
    folder = tables_folder(grid, runs, results)
    written = []
    settings = settings_of(grid)
    columns = tuple(dict.fromkeys(c for row in settings.values() for c in row))
    arms = dict.fromkeys(cell.arm for cell in cells if cell.arm)
    for arm in arms:
        mine = [cell for cell in cells if cell.arm == arm]
        finished = [cell for cell in mine if is_finished(cell, runs)]
        if not finished:
            continue
        notes = notes_of(grid, len(finished), len(mine)) + nominal_notes(finished)
        dirs = [RunDir(runs / cell.name) for cell in finished]
        curves = [row | settings[arm] for run in dirs for row in curve_rows(run)]
        episodes = [row | settings[arm] for run in dirs for row in episode_rows(run)]
        for suffix, header, rows in (
            ("", CURVE_COLUMNS, curves),
            (".episodes", EPISODE_COLUMNS, episodes),
        ):
            path = folder / f"{arm}{suffix}.csv"
            write_table(path, notes, (*header, *columns), rows)
            written.append(path)
    if written:
        configs = [draft.config for draft in grid.drafts]
        orders = {c: list(dict.fromkeys(r[c] for r in settings.values() if r[c])) for c in columns}
        tasks, shifts = (c.task for c in configs), (c.shift for c in configs)
        shown = {**grid.shown, "smoke": grid.smoke}
        files.write_text(folder / FILE, text_of(facts(tasks, shifts, orders, shown)))
    for path in stale_tables(folder, grid, set(arms)):
        path.unlink()
    return written


def tables_folder(grid: Grid, runs: Path, results: Path) -> Path:
    """Return the folder of a grid's tables; those of a smoke grid stay beside the runs."""
    return (runs / "smoke" if grid.smoke else results) / grid.results_name


def settings_of(grid: Grid) -> dict[str, Row]:
    """Return arm -> column -> label, for the axes that tell apart arms of one variant.

    An axis counts if two arms of the same task, shift and variant differ on it. A label is written
    without the name of its axis in front (``tau0.01`` is 0.01), and is empty where the arm's block
    has no such axis. An axis named like a column of the tables gets ``axis_`` in front.
    """
    arms = {d.arm: (dict(d.labels), (d.config.task, d.config.shift, d.config.variant))
            for d in grid.drafts}  # fmt: skip
    columns: dict[str, Row] = {}
    for axis in dict.fromkeys(axis for labels, _ in arms.values() for axis in labels):
        seen: dict[tuple[str, ...], set[str]] = {}
        for labels, place in arms.values():
            seen.setdefault(place, set()).add(labels.get(axis, ""))
        if max(map(len, seen.values())) < 2:
            continue
        full = dict.fromkeys(labels[axis] for labels, _ in arms.values() if axis in labels)
        short = {label: label.removeprefix(axis).lstrip(" =_") or label for label in full}
        if len(set(short.values())) < len(short):
            short = {label: label for label in full}
        name = f"axis_{axis}" if axis in _TAKEN else axis
        columns[name] = {arm: short.get(labels.get(axis, ""), "") for arm, (labels, _) in
                         arms.items()}  # fmt: skip
    return {arm: {name: column[arm] for name, column in columns.items()} for arm in arms}


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


def curve_rows(run: RunDir) -> list[Row]:
    """Return what a run reports of episodes while it trains; the evaluation at 0 if untrained."""
    rows = episode_rows(run)
    if not run.metrics.is_file() or all(row["variant"] == "zero-shot" for row in rows):
        return _untrained_rows(rows)
    measures = {row["metric"] for row in rows}
    series: dict[str, list[Row]] = {}
    for row in files.read_rows(run.metrics, "the metrics of a run", cells_of(CURVE_COLUMNS)):
        if row["metric"].removeprefix(EVALUATION) in measures:
            series.setdefault(row["metric"], []).append(row)
    return [row for rows in series.values() for row in thin(rows)]


def _untrained_rows(rows: Sequence[Row]) -> list[Row]:
    values: dict[str, list[float]] = {}
    for row in rows:
        values.setdefault(row["metric"], []).append(float(row["value"]))
    return [
        {c: rows[0][c] for c in EPISODE_COLUMNS[:5]}
        | {"metric": EVALUATION + name, "env_steps": "0", "grad_steps": "0", "wall_s": "0"}
        | {"value": f"{sum(column) / len(column):.6g}"}
        for name, column in values.items()
    ]


def episode_rows(run: RunDir) -> list[Row]:
    """Return every measure of every episode of a run's final evaluation."""
    return files.read_rows(run.episodes, "the evaluation of a run", cells_of(EPISODE_COLUMNS))


def arm_of(run: RunDir) -> str:
    """Return the name of a run but for its seed, wherever that stands in it."""
    seed = rf"-s{run.read_config().seed}(?!\d)"
    return re.sub(rf"{seed}(?!.*{seed})", "", run.name)


def gather_runs(paths: Sequence[Path], results: Path) -> Path:
    """Write the tables of finished runs, one arm for those of one name but for the seed.

    Returns:
        The folder of the tables, in ``results``.

    Raises:
        ValueError: No run, or one that is not finished.
    """
    arms: dict[str, list[RunDir]] = {}
    for run in map(RunDir, paths):
        if not run.episodes.is_file():
            raise ValueError(f"{run} is not finished, and only finished runs are reported"
                             " (nearest: status:finished)")  # fmt: skip
        arms.setdefault(arm_of(run), []).append(run)
    if not arms:
        raise ValueError("no run to report")
    folder = results / "runs"
    for arm, runs in arms.items():
        for suffix, header, rows_of in (
            ("", CURVE_COLUMNS, curve_rows),
            (".episodes", EPISODE_COLUMNS, episode_rows),
        ):
            rows = [row | {"runs": arm} for run in runs for row in rows_of(run)]
            write_table(folder / f"{arm}{suffix}.csv", (), (*header, "runs"), rows)
    files.write_text(folder / FILE, text_of({"title": f"Runs: {', '.join(arms)}"}))
    describe(folder)
    return folder


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
