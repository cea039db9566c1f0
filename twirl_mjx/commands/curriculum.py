"""``twirl curriculum``."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

import tyro

from twirl_mjx.checks import check_choice
from twirl_mjx.commands.options import default_preset, parse, say
from twirl_mjx.config import SHIFTS, SOURCE_OF
from twirl_mjx.presets import PRESETS, make_config
from twirl_mjx.training import pipeline, rundir
from twirl_mjx.training.loop import EVAL_CSV

ADAPTATION_ENV_STEPS = 100_000
"""Transitions of an adaptation run (paper, section "Transfer to New Environments")."""


@dataclasses.dataclass(frozen=True)
class CurriculumOptions:
    """Train a chain unattended: source task, target task, then every dynamics shift."""

    task: Literal["biped", "hurdles"] = "biped"
    """Target task at the heart of the chain."""
    preset: Annotated[str, tyro.conf.arg(help="paper, cpu or debug")] = ""
    """Settings; cpu without an accelerator, else paper."""
    seed: int = 0
    """Seed of every run."""
    runs: Path = Path("runs")
    """Folder of all runs."""
    shifts: tuple[str, ...] = SHIFTS[1:]
    """Shifts to adapt to."""


def main(argv: list[str]) -> int:
    """Run the chain; links that are finished are skipped, an interrupted one resumes."""
    options = parse(CurriculumOptions, argv, "twirl curriculum")
    preset = options.preset or default_preset()
    check_choice("preset", preset, PRESETS)
    for shift in options.shifts:
        check_choice("shift", shift, SHIFTS)
    base = dataclasses.replace(make_config(options.task, preset), seed=options.seed)
    chain = [dataclasses.replace(base, source="train")]
    budget = min(ADAPTATION_ENV_STEPS, base.total_env_steps)
    chain += [
        dataclasses.replace(base, shift=shift, variant="twirl+weights", total_env_steps=budget)
        for shift in options.shifts
    ]
    for number, config in enumerate(chain, 1):
        name = rundir.default_name(config, preset)
        if (options.runs / name / EVAL_CSV).is_file():
            say(f"link {number} of {len(chain)}: {name} is finished")
            continue
        say(f"link {number} of {len(chain)}: {SOURCE_OF[config.task]} -> {name}")
        pipeline.run(config, preset, options.runs, None, say)
    return 0
