"""Bars per task and shift, and the ablations of phi and of updates per transition."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from twirl_mjx.checks import choose_one
from twirl_mjx.figures.aggregate import (
    cell_strata,
    check_statistic,
    common_end,
    estimate,
    groups,
    metric_rows,
    seed_counts,
)
from twirl_mjx.figures.canvas import Canvas, canvas, steps_axis
from twirl_mjx.figures.curves import MEANINGS, curves_caption, draw_curves, line_marks
from twirl_mjx.figures.statistics import Interval
from twirl_mjx.figures.style import (
    SHIFTS,
    TASKS,
    VARIANTS,
    Mark,
    Theme,
    canonical,
    metric_info,
    metric_label,
    ordered_mark,
    short_count,
    theme_of,
    variant_mark,
)
from twirl_mjx.figures.tables import Table, select, unique

_ABLATIONS = ("phi", "utd")
_BARS_BY = ("variant", "run")
_AXIS_NAMES = {
    "phi": "phi (share of source rows in a minibatch)",
    "utd": "utd (critic updates per transition)",
}


@dataclass(frozen=True)
class Slot:
    """Where a bar stands."""

    group: int
    """Position of its group on the axis."""
    index: int
    """Position within the group."""
    count: int
    """Bars in a group."""

    @property
    def width(self) -> float:
        """Width of a bar; a group is 0.8 wide."""
        return 0.8 / self.count

    @property
    def centre(self) -> float:
        """Centre of the bar on the axis."""
        return self.group - 0.4 + self.width * (self.index + 0.5)


def shift_bars(
    table: Table,
    metric: str,
    *,
    statistic: str = "iqm",
    by: str = "variant",
    theme: str = "light",
) -> Figure:
    """Draw one row per task, one group per shift and one bar per variant (paper Figure 8).

    Curve rows are compared at the transitions that every trained run of the group has reached;
    episode rows are pooled over runs, each run a stratum. A dot is a single run.

    Args:
        table: Curve or episode rows.
        metric: What to draw, for example ``return``.
        statistic: ``iqm`` or ``rate`` (with bootstrap interval), ``mean`` (with deviation).
        by: What a bar stands for: ``variant``, or ``run`` to set runs side by side.
        theme: ``light`` or ``dark``.

    Raises:
        TableError: If the rows lack the metric or contradict themselves.
        ValueError: If a shift, variant or option is unknown.
    """
    check_statistic(statistic)
    rows = metric_rows(table, metric)
    for shift in unique(rows, "shift"):
        if shift not in SHIFTS:
            raise ValueError(f"{rows.source}: unknown shift '{shift}': {choose_one(shift, SHIFTS)}")
    tasks = canonical(rows["task"].tolist(), TASKS)
    shifts = canonical(rows["shift"].tolist(), SHIFTS)
    ends = {} if rows.is_episodes else common_end(rows)
    name = metric_info(metric).label
    title = f"{name[:1].upper()}{name[1:]} per dynamics shift"
    colours = theme_of(theme)
    marks = _bar_marks(rows, by, colours)
    width = min(10.0, max(4.6, 1.2 + 0.34 * len(shifts) * (len(marks) + 1)))
    with canvas(title, rows, theme, (len(tasks), 1), (width, 1.85)) as frame:
        for label, mark in marks.items():
            frame.legend[label] = Patch(**_fill(mark, colours))
        for task, axes in zip(tasks, frame.axes[:, 0], strict=True):
            for (shift, value), cell in groups(select(rows, task=task), ["shift", by]).items():
                slot = Slot(shifts.index(shift), list(marks).index(value), len(marks))
                strata = cell_strata(cell, ends.get((task, shift), 0))
                runs = _run_values(strata, statistic) if rows.is_episodes else strata[0]
                look = marks[value], colours
                _draw_bar(axes, slot, estimate(strata, statistic), runs, *look)
            axes.set_title(task)
            axes.set_ylabel(metric_label(metric))
            axes.set_xticks(range(len(shifts)), shifts)
            axes.set_xlim(-0.5, len(shifts) - 0.5)
            axes.tick_params(axis="x", length=0)
        frame.captions.append(_bars_caption(rows, statistic, by, ends))
    return frame.figure


def ablation(
    table: Table,
    column: str,
    metric: str,
    *,
    statistic: str = "iqm",
    theme: str = "light",
) -> Figure:
    """Draw learning curves per value of phi or utd, and the value reached beside them.

    Args:
        table: Curve rows with the column.
        column: ``phi`` or ``utd``.
        metric: What to draw, for example ``return``.
        statistic: ``iqm`` or ``rate`` (with bootstrap interval), ``mean`` (with deviation).
        theme: ``light`` or ``dark``.

    Raises:
        TableError: If the rows lack the column or the metric, or contradict themselves.
        ValueError: If an option is unknown.
    """
    check_statistic(statistic)
    if column not in _ABLATIONS:
        raise ValueError(f"no ablation of '{column}': {choose_one(column, _ABLATIONS)}")
    rows = metric_rows(table, metric)
    panels = groups(rows, ["task", "shift"])
    ends = common_end(rows)
    title = f"Effect of {column} on {metric_info(metric).label}"
    with canvas(title, rows, theme, (len(panels), 2), (7.4, 2.15)) as frame:
        for (key, part), (left, right) in zip(panels.items(), frame.axes, strict=True):
            task, shift = key
            left.set_title(task if shift == "none" else f"{task}, {shift}")
            left.set_ylabel(metric_label(metric))
            draw_curves(frame, left, part, statistic=statistic, by=column)
            steps_axis(left)
            right.set_title(f"after {short_count(ends[key])} transitions")
            _draw_points(frame, right, part, column, statistic, ends[key])
            right.set_xlabel(_AXIS_NAMES[column])
        frame.captions.append(
            f"{curves_caption(rows, statistic, column)} Right: the same as point, whisker and dots."
        )
    return frame.figure


def _run_values(strata: list[np.ndarray], statistic: str) -> np.ndarray:
    """Return one value per run from its episodes."""
    return np.array([estimate([episodes], statistic).estimate for episodes in strata])


def _bar_marks(table: Table, by: str, theme: Theme) -> dict[str, Mark]:
    if by not in _BARS_BY:
        raise ValueError(f"cannot draw one bar per '{by}': {choose_one(by, _BARS_BY)}")
    values = canonical(table[by].tolist(), VARIANTS)
    if by == "variant":
        return {value: variant_mark(value, theme) for value in values}
    return {value: ordered_mark(i, len(values), theme) for i, value in enumerate(values)}


def _fill(mark: Mark, theme: Theme) -> dict[str, Any]:
    """Return how a bar is filled; the hatch is drawn in the colour of the background."""
    return {"facecolor": mark.colour, "edgecolor": theme.background, "hatch": mark.hatch, "lw": 0}


def _draw_bar(
    axes: Axes, slot: Slot, value: Interval, runs: np.ndarray, mark: Mark, theme: Theme
) -> None:
    axes.bar(slot.centre, value.estimate, slot.width * 0.94, zorder=2, **_fill(mark, theme))
    _draw_whisker(axes, slot.centre, value.low, value.high, theme)
    if len(runs) > 1:
        _draw_dots(axes, slot.centre, runs, slot.width * 0.22, theme)


def _draw_points(
    frame: Canvas, axes: Axes, table: Table, column: str, statistic: str, end: int
) -> None:
    marks = line_marks(table, column, frame.theme)
    ticks: Mapping[float, int] = {value: i for i, value in enumerate(marks)}
    for (value,), part in groups(table, [column]).items():
        strata, x, mark = cell_strata(part, end), ticks[value], marks[value]
        point = estimate(strata, statistic)
        _draw_whisker(axes, x, point.low, point.high, frame.theme)
        axes.plot(x, point.estimate, marker=mark.marker, color=mark.colour, ms=8, zorder=4)
        _draw_dots(axes, x + 0.18, strata[0], 0.0, frame.theme)
    axes.set_xticks(range(len(ticks)), [f"{value:g}" for value in ticks])
    axes.set_xlim(-0.5, len(ticks) - 0.5)


def _draw_whisker(axes: Axes, x: float, low: float, high: float, theme: Theme) -> None:
    if not np.isnan(low):
        axes.vlines(x, low, high, color=theme.text, lw=1.1, zorder=3)


def _draw_dots(axes: Axes, x: float, values: np.ndarray, spread: float, theme: Theme) -> None:
    offsets = np.linspace(-spread, spread, len(values)) if len(values) > 1 else np.zeros(1)
    axes.scatter(
        x + offsets,
        values,
        s=9,
        zorder=4,
        facecolor=theme.background,
        edgecolor=theme.text,
        lw=0.7,
    )


def _bars_caption(table: Table, statistic: str, by: str, ends: Mapping[tuple, int]) -> str:
    """Return what bars and whiskers are, of how many runs, and after how many transitions."""
    most, seeds = seed_counts(table, by)
    centre, bounds = MEANINGS[statistic]
    if table.is_episodes:
        runs = "one run per bar." if most == 1 else f"{seeds} per bar; dots: single runs."
        return f"Bars: {centre}, whiskers: {bounds}, over the episodes of {runs}"
    reached = sorted({end for end in ends.values() if end})
    limits = " to ".join(dict.fromkeys(short_count(end) for end in (*reached[:1], *reached[-1:])))
    after = f" after {limits} transitions" if reached else ""
    if most == 1:
        return f"Bars: single runs{after}; one seed allows no interval."
    return f"Bars: {centre}, whiskers: {bounds}, {seeds}{after}; dots: single runs."
