"""``twirl sweep``."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro

from twirl_mjx.checks import check_range
from twirl_mjx.commands.console import parse
from twirl_mjx.commands.tables import results_folder


@dataclasses.dataclass(frozen=True)
class SweepOptions:
    """Run what is missing of a grid, resume what was cut off, and write its tables."""

    grid: Annotated[str, tyro.conf.Positional]
    """Module in experiments/ (tasks, shifts, phi, utd), or the path of a grid file."""
    reduced: bool = False
    """Take the smaller form, sized for two CPU cores."""
    dry_run: bool = False
    """List the cells with their status and an estimate of the time; run nothing."""
    seeds: tuple[int, ...] = ()
    """Seeds instead of the grid's."""
    arms: str = "*"
    """Only arms that match, for example 'biped-*'."""
    nominal: tuple[Path, ...] = ()
    """Finished nominal runs that adaptation starts from, one per task; the grid's by default."""
    runs: Path = Path("runs")
    """Folder of all runs; on a cluster one that all machines share."""
    results: Path = dataclasses.field(default_factory=results_folder)
    """Folder of the tables: experiments/results in a checkout, elsewhere results."""
    gather_only: bool = False
    """Only write the tables of what is finished."""
    workers: int | None = None
    """Most processes at once; one per usable core, or per GPU fraction, by default."""
    together: int | None = None
    """Most runs in one process (1: a process for each); by default cells that differ in seed and
    phi only are one program, divided evenly on the workers."""
    gpus: float | None = None
    """GPUs per run, may be a fraction; one where there are any by default."""
    address: str | None = None
    """Join this Ray cluster ('auto' for the one of this machine) instead of starting Ray."""
    retries: int = 1
    """Further attempts after a crash; each goes on from the last checkpoint."""


def main(argv: list[str]) -> int:
    """Sweep; exit status 1 when a cell failed, 130 when stopped by a signal after saving."""
    options = parse(SweepOptions, argv, "twirl sweep")
    check_range("retries", options.retries, 0, 100)
    if options.together is not None:
        check_range("together", options.together, 1, 10_000)
    if options.workers is not None:
        check_range("workers", options.workers, 1, 10_000)
    from twirl_mjx.commands.sweep_run import sweep  # needs jax, which options do not

    return sweep(options)
