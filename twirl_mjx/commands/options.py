"""Parsing shared by the commands: presets first, then every field as a documented option."""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path
from typing import Annotated, Any

import tyro

from twirl_mjx.config import TrainConfig
from twirl_mjx.presets import make_config


@dataclasses.dataclass(frozen=True)
class TrainOptions:
    """Train a task (`collect`: only record its source), with every stage before it that is missing.

    The same command resumes.
    """

    preset: str
    """Settings to start from: paper, cpu or debug (default: cpu without an accelerator)."""
    name: str | None
    """Name of the run; derived from task, variant, preset and seed by default."""
    runs: Path
    """Folder of all runs."""
    log: tuple[str, ...]
    """Where metrics go beside metrics.csv, TensorBoard and the terminal: wandb, trackio or a sink
    of your own, FILE.py:NAME."""
    config: Annotated[TrainConfig, tyro.conf.arg(name="")]


def default_preset() -> str:
    """Return ``paper`` where jax has an accelerator, else ``cpu``."""
    import jax

    return "cpu" if jax.default_backend() == "cpu" else "paper"


def parse[T](kind: type[T], argv: list[str], prog: str, default: T | None = None) -> T:
    """Parse a command's options with tyro; a wrong one is refused with the nearest valid."""
    if default is None:
        return tyro.cli(kind, args=argv, prog=prog)
    return tyro.cli(kind, args=argv, prog=prog, default=default)


def parse_train(argv: list[str], prog: str = "twirl train") -> TrainOptions:
    """Parse training options: ``--task`` and ``--preset`` choose the defaults of the others.

    Raises:
        ValueError: Unknown task or preset, or a value out of range.
    """
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    first.add_argument("--task", default="biped")
    first.add_argument("--preset", default=None)
    first.add_argument("--runs", default="runs")
    known, _ = first.parse_known_args(argv)
    preset = known.preset or default_preset()
    default = TrainOptions(
        preset=preset,
        name=None,
        runs=Path(known.runs),
        log=(),
        config=make_config(known.task, preset),
    )
    return parse(TrainOptions, argv, prog, default)


def say(text: str) -> None:
    """Print one line at once."""
    print(text, flush=True)


def json_text(record: Any) -> str:
    """Return a record as one JSON document for machines."""
    import json

    return json.dumps(record, indent=2, sort_keys=True, allow_nan=True)
