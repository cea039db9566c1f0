"""``twirl runs``: list runs, show one, compare some, delete what finished ones do not need."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console
from rich.table import Table

from twirl_mjx.commands.console import json_text, parse, say
from twirl_mjx.training import overview
from twirl_mjx.training.overview import Overview

USAGE = """usage: twirl runs [NAMES] [options]          list runs
       twirl runs show NAME [options]        everything about one
       twirl runs compare NAMES [options]    where they differ, and how they did
       twirl runs prune [NAMES] [options]    delete checkpoints and collected experience of finished
                                             runs; says what, and asks for --yes

NAMES are names in the folder of all runs, shell patterns of them, paths, or conditions such as
task:biped status:finished seed:0 droq.utd:0.5, all of which hold. Other commands take them, too.
`twirl runs list --help` (show, compare, prune) lists the options.
"""
Key = Literal["name", "task", "status", "steps", "best", "age", "size"]
FILTERS = ("task", "variant", "shift", "status", "seed")
KEYS: dict[Key, Callable[[Overview], Any]] = {
    "name": lambda run: run.name,
    "task": lambda run: (str(run.setting("task")), run.name),
    "status": lambda run: (overview.STATES.index(run.state), run.name),
    "steps": lambda run: -run.env_steps,
    "best": lambda run: -(run.best_return if run.best_return is not None else float("-inf")),
    "age": lambda run: -run.changed,
    "size": lambda run: -run.size,
}
"""Order of a list: most, best, newest and largest first."""


@dataclasses.dataclass(frozen=True)
class ListOptions:
    """List runs."""

    names: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Names, patterns such as 'biped-*', paths, or conditions such as task:biped seed:0; all by
    default."""
    runs: Path = Path("runs")
    """Folder of all runs."""
    sort: Key = "age"
    """Order of the rows."""
    task: str | None = None
    """Only runs of this task."""
    variant: str | None = None
    """Only runs of this variant."""
    shift: str | None = None
    """Only runs under this shift, none for those without."""
    status: overview.State | None = None
    """Only runs in this state."""
    seed: int | None = None
    """Only runs with this seed."""
    json: bool = False
    """Print one JSON document instead."""


@dataclasses.dataclass(frozen=True)
class ShowOptions:
    """Show everything about one run."""

    name: Annotated[str, tyro.conf.Positional]
    """Name or path of the run."""
    runs: Path = Path("runs")
    """Folder of all runs."""


@dataclasses.dataclass(frozen=True)
class CompareOptions:
    """Show in which settings runs differ, and how they did."""

    names: Annotated[tuple[str, ...], tyro.conf.Positional]
    """Names, patterns, paths or conditions of two or more."""
    runs: Path = Path("runs")
    """Folder of all runs."""


@dataclasses.dataclass(frozen=True)
class PruneOptions:
    """Delete checkpoints, with the replay in them, and collected experience of finished runs.

    Policies, tables and configs stay. A pruned run cannot be trained further, and an adaptation
    cannot take its replay as source data; its policy works as before.
    """

    names: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Names, patterns, paths or conditions; all finished runs by default."""
    runs: Path = Path("runs")
    """Folder of all runs."""
    yes: bool = False
    """Delete; without it nothing is touched."""


def main(argv: list[str]) -> int:
    """List, show, compare or prune."""
    verbs = {"list": _list, "show": _show, "compare": _compare, "prune": _prune}
    if argv[:1] in (["--help"], ["-h"]):
        print(USAGE, end="")
        return 0
    verb, rest = (argv[0], argv[1:]) if argv and argv[0] in verbs else ("list", argv)
    return verbs[verb](rest)


def _console() -> Console:
    return Console(width=None if sys.stdout.isatty() else 160, soft_wrap=False)


def _list(argv: list[str]) -> int:
    options = parse(ListOptions, argv, "twirl runs list")
    asked = {name: getattr(options, name) for name in FILTERS}
    words = [f"{name}:{value}" for name, value in asked.items() if value is not None]
    found = [overview.look(path) for path in overview.find(options.runs, [*options.names, *words])]
    found.sort(key=KEYS[options.sort])
    if options.json:
        say(json_text([_record(run) for run in found]))
        return 0
    if not found:
        say(f"no runs in {options.runs} that fit")
        return 0
    table = Table(box=None, pad_edge=False)
    table.add_column("name", overflow="fold")
    for column in ("task", "variant", "status"):
        table.add_column(column)
    for column in ("seed", "steps", "best return", "age", "size"):
        table.add_column(column, justify="right", no_wrap=True)
    for run in found:
        table.add_row(
            run.name, str(run.setting("task")), str(run.setting("variant")), run.state,
            str(run.setting("seed")), f"{run.env_steps:,}", _number(run.best_return),
            overview.age_of(run), overview.size_text(run.size),
        )  # fmt: skip
    _console().print(table)
    say(f"{len(found)} runs, {overview.size_text(sum(run.size for run in found))}")
    return 0


def _record(run: Overview) -> dict[str, Any]:
    return dataclasses.asdict(run) | {"path": str(run.path), "name": run.name}


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"


def _show(argv: list[str]) -> int:
    options = parse(ShowOptions, argv, "twirl runs show")
    found = overview.find(options.runs, (options.name,))
    if len(found) > 1:
        names = ", ".join(path.name for path in found)
        raise ValueError(f"{options.name!r} matches {len(found)} runs, expected one: {names}")
    run = overview.look(found[0])
    shift = run.setting("shift")
    hours, rest = divmod(int(run.wall_s), 3600)
    table = Table(box=None, show_header=False, pad_edge=False)
    rows = {
        "run": str(run.path),
        "task": str(run.setting("task")) + (f" under {shift}" if shift != "none" else ""),
        "variant": f"{run.setting('variant')}, source {run.setting('source')}",
        "seed": str(run.setting("seed")),
        "status": f"{run.state}, changed {overview.age_of(run)} ago",
        "steps": f"{run.env_steps:,} of {run.setting('total_env_steps'):,}"
        if run.settings
        else f"{run.env_steps:,}",
        "trained for": f"{hours}:{rest // 60:02d} h",
        "best return": _number(run.best_return),
        "size": f"{overview.size_text(run.size)}, of it {overview.size_text(run.prunable)}"
        " checkpoints and collected experience",
    } | {f"closing {name}": f"{value:.3g}" for name, value in run.measures.items()}
    for name, text in rows.items():
        table.add_row(name, text)
    _console().print(table)
    return 0


def _compare(argv: list[str]) -> int:
    options = parse(CompareOptions, argv, "twirl runs compare")
    found = [overview.look(path) for path in overview.find(options.runs, options.names)]
    if len(found) < 2:
        raise ValueError(
            f"found {len(found)} of the runs to compare in {options.runs}/, expected two or more"
            " (`twirl runs` lists what is there)"
        )
    table = Table(box=None, pad_edge=False)
    table.add_column("", overflow="fold")
    for run in found:
        table.add_column(run.name, overflow="fold", justify="right")
    for name, values in overview.differences(found).items():
        table.add_row(name, *("-" if value is None else str(value) for value in values))
    table.add_section()
    table.add_row("status", *(run.state for run in found))
    table.add_row("steps", *(f"{run.env_steps:,}" for run in found))
    table.add_row("best return", *(_number(run.best_return) for run in found))
    for name in dict.fromkeys(name for run in found for name in run.measures):
        cells = (run.measures.get(name) for run in found)
        table.add_row(f"closing {name}", *("-" if v is None else f"{v:.3g}" for v in cells))
    _console().print(table)
    return 0


def _prune(argv: list[str]) -> int:
    options = parse(PruneOptions, argv, "twirl runs prune")
    found = [overview.look(path) for path in overview.find(options.runs, options.names)]
    unfinished = [run for run in found if run.state != "finished"]
    if options.names and unfinished:
        run = unfinished[0]
        raise ValueError(
            f"{run.path} is {run.state}, and only finished runs are pruned: it could not be resumed"
        )
    pruned = [run for run in found if run.state == "finished" and run.prunable]
    if not pruned:
        say(f"nothing to delete: no finished run in {options.runs} has checkpoints")
        return 0
    for run in pruned:
        parts = [name for name in overview.PRUNED if (run.path / name).exists()]
        verb = "delete" if options.yes else "would delete"
        say(f"{verb} {' and '.join(parts)} of {run.path}: {overview.size_text(run.prunable)}")
        if options.yes:
            overview.prune(run)
    total = overview.size_text(sum(run.prunable for run in pruned))
    if not options.yes:
        say(f"nothing was deleted; --yes frees {total}. Policies, tables and configs stay.")
        return 0
    say(f"freed {total}; policies, tables and configs stay")
    return 0
