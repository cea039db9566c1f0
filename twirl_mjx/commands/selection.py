"""Runs by name, pattern or condition, wherever a command takes a policy."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from twirl_mjx.training.overview import expand

RUNS = Path("runs")
"""Folder of all runs of commands without an option for it."""


def split_name(word: str) -> tuple[str, str]:
    """Return name and policy of NAME=POLICY; the name is empty where none is given."""
    name, equals, given = word.partition("=")
    if equals and re.fullmatch(r"[\w+-]+", name) and not Path(word).exists():
        return name, given
    return "", word


def selected(words: Sequence[str], runs: Path = RUNS) -> tuple[str, ...]:
    """Return policies with what selects runs replaced by the paths of these; see ``overview``.

    Raises:
        FileNotFoundError: Conditions, and no run that fits.
        ValueError: A condition on what no run has.
    """
    pairs = map(split_name, words)
    words = tuple(f"{name}={the_one(given, runs)}" if name else given for name, given in pairs)
    found = tuple(expand(words, runs))
    if found == tuple(words):
        return found
    from twirl_mjx.policies.resolve import SCRIPTED_SOURCES  # slow to import, and seldom needed

    return tuple(expand(words, runs, SCRIPTED_SOURCES))


def the_one(word: str, runs: Path = RUNS) -> str:
    """Return a policy, or the path of the one run that a word selects.

    Raises:
        FileNotFoundError: A condition, and no run that fits.
        ValueError: Several runs fit, or a condition on what no run has.
    """
    found = list(selected([word], runs))
    if len(found) > 1:
        names = ", ".join(Path(path).name for path in found)
        raise ValueError(f"{word!r} selects {len(found)} runs, expected one: {names}")
    return found[0]
