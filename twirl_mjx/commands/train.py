"""``twirl train``."""

from __future__ import annotations

from twirl_mjx.commands.console import say
from twirl_mjx.commands.options import parse_train
from twirl_mjx.commands.waiting import waiting


def main(argv: list[str]) -> int:
    """Train to the budget; see ``training.pipeline``."""
    options = parse_train(argv)
    with waiting("loading the trainer"):  # orbax and more, which options do not need
        from twirl_mjx.training import pipeline
    run_dirs = pipeline.run_seeds(
        options.config,
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
