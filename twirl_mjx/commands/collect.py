"""``twirl collect``."""

from __future__ import annotations

from twirl_mjx.commands.options import parse_train, say
from twirl_mjx.training import pipeline, rundir


def main(argv: list[str]) -> int:
    """Record a source policy in a target task as ``runs/<name>/source.npz``."""
    options = parse_train(argv, "twirl collect")
    config = options.config
    source = pipeline.find_source(config, options.preset, options.runs, say)
    run_dir = options.runs / (options.name or rundir.default_name(config, options.preset))
    with rundir.exclusive(run_dir):
        rundir.open_run(run_dir, config, source.identity)
        pipeline.source_data(config, run_dir, source, say)
    say(f"done: {run_dir / 'source.npz'}")
    return 0
