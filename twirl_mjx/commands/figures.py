"""``twirl figures``."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from twirl_mjx import files
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
    """Folder of the few that pages show: a picture of the same name is replaced by the new one."""
    overwrite: bool = False
    """Replace pictures in --out that this command did not write."""


def main(argv: list[str]) -> int:
    """Draw everything there is data for."""
    options = parse(FiguresOptions, argv, "twirl figures")
    with waiting("loading matplotlib"):
        from twirl_mjx.figures.plots import make_figures
    for path in make_figures(options.results, options.out, overwrite=options.overwrite):
        say(f"wrote {path}")
        if (page := options.shown / path.name).is_file():
            files.write_bytes(page, files.read_bytes(path, "a picture"))
            say(f"wrote {page}")
    return 0
