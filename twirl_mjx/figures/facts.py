"""What figures need to know of a folder of tables beside the numbers: ``grid.json``.

All keys may be left out; without the file, order is that of appearance, a measure is written as it
is called, and a task is led by its return::

    {"title": "...", "about": "one sentence", "place": 1, "smoke": false,
     "axes": {"task": {"order": ["biped", "hurdles"]},
              "tau": {"title": "share of the target network", "order": ["0.005", "0.01"]}},
     "baseline": {"variant": "scratch"},
     "tasks": {"hurdles": {"lead": ["hurdles_passed", "single_flight"]}},
     "measures": {"min_distance": {"unit": "m", "smaller_is_better": true},
                  "single_flight": {"unit": "share", "ratio": ["clean_clearances",
                                                               "hurdles_passed"]}}}

``place`` puts a folder before others in the report. ``smoke``: the runs only show that everything
works; such tables are never drawn, tabled or reported. ``lead``: what a task is judged by, the
main measure first. ``ratio``: the measure is computed, the first over the second.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from twirl_mjx import files
from twirl_mjx.checks import choose_one
from twirl_mjx.figures.errors import TableError

FILE = "grid.json"
"""Name of the file, beside the tables."""
EVALUATION = "eval/"
"""Prefix of a measure taken during training, but with the deterministic policy on own seeds."""
DOES_NOTHING = ("zero", "source")
"""Variants, or runs, that learn nothing: shown as levels to beat, never counted as arms."""


@dataclass(frozen=True)
class Measure:
    """How a measure is written."""

    label: str = ""
    """Name for people, lower case; its own name where empty."""
    unit: str = ""
    """Unit; ``share`` is one of 0 or 1 per episode, so that quartiles mean nothing."""
    about: str = ""
    """What is measured, in a few words."""
    smaller_is_better: bool = False
    """Direction of improvement."""
    ratio: tuple[str, ...] = ()
    """The two measures it is the ratio of; measured itself where empty."""

    @property
    def is_rate(self) -> bool:
        """Whether the mean is shown, not the interquartile mean."""
        return self.unit == "share"


@dataclass(frozen=True)
class Axis:
    """What rows are told apart by: task, shift, variant, or a column of settings."""

    title: str = ""
    """What it is, for an axis label; its name where empty."""
    order: tuple[str, ...] = ()
    """Its labels in the order of figures and tables; more may follow in order of appearance."""


@dataclass(frozen=True)
class TaskFacts:
    """How a task is judged."""

    lead: tuple[str, ...] = ("return",)
    """Measures it is judged by, the main one first."""


@dataclass(frozen=True)
class Facts:
    """The whole of ``grid.json``."""

    title: str = ""
    """Heading in the report; the folder's name where empty."""
    about: str = ""
    """What is compared, in one sentence."""
    place: int = 1000
    """Lower ones come first in the report."""
    smoke: bool = False
    """Whether the runs are too short to be results."""
    axes: Mapping[str, Axis] = field(default_factory=dict)
    """``task``, ``shift``, ``variant`` or column of settings -> its title and order."""
    baseline: Mapping[str, str] = field(default_factory=dict)
    """Column = value of the arm that others are compared with."""
    tasks: Mapping[str, TaskFacts] = field(default_factory=dict)
    """Task -> how it is judged."""
    measures: Mapping[str, Measure] = field(default_factory=dict)
    """Measure -> how it is written."""

    def measure(self, name: str) -> Measure:
        """Return how a measure is written; an unlisted one is written as it is called."""
        if name.startswith(EVALUATION):
            plain = self.measure(name.removeprefix(EVALUATION))
            return replace(plain, label=f"evaluation {plain.label}")
        found = self.measures.get(name, Measure())
        unit = "" if found.unit == "1" else found.unit
        return replace(found, label=found.label or name.replace("_", " "), unit=unit)

    def label(self, name: str) -> str:
        """Return the axis label of a measure, with its unit."""
        found = self.measure(name)
        text = found.label[:1].upper() + found.label[1:]
        return f"{text} [{found.unit}]" if found.unit else text

    def order(self, axis: str) -> tuple[str, ...]:
        """Return the labels of an axis as the file lists them; empty where it does not."""
        return self.axes[axis].order if axis in self.axes else ()

    def axis_title(self, axis: str) -> str:
        """Return "phi (share of source rows)", or the name alone."""
        title = self.axes[axis].title if axis in self.axes else ""
        return f"{axis} ({title})" if title else axis

    def lead(self, task: str) -> tuple[str, ...]:
        """Return the measures a task is judged by."""
        return self.tasks.get(task, TaskFacts()).lead


def sort_key(label: object) -> tuple[bool, float, str]:
    """Return what sorts labels: numbers by size, then other text."""
    try:
        return False, float(str(label)), ""
    except ValueError:
        return True, 0.0, str(label)


def read_facts(folder: Path) -> Facts:
    """Read ``grid.json`` of a folder of tables; defaults where there is none.

    Raises:
        TableError: Not JSON, an unknown key (with the nearest), or a value of another kind.
    """
    path = folder / FILE
    if not path.is_file():
        return Facts()
    try:
        data = files.read_json(path, "facts of a grid")
    except ValueError as error:
        raise TableError(f"{path}: not JSON ({error})") from None
    many = {"axes": Axis, "tasks": TaskFacts, "measures": Measure}
    for key, kind in many.items():
        entries = _object(data, str(path)).get(key, {})
        data[key] = {
            name: _struct(kind, entry, f"{path}: {key}.{name}")
            for name, entry in _object(entries, f"{path}: {key}").items()
        }
    data["baseline"] = _object(data.get("baseline", {}), f"{path}: baseline")
    return _struct(Facts, data, str(path))


def _object(value: Any, where: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise TableError(f"{where} is {value!r}, expected an object")
    return value


def _struct(kind: type, data: Any, where: str) -> Any:
    defaults = {f.name: getattr(kind(), f.name) for f in fields(kind)}
    values = {}
    for key, value in _object(data, where).items():
        if key not in defaults:
            raise TableError(f"{where}: unknown key '{key}': {choose_one(key, defaults)}")
        wanted = type(defaults[key])
        if wanted is tuple and isinstance(value, list) and all(isinstance(v, str) for v in value):
            value = tuple(value)
        if type(value) is not wanted:
            shown = {tuple: "list of strings", str: "text"}.get(wanted, wanted.__name__)
            raise TableError(f"{where}: {key} is {value!r}, expected a {shown}")
        values[key] = value
    return kind(**values)
