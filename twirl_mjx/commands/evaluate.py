"""``twirl evaluate``."""

from __future__ import annotations

import dataclasses
import importlib
import shlex
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
import tyro
from rich.box import SIMPLE
from rich.console import Console
from rich.table import Table

from twirl_mjx import files
from twirl_mjx.checks import check_once, check_range
from twirl_mjx.commands.console import say
from twirl_mjx.commands.options import Overrides, parse_in_tasks, with_overrides
from twirl_mjx.commands.render import config_of
from twirl_mjx.commands.selection import selected
from twirl_mjx.commands.tables import check_settings, named, write_rows
from twirl_mjx.commands.waiting import waiting
from twirl_mjx.figures.statistics import bootstrap, mean
from twirl_mjx.sim.leaves import PAPER_SHIFTS, SHIFTS
from twirl_mjx.tasks.task import Task
from twirl_mjx.worlds.config import WorldConfig

if TYPE_CHECKING:
    from twirl_mjx.policies.resolve import Source

MEDIANS = ("min_distance",)
"""Measures of which the table shows the median, as the paper does: goals lie at all distances."""


@dataclasses.dataclass(frozen=True)
class EvaluateOptions:
    """Evaluate policies across dynamics conditions, on one fixed course unless told otherwise.

    Options of the task (`--biped.goal-distance 1`) are those of the policy's config by default;
    `--dynamics.friction 0.3` and `--randomize payload=0:2` hold in all conditions.
    """

    policies: Annotated[tuple[str, ...], tyro.conf.Positional]
    """Runs (names, patterns, conditions such as task:biped seed:0, directories), policy files
    (.npz, .onnx), file.py:function or scripted names (trot, bound, zero, random, clip);
    NAME=POLICY gives it a name in the table, such as source=stand.npz."""
    runs: Path = Path("runs")
    """Folder of all runs."""
    task: str | None = None
    """Task to act in; the one a policy was trained for by default."""
    shifts: tuple[str, ...] = PAPER_SHIFTS
    """Conditions."""
    strength: float = 1.0
    """Strength of every shift: 0 nominal, 1 the paper's value."""
    course: Literal["fixed", "random"] = "fixed"
    """One course for all episodes, or goals and hurdles drawn as in training without a shift."""
    engine: Literal["auto", "mjx", "native"] = "auto"
    """Physics engine: MJX, or C MuJoCo in threads; auto as in training."""
    episodes: int = 100
    """Episodes per condition and policy."""
    seed: int = 2_000_003
    """Seed of the episodes; training never uses it."""
    out: Path | None = None
    """Tidy table of every episode, replaced after every policy; by default
    runs/evaluation-DATE-TIME.csv."""
    setting: tuple[str, ...] = ()
    """Columns that tell this table from others beside it, as name=value: gap=2.4."""
    figure: Path | None = None
    """Also draw the returns as bars into this PNG file."""
    source_contract: str = ""
    """How foreign policies meet the robot, by name or file (docs/sources.md)."""
    source_command: str = ""
    """What foreign policies are told to do: 0.5,0,0 or towards-goal:0.5."""
    allow_clipping: bool = False
    """Score foreign policies without a contract although their outputs leave [-1, 1]."""
    overwrite: bool = False
    """Replace a table or a figure that this command did not write."""


@dataclasses.dataclass(frozen=True)
class Candidate:
    """A policy to evaluate."""

    given: str
    """What the command line calls it."""
    run: str
    """What the table calls it."""
    config: WorldConfig
    """Task, course and options it is scored under."""
    found: Source
    """The policy."""


def main(argv: list[str]) -> int:
    """Evaluate, print a table per policy and write every episode."""
    options, overrides = parse_in_tasks(EvaluateOptions, argv, "twirl evaluate")
    if not options.policies:
        raise ValueError("name at least one policy: a run directory, a policy file or a script")
    check_range("episodes", options.episodes, 1, 1_000_000)
    check_range("seed", options.seed, 0, 2**32 - 1)
    if not options.shifts:
        raise ValueError(f"--shifts needs a condition: any of {', '.join(SHIFTS.names())}")
    options = dataclasses.replace(options, shifts=tuple(map(SHIFTS.admit, options.shifts)))
    check_once("--shifts", options.shifts)
    out = options.out or Path("runs", f"evaluation-{time.strftime('%Y%m%d-%H%M%S')}.csv")
    check_outputs(out, options.figure, options.overwrite)
    settings = check_settings(options.setting)
    with waiting("loading jax and MuJoCo"):  # which options do not need
        importlib.import_module("twirl_mjx.evaluation.shifts")
    check_memory(options)
    options = dataclasses.replace(options, policies=selected(options.policies, options.runs))
    candidates = resolve_all(options, overrides)
    notes = f"# command: {shlex.join(['.venv/bin/twirl', 'evaluate', *argv])}\n"
    rows: list[list[object]] = []
    for candidate in candidates:
        rows += _evaluate_one(candidate, options)
        write_rows(out, rows, notes, settings)
        say(f"wrote {out}: {len(rows):,} rows")
    if options.figure is not None:
        _draw(out, options.figure)
    return 0


def check_outputs(out: Path, figure: Path | None, overwrite: bool = False) -> None:
    """Check where results go before anything is evaluated.

    Raises:
        ValueError: A folder or a device where a file is meant, a figure that is no PNG, or a file
            that this command did not write.
    """
    from twirl_mjx.training.rundir import EVAL_COLUMNS

    if out.is_dir():
        raise ValueError(f"--out {out} is a folder (nearest: {out / 'evaluation.csv'})")
    files.check_ours(out, ",".join(EVAL_COLUMNS), overwrite=overwrite)
    if figure is None:
        return
    if figure.is_dir() or figure.suffix != ".png":
        raise ValueError(
            f"--figure {figure} is no PNG file (nearest: {figure.with_suffix('.png')})"
        )
    files.check_ours(figure, overwrite=overwrite)


def check_memory(options: EvaluateOptions) -> None:
    """Refuse more episodes than fit into memory: conditions on one ground run at once."""
    from twirl_mjx.evaluation.shifts import scenes_of
    from twirl_mjx.training import memory

    at_once = options.episodes * max(map(len, scenes_of(options.shifts).values()))
    memory.check([memory.acting("--episodes", options.episodes, at_once, options.engine)])


def resolve_all(options: EvaluateOptions, overrides: Overrides) -> list[Candidate]:
    """Return all policies, ready to act, before the first of them is evaluated.

    Raises:
        FileNotFoundError: Nothing to load under a name.
        ValueError: A file that is no policy, options of another task, or two policies that the
            table could not tell apart.
    """
    from twirl_mjx.policies.resolve import PLAIN, Terms, resolve_actor, takes_terms

    terms = Terms(options.source_contract, options.source_command, options.allow_clipping)
    pairs = [named(word) for word in options.policies]
    foreign = [given for _, given in pairs if terms != PLAIN and takes_terms(given)]
    candidates: dict[str, Candidate] = {}
    for run, given in pairs:
        if run in candidates:
            raise ValueError(
                f"{candidates[run].given} and {given} would both be {run!r} in the table:"
                f" give one another name (nearest: {run}_2={given})"
            )
        config = with_overrides(config_of(given, options.task), overrides)
        config = dataclasses.replace(config, course=options.course, engine=options.engine)
        config.make_task()  # refuses options that only the task can judge
        its = terms if given in foreign or not foreign else PLAIN  # refused where nobody is foreign
        found = resolve_actor(given, config, terms=its)
        for note in found.notes:
            say(f"{given}: {note}")
        candidates[run] = Candidate(given, run, config, found)
    return list(candidates.values())


def _evaluate_one(candidate: Candidate, options: EvaluateOptions) -> list[list[object]]:
    """Evaluate one policy and print its table; return its rows."""
    from twirl_mjx.evaluation.shifts import evaluate_shifts

    config, found = candidate.config, candidate.found
    conditions = len(options.shifts)
    say(
        f"evaluating {candidate.given} in {config.task}: {conditions} conditions x"
        f" {options.episodes} episodes"
    )
    began = time.monotonic()
    values = evaluate_shifts(
        config,
        found.policy,
        episodes=options.episodes,
        seed=options.seed,
        shifts=options.shifts,
        strength=options.strength,
    )
    wall = time.monotonic() - began
    _print_table(f"{candidate.given} in {config.task}", values, config.task_type)
    say(f"took {wall:.1f} s, with compilation")
    card = getattr(getattr(found.loaded, "header", None), "card", {})
    variant = card.get("variant", "scripted") if found.loaded else "scripted"
    trained = [variant, card.get("seed", 0), card.get("env_steps", 0)]
    return [
        [candidate.run, config.task, shift, *trained, episode, measure, f"{float(value):.9g}"]
        for shift, measures in values.items()
        for measure, column in measures.items()
        for episode, value in enumerate(column)
        if not np.isnan(value)
    ]


def _print_table(
    title: str, values: dict[str, dict[str, np.ndarray]], task: type[Task] = Task
) -> None:
    """Print the mean of every measure; of those that lead the task first, with 95 % intervals.

    A row is a measure and a column a condition; conditions that do not fit stand below.
    """
    console = Console(width=None if sys.stdout.isatty() else 80)
    columns = {shift: _cells(found, task) for shift, found in values.items()}
    for shown in _that_fit(columns, console.width):
        table = Table(title=title, box=SIMPLE, padding=(0, 1))
        table.add_column("", overflow="fold")
        for shift in shown:
            table.add_column(shift, justify="right", no_wrap=True)
        for row in dict.fromkeys(row for shift in shown for row in columns[shift]):
            table.add_row(row, *(columns[shift].get(row, "") for shift in shown))
        console.print(table)


def _cells(found: dict[str, np.ndarray], task: type[Task]) -> dict[str, str]:
    """Return the texts of one condition by the name of their row."""
    ratios = {
        name: found[top][found[below] > 0] / found[below][found[below] > 0]
        for name, (top, below) in task.ratios.items()
        if top in found
    }
    every = found | ratios
    cells: dict[str, str] = {}
    for name in dict.fromkeys((*(n for n in task.lead if n in every), "return", *every)):
        values = every[name][~np.isnan(every[name])]
        if name in MEDIANS:
            cells[f"{name} (median)"] = f"{np.median(values):.3g}" if len(values) else ""
        if not len(values):
            continue
        cells[name] = f"{values.mean():.4g}"
        if name in task.lead and len(values) > 1:
            found_interval = bootstrap([values], mean)
            cells[f"  {name} 95 %"] = f"{found_interval.low:.4g}, {found_interval.high:.4g}"
    return cells


def _that_fit(columns: dict[str, dict[str, str]], width: int) -> list[list[str]]:
    """Return the conditions in groups whose columns fit into a width in characters, with gaps."""
    gap = 3
    rows = max(len(row) for cells in columns.values() for row in cells) + gap
    groups: list[list[str]] = []
    room = 0
    for shift, cells in columns.items():
        needs = max(map(len, (shift, *cells.values()))) + gap
        if not groups or needs > room:
            groups.append([])
            room = width - rows
        groups[-1].append(shift)
        room -= needs
    return groups


def _draw(table: Path, figure: Path) -> None:
    from twirl_mjx.figures.bars import shift_bars
    from twirl_mjx.figures.canvas import write_png
    from twirl_mjx.figures.tables import read_episodes

    write_png(shift_bars(read_episodes(table), "return", by="run"), figure)
    say(f"wrote {figure}")
