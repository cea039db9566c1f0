"""``twirl evaluate``."""

from __future__ import annotations

import csv
import dataclasses
import sys
import time
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from twirl_mjx.checks import check_choice, check_range
from twirl_mjx.commands.options import parse, say
from twirl_mjx.commands.render import config_of, name_of
from twirl_mjx.config import SHIFTS, TrainConfig
from twirl_mjx.evaluation.shifts import evaluate_shifts
from twirl_mjx.figures.statistics import bootstrap
from twirl_mjx.policies.resolve import ResolvedPolicy, resolve_policy
from twirl_mjx.sim.robots import A1
from twirl_mjx.tasks.bands import min_gap
from twirl_mjx.training.loop import EVAL_COLUMNS

MEDIANS = ("min_distance",)
"""Measures of which the table shows the median, as the paper does: goals lie at all distances."""


@dataclasses.dataclass(frozen=True)
class EvaluateOptions:
    """Evaluate policies across dynamics conditions, on one fixed course unless told otherwise."""

    policies: Annotated[tuple[str, ...], tyro.conf.Positional]
    """Run directories, policy files (.npz, .onnx) or scripted names (trot, bound, zero,
    random, clip)."""
    task: str | None = None
    """Task to act in; the one a policy was trained for by default."""
    shifts: tuple[str, ...] = SHIFTS
    """Conditions."""
    strength: float = 1.0
    """Strength of every shift: 0 nominal, 1 the paper's value."""
    course: Literal["fixed", "random"] = "fixed"
    """One course for all episodes, or goals and hurdles drawn as in training without a shift."""
    goal_distance: float | None = None
    """m, distance of every goal of ``biped``; that of the policy's config by default."""
    hurdle_gap: float | None = None
    """m, gap between all hurdles of ``hurdles``; that of the policy's config by default."""
    hurdle_gaps: tuple[float, float] | None = None
    """m, smallest and largest gap on the random course of ``hurdles``; those of the policy's config
    by default."""
    engine: Literal["auto", "mjx", "native"] = "auto"
    """Physics engine: MJX, or C MuJoCo in threads; auto as in training."""
    episodes: int = 100
    """Episodes per condition and policy."""
    seed: int = 2_000_003
    """Seed of the episodes; training never uses it."""
    out: Path | None = None
    """Tidy table of every episode, replaced after every policy; by default
    runs/evaluation-DATE-TIME.csv."""
    figure: Path | None = None
    """Also draw the returns as bars into this PNG file."""


@dataclasses.dataclass(frozen=True)
class Candidate:
    """A policy to evaluate."""

    given: str
    """What the command line calls it."""
    run: str
    """What the table calls it."""
    config: TrainConfig
    """Task, course and options it is scored under."""
    found: ResolvedPolicy
    """The policy."""


def main(argv: list[str]) -> int:
    """Evaluate, print a table per policy and write every episode."""
    options = parse(EvaluateOptions, argv, "twirl evaluate")
    if not options.policies:
        raise ValueError("name at least one policy: a run directory, a policy file or a script")
    check_range("episodes", options.episodes, 1, 1_000_000)
    for shift in options.shifts:
        check_choice("shift", shift, SHIFTS)
    out = options.out or Path("runs", f"evaluation-{time.strftime('%Y%m%d-%H%M%S')}.csv")
    check_outputs(out, options.figure)
    candidates = resolve_all(options)
    rows: list[list[object]] = []
    for candidate in candidates:
        rows += _evaluate_one(candidate, options)
        write_rows(out, rows)
        say(f"wrote {out}: {len(rows):,} rows")
    if options.figure is not None:
        _draw(out, options.figure)
    return 0


def check_outputs(out: Path, figure: Path | None) -> None:
    """Check where results go before anything is evaluated.

    Raises:
        ValueError: A folder where a file is meant, or a figure that is no PNG.
    """
    if out.is_dir():
        raise ValueError(f"--out {out} is a folder (nearest: {out / 'evaluation.csv'})")
    if figure is not None and (figure.is_dir() or figure.suffix != ".png"):
        raise ValueError(
            f"--figure {figure} is no PNG file (nearest: {figure.with_suffix('.png')})"
        )


def resolve_all(options: EvaluateOptions) -> list[Candidate]:
    """Return all policies, ready to act, before the first of them is evaluated.

    Raises:
        FileNotFoundError: Nothing to load under a name.
        ValueError: A file that is no policy, a course of another task, or two policies that the
            table could not tell apart.
    """
    candidates: dict[str, Candidate] = {}
    for given in options.policies:
        run = name_of(given)
        if run in candidates:
            raise ValueError(
                f"{candidates[run].given} and {given} would both be {run!r} in the table:"
                " evaluate them one by one with --out, or copy one to another name"
            )
        config = on_course(config_of(given, options.task), options)
        candidates[run] = Candidate(given, run, config, resolve_policy(given, config))
    return list(candidates.values())


def write_rows(path: Path, rows: list[list[object]]) -> None:
    """Write a table of episodes under its header, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(path.name + ".partial")
    with partial.open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([EVAL_COLUMNS, *rows])
    partial.replace(path)


def on_course(config: TrainConfig, options: EvaluateOptions) -> TrainConfig:
    """Return the config with the goals, hurdles and engine that the options ask for.

    Raises:
        ValueError: A distance out of range, or of another task.
    """
    of_task = {"goal_distance": "biped", "hurdle_gap": "hurdles", "hurdle_gaps": "hurdles"}
    for name, task in of_task.items():
        if getattr(options, name) is not None and config.task != task:
            raise ValueError(f"{name} is an option of task {task}, not of {config.task}")
    biped, hurdles = config.biped, config.hurdles
    if (goal := options.goal_distance) is not None:
        check_range("goal_distance", goal, 0.01, 100.0)
        biped = dataclasses.replace(
            biped, fixed_goal=(goal, 0.0), goal_min_radius=goal, goal_max_radius=goal
        )
    if (gap := options.hurdle_gap) is not None:
        check_range("hurdle_gap", gap, min_gap(A1), 100.0)
        hurdles = dataclasses.replace(hurdles, fixed_gap=gap, min_gap=gap, max_gap=gap)
    if (gaps := options.hurdle_gaps) is not None:
        if options.course != "random" or options.hurdle_gap is not None:
            raise ValueError(
                f"hurdle_gaps {gaps[0]} {gaps[1]} are drawn on the random course only"
                " (nearest: add --course random, and leave --hurdle-gap out)"
            )
        hurdles = dataclasses.replace(hurdles, min_gap=gaps[0], max_gap=gaps[1])
    env = dataclasses.replace(config.env, course=options.course, engine=options.engine)
    return dataclasses.replace(config, biped=biped, hurdles=hurdles, env=env)


def _evaluate_one(candidate: Candidate, options: EvaluateOptions) -> list[list[object]]:
    """Evaluate one policy and print its table; return its rows."""
    config, found = candidate.config, candidate.found
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
    _print_table(f"{candidate.given} in {config.task}", values)
    conditions = len(options.shifts)
    say(f"{conditions} conditions x {options.episodes} episodes in {wall:.1f} s, with compilation")
    card = getattr(getattr(found.loaded, "header", None), "card", {})
    variant = card.get("variant", "scripted") if found.loaded else "scripted"
    trained = [variant, card.get("seed", config.seed), card.get("env_steps", 0)]
    return [
        [candidate.run, config.task, shift, *trained, episode, measure, f"{float(value):.9g}"]
        for shift, measures in values.items()
        for measure, column in measures.items()
        for episode, value in enumerate(column)
        if not np.isnan(value)
    ]


def _print_table(title: str, values: dict[str, dict[str, np.ndarray]]) -> None:
    """Print mean of every measure, and mean and IQM of the return with a 95 % interval."""
    measures = [m for m in next(iter(values.values())) if m != "return"]
    titles = [f"{m} (median)" if m in MEDIANS else m for m in measures]
    table = Table(title=title)
    for column in ("condition", "return (mean)", "return IQM [95 %]", *titles):
        table.add_column(column, justify="left" if column == "condition" else "right")
    for shift, found in values.items():
        iqm = bootstrap([found["return"]])
        table.add_row(
            shift,
            f"{found['return'].mean():.1f}",
            f"{iqm.estimate:.1f} [{iqm.low:.1f}, {iqm.high:.1f}]",
            *(f"{(np.nanmedian if m in MEDIANS else np.nanmean)(found[m]):.3g}" for m in measures),
        )
    Console(width=None if sys.stdout.isatty() else 160).print(table)


def _draw(table: Path, figure: Path) -> None:
    from twirl_mjx.figures.bars import shift_bars
    from twirl_mjx.figures.canvas import write_png
    from twirl_mjx.figures.tables import read_episodes

    write_png(shift_bars(read_episodes(table), "return", by="run"), figure)
    say(f"wrote {figure}")
