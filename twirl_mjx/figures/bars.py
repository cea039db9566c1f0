"""Bars per task and shift, and the effect of a setting such as phi."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from twirl_mjx.checks import choose_one
from twirl_mjx.figures.aggregate import (
    cell_runs,
    check_statistic,
    common_end,
    estimate,
    metric_rows,
    seed_counts,
)
from twirl_mjx.figures.canvas import Canvas, canvas, steps_axis
from twirl_mjx.figures.cells import groups, is_idle, labelled, ordered
from twirl_mjx.figures.curves import (
    MEANINGS,
    curves_caption,
    draw_curves,
    line_marks,
    place_name,
)
from twirl_mjx.figures.errors import TableError
from twirl_mjx.figures.facts import Axis
from twirl_mjx.figures.statistics import Interval
from twirl_mjx.figures.style import Mark, Theme, ordered_mark, short_count
from twirl_mjx.figures.tables import LABEL_COLUMN, Table, mask, select

_BARS_BY = ("label", "run")


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
    by: str = "label",
    theme: str = "light",
) -> Figure:
    """Draw one row per task, one group per shift and one bar per arm (paper Figure 8).

    Curve rows are compared at the transitions that every trained run of the group has reached;
    episode rows are pooled over runs. A dot is a single run. A policy that learns nothing is no bar
    but a level across its group.

    Args:
        table: Curve or episode rows.
        metric: What to draw, for example ``return``.
        statistic: ``iqm`` or ``rate`` (with bootstrap interval), ``mean`` (with deviation).
        by: What a bar stands for: ``label`` (variant and settings), or ``run`` to set runs side by
            side.
        theme: ``light`` or ``dark``.

    Raises:
        TableError: If the rows lack the metric or contradict themselves.
        ValueError: If an option is unknown.
    """
    check_statistic(statistic)
    if by not in _BARS_BY:
        raise ValueError(f"cannot draw one bar per '{by}': {choose_one(by, _BARS_BY)}")
    rows = labelled(metric_rows(table, metric))
    tasks, shifts = ordered(rows, "task"), ordered(rows, "shift")
    ends = {} if rows.is_episodes else common_end(table)
    name = rows.facts.measure(metric).label
    title = f"{name[:1].upper()}{name[1:]} per dynamics shift"
    with canvas(title, rows, theme, (len(tasks), 1), (_bars_width(rows, by), 1.85)) as frame:
        marks = _bar_marks(rows, by, frame.theme)
        idle = _idle_values(rows, by)
        bars = [value for value in marks if value not in idle]
        for value, mark in marks.items():
            level = Line2D([], [], color=mark.colour, ls="--")
            handle = level if value in idle else Patch(**_fill(mark, frame.theme))
            frame.legend[f"{value} (learns nothing)" if value in idle else value] = handle
        for task, axes in zip(tasks, frame.axes[:, 0], strict=True):
            for (shift, value), cell in groups(select(rows, task=task), ["shift", by]).items():
                runs, group = cell_runs(cell, ends.get((task, shift), 0)), shifts.index(shift)
                if value in idle:
                    _draw_level(axes, group, estimate(runs, statistic), marks[value])
                    continue
                slot = Slot(group, bars.index(value), len(bars))
                _draw_bar(axes, slot, runs, statistic, marks[value], frame.theme)
            frame.ylabel(axes, rows.facts.label(metric))
            frame.title(axes, task)
            frame.xticks(axes, shifts)
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
    """Draw learning curves per value of a setting, and the value reached beside them.

    There is one row of panels per task, shift and values of the other settings. Arms without the
    setting are left out, but for levels: what was not trained, or learns nothing.

    Args:
        table: Curve rows with the column.
        column: A column of settings, for example ``phi``.
        metric: What to draw, for example ``return``.
        statistic: ``iqm`` or ``rate`` (with bootstrap interval), ``mean`` (with deviation).
        theme: ``light`` or ``dark``.

    Raises:
        TableError: If the rows lack the column or the metric, or contradict themselves.
        ValueError: If an option is unknown.
    """
    check_statistic(statistic)
    if column not in table.settings:
        raise TableError(
            f"{table.source}: no setting '{column}': {choose_one(column, table.settings)}"
        )
    rows = labelled(metric_rows(table, metric))
    stated = mask(rows, rows[column] != "")
    if not len(stated):
        raise TableError(f"{table.source}: column '{column}' is empty in every row")
    others = [c for c in ("variant", *rows.settings) if c != column and _varies(stated, c)]
    panels = groups(stated, ["task", "shift", *others])
    ends = common_end(mask(table, table[column] != ""))
    title = f"Effect of {column} on {rows.facts.measure(metric).label}"
    with canvas(title, rows, theme, (len(panels), 2), (7.4, 2.15)) as frame:
        marks = line_marks(stated, frame.theme, column)
        for (key, part), (left, right) in zip(panels.items(), frame.axes, strict=True):
            task, shift, *values = key
            pairs = zip(others, values, strict=True)
            words = [v if c == "variant" else f"{c} = {v}" for c, v in pairs]
            frame.ylabel(left, rows.facts.label(metric))
            frame.title(left, place_name(task, shift, *words))
            levels = (rows["task"] == task) & (rows["shift"] == shift) & _untrained(rows, column)
            _draw_effect(frame, left, part, mask(rows, levels), column, marks, statistic)
            steps_axis(left)
            frame.title(right, f"after {short_count(ends[task, shift])} transitions")
            _draw_points(frame, right, part, column, marks, statistic, ends[task, shift])
            right.set_xlabel(rows.facts.axis_title(column))
        caption = curves_caption(stated, statistic)
        frame.captions.append(f"{caption} Right: the same as point, whisker and dots.")
    return frame.figure


def _varies(table: Table, column: str) -> bool:
    return len(set(table[column].tolist())) > 1


def _untrained(rows: Table, column: str) -> np.ndarray:
    """Return which rows without a setting are levels: not trained, or of what learns nothing."""
    trained = {run for (run,), p in groups(rows, ["run"]).items() if p["env_steps"].max() > 0}
    level = is_idle(rows) | ~np.isin(rows["run"], list(trained))
    return level & (rows[column] == "")


def _draw_effect(
    frame: Canvas,
    axes: Axes,
    part: Table,
    levels: Table,
    column: str,
    marks: Mapping[str, Mark],
    statistic: str,
) -> None:
    """Draw one line per value of a setting, under the name of the value alone, and levels."""
    names = np.array([f"{column} = {value}" for value in part[column].tolist()], dtype=str)
    looks = {f"{column} = {value}": mark for value, mark in marks.items()}
    looks |= line_marks(levels, frame.theme) if len(levels) else {}
    axis = {LABEL_COLUMN: Axis(order=tuple(looks))}
    facts = replace(part.facts, axes={**part.facts.axes, **axis})
    columns = {**part.columns, LABEL_COLUMN: names}
    joined = {c: np.concatenate([v, levels[c]]) for c, v in columns.items()}
    draw_curves(frame, axes, replace(part, columns=joined, facts=facts), looks, statistic=statistic)


def _bars_width(rows: Table, by: str) -> float:
    values, shifts = len(ordered(rows, by)), len(ordered(rows, "shift"))
    return min(10.0, max(4.6, 1.2 + 0.34 * shifts * (values + 1)))


def _bar_marks(rows: Table, by: str, theme: Theme) -> dict[str, Mark]:
    if by == LABEL_COLUMN:
        return line_marks(rows, theme)
    values = ordered(rows, by)
    return {value: ordered_mark(i, len(values), theme) for i, value in enumerate(values)}


def _idle_values(rows: Table, by: str) -> set[str]:
    """Return what stands for policies that learn nothing; none where nothing else is drawn."""
    idle = is_idle(rows)
    return set() if idle.all() else set(rows[by][idle].tolist())


def _fill(mark: Mark, theme: Theme) -> dict[str, Any]:
    """Return how a bar is filled; the hatch is drawn in the colour of the background."""
    return {"facecolor": mark.colour, "edgecolor": theme.background, "hatch": mark.hatch, "lw": 0}


def _draw_level(axes: Axes, group: int, value: Interval, mark: Mark) -> None:
    ends = [group - 0.46, group + 0.46]
    axes.plot(ends, [value.estimate] * 2, color=mark.colour, ls="--", lw=1.4, zorder=5)


def _draw_bar(
    axes: Axes,
    slot: Slot,
    runs: Sequence[np.ndarray],
    statistic: str,
    mark: Mark,
    theme: Theme,
) -> None:
    value = estimate(runs, statistic)
    axes.bar(slot.centre, value.estimate, slot.width * 0.94, zorder=2, **_fill(mark, theme))
    _draw_whisker(axes, slot.centre, value.low, value.high, theme)
    if len(runs) > 1:
        _draw_dots(axes, slot.centre, _run_values(runs, statistic), slot.width * 0.22, theme)


def _run_values(runs: Sequence[np.ndarray], statistic: str) -> np.ndarray:
    """Return one value per run."""
    return np.array([estimate([run], statistic).estimate for run in runs])


def _draw_points(
    frame: Canvas,
    axes: Axes,
    table: Table,
    column: str,
    marks: Mapping[str, Mark],
    statistic: str,
    end: int,
) -> None:
    ticks: Mapping[str, int] = {value: i for i, value in enumerate(marks)}
    for (value,), part in groups(table, [column]).items():
        runs, x, mark = cell_runs(part, end), ticks[value], marks[value]
        point = estimate(runs, statistic)
        _draw_whisker(axes, x, point.low, point.high, frame.theme)
        axes.plot(x, point.estimate, marker=mark.marker, color=mark.colour, ms=8, zorder=4)
        _draw_dots(axes, x + 0.18, _run_values(runs, statistic), 0.0, frame.theme)
    frame.xticks(axes, list(ticks))


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
        if most == 1:
            return (
                f"Bars: {centre}, whiskers: {bounds}, over the episodes of one run per bar: they "
                "say nothing about further seeds."
            )
        return f"Bars: {centre}, whiskers: {bounds}, {seeds} and their episodes; dots: single runs."
    reached = sorted({end for end in ends.values() if end})
    limits = " to ".join(dict.fromkeys(short_count(end) for end in (*reached[:1], *reached[-1:])))
    after = f" after {limits} transitions" if reached else ""
    if most == 1:
        return f"Bars: single runs{after}; one seed allows no interval."
    return f"Bars: {centre}, whiskers: {bounds}, {seeds}{after}; dots: single runs."
