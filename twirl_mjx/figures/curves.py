"""Learning curves, one panel per task and shift."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from twirl_mjx.checks import choose_one
from twirl_mjx.figures.aggregate import (
    Series,
    check_statistic,
    curve,
    estimate,
    groups,
    metric_rows,
    run_series,
    seed_counts,
)
from twirl_mjx.figures.canvas import Canvas, canvas, steps_axis
from twirl_mjx.figures.style import (
    SHIFTS,
    TASKS,
    Mark,
    Theme,
    canonical,
    metric_info,
    metric_label,
    ordered_mark,
    variant_mark,
)
from twirl_mjx.figures.tables import Table, TableError, unique

BY = ("variant", "phi", "utd")
"""What the lines of a panel may stand for."""

MEANINGS = {
    "mean": ("mean", "standard deviation"),
    "rate": ("mean", "95 % bootstrap interval"),
    "iqm": ("interquartile mean", "95 % bootstrap interval"),
}
"""Statistic -> what the centre and the bounds are, for captions."""


def learning_curves(
    table: Table,
    metric: str,
    *,
    statistic: str = "mean",
    by: str = "variant",
    theme: str = "light",
) -> Figure:
    """Draw a metric against transitions, one panel per (task, shift), one line per variant.

    A variant without training (source, zero-shot) is a horizontal line.

    Args:
        table: Curve rows.
        metric: What to draw, for example ``return``.
        statistic: ``mean`` (paper style, with standard deviation), ``iqm`` or ``rate`` (with a
            bootstrap band).
        by: What a line stands for: ``variant``, ``phi`` or ``utd``.
        theme: ``light`` or ``dark``.

    Raises:
        TableError: If the rows lack a column or the metric, or contradict themselves.
        ValueError: If an option is unknown or a variant has no colour.
    """
    check_statistic(statistic)
    rows = metric_rows(table, metric)
    panels = groups(rows, ["task", "shift"])
    shape, places = _arrange(list(panels))
    width = min(10.0, 2.3 * shape[1] + 0.9) if shape[1] > 2 else 3.4 * shape[1] + 0.4
    name = metric_info(metric).label
    with canvas(
        f"{name[:1].upper()}{name[1:]} during training", rows, theme, shape, (max(width, 4.6), 2.15)
    ) as frame:
        for axes in frame.axes.flat:
            axes.set_visible(False)
        for (task, shift), part in panels.items():
            row, column = places[(task, shift)]
            axes = frame.axes[row, column]
            axes.set_visible(True)
            axes.set_title(task if shift == "none" else f"{task}, {shift}")
            draw_curves(frame, axes, part, statistic=statistic, by=by)
            below = [places[k] for k in places if places[k][1] == column]
            steps_axis(axes, ticks=5 if shape[1] < 3 else 3, label=row == max(r for r, _ in below))
            if column == 0:
                axes.set_ylabel(metric_label(metric))
        frame.captions.append(curves_caption(rows, statistic, by))
    return frame.figure


def draw_curves(frame: Canvas, axes: Axes, table: Table, *, statistic: str, by: str) -> None:
    """Draw every line of one panel and enter it into the legend.

    Args:
        frame: The figure; its legend grows.
        axes: The panel.
        table: Rows of one metric, task and shift.
        statistic: One of ``aggregate.STATISTICS``.
        by: ``variant``, ``phi`` or ``utd``.

    Raises:
        ValueError: If ``by`` is unknown or a variant has no colour.
        TableError: If the column is missing or a run contradicts itself.
    """
    marks = line_marks(table, by, frame.theme)
    cells = {key[0]: run_series(part) for key, part in groups(table, [by]).items()}
    end = max(int(s.env_steps[-1]) for series in cells.values() for s in series)
    for value, series in cells.items():
        mark, label = marks[value], value if by == "variant" else f"{by} = {value:g}"
        if all(s.env_steps[-1] == 0 for s in series):
            _draw_level(axes, series, end, mark, statistic)
        else:
            _draw_line(axes, series, mark, statistic)
        frame.legend.setdefault(str(label), Line2D([], [], color=mark.colour, ls=mark.line))
    axes.set_xlim(0, max(end, 1))


def curves_caption(table: Table, statistic: str, by: str) -> str:
    """Return what lines and bands are, and of how many seeds."""
    most, seeds = seed_counts(table, by)
    if most == 1:
        return "Lines: single runs; one seed allows no interval."
    centre, bounds = MEANINGS[statistic]
    return f"Line: {centre}, band: {bounds}, {seeds}; thin: single runs."


def line_marks(table: Table, by: str, theme: Theme) -> dict:
    """Return the look of every value of a column: fixed for variants, ordered for phi and utd.

    Raises:
        ValueError: If ``by`` is unknown or a variant has no colour.
        TableError: If the column is missing or empty.
    """
    if by not in BY:
        raise ValueError(f"cannot draw one line per '{by}': {choose_one(by, BY)}")
    if by == "variant":
        return {v: variant_mark(v, theme) for v in unique(table, "variant")}
    values = unique(table, by)
    if not values:
        raise TableError(f"{table.source}: column '{by}' is empty in every row")
    return {v: ordered_mark(i, len(values), theme) for i, v in enumerate(values)}


def _arrange(keys: Sequence[tuple]) -> tuple[tuple[int, int], dict[tuple, tuple[int, int]]]:
    """Place panels: a row per task and a column per shift, or two or three tasks in a row."""
    tasks = canonical((task for task, _ in keys), TASKS)
    shifts = canonical((shift for _, shift in keys), SHIFTS)
    if len(shifts) > 1:
        places = {(t, s): (tasks.index(t), shifts.index(s)) for t, s in keys}
        return (len(tasks), len(shifts)), places
    columns = min(2 if len(tasks) == 4 else 3, len(tasks))
    places = {(t, s): divmod(tasks.index(t), columns) for t, s in keys}
    return (-(-len(tasks) // columns), columns), places


def _draw_line(axes: Axes, series: Sequence[Series], mark: Mark, statistic: str) -> None:
    for s in series:
        axes.plot(s.env_steps, s.values, color=mark.colour, lw=0.6, alpha=0.45, zorder=2)
    line = curve(series, statistic)
    axes.plot(line.env_steps, line.centre, color=mark.colour, ls=mark.line, zorder=3)
    if len(line.env_steps) == 1:
        axes.plot(line.env_steps, line.centre, color=mark.colour, marker=mark.marker, zorder=3)
    if not np.isnan(line.low).any():
        axes.fill_between(
            line.env_steps, line.low, line.high, color=mark.colour, alpha=0.2, lw=0, zorder=1
        )


def _draw_level(axes: Axes, series: Sequence[Series], end: int, mark: Mark, statistic: str) -> None:
    level = estimate([np.array([s.values[-1] for s in series])], statistic)
    ends = [0, max(end, 1)]
    axes.plot(ends, [level.estimate] * 2, color=mark.colour, ls=mark.line, zorder=3)
    if not np.isnan(level.low):
        axes.fill_between(ends, level.low, level.high, color=mark.colour, alpha=0.12, lw=0)
