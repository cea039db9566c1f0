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
    run_dir = pipeline.run(
        options.config, options.preset, options.runs, options.name, say, sinks=options.log
    )
    say(f"done: {run_dir} (policy.npz, metrics.csv, eval.csv); film it: twirl render {run_dir}")
    return 0
