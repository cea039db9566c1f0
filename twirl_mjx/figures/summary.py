"""One line of numbers per cell of a grid: the table behind the figures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from twirl_mjx.figures.aggregate import (
    cell_strata,
    common_end,
    estimate,
    groups,
    metric_rows,
    statistics_of,
)
from twirl_mjx.figures.statistics import (
    Interval,
    iqm,
    mean,
    probability_of_improvement,
    ratio,
    std,
)
from twirl_mjx.figures.style import EVALUATION, MAIN_METRICS, METRICS, metric_info
from twirl_mjx.figures.tables import OPTIONAL_COLUMNS, Table, TableError, note_texts, unique

_BASELINES: dict[str, dict[str, object]] = {
    "tasks": {"variant": "scratch"},
    "shifts": {"variant": "weights"},
    "phi": {"phi": 0.0},
    "utd": {"utd": 1.0},
}


@dataclass(frozen=True)
class Summary:
    """The numbers of one cell: a variant (and phi, and utd) of a task under a shift."""

    task: str
    """Task name."""
    shift: str
    """Dynamics shift."""
    variant: str
    """Variant name, or the run's where runs are summarised."""
    settings: dict[str, float]
    """phi and utd, where the table states them."""
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
    mean: float
    """Mean over the samples."""
    std: float
    """Standard deviation (n - 1) over the samples; NaN for one."""
    robust: Interval
    """IQM (mean for a rate) with its stratified bootstrap interval."""
    ratio: Interval | None
    """``robust`` over that of the baseline; None for the baseline itself or where there is none."""
    better: Interval | None
    """Probability of being better than the baseline; None as above."""

    @property
    def label(self) -> str:
        """The cell in words, without task and shift."""
        return ", ".join([self.variant, *(f"{k} {v:g}" for k, v in self.settings.items())])

    def matches(self, baseline: dict[str, object]) -> bool:
        """Return whether the cell has the values (column = value) of a baseline."""
        return {"variant": self.variant, **self.settings}.items() >= baseline.items()


def baseline_of(grid: str) -> dict[str, object]:
    """Return what a grid's cells are compared with, as column = value; empty if nothing.

    The tasks are compared with learning from scratch, shifts with transferring the networks only,
    ablations with their smallest value.
    """
    return _BASELINES.get(grid_kind(grid), {})


def grid_kind(grid: str) -> str:
    """Return the first word of a grid's name: ``phi``, ``phi_small`` and ``phi-cpu`` are alike."""
    return grid.replace("-", "_").split("_")[0]


def main_metric(table: Table) -> str:
    """Return the first of ``MAIN_METRICS`` that every run of a table reports.

    Raises:
        TableError: If there is none; the message names a run without.
    """
    runs = set(zip(table["arm"].tolist(), table["run"].tolist(), strict=True))
    lacking = runs
    for metric in MAIN_METRICS:
        rows = table["metric"] == metric
        have = zip(table["arm"][rows].tolist(), table["run"][rows].tolist(), strict=True)
        lacking = runs - set(have)
        if not lacking:
            return metric
    names = " and ".join(f"'{metric}'" for metric in MAIN_METRICS)
    run = min(lacking)[1]
    raise TableError(f"{table.source}: run '{run}' has neither {names} for all runs to compare by")


def shown_metrics(table: Table, main: str) -> list[str]:
    """Return the main metric, then those with a written name and the same prefix."""
    prefix = EVALUATION if main.startswith(EVALUATION) else ""
    present = set(unique(table, "metric"))
    names = [prefix + name for name in METRICS]
    return [main, *(name for name in names if name in present and name != main)]


def summarise(
    table: Table,
    metric: str,
    baseline: dict[str, object] | None = None,
    *,
    by: str = "variant",
) -> list[Summary]:
    """Return one summary per cell, in the order of figures.

    Args:
        table: Curve or episode rows.
        metric: What to summarise.
        baseline: Column = value of the cells to compare with, for example
            ``{"variant": "scratch"}``; None or empty for no comparison.
        by: What a cell stands for: ``variant``, or ``run`` to set runs side by side.

    Raises:
        TableError: If the rows lack the metric or contradict themselves.
    """
    rows = metric_rows(table, metric)
    extra = [c for c in OPTIONAL_COLUMNS if c in rows.columns]
    filled = {c: np.where(np.isnan(rows[c]), -1.0, rows[c]) for c in extra}  # -1: not stated
    rows = Table({**rows.columns, **filled}, rows.notes, rows.source)
    ends = common_end(rows)
    statistic = statistics_of(metric)[-1]
    summaries = []
    for (task, shift), part in groups(rows, ["task", "shift"]).items():
        cells = groups(part, [by, *extra])
        end = ends[(task, shift)]
        strata = {key: cell_strata(cell, end) for key, cell in cells.items()}
        reference = _find_baseline(cells, baseline or {})
        for key, cell in cells.items():
            settings = {c: v for c, v in zip(extra, key[1:], strict=True) if v >= 0}
            against = strata[reference] if reference not in (None, key) else None
            compared = _compare(strata[key], against, metric)
            summaries.append(
                _summary(
                    cell, (task, shift, key[0]), settings, strata[key], statistic, end, compared
                )
            )
    return summaries


def shift_wins(summaries: list[Summary]) -> tuple[int, int]:
    """Return in how many (task, shift) cells a TWiRL variant beats ``weights`` and ``zero-shot``.

    Only cells that hold a TWiRL variant and both others count; the measure is ``robust``.

    Args:
        summaries: Summaries of a metric of which more is better.

    Returns:
        Cells won and cells compared.
    """
    cells: dict[tuple[str, str], dict[str, float]] = {}
    for s in summaries:
        cells.setdefault((s.task, s.shift), {})[s.variant] = s.robust.estimate
    won = compared = 0
    for values in cells.values():
        twirl = [values[v] for v in ("twirl", "twirl+weights") if v in values]
        if twirl and {"weights", "zero-shot"} <= values.keys():
            compared += 1
            won += max(twirl) > max(values["weights"], values["zero-shot"])
    return won, compared


def _find_baseline(cells: dict[tuple, Table], baseline: dict[str, object]) -> tuple | None:
    """Return the key of the one cell that matches, None if no or several cells do."""
    if not baseline:
        return None
    keys = [
        key
        for key, cell in cells.items()
        if all(c in cell.columns and (cell[c] == v).all() for c, v in baseline.items())
    ]
    return keys[0] if len(keys) == 1 else None


def _compare(
    strata: list[np.ndarray], against: list[np.ndarray] | None, metric: str
) -> tuple[Interval | None, Interval | None]:
    if against is None:
        return None, None
    x, y = np.concatenate(strata), np.concatenate(against)
    info = metric_info(metric)
    sign = 1.0 if info.higher_is_better else -1.0
    function = mean if info.is_rate else iqm
    return ratio(x, y, function), probability_of_improvement([sign * x], [sign * y])


def _summary(
    cell: Table,
    names: tuple[str, str, str],
    settings: dict[str, float],
    strata: list[np.ndarray],
    statistic: str,
    end: int,
    compared: tuple[Interval | None, Interval | None],
) -> Summary:
    pooled = np.concatenate(strata)
    reached = cell["env_steps"] <= end
    steps = int(cell["env_steps"].max()) if cell.is_episodes else end
    curves = not cell.is_episodes and bool(reached.any())
    return Summary(
        task=names[0],
        shift=names[1],
        variant=names[2],
        settings=settings,
        arms=tuple(unique(cell, "arm")),
        commands=tuple(note_texts(cell, "command")),
        seeds=tuple(unique(cell, "seed")),
        samples=len(pooled),
        env_steps=min(steps, int(cell["env_steps"].max())),
        grad_steps=int(cell["grad_steps"][reached].max()) if curves else 0,
        wall_s=float(cell["wall_s"][reached].max()) if curves else float("nan"),
        mean=float(mean(pooled)),
        std=float(std(pooled)),
        robust=estimate(strata, statistic),
        ratio=compared[0],
        better=compared[1],
    )
