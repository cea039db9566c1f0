"""The tree of a contest: which candidates were trained how far, and who won (``sweep.contest``)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from twirl_mjx.figures.canvas import canvas, steps_axis
from twirl_mjx.figures.decisions import DROPPED, GOES_ON, ON, Decision, ancestry
from twirl_mjx.figures.tables import ARM_COLUMN, Table
from twirl_mjx.figures.wording import numbers

_ROW = 0.36
"""Inches of a run."""


def contest_tree(
    rows: Sequence[Decision], measure: str, title: str, theme: str = "light"
) -> Figure:
    """Draw a line for every run, from where its source was to where it was dropped.

    Args:
        rows: Decisions, those on sources as they are among them.
        measure: What was measured, for the caption, with its unit.
        title: Heading.
        theme: Name of a theme.

    Raises:
        ValueError: No run was judged.
    """
    judged = [row for row in rows if row.run]
    if not judged:
        raise ValueError("no candidate of this contest has been judged (nearest: let it run on)")
    runs = list(dict.fromkeys(row.run for row in judged))
    places = {run: -index for index, run in enumerate(runs)}
    line = {row.run for row in ancestry(rows, _winner(judged))}
    starts = {run: _start(judged, run) for run in runs}
    size = (8.2, 0.6 + _ROW * len(runs))
    with canvas(title, Table({ARM_COLUMN: np.array([])}), theme, (1, 1), size) as frame:
        axes, colours = frame.axes[0, 0], frame.theme
        for run in runs:
            mine = [row for row in judged if row.run == run]
            colour = colours.categories[0] if run in line else colours.categories[5]
            xs = [starts[run], *(starts[run] + row.env_steps for row in mine)]
            axes.plot(xs, [places[run]] * len(xs), color=colour, lw=2.2 if run in line else 1.2)
            if mine[0].source in places:
                above = places[mine[0].source]
                axes.plot([xs[0]] * 2, [above, places[run]], color=colour, lw=1.0)
            for x, row in zip(xs[1:], mine, strict=True):
                marker = "x" if row.kept == DROPPED else "o"
                axes.plot(x, places[run], marker=marker, color=colour, ms=5)
                axes.annotate(
                    numbers(row.value)[0], (x, places[run]), (0, 4), textcoords="offset points",
                    ha="center", va="bottom", fontsize=7.5, color=colours.text,
                )  # fmt: skip
        names = [_label(judged, run) for run in runs]
        axes.set_yticks([places[run] for run in runs], names)
        axes.set_ylim(-len(runs) + 0.4, 0.8)
        axes.margins(x=0.05)
        axes.grid(visible=False)
        steps_axis(axes)
        for label, marker, colour in (
            ("leads to the winner", "o", colours.categories[0]),
            ("dropped", "x", colours.categories[5]),
        ):
            frame.legend[label] = Line2D([], [], marker=marker, color=colour)
        frame.captions.append(f"Numbers: {measure}.")
        alone = [row for row in rows if not row.run and not np.isnan(row.value)]
        if alone:
            told = ", ".join(f"{row.source} {numbers(row.value)[0]}" for row in alone)
            frame.captions.append(f"The sources as they are: {told}.")
    return frame.figure


def _winner(judged: Sequence[Decision]) -> str:
    """Return the run that was kept last, else the one that was judged last."""
    kept = [row.run for row in judged if row.kept == GOES_ON]
    return kept[-1] if kept else judged[-1].run


def _start(judged: Sequence[Decision], run: str) -> int:
    """Return how many transitions led to the first of a run, those of its sources."""
    first = next(row for row in judged if row.run == run)
    before = [r for r in judged if r.run == first.source and r.round < first.round]
    return _start(judged, first.source) + before[-1].env_steps if before else 0


def _label(judged: Sequence[Decision], run: str) -> str:
    """Return "walk from stand", and the round alone for a run from an earlier one."""
    row = next(row for row in judged if row.run == run)
    known = any(other.run == row.source for other in judged)
    stage = f"{row.stage}, as before" if run.endswith(ON) else row.stage
    return f"{row.round}: {stage}" + ("" if known else f" from {row.source}")
