"""``twirl figures``."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path

from twirl_mjx.commands.console import parse, say
from twirl_mjx.commands.waiting import waiting


@dataclasses.dataclass(frozen=True)
class FiguresOptions:
    """Rebuild all figures from the committed tables; needs no jax."""

    results: Path = Path("experiments/results")
    """Folder with <grid>/<arm>.csv."""
    out: Path = Path("runs/figures")
    """Folder of the pictures."""
    shown: Path = Path("docs/images/results")
    """Folder of the few that pages show: a picture that is there is replaced by the new one."""


def main(argv: list[str]) -> int:
    """Draw everything there is data for."""
    options = parse(FiguresOptions, argv, "twirl figures")
    with waiting("loading matplotlib"):
        from twirl_mjx.figures.plots import make_figures
    for path in make_figures(options.results, options.out):
        say(f"wrote {path}")
        if (page := options.shown / path.name).is_file():
            shutil.copyfile(path, page)
            say(f"wrote {page}")
    return 0
