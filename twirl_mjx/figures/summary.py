"""One line of numbers per cell of a grid: the table behind the figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from twirl_mjx.figures.aggregate import cell_runs, common_end, estimate, metric_rows, statistics_of
from twirl_mjx.figures.cells import groups, is_idle, labelled
from twirl_mjx.figures.facts import Measure
from twirl_mjx.figures.statistics import (
    Interval,
    bootstrap,
    iqm,
    mean,
    probability_of_improvement,
    ratio,
)
from twirl_mjx.figures.tables import LABEL_COLUMN, Table, note_texts, unique


@dataclass(frozen=True)
class Summary:
    """The numbers of one cell: an arm of a task under a shift."""

    task: str
    """Task name."""
    shift: str
    """Dynamics shift."""
    label: str
    """The cell in words, without task and shift; the run's name where runs are summarised."""
    is_idle: bool
    """Whether it is a policy that learns nothing, a level to beat and no arm."""
    is_baseline: bool
    """Whether it is what the others are compared with."""
    arms: tuple[str, ...]
    """Files that hold the rows."""
    commands: tuple[str, ...]
    """Commands the files state for their rows."""
    seeds: tuple[int, ...]
    """Seeds of the runs."""
    samples: int
    """Values summarised: runs of a curve table, episodes of an episode table."""
    env_steps: int
    """Transitions at which the cell is compared."""
    grad_steps: int
    """Critic updates by then, most of any run; 0 for episodes."""
    wall_s: float
    """Wall time by then, most of any run, seconds; NaN for episodes."""
    runs: tuple[float, ...]
    """Mean of every run, by seed."""
    mean: Interval
    """Mean over all samples."""
    robust: Interval
    """IQM (mean for a rate) over all samples."""
    ratio: Interval | None
    """``robust`` over that of the baseline; None for the baseline itself or where there is none."""
    better: Interval | None
    """Probability of being better than the baseline; None as above."""


def summarise(
    table: Table,
    metric: str,
    baseline: Mapping[str, str] | None = None,
    *,
    by: str = LABEL_COLUMN,
) -> list[Summary]:
    """Return one summary per cell, in the order of figures.

    Args:
        table: Curve or episode rows.
        metric: What to summarise.
        baseline: Column = value of the cells to compare with, for example
            ``{"variant": "scratch"}``; by default that of the table's facts.
        by: What a cell stands for: ``label``, or ``run`` to set runs side by side.

    Raises:
        TableError: If the rows lack the metric or contradict themselves.
    """
    rows = labelled(metric_rows(table, metric))
    baseline = rows.facts.baseline if baseline is None else baseline
    ends = common_end(table)
    summaries = []
    for place, part in groups(rows, ["task", "shift"]).items():
        cells = {key[0]: cell for key, cell in groups(part, [by]).items()}
        runs = {label: cell_runs(cell, ends[place]) for label, cell in cells.items()}
        reference = _find_baseline(cells, baseline)
        for label, cell in cells.items():
            against = runs[reference] if reference not in (None, label) else None
            compared = _compare(runs[label], against, rows.facts.measure(metric))
            summaries.append(
                _summary(
                    cell, metric, (*place, label), runs[label], ends[place], compared,
                    is_baseline=label == reference,
                )
            )  # fmt: skip
    return summaries


def best(summaries: Sequence[Summary], measure: Measure) -> dict[tuple[str, str], Summary]:
    """Return the best learning cell of every task and shift that holds two or more.

    Args:
        summaries: Summaries of one measure; they are compared by ``robust``.
        measure: The measure, which says whether less is better.
    """
    sign = -1.0 if measure.smaller_is_better else 1.0
    rivals: dict[tuple[str, str], list[Summary]] = {}
    for s in summaries:
        if not s.is_idle:
            rivals.setdefault((s.task, s.shift), []).append(s)
    return {
        place: max(several, key=lambda s: sign * s.robust.estimate)
        for place, several in rivals.items()
        if len(several) > 1
    }


def _find_baseline(cells: Mapping[str, Table], baseline: Mapping[str, str]) -> str | None:
    """Return the label of the one cell that matches, None if no or several cells do."""
    labels = [
        label
        for label, cell in cells.items()
        if all(c in cell.columns and (cell[c] == v).all() for c, v in baseline.items())
    ]
    return labels[0] if baseline and len(labels) == 1 else None


def _compare(
    runs: list[np.ndarray], against: list[np.ndarray] | None, measure: Measure
) -> tuple[Interval | None, Interval | None]:
    if against is None:
        return None, None
    sign = -1.0 if measure.smaller_is_better else 1.0
    better = probability_of_improvement([sign * x for x in runs], [sign * y for y in against])
    return ratio(runs, against, mean if measure.is_rate else iqm), better


def _summary(
    cell: Table,
    metric: str,
    names: tuple[str, str, str],
    runs: list[np.ndarray],
    end: int,
    compared: tuple[Interval | None, Interval | None],
    *,
    is_baseline: bool,
) -> Summary:
    reached = cell["env_steps"] <= end
    last = int(cell["env_steps"].max())
    curves = not cell.is_episodes and bool(reached.any())
    return Summary(
        task=names[0],
        shift=names[1],
        label=names[2],
        is_idle=bool(is_idle(cell).all()),
        is_baseline=is_baseline,
        arms=tuple(unique(cell, "arm")),
        commands=tuple(note_texts(cell, "command")),
        seeds=tuple(unique(cell, "seed")),
        samples=sum(map(len, runs)),
        env_steps=last if cell.is_episodes else min(end, last),
        grad_steps=int(cell["grad_steps"][reached].max()) if curves else 0,
        wall_s=float(cell["wall_s"][reached].max()) if curves else float("nan"),
        runs=tuple(float(run.mean()) for run in runs),
        mean=bootstrap(runs, mean),
        robust=estimate(runs, statistics_of(cell.facts, metric)[-1]),
        ratio=compared[0],
        better=compared[1],
    )
