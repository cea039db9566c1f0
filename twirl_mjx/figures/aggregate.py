"""From rows to numbers: runs on a common axis, last values, and summaries per cell.

A *cell* is what is compared: one variant (with its settings, such as phi) of one task under one
shift; its samples are its runs, which differ by their seeds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from twirl_mjx.checks import choose_one
from twirl_mjx.figures.cells import groups, is_idle
from twirl_mjx.figures.errors import TableError
from twirl_mjx.figures.facts import Facts
from twirl_mjx.figures.statistics import Interval, bootstrap, bootstrap_band, iqm, mean, std
from twirl_mjx.figures.tables import Table, mask, select

STATISTICS = ("mean", "iqm", "rate")
"""What centre and bounds mean: ``mean``: mean and standard deviation (paper style); ``iqm``:
interquartile mean and 95 % bootstrap interval; ``rate``: mean and 95 % bootstrap interval."""

MAX_POINTS = 200
"""Points kept of a drawn curve."""

_BOOTSTRAPPED = {"iqm": iqm, "rate": mean}


@dataclass(frozen=True)
class Series:
    """One metric of one run."""

    run: str
    """Name of the run."""
    seed: int
    """Its seed."""
    env_steps: np.ndarray
    """Transitions at each measurement, strictly increasing, [T]."""
    values: np.ndarray
    """The metric, [T]."""


@dataclass(frozen=True)
class Curve:
    """A statistic over runs along a common axis."""

    env_steps: np.ndarray
    """Transitions, [T]."""
    centre: np.ndarray
    """Mean or interquartile mean, [T]."""
    low: np.ndarray
    """Lower edge of the band, [T]; NaN for a single run."""
    high: np.ndarray
    """Upper edge of the band, [T]; NaN for a single run."""


def metric_rows(table: Table, metric: str) -> Table:
    """Return the measured (not NaN) rows of a metric.

    Raises:
        TableError: If the table does not have the metric, or has it nowhere measured.
    """
    part = select(table, metric=metric)
    part = mask(part, ~np.isnan(part["value"]))
    if not len(part):
        raise TableError(f"{table.source}: metric '{metric}' is NaN in every row")
    return part


def run_series(table: Table) -> list[Series]:
    """Return one series per run from the rows of one metric in one cell.

    A row that repeats an earlier one with the same value is dropped; a contradiction is refused.

    Raises:
        TableError: If a run holds two values for one moment, or two runs share a seed.
    """
    series = []
    for (seed, run), part in groups(table, ["seed", "run"]).items():
        order = np.lexsort((part["value"], part["env_steps"]))
        steps, values = part["env_steps"][order], part["value"][order]
        same = np.diff(steps) == 0
        clash = same & (np.diff(values) != 0)
        if clash.any():
            i = int(np.argmax(clash))
            raise TableError(
                f"{table.source}: run '{run}' has two values of '{part['metric'][0]}' at "
                f"{steps[i]} transitions, {values[i]:g} and {values[i + 1]:g}; expected one"
            )
        if series and series[-1].seed == seed:
            raise TableError(
                f"{table.source}: runs '{series[-1].run}' and '{run}' are the same cell with seed "
                f"{seed}; expected one run per seed"
            )
        keep = np.concatenate([[True], ~same])
        series.append(Series(str(run), int(seed), steps[keep], values[keep]))
    return series


def step_hold(series: Series, env_steps: np.ndarray) -> np.ndarray:
    """Return the last value measured at or before each moment; NaN before the first, [T]."""
    index = np.searchsorted(series.env_steps, env_steps, side="right") - 1
    return np.where(index >= 0, series.values[np.maximum(index, 0)], np.nan)


def common_axis(series: Sequence[Series], points: int = MAX_POINTS) -> np.ndarray:
    """Return moments at which every run has been measured and none has ended.

    Args:
        series: Runs of one cell.
        points: Most moments to return.

    Returns:
        Increasing transitions, [T]; empty if the runs do not overlap.
    """
    start = max(s.env_steps[0] for s in series)
    stop = min(s.env_steps[-1] for s in series)
    moments = np.unique(np.concatenate([s.env_steps for s in series]))
    moments = moments[(moments >= start) & (moments <= stop)]
    if len(moments) <= points:
        return moments
    return moments[np.linspace(0, len(moments) - 1, points).round().astype(int)]


def curve(series: Sequence[Series], statistic: str) -> Curve:
    """Return the statistic of runs over their common axis, empty if the runs do not overlap.

    Args:
        series: Runs of one cell.
        statistic: One of ``STATISTICS``.
    """
    axis = common_axis(series)
    if not len(axis):  # a measure that is undefined most of the time
        return Curve(axis, *np.empty((3, 0)))
    values = np.stack([step_hold(s, axis) for s in series])
    if check_statistic(statistic) != "mean":
        function = _BOOTSTRAPPED[statistic]
        return Curve(axis, function(values, axis=0), *bootstrap_band(values, function))
    centre, spread = mean(values, axis=0), std(values, axis=0)
    return Curve(axis, centre, centre - spread, centre + spread)


def seed_counts(table: Table, by: str) -> tuple[int, str]:
    """Return the most runs in a cell, and the range of runs per cell in words.

    Args:
        table: Any rows.
        by: What a cell stands for, besides task and shift.
    """
    learning = mask(table, ~is_idle(table))
    cells = groups(learning if len(learning) else table, ["task", "shift", by]).values()
    counts = [len(groups(cell, ["arm", "run", "seed"])) for cell in cells]
    low, high = min(counts), max(counts)
    return high, f"{low} to {high} seeds" if low < high else f"{high} seed{'s' * (high > 1)}"


def common_end(table: Table) -> dict[tuple, int]:
    """Return, per (task, shift), the transitions that every trained run reached.

    Runs without training (zero-shot, or a policy that learns nothing) do not count. This is the
    moment at which arms are compared: never one run's longer training against another's shorter.

    Args:
        table: Rows of all metrics: one that is seldom defined ends before its run does.
    """
    ends = {}
    for key, rows in groups(table, ["task", "shift"]).items():
        part = mask(rows, ~is_idle(rows))
        lasts = [s["env_steps"].max() for s in groups(part, ["arm", "run", "seed"]).values()]
        ends[key] = int(min((last for last in lasts if last > 0), default=0))
    return ends


def final_values(series: Sequence[Series], env_steps: int) -> np.ndarray:
    """Return the last value of each run measured by ``env_steps``, [S].

    Raises:
        TableError: If a run was not measured by then.
    """
    for s in series:
        if s.env_steps[0] > env_steps:
            raise TableError(
                f"run '{s.run}' is first measured at {s.env_steps[0]} transitions, expected by "
                f"{env_steps}, where another run of its comparison ends"
            )
    return np.array([step_hold(s, np.array([env_steps]))[0] for s in series])


def estimate(runs: Sequence[np.ndarray], statistic: str) -> Interval:
    """Return centre and bounds of samples by a named statistic.

    Args:
        runs: Samples [E_k] of every run.
        statistic: One of ``STATISTICS``.
    """
    if check_statistic(statistic) != "mean":
        return bootstrap(runs, _BOOTSTRAPPED[statistic])
    pooled = np.concatenate(runs)
    centre, spread = float(mean(pooled)), float(std(pooled))
    return Interval(centre, centre - spread, centre + spread)


def cell_runs(table: Table, env_steps: int) -> list[np.ndarray]:
    """Return the samples of one cell, one array per run, from the rows of one metric.

    Args:
        table: Rows of one metric in one cell.
        env_steps: Moment of comparison; not used for episodes, nor where nothing was trained.

    Returns:
        Episodes: those [E] of the run's longest trained policy. Curves: its value [1].

    Raises:
        TableError: If an episode appears twice or a run has no value by ``env_steps``.
    """
    if table.is_episodes:
        return [_last_episodes(part) for part in groups(table, ["seed", "run"]).values()]
    if is_idle(table).all():
        env_steps = int(table["env_steps"].max())
    return [np.array([value]) for value in final_values(run_series(table), env_steps)]


def statistics_of(facts: Facts, metric: str) -> tuple[str, ...]:
    """Return the statistics in which a metric is shown."""
    return ("rate",) if facts.measure(metric).is_rate else ("mean", "iqm")


def check_statistic(statistic: str) -> str:
    """Return the name if it is one of ``STATISTICS``.

    Raises:
        ValueError: If it is not.
    """
    if statistic not in STATISTICS:
        raise ValueError(f"no statistic '{statistic}': {choose_one(statistic, STATISTICS)}")
    return statistic


def _last_episodes(table: Table) -> np.ndarray:
    """Return the values [E] of the longest trained policy of a run, each episode counted once."""
    part = mask(table, table["env_steps"] == table["env_steps"].max())
    episodes, counts = np.unique(part["episode"], return_counts=True)
    if counts.max() > 1:
        raise TableError(
            f"{table.source}: run '{part['run'][0]}' has episode {episodes[counts.argmax()]} "
            f"{counts.max()} times under shift '{part['shift'][0]}'; expected once"
        )
    return part["value"]
