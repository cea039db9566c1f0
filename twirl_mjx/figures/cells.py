"""What tells rows apart: order of values, names of arms, idle policies, what leads a task."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from twirl_mjx.figures.errors import TableError
from twirl_mjx.figures.facts import DOES_NOTHING, EVALUATION, Axis, sort_key
from twirl_mjx.figures.tables import LABEL_COLUMN, Table, mask


def ordered(table: Table, column: str) -> list:
    """Return the distinct values of a column in the order of figures.

    First those the facts list, as listed there; then numbers by size, text by appearance.
    """
    present = dict.fromkeys(table[column].tolist())
    known = [value for value in table.facts.order(column) if value in present]
    rest = [value for value in present if value not in known]
    numbers = not any(sort_key(value)[0] for value in rest if value != "")
    return known + (sorted(rest, key=sort_key) if numbers else rest)


def groups(table: Table, columns: Sequence[str]) -> dict[tuple, Table]:
    """Split a table by the values of columns, in the order of figures.

    Args:
        table: Any table.
        columns: Column names.

    Returns:
        Values of the columns -> rows; only combinations that occur.
    """
    orders = {c: ordered(table, c) for c in columns}
    parts: dict[tuple, Table] = {(): table}
    for column in columns:
        finer = {}
        for key, part in parts.items():
            for value in orders[column]:
                rows = part[column] == value
                if rows.any():
                    finer[(*key, value)] = mask(part, rows)
        parts = finer
    return parts


def is_idle(table: Table) -> np.ndarray:
    """Return which rows are of a policy that learns nothing (``DOES_NOTHING``), [R] bool."""
    return np.isin(table["variant"], DOES_NOTHING) | np.isin(table["run"], DOES_NOTHING)


def labelled(table: Table) -> Table:
    """Return the table with a column that names what a line, bar or row stands for.

    The name holds the settings, and the variant where several have settings or there are none; of
    a policy that learns nothing it is its name, with the settings that it has.
    """
    idle = is_idle(table)
    columns = ["variant", *table.settings]
    words = [table[column].tolist() for column in columns]
    idlers = np.where(np.isin(table["run"], DOES_NOTHING), table["run"], table["variant"])
    cells = [
        (idlers[i], *cell[1:]) if idle[i] else cell
        for i, cell in enumerate(zip(*words, strict=True))
    ]
    several = len({cell[0] for cell in cells if any(cell[1:])}) > 1
    names = {cell: _cell_name(cell, columns, several=several) for cell in dict.fromkeys(cells)}
    ranks = [{value: i for i, value in enumerate(ordered(table, c))} for c in columns]
    inside = sorted(
        names, key=lambda cell: [r.get(v, len(r)) for r, v in zip(ranks, cell, strict=True)]
    )
    axes = {**table.facts.axes, LABEL_COLUMN: Axis(order=tuple(names[cell] for cell in inside))}
    labels = np.array([names[cell] for cell in cells], dtype=str)
    return replace(
        table,
        columns={**table.columns, LABEL_COLUMN: labels},
        facts=replace(table.facts, axes=axes),
    )


def _cell_name(cell: Sequence[str], columns: Sequence[str], *, several: bool) -> str:
    pairs = zip(columns[1:], cell[1:], strict=True)
    settings = [f"{column} = {value}" for column, value in pairs if value]
    return ", ".join([cell[0], *settings] if several or not settings else settings)


def lead_metrics(table: Table, task: str) -> list[str]:
    """Return the measures a task is led by, as all of its learning runs report them.

    Those of evaluations (``eval/``) go before those of the exploring policy.

    Raises:
        TableError: If no lead is reported by all runs; the message names a run without.
    """
    rows = mask(table, table["task"] == task)
    learning = mask(rows, ~is_idle(rows))
    rows = learning if len(learning) else rows
    per_run = [set(part["metric"].tolist()) for part in groups(rows, ["arm", "run"]).values()]
    shared = set.intersection(*per_run)
    wanted = dict.fromkeys((*table.facts.lead(task), "return"))
    for prefix in (EVALUATION, ""):
        if found := [prefix + name for name in wanted if prefix + name in shared]:
            return found
    names = ", ".join(f"'{name}'" for name in wanted)
    lacking = [key[1] for key in groups(rows, ["arm", "run"])]
    lacking = [run for run, have in zip(lacking, per_run, strict=True) if not have & {*wanted}]
    who = f"run '{lacking[0]}' has" if lacking else "its runs have"
    raise TableError(f"{table.source}: {who} none of {names} for all runs to compare by")


def shown_metrics(table: Table, task: str) -> list[str]:
    """Return the leads of a task, then all measures of the same prefix that its rows hold."""
    leads = lead_metrics(table, task)
    prefix = EVALUATION if leads[0].startswith(EVALUATION) else ""
    rows = mask(table, (table["task"] == task) & ~np.isnan(table["value"]))
    present = dict.fromkeys(rows["metric"].tolist())
    listed = [prefix + name for name in table.facts.measures]
    names = dict.fromkeys((*leads, *(n for n in listed if n in present), *present))
    same = (n for n in names if n.startswith(EVALUATION) == bool(prefix))
    return list(same)
