"""``twirl report``."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from twirl_mjx import files
from twirl_mjx.commands.console import parse, say
from twirl_mjx.commands.waiting import waiting


@dataclasses.dataclass(frozen=True)
class ReportOptions:
    """Write the results as one HTML page that opens offline; needs no jax."""

    results: Path = Path("experiments/results")
    """Folder with <grid>/<arm>.csv."""
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
    with waiting("loading matplotlib"):
        from twirl_mjx.figures.report import write_report
    say(f"wrote {write_report(options.results, options.out, options.media, say=say)}")
    return 0
