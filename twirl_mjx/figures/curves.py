"""Learning curves, one panel per task and shift."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from twirl_mjx.figures.aggregate import (
    Series,
    check_statistic,
    curve,
    estimate,
    metric_rows,
    run_series,
    seed_counts,
)
from twirl_mjx.figures.canvas import Canvas, canvas, steps_axis
from twirl_mjx.figures.cells import groups, is_idle, labelled, ordered
from twirl_mjx.figures.style import Mark, Theme, category_mark, ordered_mark
from twirl_mjx.figures.tables import LABEL_COLUMN, Table, mask

MEANINGS = {
    "mean": ("mean", "standard deviation"),
    "rate": ("mean", "95 % bootstrap interval"),
    "iqm": ("interquartile mean", "95 % bootstrap interval"),
}
"""Statistic -> what the centre and the bounds are, for captions."""


def learning_curves(
    table: Table, metric: str, *, statistic: str = "mean", theme: str = "light"
) -> Figure:
    """Draw a metric against transitions, one panel per (task, shift), one line per arm.

    What was not trained (zero-shot, a policy that does nothing) is a horizontal line.

    Args:
        table: Curve rows.
        metric: What to draw, for example ``return``.
        statistic: ``mean`` (paper style, with standard deviation), ``iqm`` or ``rate`` (with a
            bootstrap band).
        theme: ``light`` or ``dark``.

    Raises:
        TableError: If the rows lack the metric, or contradict themselves.
        ValueError: If an option is unknown.
    """
    check_statistic(statistic)
    rows = labelled(metric_rows(table, metric))
    panels = groups(rows, ["task", "shift"])
    shape, places = _arrange(ordered(rows, "task"), ordered(rows, "shift"), list(panels))
    width = min(10.0, 2.3 * shape[1] + 0.9) if shape[1] > 2 else 3.4 * shape[1] + 0.4
    name = rows.facts.measure(metric).label
    with canvas(
        f"{name[:1].upper()}{name[1:]} during training", rows, theme, shape, (max(width, 4.6), 2.15)
    ) as frame:
        for axes in frame.axes.flat:
            axes.set_visible(False)
        marks = line_marks(rows, frame.theme)
        for (task, shift), part in panels.items():
            row, column = places[(task, shift)]
            axes = frame.axes[row, column]
            axes.set_visible(True)
            if column == 0:
                frame.ylabel(axes, rows.facts.label(metric))
            frame.title(axes, place_name(task, shift))
            draw_curves(frame, axes, part, marks, statistic=statistic)
            below = [places[k] for k in places if places[k][1] == column]
            steps_axis(axes, ticks=5 if shape[1] < 3 else 3, label=row == max(r for r, _ in below))
        frame.captions.append(curves_caption(rows, statistic))
    return frame.figure


def place_name(*parts: str) -> str:
    """Return task, shift and what else a panel stands for in words; no shift goes unsaid."""
    return ", ".join(part for i, part in enumerate(parts) if part and (i, part) != (1, "none"))


def draw_curves(
    frame: Canvas, axes: Axes, table: Table, marks: dict[str, Mark], *, statistic: str
) -> None:
    """Draw every line of one panel and enter it into the legend.

    Args:
        frame: The figure; its legend grows.
        axes: The panel.
        table: Labelled rows of one metric, task and shift.
        marks: Look of every label.
        statistic: One of ``aggregate.STATISTICS``.

    Raises:
        TableError: If a run contradicts itself.
    """
    learning = mask(table, ~is_idle(table))
    cells = {label: run_series(part) for (label,), part in groups(table, [LABEL_COLUMN]).items()}
    end = int(learning["env_steps"].max()) if len(learning) else 0
    idle = set(table[LABEL_COLUMN].tolist()) - set(learning[LABEL_COLUMN].tolist())
    for label, series in cells.items():
        mark = marks[label]
        if label in idle or all(s.env_steps[-1] == 0 for s in series):
            _draw_level(axes, series, end, mark, statistic)
        else:
            _draw_line(axes, series, mark, statistic)
        frame.legend.setdefault(label, Line2D([], [], color=mark.colour, ls=mark.line))
    axes.set_xlim(0, max(end, 1))


def curves_caption(table: Table, statistic: str) -> str:
    """Return what lines and bands are, and of how many seeds."""
    most, seeds = seed_counts(table, LABEL_COLUMN)
    if most == 1:
        return "Lines: single runs; one seed allows no interval."
    centre, bounds = MEANINGS[statistic]
    return f"Line: {centre}, band: {bounds}, {seeds}; thin: single runs."


def line_marks(table: Table, theme: Theme, column: str = LABEL_COLUMN) -> dict[str, Mark]:
    """Return the look of every value of a column.

    A variant keeps its place in the order of variants, whatever else is drawn; values of settings
    are ordered, and go from dark to bright.

    Args:
        table: Labelled rows.
        theme: Colours.
        column: The label, or a column of settings.
    """
    values = [value for value in ordered(table, column) if value]
    variants = list(dict.fromkeys((*table.facts.order("variant"), *ordered(table, "variant"))))
    names = [value for value in values if column == LABEL_COLUMN and _is_name(value, table)]
    places = {name: i for i, name in enumerate(dict.fromkeys((*variants, *names)))}
    steps = [value for value in values if value not in names]
    return {
        v: category_mark(places[v], theme)
        if v in names
        else ordered_mark(steps.index(v), len(steps), theme)
        for v in values
    }


def _is_name(label: str, table: Table) -> bool:
    """Return whether a label is the name of a variant or policy, without settings."""
    rows = mask(table, table[LABEL_COLUMN] == label)
    return bool(is_idle(rows).all()) or not any((rows[c] != "").any() for c in table.settings)


def _arrange(
    tasks: Sequence[str], shifts: Sequence[str], keys: Sequence[tuple]
) -> tuple[tuple[int, int], dict[tuple, tuple[int, int]]]:
    """Place panels: a row per task and a column per shift, or two or three tasks in a row."""
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
    level = estimate([s.values[-1:] for s in series], statistic)
    ends = [0, max(end, 1)]
    axes.plot(ends, [level.estimate] * 2, color=mark.colour, ls=mark.line, zorder=3)
    if not np.isnan(level.low):
        axes.fill_between(ends, level.low, level.high, color=mark.colour, alpha=0.12, lw=0)
