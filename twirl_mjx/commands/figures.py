"""``twirl figures``."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from twirl_mjx import files
from twirl_mjx.commands.console import parse, say
from twirl_mjx.commands.tables import results_folder
from twirl_mjx.commands.waiting import waiting


@dataclasses.dataclass(frozen=True)
class FiguresOptions:
    """Rebuild all figures, and the numbers of pages, from the committed tables; needs no jax."""

    results: Path = dataclasses.field(default_factory=results_folder)
    """Folder with <grid>/<arm>.csv: experiments/results of a checkout, elsewhere results."""
    out: Path = Path("runs/figures")
    """Folder of the pictures."""
    shown: Path = Path("docs/images/results")
    """Folder of the few that pages show: a picture of the same name is replaced by the new one."""
    quotes: Path = Path("experiments/quotes")
    """Folder of the templates of what pages quote (docs/figures.md)."""
    pages: tuple[Path, ...] = (
        Path("README.md"),
        Path("docs/results.md"),
        Path("docs/performance_learner.md"),
    )
    """Pages whose blocks are written anew; one that is not there is left out."""
    pictures: bool = True
    """Whether to draw; --no-pictures writes the pages alone."""
    overwrite: bool = False
    """Replace pictures in --out that this command did not write."""


def main(argv: list[str]) -> int:
    """Write the pages, then draw everything there is data for."""
    from twirl_mjx.figures.quotes import Quotes

    options = parse(FiguresOptions, argv, "twirl figures")
    quotes = Quotes(options.results, options.quotes)
    for page in filter(Path.is_file, options.pages):
        if quotes.write(page):
            say(f"wrote {page}")
    if not options.pictures:
        return 0
    with waiting("loading matplotlib"):
        from twirl_mjx.figures.plots import make_figures
    for path in make_figures(options.results, options.out, overwrite=options.overwrite):
        say(f"wrote {path}")
        if (page := options.shown / path.name).is_file():
            files.write_bytes(page, files.read_bytes(path, "a picture"))
            say(f"wrote {page}")
    return 0
