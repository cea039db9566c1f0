"""All tasks by name: those of this package, of a user's file, of installed packages."""

from __future__ import annotations

import dataclasses
import re
from typing import Any

from twirl_mjx.plugins import Registry
from twirl_mjx.tasks.task import Measure, Task

BUILT_IN = ("stand", "biped", "imitate", "hurdles")


def accept(item: Any) -> type[Task]:
    """Return a task class after checking what it says of itself.

    Raises:
        ValueError: It is no task, or a part of it has another form; one line.
    """
    if not (isinstance(item, type) and issubclass(item, Task)):
        raise ValueError(f"{_called(item)} is no task: expected a class derived from Task")
    name = getattr(item, "name", None)
    if not isinstance(name, str) or not re.fullmatch(r"[a-z][a-z0-9_]*", name):
        raise ValueError(f"{_called(item)} has the name {name!r}, expected lower case letters,"
                         f" digits and _ (nearest: {_called(item).lower()!r})")  # fmt: skip
    options = item.Options
    if not (isinstance(options, type) and dataclasses.is_dataclass(options)):
        raise ValueError(f"{_called(item)}.Options is {options!r}, expected a frozen dataclass")
    if not options.__dataclass_params__.frozen:  # type: ignore[attr-defined]
        raise ValueError(f"{_called(item)}.Options is not frozen (@dataclass(frozen=True))")
    for field in dataclasses.fields(options):
        if field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
            raise ValueError(f"{_called(item)}.Options.{field.name} has no default")
    known = {field.name for field in dataclasses.fields(options)}
    for part in ("course_options", "training_options"):
        if unknown := [key for key in getattr(item, part) if key not in known]:
            raise ValueError(f"{_called(item)}.{part} names {unknown[0]!r}, which is no option")
    for key, measure in item.measures.items():
        if not isinstance(measure, Measure):
            raise ValueError(f"{_called(item)}.measures[{key!r}] is no Measure: {measure!r}")
    return item


def _called(item: Any) -> str:
    return getattr(item, "__name__", None) or f"{item!r}"


TASKS: Registry[type[Task]] = Registry(
    "task",
    accept=accept,
    group="twirl_mjx.tasks",
    shipped={name: f"twirl_mjx.tasks.{name}:{name.title()}" for name in BUILT_IN},
)
"""The one list of tasks."""

register = TASKS.register
