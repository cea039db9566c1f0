"""``twirl collect``."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from twirl_mjx.commands.console import say
from twirl_mjx.commands.options import parse_collect
from twirl_mjx.commands.selection import the_one
from twirl_mjx.commands.waiting import waiting
from twirl_mjx.tasks.imitate import ImitateOptions
from twirl_mjx.training.config import TrainConfig
from twirl_mjx.training.presets import starts_from_nominal_run


def main(argv: list[str]) -> int:
    """Record a source policy in a target task as ``runs/<name>/source.npz``."""
    options = parse_collect(argv)
    with waiting("loading the trainer"):  # orbax and more, which options do not need
        from twirl_mjx.training import collection, memory, pipeline, rundir
        from twirl_mjx.training.sinks.registry import resolve
    config = dataclasses.replace(
        options.config, source=the_one(options.config.source, options.runs)
    )
    check_source(config, options.preset)
    memory.check([memory.collecting(config)])
    sinks = resolve(options.log)
    name = options.name or rundir.default_name(config, options.preset)
    run_dir = rundir.RunDir(options.runs / rundir.check_name(name))
    source = pipeline.find_source(config, options.preset, options.runs, say, sinks)
    with run_dir.exclusive():
        match run_dir.status(config, source.identity):
            case rundir.Foreign(error) | rundir.Busy(error):
                raise error
        run_dir.open(config, source.identity)
        path = run_dir.dataset
        before = _version(path)
        collection.source_data(config, run_dir, source, say)
        written = _version(path) != before
    if source.data is not None:
        say(f"nothing was collected: {source.origin} is recorded data, and `twirl train` reads it")
    elif written:
        say(f"done: {path}")
    elif config.shift != "none" and source.run_dir is not None:
        say(
            f"nothing was collected: under shift {config.shift} the replay of {source.run_dir} is"
            " the source data, and `twirl train` reads it there"
        )
    else:
        say(f"nothing was collected: {path} already fits these settings")
    return 0


def check_source(config: TrainConfig, preset: str) -> None:
    """Refuse a task that has no source policy unless one is named.

    Raises:
        ValueError: There is nothing to record; the message lists what can be named.
    """
    from twirl_mjx.policies.resolve import SCRIPTED_SOURCES

    named = config.source not in ("auto", "train")
    if named or config.task_type.source or starts_from_nominal_run(config, preset):
        return
    nearest = "clip" if isinstance(config.options, ImitateOptions) else "trot"
    raise ValueError(
        f"task {config.task} has no source policy of its own, so --source {config.source} finds"
        f" nothing to record: name one of {', '.join(SCRIPTED_SOURCES)}, a run directory, a"
        f" policy file, data or file.py:function (nearest: --source {nearest})"
    )


def _version(path: Path) -> tuple[int, int] | None:
    """Return what changes when a file is replaced; None if there is none."""
    if not path.exists():
        return None
    status = path.stat()
    return status.st_ino, status.st_mtime_ns
