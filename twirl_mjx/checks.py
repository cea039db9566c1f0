"""Refusals that name the value, what is allowed and the nearest valid choice."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def nearest(name: str, choices: Iterable[str]) -> str:
    """Return the closest of ``choices`` to ``name``, the first one when nothing is close."""
    listed = list(choices)
    return (difflib.get_close_matches(name, listed, n=1, cutoff=0.0) or listed)[0]


def check_choice(what: str, value: str, choices: tuple[str, ...]) -> None:
    """Refuse a value that is not one of ``choices``.

    Raises:
        ValueError: The message lists the choices and the nearest one.
    """
    if value not in choices:
        raise ValueError(
            f"unknown {what} {value!r}: choose one of {', '.join(choices)}"
            f" (nearest: {nearest(value, choices)!r})"
        )


def check_range(what: str, value: float, low: float, high: float) -> None:
    """Refuse a number outside [low, high].

    Raises:
        ValueError: The message names the value, the range and the nearest end.
    """
    if not low <= value <= high:
        end = low if not value > low else high
        raise ValueError(f"{what} = {value} is outside [{low}, {high}] (nearest: {end})")
