"""Refusals that name the value, what is allowed and the nearest valid choice."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence


def nearest(value: object, choices: Iterable[object]) -> str:
    """Return the one of ``choices`` (at least one) whose name is closest to ``value``."""
    names = {str(name).casefold(): str(name) for name in choices}
    close = difflib.get_close_matches(str(value).casefold(), names, n=1, cutoff=0.0)
    return names[close[0]] if close else next(iter(names.values()))


MOST_CHOICES = 32
"""Names that fit a message a person still reads."""


def choose_one(value: object, choices: Iterable[object]) -> str:
    """Return "choose one of a, b (nearest: 'a')", the end of a refusal of ``value``.

    Of more than ``MOST_CHOICES`` only the nearest is named.
    """
    names = [str(name) for name in choices]
    if not names:
        return "there is none to choose"
    shown = ", ".join(names) if len(names) <= MOST_CHOICES else f"{len(names)}"
    return f"choose one of {shown} (nearest: {nearest(value, names)!r})"


def check_choice(what: str, value: str, choices: tuple[str, ...]) -> None:
    """Refuse a value that is not one of ``choices``.

    Raises:
        ValueError: The message lists the choices and the nearest one.
    """
    if value not in choices:
        raise ValueError(f"unknown {what} {value!r}: {choose_one(value, choices)}")


def check_once(what: str, values: Sequence[object]) -> None:
    """Refuse values of which one is given twice.

    Raises:
        ValueError: The message has what was given, and each of it once.
    """
    if len(set(values)) != len(values):
        once = " ".join(map(str, dict.fromkeys(values)))
        given = " ".join(map(str, values))
        raise ValueError(f"{what} {given} names one twice (nearest: {what} {once})")


def check_printable(what: str, text: str) -> None:
    """Refuse a name with line breaks or other characters that cannot be seen.

    Tables and logs would be broken by them.

    Raises:
        ValueError: The message shows the name escaped, and the nearest that can be seen.
    """
    if not text.isprintable():
        seen = "".join(char if char.isprintable() else "_" for char in text)
        raise ValueError(f"{what} {text!a} has characters that cannot be seen (nearest: {seen!r})")


def one_line(text: object) -> str:
    """Return text out of a file as it can stand in a message: what cannot be seen is escaped."""
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in str(text))


def check_range(what: str, value: float, low: float, high: float) -> None:
    """Refuse a number outside [low, high].

    Raises:
        ValueError: The message names the value, the range and the nearest end.
    """
    if not low <= value <= high:
        end = low if not value > low else high
        raise ValueError(f"{what} = {value} is outside [{low}, {high}] (nearest: {end})")
