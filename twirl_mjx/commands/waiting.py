"""What a terminal shows while nothing else can be shown: imports, above all."""

from __future__ import annotations

import contextlib
import sys
import threading
from collections.abc import Iterator

PATIENCE_S = 1.0
"""s, a wait that is not longer needs no explanation."""


@contextlib.contextmanager
def waiting(what: str, patience_s: float = PATIENCE_S) -> Iterator[None]:
    """Show on a terminal what is being waited for once that takes long; gone when it is over.

    Args:
        what: A few words, "loading jax and MuJoCo".
        patience_s: Time in s before anything is shown.
    """
    if not sys.stderr.isatty():
        yield
        return
    shown = threading.Event()

    def show() -> None:
        shown.set()
        print(f"{what} ...", end="", file=sys.stderr, flush=True)

    timer = threading.Timer(patience_s, show)
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
        timer.join()
        if shown.is_set():
            blank = " " * len(f"{what} ...")  # no escape code, which a dumb terminal would show
            print(f"\r{blank}\r", end="", file=sys.stderr, flush=True)
