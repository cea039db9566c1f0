"""Refusals of what figures read; this part imports nothing of ours, so it has its own."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class TableError(ValueError):
    """A result table is not what it should be; the message names the file, row and remedy."""


def nearest(value: object, known: Iterable[object]) -> str:
    """Return "; nearest valid: ..." for an error message, with every choice if none is close."""
    names = [str(name) for name in known]
    close = difflib.get_close_matches(str(value), names, n=1, cutoff=0.4)
    listing = ", ".join(names) if names else "none"
    return f"; nearest valid: '{close[0]}' (of {listing})" if close else f"; valid: {listing}"
