"""Frozen dataclasses as plain values and back: what configs and options have in common."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import types
import typing
from typing import Any

from twirl_mjx.checks import check_choice


def from_dict(kind: type, values: dict[str, Any], where: str = "config") -> Any:
    """Build a dataclass from plain values (as JSON gives them).

    Raises:
        ValueError: An unknown key, with the nearest valid one, or a value of another type than
            its field's or out of range.
    """
    if not isinstance(values, dict):
        raise ValueError(f"{where} is {values!r}, expected names and values")
    fields = {f.name: f for f in dataclasses.fields(kind)}
    types_of = _types_of(kind)
    for key in values:
        check_choice(f"key in {where}", key, tuple(fields))
    made = {}
    for key, value in values.items():
        default = fields[key].default
        if dataclasses.is_dataclass(default) and isinstance(value, dict):
            value = from_dict(type(default), value, f"{where}.{key}")
        else:
            value = tuple(value) if isinstance(value, list) else value
            check_type(f"{where}.{key}".removeprefix("config."), value, types_of[key])
        made[key] = value
    return kind(**made)


_types_of = functools.cache(typing.get_type_hints)  # evaluates the annotations, 2 ms a class


def check_type(field: str, value: Any, expected: Any) -> None:
    """Refuse a value that is not of the type a field is annotated with.

    A whole number is a ``float`` too; ``True`` is no number.

    Raises:
        ValueError: The message names field, value and type, and the nearest value of that type.
    """
    if _fits(value, expected):
        return
    if typing.get_origin(expected) is typing.Literal:
        name = "one of " + ", ".join(map(repr, typing.get_args(expected)))
    else:
        name = expected.__name__ if isinstance(expected, type) else str(expected)
    nearest = ""
    for convert in (lambda: (value,), lambda: float(value), lambda: round(float(value))):
        with contextlib.suppress(TypeError, ValueError, OverflowError):
            if not nearest and _fits(made := convert(), expected):
                nearest = f" (nearest: {made!r})"
    raise ValueError(f"{field} = {value!r} is {type(value).__name__}, expected {name}{nearest}")


def _fits(value: Any, expected: Any) -> bool:
    origin, parts = typing.get_origin(expected), typing.get_args(expected)
    if expected is Any:
        return True
    if origin is typing.Literal:  # which of them is checked by the class, that names the nearest
        return isinstance(value, str)
    if origin in (typing.Union, types.UnionType):
        return any(_fits(value, part) for part in parts)
    if origin is tuple:
        if not isinstance(value, tuple):
            return False
        each = parts[:1] * len(value) if parts[-1] is Ellipsis else parts
        return len(value) == len(each) and all(map(_fits, value, each))
    return type(value) is expected or (expected is float and type(value) is int)


def flatten(record: Any) -> dict[str, Any]:
    """Return a dataclass and those in it as one flat dict with dotted keys."""
    out: dict[str, Any] = {}
    for field in dataclasses.fields(record):
        value = getattr(record, field.name)
        if dataclasses.is_dataclass(value):
            out |= {f"{field.name}.{key}": inner for key, inner in flatten(value).items()}
        else:
            out[field.name] = value
    return out


def departures(record: Any) -> dict[str, Any]:
    """Return the fields of a dataclass that are not the default, flat.

    What identifies it: a field that a later version adds, at its default, changes nothing.
    """
    default = flatten(type(record)())
    return {key: value for key, value in flatten(record).items() if value != default[key]}
