"""``twirl curriculum``."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from twirl_mjx.checks import check_choice
from twirl_mjx.commands.options import default_preset, parse, say
from twirl_mjx.config import SHIFTS, TrainConfig
from twirl_mjx.presets import PRESETS
from twirl_mjx.sweep.grid import configure
from twirl_mjx.training import pipeline, rundir

ADAPTATION_ENV_STEPS = 100_000
"""Transitions of an adaptation run (paper, section "Transfer to New Environments")."""

POLISH = {
    "variant": "twirl+weights",
    "droq.target_entropy": -12.0,
    "droq.learning_rate": 1e-4,
}
"""Less exploration noise and smaller steps, for a skill that is there already."""

CHAINS: dict[str, tuple[tuple[str, dict[str, Any]], ...]] = {
    "biped": (
        ("stand", {"task": "stand"}),
        (
            "walk",
            {
                "task": "biped",
                "variant": "twirl+weights",
                "biped.distance_reward": "speed",
                "biped.distance_weight": 4.0,
                "env.train_episode_length": 200,
                "droq.target_entropy": -12.0,
            },
        ),
        ("biped", {"task": "biped"} | POLISH),
    ),
    "hurdles": (
        ("imitate", {"task": "imitate"}),
        ("hurdles", {"task": "hurdles"}),
        ("polish", {"task": "hurdles", "hurdles.max_gap": 3.7} | POLISH),
    ),
}
"""Per target task: name and settings of every link, on top of the preset. ``walk`` is ``biped``
with an easier reward: its distance term is graded and four times as large, because leaning towards
the goal earns little in the paper's reward as long as it costs balance. ``polish`` goes on with
TWiRL's networks and its own experience, and with gaps up to a little more than the 3.6 m between
the hurdles of the paper's tests: run-ups of that length do not occur in the task itself."""


@dataclasses.dataclass(frozen=True)
class CurriculumOptions:
    """Train a chain unattended: easier tasks first, the target task, then every dynamics shift."""

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


def plan(options: CurriculumOptions, preset: str) -> list[tuple[str, TrainConfig]]:
    """Return name and config of every run of the chain; each is the source of the next.

    All shifts start from the run of the target task.
    """
    links: list[tuple[str, TrainConfig]] = []
    for name, settings in CHAINS[options.task]:
        source = {"source": str(options.runs / links[-1][0])} if links else {}
        config = configure(preset, settings | source | {"seed": options.seed}, f"link {name}")
        chained = f"{name}-chain-{preset}-s{options.seed}"
        # The first link is the run of `twirl train`, which may be there already.
        links.append((chained if links else rundir.default_name(config, preset), config))
    target, config = links[-1]
    budget = min(ADAPTATION_ENV_STEPS, config.total_env_steps)
    for shift in options.shifts:
        adapted = dataclasses.replace(
            config,
            shift=shift,
            source=str(options.runs / target),
            total_env_steps=budget,
        )
        links.append((f"{options.task}-{shift}-chain-{preset}-s{options.seed}", adapted))
    return links


def main(argv: list[str]) -> int:
    """Run the chain; links that are finished are skipped, an interrupted one resumes."""
    options = parse(CurriculumOptions, argv, "twirl curriculum")
    preset = options.preset or default_preset()
    check_choice("preset", preset, PRESETS)
    for shift in options.shifts:
        check_choice("shift", shift, SHIFTS[1:])
    links = plan(options, preset)
    for number, (name, config) in enumerate(links, 1):
        say(f"link {number} of {len(links)}: {name}")
        pipeline.run(config, preset, options.runs, name, say)
    return 0
