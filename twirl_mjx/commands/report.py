"""``twirl report``."""

from __future__ import annotations

import dataclasses
import tempfile
from pathlib import Path
from typing import Annotated

import tyro

from twirl_mjx import files
from twirl_mjx.commands.console import parse, say
from twirl_mjx.commands.tables import results_folder
from twirl_mjx.commands.waiting import waiting
from twirl_mjx.training.overview import find


@dataclasses.dataclass(frozen=True)
class ReportOptions:
    """Write results as one HTML page that opens offline: of finished runs, or of all tables."""

    names: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Runs by name, pattern, path or condition such as task:biped; without them the tables."""
    runs: Path = Path("runs")
    """Folder of all runs."""
    results: Path = dataclasses.field(default_factory=results_folder)
    """Folder with <grid>/<arm>.csv: experiments/results of a checkout, elsewhere results."""
    out: Path = Path("runs/report.html")
    """The page."""
    media: tuple[Path, ...] = ()
    """Films and pictures to show, in order."""
    overwrite: bool = False
    """Replace a page that this command did not write."""


def main(argv: list[str]) -> int:
    """Write the page."""
    options = parse(ReportOptions, argv, "twirl report")
    files.check_ours(options.out, overwrite=options.overwrite)
    found = find(options.runs, options.names) if options.names else []
    with waiting("loading matplotlib"):
        from twirl_mjx.figures.report import write_report
    if not options.names:
        say(f"wrote {write_report(options.results, options.out, options.media, say=say)}")
        return 0
    with waiting("loading jax"):  # which knows what the tasks measure
        from twirl_mjx.sweep.gather import gather_runs
    films = [film for path in found if (film := path / "episode.mp4").is_file()]
    with tempfile.TemporaryDirectory() as folder:
        gather_runs(found, Path(folder))
        title = f"twirl_mjx: {len(found)} runs"
        media = (*options.media, *films)
        say(f"wrote {write_report(folder, options.out, media, title=title, say=say)}")
    return 0
