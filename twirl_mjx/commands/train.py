"""``twirl train``."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from twirl_mjx.commands.console import say
from twirl_mjx.commands.options import TrainOptions, parse_train
from twirl_mjx.commands.selection import the_one
from twirl_mjx.commands.waiting import waiting

AND = "--and"
"""Stands between the options of runs that are one program."""


def main(argv: list[str]) -> int:
    """Train to the budget; see ``training.pipeline``."""
    several = [parse_train(words) for words in split(argv)]
    options = check_alike(several)
    with waiting("loading the trainer"):  # orbax and more, which options do not need
        from twirl_mjx.training import pipeline
    configs = [
        dataclasses.replace(each.config, source=the_one(each.config.source, each.runs))
        for each in several
    ]
    stage = (options.preset, options.runs)
    common = {"sinks": options.log, "deadline": pipeline.deadline_after(options.minutes)}
    if len(several) > 1:
        names = [each.name for each in several]
        run_dirs = pipeline.run_together(configs, names, *stage, say, **common)
    else:
        seeds = options.seeds or None
        run_dirs = pipeline.run_seeds(configs[0], seeds, *stage, options.name, say, **common)
    shown = " ".join(map(str, run_dirs))
    say(f"done: {shown} (policy.npz, metrics.csv, eval.csv); film it: twirl render {run_dirs[0]}")
    return 0


def split(argv: Sequence[str]) -> list[list[str]]:
    """Return the options of every run of a command line, which stand on both sides of ``--and``."""
    runs: list[list[str]] = [[]]
    for word in argv:
        if word == AND:
            runs.append([])
        else:
            runs[-1].append(word)
    return runs


def check_alike(several: Sequence[TrainOptions]) -> TrainOptions:
    """Return the options that the runs of one program share, which are those of the first.

    Raises:
        ValueError: One differs in them, or has seeds of its own.
    """
    first, *others = several
    for other in others:
        for name in ("preset", "runs", "log", "minutes"):
            mine, its = (getattr(each, name) for each in (first, other))
            if mine != its:
                raise ValueError(
                    f"--{name} is {mine} on one side of {AND} and {its} on the other (nearest:"
                    " the same for all)"
                )
        if first.seeds or other.seeds:
            raise ValueError(
                f"--seeds beside {AND}: give each run its own --seed (nearest: {AND} and --seed)"
            )
    return first
