"""Cells that are one program: which are started together, and the command of a team."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from twirl_mjx.sweep.plan import Cell
from twirl_mjx.sweep.worker import Job
from twirl_mjx.training import rundir
from twirl_mjx.training.checkpoint import stored_steps
from twirl_mjx.training.config import of_program

Teams = Callable[[Sequence[Job], int], list[list[Job]]]
"""(jobs that may start, free places) -> jobs by the process that runs them."""


def alone(jobs: Sequence[Job], room: int) -> list[list[Job]]:
    """Return a team of one for every job."""
    del room
    return [[job] for job in jobs]


def program_of(cell: Cell) -> str:
    """Return a text that the cells of one program have in common, and no other cell."""
    if cell.config.variant == "zero-shot" or cell.config.guide != "none":
        return cell.name  # nothing is compiled for long; guides of one program must be one
    return f"{cell.preset} {rundir.digest(of_program(cell.config))}"


def make_teams(cells: Sequence[Cell], runs: Path, most: int | None = None) -> Teams:
    """Return how the jobs of a sweep are put together.

    Cells that differ in seed, phi and source only are one program, if they are equally far. A
    program is divided evenly where there are more free places than programs.

    Args:
        cells: The cells to run.
        runs: Folder of all runs.
        most: Most cells of a team; None for any number.
    """
    programs = {cell.name: program_of(cell) for cell in cells}

    def teams(jobs: Sequence[Job], room: int) -> list[list[Job]]:
        return divide(jobs, programs, lambda job: set(stored_steps(runs / job.name)), room, most)

    return teams


def divide(
    jobs: Sequence[Job],
    programs: Mapping[str, str],
    steps_of: Callable[[Job], set[int]],
    room: int,
    most: int | None,
) -> list[list[Job]]:
    """Return teams of jobs, programs in the order of their first job.

    Args:
        jobs: What may start.
        programs: Name of a job -> its program.
        steps_of: Returns the transitions of the checkpoints of a job's run.
        room: Free places.
        most: Most jobs of a team; None for any number.
    """
    level: dict[str, list[tuple[list[Job], set[int]]]] = {}
    for job in jobs:
        steps, parts = steps_of(job), level.setdefault(programs[job.name], [])
        for index, (part, common) in enumerate(parts):
            if steps & common or not (steps or common):
                parts[index] = ([*part, job], steps & common)
                break
        else:
            parts.append(([job], steps))
    even = [part for parts in level.values() for part, _ in parts]
    share = -(-room // max(1, len(even)))
    found = []
    for part in even:
        pieces = min(len(part), max(share, -(-len(part) // (most or len(part)))))
        cuts = [len(part) * i // pieces for i in range(pieces + 1)]
        found += [part[a:b] for a, b in itertools.pairwise(cuts)]
    return found
