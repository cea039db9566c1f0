"""Configs as JSON, and the difference between two of them."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import types
import typing
from typing import Any

from twirl_mjx.checks import check_choice
from twirl_mjx.config import TrainConfig


def to_json(config: TrainConfig) -> str:
    """Return the config as indented JSON with every field."""
    return json.dumps(dataclasses.asdict(config), indent=2, sort_keys=True) + "\n"


def from_dict(kind: type, values: dict[str, Any], where: str = "config") -> Any:
    """Build a config dataclass from plain values (as JSON gives them).

    Raises:
        ValueError: An unknown key, with the nearest valid one, or a value of another type than
            its field's or out of range.
    """
    if not isinstance(values, dict):
        raise ValueError(f"{where} is {values!r}, expected names and values")
    fields = {f.name: f for f in dataclasses.fields(kind)}
    types_of = typing.get_type_hints(kind)
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


def from_json(text: str) -> TrainConfig:
    """Read a config written by :func:`to_json`.

    Raises:
        ValueError: The text is not JSON, or holds an unknown key or a bad value.
    """
    return from_dict(TrainConfig, json.loads(text))


def diff(a: TrainConfig, b: TrainConfig) -> list[str]:
    """Return one line ``key: a -> b`` for every field in which two configs differ."""
    flat_a, flat_b = flatten(a), flatten(b)
    return [f"{k}: {flat_a[k]!r} -> {flat_b[k]!r}" for k in flat_a if flat_a[k] != flat_b[k]]


def departures(config: Any) -> dict[str, Any]:
    """Return the fields of a config (or a part of one) that are not the default, flat.

    What identifies a config: a field that a later version adds, at its default, changes nothing.
    """
    default = flatten(type(config)())
    return {key: value for key, value in flatten(config).items() if value != default[key]}


def flatten(config: Any) -> dict[str, Any]:
    """Return a config (or a part of one) as a flat dict with dotted keys."""

    def walk(value: Any, prefix: str) -> dict[str, Any]:
        if not dataclasses.is_dataclass(value):
            return {prefix[:-1]: value}
        out: dict[str, Any] = {}
        for field in dataclasses.fields(value):
            out |= walk(getattr(value, field.name), f"{prefix}{field.name}.")
        return out

    return walk(config, "")
