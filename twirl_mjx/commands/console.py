"""What every command does with its words: parse options, print lines; imports nothing heavy."""

from __future__ import annotations

import json
from typing import Any

import tyro


def parse[T](kind: type[T], argv: list[str], prog: str, default: T | None = None) -> T:
    """Parse a command's options with tyro; a wrong one is refused with the nearest valid."""
    if default is None:
        return tyro.cli(kind, args=argv, prog=prog)
    return tyro.cli(kind, args=argv, prog=prog, default=default)


def say(text: str) -> None:
    """Print one line at once."""
    print(text, flush=True)


def json_text(record: Any) -> str:
    """Return a record as one JSON document for machines."""
    return json.dumps(record, indent=2, sort_keys=True, allow_nan=True)
