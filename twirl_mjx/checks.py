"""Refusals that name the value, what is allowed and the nearest valid choice."""

from __future__ import annotations

import difflib


def check_choice(what: str, value: str, choices: tuple[str, ...]) -> None:
    """Refuse a value that is not one of ``choices``.

    Raises:
        ValueError: The message lists the choices and the nearest one.
    """
    if value not in choices:
        nearest = (difflib.get_close_matches(value, choices, n=1, cutoff=0.0) or choices[:1])[0]
        raise ValueError(
            f"unknown {what} {value!r}: choose one of {', '.join(choices)} (nearest: {nearest!r})"
        )


def check_range(what: str, value: float, low: float, high: float) -> None:
    """Refuse a number outside [low, high].

    Raises:
        ValueError: The message names the value, the range and the nearest end.
    """
    if not low <= value <= high:
        nearest = low if not value > low else high
        raise ValueError(f"{what} = {value} is outside [{low}, {high}] (nearest: {nearest})")
