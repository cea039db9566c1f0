"""``twirl collect``."""

from __future__ import annotations

from twirl_mjx.commands.options import parse_train, say
from twirl_mjx.training import pipeline, rundir


def main(argv: list[str]) -> int:
    """Record a source policy in a target task as ``runs/<name>/source.npz``."""
    options = parse_train(argv, "twirl collect")
    config = options.config
    source = pipeline.find_source(config, options.preset, options.runs, say)
    name = options.name or rundir.default_name(config, options.preset)
    pipeline.source_data(config, options.runs / name, source, say)
    say(f"done: {options.runs / name / 'source.npz'}")
    return 0
