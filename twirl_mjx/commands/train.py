"""``twirl train``."""

from __future__ import annotations

import dataclasses

from twirl_mjx.commands.console import say
from twirl_mjx.commands.options import parse_train
from twirl_mjx.commands.selection import the_one
from twirl_mjx.commands.waiting import waiting


def main(argv: list[str]) -> int:
    """Train to the budget; see ``training.pipeline``."""
    options = parse_train(argv)
    with waiting("loading the trainer"):  # orbax and more, which options do not need
        from twirl_mjx.training import pipeline
    config = dataclasses.replace(
        options.config, source=the_one(options.config.source, options.runs)
    )
    run_dirs = pipeline.run_seeds(
        config,
        options.seeds or None,
        options.preset,
        options.runs,
        options.name,
        say,
        sinks=options.log,
        deadline=pipeline.deadline_after(options.minutes),
    )
    shown = " ".join(map(str, run_dirs))
    say(f"done: {shown} (policy.npz, metrics.csv, eval.csv); film it: twirl render {run_dirs[0]}")
    return 0
