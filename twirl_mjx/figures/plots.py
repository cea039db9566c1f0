"""Rebuild every figure from ``experiments/results/<grid>/``, and from nothing else."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from matplotlib.figure import Figure

from twirl_mjx import files
from twirl_mjx.figures.aggregate import statistics_of
from twirl_mjx.figures.bars import ablation, shift_bars
from twirl_mjx.figures.canvas import write_png
from twirl_mjx.figures.cells import groups, lead_metrics, ordered, shown_metrics
from twirl_mjx.figures.curves import learning_curves
from twirl_mjx.figures.errors import TableError
from twirl_mjx.figures.facts import read_facts
from twirl_mjx.figures.tables import Table, mask, read_directory

__all__ = ["Drawing", "ablation", "drawings", "learning_curves", "make_figures", "read_grids"]
__all__ += ["shift_bars"]


@dataclass(frozen=True)
class Drawing:
    """A figure that can be drawn from a table."""

    name: str
    """File name without ending, for example ``phi_ablation_return_iqm``."""
    kind: str
    """``curves``, ``bars`` or ``ablation``."""
    metric: str
    """Metric drawn."""
    statistic: str
    """One of ``aggregate.STATISTICS``."""
    draw: Callable[[str], Figure]
    """Function of the theme's name."""


def read_grids(
    results_dir: str | Path, say: Callable[[str], None] = print
) -> dict[str, tuple[Table | None, Table | None]]:
    """Read every grid below a directory and say which have no data, or are no results.

    Args:
        results_dir: ``experiments/results``.
        say: Called with one line per grid that is left out.
        overwrite: Whether pictures may be replaced that this did not write.

    Returns:
        Grid -> (curve rows, episode rows), in the order of ``place``, then of names; None where
        there are none.

    Raises:
        TableError: If the directory does not exist or a table is not valid.
    """
    results_dir = Path(results_dir)
    if not results_dir.is_dir():
        raise TableError(f"{results_dir}: no such directory, expected <grid>/<arm>.csv below it")
    found = {path.name: read_facts(path) for path in results_dir.iterdir() if path.is_dir()}
    grids = {}
    for name in sorted(found, key=lambda name: (found[name].place, name)):
        folder = results_dir / name
        if found[name].smoke:
            say(f"grid '{name}': a smoke run is no result, no figure")
        elif (tables := read_directory(folder)) == (None, None):
            say(f"grid '{name}': no data in {folder}, no figure")
        else:
            grids[name] = tables
    return grids


def drawings(grid: str, curves: Table | None, episodes: Table | None) -> Iterator[Drawing]:
    """Yield the figures of one grid: every measure that its rows hold.

    Curves with settings become one effect per setting that varies, other curves learning curves
    (of what is measured at two moments or more) and, where there are several shifts, bars;
    episodes become bars. What leads a task is drawn in the paper's style (mean and deviation) as
    well.

    Args:
        grid: Name of the grid.
        curves: Curve rows.
        episodes: Episode rows.

    Raises:
        TableError: If the runs of a task have no measure in common.
    """
    for table in (curves, episodes):
        if table is None:
            continue
        start = f"{grid}_episodes" if table.is_episodes else grid
        tasks = ordered(table, "task")
        leads = {metric for task in tasks for metric in lead_metrics(table, task)}
        metrics = dict.fromkeys(m for task in tasks for m in shown_metrics(table, task))
        kinds = _kinds(table)
        several = [column for _, column in kinds if column][1:]
        for kind, column in kinds:
            words = [start, kind, *([_slug(column)] if several else [])]
            for metric in metrics:
                if kind == "curves" and metric not in leads and not _is_curve(table, metric):
                    continue
                if column and not _has_effect(table, metric, column):
                    continue
                shown = statistics_of(table.facts, metric)
                for statistic in shown if metric in leads else shown[-1:]:
                    name = "_".join([*words, _slug(metric), statistic])
                    yield _drawing(name, kind, metric, statistic, table, column)


def make_figures(
    results_dir: str | Path,
    output_dir: str | Path,
    say: Callable[[str], None] = print,
    *,
    overwrite: bool = False,
) -> list[Path]:
    """Draw every figure of every grid as PNG.

    Args:
        results_dir: ``experiments/results``, with ``<grid>/<arm>.csv`` below it.
        output_dir: Directory of the pictures, made if needed.
        say: Called with one line per grid that is left out.
        overwrite: Whether pictures may be replaced that this did not write.

    Returns:
        The files written, ``<output_dir>/<grid>_<kind>_<metric>_<statistic>.png``.

    Raises:
        TableError: If a table is not valid.
        FileError: A picture is there that this did not write; nothing is drawn then.
    """
    wanted = [
        (drawing, Path(output_dir) / f"{drawing.name}.png")
        for grid, (curves, episodes) in read_grids(results_dir, say).items()
        for drawing in drawings(grid, curves, episodes)
    ]
    for _, path in wanted:
        files.check_ours(path, overwrite=overwrite)
    return [write_png(drawing.draw("light"), path) for drawing, path in wanted]


def _kinds(table: Table) -> list[tuple[str, str]]:
    """Return (kind, setting drawn or empty) of the figures of a table."""
    varied = [c for c in table.settings if len({*ordered(table, c)} - {""}) > 1]
    if table.is_episodes:
        return [("bars", "")]
    if varied:
        return [("ablation", column) for column in varied]
    return [("curves", ""), *([("bars", "")] if len(ordered(table, "shift")) > 1 else [])]


def _is_curve(table: Table, metric: str) -> bool:
    """Return whether any run reports a metric at two moments, not at its close alone."""
    rows = mask(table, table["metric"] == metric)
    return any(len(set(run["env_steps"].tolist())) > 1 for run in groups(rows, ["run"]).values())


def _has_effect(table: Table, metric: str, column: str) -> bool:
    """Return whether any run with a setting reports a metric, not only those without it."""
    return bool(((table["metric"] == metric) & (table[column] != "")).any())


def _drawing(
    name: str, kind: str, metric: str, statistic: str, table: Table, column: str
) -> Drawing:
    def draw(theme: str) -> Figure:
        if kind == "ablation":
            return ablation(table, column, metric, statistic=statistic, theme=theme)
        function = shift_bars if kind == "bars" else learning_curves
        return function(table, metric, statistic=statistic, theme=theme)

    return Drawing(name, kind, metric, statistic, draw)


def _slug(text: str) -> str:
    return "".join(c if c.isalnum() else "_" for c in text)
