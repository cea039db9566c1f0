"""Numbers that pages quote, taken from committed tables.

A page holds blocks between ``<!-- quotes: NAME -->`` and ``<!-- end: NAME -->``. ``twirl figures``
writes what stands there: the template ``experiments/quotes/NAME.md.in`` with every field
``{{...}}`` replaced, so that no number is typed by hand. A field is a line of words::

    {{GRID MEASURE COLUMN=VALUE ... [FORM]}}
    {{GRID MEASURE COLUMN=VALUE ... over COLUMN=VALUE ... [better]}}

It names a folder of ``experiments/results``, a measure and the rows it is about: all of one task,
shift, variant and setting; runs may be several. Values with blanks stand in quotation marks. A
measure ``eval/...`` is read from the curves, any other from the closing episodes. Of a curve
``at=N`` takes the last value by N transitions, not that of the end. Forms:

``mean``    mean with its 95 % interval (the default); a share in per cent
``iqm``     interquartile mean with its 95 % interval
``short``   mean without its interval
``median``  median of all episodes
``seeds``   the mean of every run, in the order of the seeds
``best``    of curves: the value of every run at its best evaluation return
``count``   number of values
``over``    ratio of the two means with its 95 % interval; with ``better`` the probability that a
            sample of the first is better than one of the second
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from twirl_mjx import files
from twirl_mjx.checks import choose_one
from twirl_mjx.figures.aggregate import cell_runs, metric_rows, run_series, step_hold
from twirl_mjx.figures.errors import TableError
from twirl_mjx.figures.facts import EVALUATION, Measure
from twirl_mjx.figures.statistics import (
    Interval,
    bootstrap,
    iqm,
    mean,
    probability_of_improvement,
    ratio,
)
from twirl_mjx.figures.tables import Table, mask, read_directory, unique
from twirl_mjx.figures.wording import interval_text, numbers

FORMS = ("mean", "short", "iqm", "median", "seeds", "best", "count")
"""What a field may end with."""
TEMPLATE = "{name}.md.in"
"""Name of a template's file."""

_BLOCK = re.compile(r"(<!-- quotes: ([\w-]+) -->\n)(.*?)(<!-- end: \2 -->)", re.S)
_FIELD = re.compile(r"\{\{(.*?)\}\}", re.S)


@dataclass(frozen=True)
class Quotes:
    """Fills blocks and fields from one folder of results."""

    results: Path
    """``experiments/results``."""
    templates: Path
    """``experiments/quotes``."""
    _read: dict[str, tuple[Table | None, Table | None]] = field(default_factory=dict)
    _found: dict[str, str] = field(default_factory=dict)

    def fill(self, text: str) -> str:
        """Return the text of a page with every block written anew.

        Raises:
            TableError: A block without template, or a field that no table answers.
        """
        return _BLOCK.sub(lambda block: block[1] + self._block(block[2]) + block[4], text)

    def write(self, page: str | Path) -> bool:
        """Write the blocks of a page anew; return whether that changed it.

        Raises:
            TableError: As in ``fill``.
        """
        old = files.read_text(page, "a page")
        new = self.fill(old)
        if new != old:
            files.write_text(page, new)
        return new != old

    def quote(self, words: str) -> str:
        """Return what a field (without its braces) is replaced by.

        Raises:
            TableError: An unknown folder, measure, column, value or form, or rows of several
                tasks, shifts, variants or settings.
        """
        left, _, right = words.partition(" over ")
        grid, metric, *conditions = shlex.split(left)
        if right:
            others = shlex.split(right)
            better = others[-1] == "better"
            rows, at = self._rows(grid, metric, conditions)
            against, _ = self._rows(grid, metric, others[: len(others) - better])
            return _compared(_samples(rows, at), _samples(against, at), rows, metric, better=better)
        form = "mean" if "=" in (conditions or ["="])[-1] else conditions.pop()
        if form not in FORMS:
            raise TableError(f"{words}: no form '{form}': {choose_one(form, FORMS)}")
        rows, at = self._rows(grid, metric, conditions)
        if form == "best":
            returns, _ = self._rows(grid, EVALUATION + "return", conditions)
            return _listed(_at_best(rows, returns), rows.facts.measure(metric))
        return _one(_samples(rows, at), form, rows.facts.measure(metric))

    def _block(self, name: str) -> str:
        path = self.templates / TEMPLATE.format(name=name)
        if not path.is_file():
            known = [file.name.removesuffix(".md.in") for file in self.templates.glob("*.md.in")]
            raise TableError(f"{path}: no template '{name}': {choose_one(name, known)}")
        template = files.read_text(path, "a template")
        return _FIELD.sub(lambda found: self._quoted(found[1]), template)

    def _quoted(self, words: str) -> str:
        if words not in self._found:
            self._found[words] = self.quote(words)
        return self._found[words]

    def _rows(self, grid: str, metric: str, conditions: Sequence[str]) -> tuple[Table, int | None]:
        """Return the rows of one cell, and the transitions at which a curve is read."""
        table = self._table(grid, metric)
        at = None
        for condition in conditions:
            column, _, value = condition.partition("=")
            if column == "at":
                at = int(value)
                continue
            hits = table[column].astype(str) == value
            if not hits.any():
                known = [str(known) for known in unique(table, column)]
                raise TableError(f"{grid}: no {column} '{value}': {choose_one(value, known)}")
            table = mask(table, hits)
        rows = metric_rows(table, metric)
        for column in ("task", "shift", "variant", *rows.settings):
            if len(several := unique(rows, column)) > 1:
                raise TableError(f"{grid} {metric}: {column} is any of {several}: name one")
        return rows, at

    def _table(self, grid: str, metric: str) -> Table:
        if grid not in self._read:
            if not (self.results / grid).is_dir():
                known = [path.name for path in self.results.iterdir() if path.is_dir()]
                raise TableError(f"{self.results}: no folder '{grid}': {choose_one(grid, known)}")
            self._read[grid] = read_directory(self.results / grid)
        curves, episodes = self._read[grid]
        table = curves if metric.startswith(EVALUATION) else episodes
        if table is None:
            kind = "curves" if metric.startswith(EVALUATION) else "closing episodes"
            raise TableError(f"{self.results / grid}: no {kind} to quote '{metric}' from")
        return table


def _samples(rows: Table, at: int | None) -> list[np.ndarray]:
    """Return the samples of every run: its episodes, or one value of its curve."""
    last = int(rows["env_steps"].max())
    if rows.is_episodes or at is not None:
        return cell_runs(rows, last if at is None else at)
    return [np.array([series.values[-1]]) for series in run_series(rows)]


def _at_best(rows: Table, returns: Table) -> list[np.ndarray]:
    """Return the value [1] of every run where its evaluation return was highest."""
    best = {s.run: s.env_steps[[np.argmax(s.values)]] for s in run_series(returns)}
    return [step_hold(series, best[series.run]) for series in run_series(rows)]


def _one(runs: list[np.ndarray], form: str, measure: Measure) -> str:
    pooled = np.concatenate(runs)
    if form == "count":
        return f"{len(pooled)}"
    if form == "seeds":
        return _listed(runs, measure)
    if form in ("median", "short"):
        centre = np.median(pooled) if form == "median" else pooled.mean()
        return _text(Interval(float(centre), np.nan, np.nan), measure)
    return _text(bootstrap(runs, iqm if form == "iqm" else mean), measure)


def _compared(
    runs: list[np.ndarray], against: list[np.ndarray], rows: Table, metric: str, *, better: bool
) -> str:
    if not better:
        return interval_text(ratio(runs, against, mean))
    sign = -1.0 if rows.facts.measure(metric).smaller_is_better else 1.0
    xs, ys = ([sign * run for run in side] for side in (runs, against))
    return interval_text(probability_of_improvement(xs, ys))


def _listed(runs: Sequence[np.ndarray], measure: Measure) -> str:
    values = [float(run.mean()) for run in runs]
    if measure.is_rate:
        return " / ".join(f"{100 * value:.0f}" for value in values) + " %"
    return " / ".join(numbers(*values))


def _text(interval: Interval, measure: Measure) -> str:
    if not measure.is_rate:
        return interval_text(interval)
    centre, low, high = (100 * x for x in (interval.estimate, interval.low, interval.high))
    return f"{centre:.0f} %" if np.isnan(low) else f"{centre:.0f} % [{low:.0f}, {high:.0f}]"
