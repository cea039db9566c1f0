"""``twirl curriculum``."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro

from twirl_mjx.checks import check_choice, check_once
from twirl_mjx.commands.console import parse, say
from twirl_mjx.commands.options import default_preset
from twirl_mjx.sim.leaves import PAPER_SHIFTS, SHIFTS
from twirl_mjx.sweep.grid import configure
from twirl_mjx.tasks.registry import TASKS
from twirl_mjx.tasks.task import Link
from twirl_mjx.training.config import TrainConfig
from twirl_mjx.training.presets import PRESETS

ADAPTATION_ENV_STEPS = 100_000
"""Transitions of an adaptation run (paper, section "Transfer to New Environments")."""


@dataclasses.dataclass(frozen=True)
class CurriculumOptions:
    """Train a chain unattended: easier tasks first, the target task, then every dynamics shift.

    With --source the target task starts from that source, and the easier tasks are left out.
    """

    task: str = TrainConfig.task
    """Target task at the heart of the chain."""
    preset: Annotated[str, tyro.conf.arg(help="paper, cpu, massive or debug")] = ""
    """Settings; cpu without an accelerator, else paper."""
    seed: int = 0
    """Seed of every run."""
    runs: Path = Path("runs")
    """Folder of all runs."""
    shifts: tuple[str, ...] = PAPER_SHIFTS[1:]
    """Shifts to adapt to."""
    source: str = ""
    """Source of the target task instead of the easier ones: whatever twirl train takes."""
    source_contract: str = ""
    """How a foreign source meets the robot, by name or file (docs/sources.md)."""
    source_command: str = ""
    """What a foreign source is told to do: 0.5,0,0 or towards-goal:0.5."""
    allow_clipping: bool = False
    """Record a source although more than 20 % of its joint targets lie outside the action box."""


def chain_of(task: str) -> tuple[Link, ...]:
    """Return the runs that lead to a task: its own chain, else those of its sources and its own."""
    kind = TASKS.get(task)
    if kind.chain:
        return kind.chain
    before = chain_of(kind.source) if kind.source else ()
    return (*before, Link(task, {"task": task}))


def plan(options: CurriculumOptions, preset: str) -> list[tuple[str, TrainConfig]]:
    """Return name and config of every run of the chain; each is the source of the next.

    All shifts start from the run of the target task.
    """
    from twirl_mjx.training.rundir import default_name  # needs jax, which options do not

    links: list[tuple[str, TrainConfig]] = []
    task = TASKS.admit(options.task)
    for name, settings in chain_of(task)[-1:] if options.source else chain_of(task):
        source = {"source": str(options.runs / links[-1][0])} if links else given_source(options)
        config = configure(preset, {**settings, **source, "seed": options.seed}, f"link {name}")
        chained = f"{name}-chain-{preset}-s{options.seed}"
        # The first link is the run of `twirl train`, which may be there already.
        links.append((chained if links else default_name(config, preset), config))
    target, config = links[-1]
    budget = min(ADAPTATION_ENV_STEPS, config.total_env_steps)
    for shift in options.shifts:
        adapted = dataclasses.replace(
            config,
            shift=shift,
            source=str(options.runs / target),
            source_contract="",
            source_command="",
            total_env_steps=budget,
        )
        links.append((f"{task}-{shift}-chain-{preset}-s{options.seed}", adapted))
    return links


def given_source(options: CurriculumOptions) -> dict[str, str | bool]:
    """Return the settings of the source that was named, none if there was none.

    Raises:
        ValueError: A contract or a command, and no source that could have one.
    """
    terms = {"contract": options.source_contract, "command": options.source_command}
    if not options.source:
        for name, value in terms.items():
            if value:
                raise ValueError(
                    f"--source-{name} {value} would do nothing without a foreign source (nearest:"
                    " --source FILE.onnx)"
                )
        return {}
    said: dict[str, str | bool] = {f"source_{name}": value for name, value in terms.items()}
    return {"source": options.source, "variant": "twirl", **said} | (
        {"allow_clipping": True} if options.allow_clipping else {}
    )


def main(argv: list[str]) -> int:
    """Run the chain; links that are finished are skipped, an interrupted one resumes."""
    options = parse(CurriculumOptions, argv, "twirl curriculum")
    preset = options.preset or default_preset()
    check_choice("preset", preset, PRESETS)
    options = dataclasses.replace(options, shifts=tuple(map(SHIFTS.admit, options.shifts)))
    check_once("--shifts", options.shifts)
    from twirl_mjx.training import pipeline, source_rules

    links = plan(options, preset)
    for _, config in links:  # the last link would be refused after hours of those before it
        source_rules.check_source_is_used(config, preset)
    for number, (name, config) in enumerate(links, 1):
        say(f"link {number} of {len(links)}: {name}")
        pipeline.run(config, preset, options.runs, name, say)
    return 0
