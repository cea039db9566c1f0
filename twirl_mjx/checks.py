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


def check_updates(utd: float, num_envs: int, updates_per_block: int) -> None:
    """Check that UTD gives whole blocks of critic updates per vector step, rounding apart.

    Raises:
        ValueError: With the numbers, and the nearest ``utd`` that divides.
    """
    updates = utd * num_envs
    blocks = max(1, round(updates / updates_per_block))
    if abs(updates - blocks * updates_per_block) > 1e-5 * updates:
        raise ValueError(
            f"droq.utd {utd:g} x env.num_envs {num_envs} = {updates:g} critic updates per"
            f" vector step, which is not a whole number of blocks of droq.updates_per_block"
            f" {updates_per_block} (nearest: utd {blocks * updates_per_block / num_envs:g})"
        )
