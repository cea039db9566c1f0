"""Rebuild every figure from ``experiments/results/<grid>/*.csv``, and from nothing else."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from matplotlib.figure import Figure

from twirl_mjx.figures.aggregate import statistics_of
from twirl_mjx.figures.bars import ablation, shift_bars
from twirl_mjx.figures.canvas import write_png
from twirl_mjx.figures.curves import learning_curves
from twirl_mjx.figures.style import metric_info
from twirl_mjx.figures.summary import grid_kind, main_metric, shown_metrics
from twirl_mjx.figures.tables import Table, TableError, read_directory

__all__ = ["GRIDS", "Drawing", "ablation", "drawings", "learning_curves", "make_figures"]
__all__ += ["read_grids", "shift_bars"]

GRIDS = ("tasks", "shifts", "phi", "utd")
"""Grids of the paper; further directories are drawn as learning curves."""


@dataclass(frozen=True)
class Drawing:
    """A figure that can be drawn from a table."""

    name: str
    """File name without ending, for example ``phi_return_iqm``."""
    kind: str
    """``curves``, ``bars`` or ``ablation``."""
    metric: str
    """Metric drawn."""
    statistic: str
    """One of ``aggregate.STATISTICS``."""
    table: Table
    """The rows."""
    draw: Callable[[str], Figure]
    """Function of the theme's name."""


def read_grids(
    results_dir: str | Path, say: Callable[[str], None] = print
) -> dict[str, tuple[Table | None, Table | None]]:
    """Read every grid below a directory and say which of the paper's have no data.

    Args:
        results_dir: ``experiments/results``.
        say: Called with one line per grid without data.

    Returns:
        Grid -> (curve rows, episode rows), the paper's grids first; None where there are none.

    Raises:
        TableError: If the directory does not exist or a table is not valid.
    """
    results_dir = Path(results_dir)
    if not results_dir.is_dir():
        raise TableError(f"{results_dir}: no such directory, expected <grid>/<arm>.csv below it")
    found = sorted(path.name for path in results_dir.iterdir() if path.is_dir())
    kinds = {grid_kind(name) for name in found}
    missing = [grid for grid in GRIDS if grid not in kinds]
    order = {kind: i for i, kind in enumerate(GRIDS)}
    grids = {}
    for name in sorted(found, key=lambda name: (order.get(grid_kind(name), len(GRIDS)), name)):
        tables = read_directory(results_dir / name)
        if tables == (None, None):
            missing.append(name)
        else:
            grids[name] = tables
    for name in missing:
        say(f"grid '{name}': no data in {results_dir / name}, no figure")
    return grids


def drawings(
    grid: str, curves: Table | None, episodes: Table | None, metric: str | None = None
) -> Iterator[Drawing]:
    """Yield the figures of one grid.

    Every grid has its main metric in the paper's style and with IQM; ``tasks`` and grids of your
    own have curves of every headline metric; episode tables become bars, but for the ablations.

    Args:
        grid: Name of the grid; its first word says what kind it is.
        curves: Curve rows.
        episodes: Episode rows.
        metric: Main metric; None for ``summary.main_metric``.

    Raises:
        TableError: If the runs have no main metric in common.
    """
    kind = grid_kind(grid)
    for table in (curves, episodes):
        if table is None:
            continue
        main = metric or main_metric(table)
        every = [m for m in shown_metrics(table, main) if _is_drawn(m, main)]
        if kind in ("phi", "utd"):  # bars would pool the episodes of different values
            wanted = [] if table.is_episodes else [("ablation", main)]
        elif table.is_episodes:
            wanted = [("bars", name) for name in every]
        elif kind == "shifts":
            wanted = [("bars", main), ("curves", main)]
        else:
            wanted = [("curves", name) for name in every]
        for shape, name, statistic in ((*w, s) for w in wanted for s in statistics_of(w[1])):
            start = f"{grid}_episodes" if table.is_episodes else grid
            file = f"{start}_{shape}_{_slug(name)}_{statistic}"
            yield _drawing(file, shape, name, statistic, table, kind)


def make_figures(
    results_dir: str | Path,
    output_dir: str | Path,
    metric: str | None = None,
    say: Callable[[str], None] = print,
) -> list[Path]:
    """Draw every figure of every grid as PNG.

    Args:
        results_dir: ``experiments/results``, with ``<grid>/<arm>.csv`` below it.
        output_dir: Directory of the pictures, made if needed.
        metric: Main metric; None for ``summary.main_metric``.
        say: Called with one line per grid without data.

    Returns:
        The files written, ``<output_dir>/<grid>_<kind>_<metric>_<statistic>.png``.

    Raises:
        TableError: If a table is not valid or lacks the main metric.
    """
    paths = []
    for grid, (curves, episodes) in read_grids(results_dir, say).items():
        for drawing in drawings(grid, curves, episodes, metric):
            path = Path(output_dir) / f"{drawing.name}.png"
            paths.append(write_png(drawing.draw("light"), path))
    return paths


def _drawing(
    name: str, kind: str, metric: str, statistic: str, table: Table, column: str
) -> Drawing:
    def draw(theme: str) -> Figure:
        if kind == "ablation":
            return ablation(table, column, metric, statistic=statistic, theme=theme)
        function = shift_bars if kind == "bars" else learning_curves
        return function(table, metric, statistic=statistic, theme=theme)

    return Drawing(name, kind, metric, statistic, table, draw)


def _is_drawn(metric: str, main: str) -> bool:
    return metric == main or metric_info(metric).is_headline


def _slug(metric: str) -> str:
    return "".join(c if c.isalnum() else "_" for c in metric)
