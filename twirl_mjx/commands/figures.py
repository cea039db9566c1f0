"""``twirl figures``."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from twirl_mjx.commands.console import parse, say


@dataclasses.dataclass(frozen=True)
class FiguresOptions:
    """Rebuild all figures from the committed tables; needs no jax."""

    results: Path = Path("experiments/results")
    """Folder with <grid>/<arm>.csv."""
    out: Path = Path("docs/images/results")
    """Folder of the pictures."""


def main(argv: list[str]) -> int:
    """Draw everything there is data for."""
    from twirl_mjx.figures.plots import make_figures

    options = parse(FiguresOptions, argv, "twirl figures")
    for path in make_figures(options.results, options.out):
        say(f"wrote {path}")
    return 0
