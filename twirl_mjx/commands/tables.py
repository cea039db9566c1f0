"""Tables that commands write and read: where they are, whose rows, which further columns."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from twirl_mjx import files
from twirl_mjx.checks import check_printable
from twirl_mjx.commands.selection import split_name


def results_folder() -> Path:
    """Return where tables of grids are: of the checkout that the user is in, else ``results``."""
    return Path("experiments/results") if Path("experiments").is_dir() else Path("results")


def named(word: str) -> tuple[str, str]:
    """Return what the table calls a policy and what loads it, of NAME=POLICY or POLICY.

    Raises:
        ValueError: A name with line breaks or the like.
    """
    from twirl_mjx.commands.render import name_of

    name, given = split_name(word)
    if name:
        return name, given
    check_printable("the name of policy", found := name_of(word))
    return found, word


def check_settings(words: tuple[str, ...]) -> dict[str, str]:
    """Return the further columns of a table by name.

    Raises:
        ValueError: Not name=value, a name that the table has, or one given twice.
    """
    from twirl_mjx.figures.tables import RESERVED

    settings: dict[str, str] = {}
    for word in words:
        name, _, value = (part.strip() for part in word.partition("="))
        check_printable("--setting", word)
        if not name.isidentifier() or not value:
            raise ValueError(f"--setting {word!r} is not name=value (nearest: gap=2.4)")
        if name in RESERVED or name in settings:
            raise ValueError(f"--setting {word}: the table has a column {name} already")
        settings[name] = value
    return settings


def write_rows(
    path: Path, rows: list[list[object]], notes: str = "", settings: Mapping[str, str] | None = None
) -> None:
    """Write a table of episodes under notes and header, whole or not at all."""
    from twirl_mjx.training.rundir import EVAL_COLUMNS

    more = dict(settings or {})
    table = ([*row, *more.values()] for row in rows)
    files.write_csv(path, [[*EVAL_COLUMNS, *more], *table], notes)
