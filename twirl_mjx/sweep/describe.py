"""``grid.json``: what the figures need to know of a folder of tables (see ``figures.facts``).

``gather`` writes it for grids. For a folder of tables that belong to no grid::

    .venv/bin/python -m twirl_mjx.sweep.describe experiments/results/NAME

which keeps title, about, place, baseline, smoke and axis titles of a file that is there.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from twirl_mjx import files
from twirl_mjx.figures.facts import DOES_NOTHING, FILE
from twirl_mjx.figures.tables import read_directory, sort_key
from twirl_mjx.sim.leaves import shift_names
from twirl_mjx.tasks.measures import SUCCESS, measures_of
from twirl_mjx.tasks.registry import TASKS
from twirl_mjx.training.config import VARIANTS

VARIANT_ORDER = (*VARIANTS[1:], *VARIANTS[:1], *DOES_NOTHING[::-1])
"""Variants in the order of figures, which also gives them their colours."""
KEPT = ("title", "about", "place", "smoke", "baseline")
"""Keys that are not made from tasks and tables."""

Json = dict[str, Any]


def vocabulary(tasks: Sequence[str]) -> Json:
    """Return how the measures of tasks are written, and what leads each task."""
    measures: Json = {}
    kinds = [TASKS.get(task) for task in tasks if task in TASKS.names()]
    for kind in kinds:
        for name, measure in (measures_of(kind) | {"success": SUCCESS}).items():
            measures[name] = {"unit": measure.unit, "about": measure.about}
            if measure.smaller_is_better:
                measures[name]["smaller_is_better"] = True
        for name, parts in kind.ratios.items():
            measures[name] = {"unit": "share", "ratio": list(parts)}
    return {"tasks": {kind.name: {"lead": list(kind.lead)} for kind in kinds}, "measures": measures}


def facts(
    tasks: Iterable[str],
    shifts: Iterable[str],
    settings: Mapping[str, Sequence[str]],
    shown: Mapping[str, Any],
) -> Json:
    """Return the content of ``grid.json``.

    Args:
        tasks: Tasks of the tables.
        shifts: Their shifts.
        settings: Column of settings -> its labels in order.
        shown: ``title``, ``about``, ``place``, ``smoke``, ``baseline``, and ``titles`` of axes.
    """
    orders = {
        "task": in_order(tasks, TASKS.names()),
        "shift": in_order(shifts, shift_names()),
        "variant": list(VARIANT_ORDER),
        **settings,
    }
    titles = shown.get("titles", {})
    axes = {
        name: ({"title": titles[name]} if name in titles else {}) | {"order": list(order)}
        for name, order in orders.items()
    }
    kept = {key: shown[key] for key in KEPT if shown.get(key)}
    return kept | {"axes": axes} | vocabulary(orders["task"])


def in_order(values: Iterable[str], known: Sequence[str]) -> list[str]:
    """Return distinct values: those known in their order, then the rest by appearance."""
    found = dict.fromkeys(values)
    return [v for v in known if v in found] + [v for v in found if v not in known]


def text_of(content: Json) -> str:
    """Return ``grid.json`` as text, one axis, task or measure a line."""
    blocks = []
    for key, value in content.items():
        if key in ("axes", "tasks", "measures") and value:
            lines = [f"  {json.dumps(name)}: {json.dumps(entry)}" for name, entry in value.items()]
            blocks.append(f" {json.dumps(key)}: {{\n" + ",\n".join(lines) + "\n }")
        else:
            blocks.append(f" {json.dumps(key)}: {json.dumps(value)}")
    return "{\n" + ",\n".join(blocks) + "\n}\n"


def describe(folder: Path) -> Path:
    """Write ``grid.json`` of a folder of tables from the tables themselves; return its path.

    Raises:
        ValueError: No table there, or one that is not valid.
    """
    tables = [table for table in read_directory(folder) if table is not None]
    if not tables:
        raise ValueError(f"{folder}: no tables to describe")
    path = folder / FILE
    old: Json = files.read_json(path, "grid.json") if path.is_file() else {}
    titles = {k: axis["title"] for k, axis in old.get("axes", {}).items() if "title" in axis}

    def values(column: str) -> list[str]:
        return list(dict.fromkeys(v for t in tables for v in t[column].tolist()))

    settings = {}
    for column in dict.fromkeys(c for table in tables for c in table.settings):
        found = {v for t in tables if column in t.columns for v in t[column].tolist() if v}
        listed = old.get("axes", {}).get(column, {}).get("order", ())
        settings[column] = in_order(sorted(found, key=sort_key), listed)
    content = facts(values("task"), values("shift"), settings, old | {"titles": titles})
    files.write_text(path, text_of(content))
    return path


if __name__ == "__main__":
    for argument in sys.argv[1:]:
        print(f"wrote {describe(Path(argument))}")
