"""``twirl rehearse``."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro

from twirl_mjx.checks import check_range
from twirl_mjx.commands.console import parse, say
from twirl_mjx.deploy.conditions import RehearsalConfig


@dataclasses.dataclass(frozen=True)
class RehearseOptions:
    """Run a policy in an independent 1 ms simulator loop with latency, noise and motor limits."""

    policy: Annotated[Path, tyro.conf.Positional]
    """Run directory or policy file (.npz, .onnx)."""
    task: str | None = None
    """Task; the one the policy was trained for by default."""
    episodes: int = 8
    """Episodes."""
    seed: int = 0
    """Seed of goals, noise and courses."""
    robot: RehearsalConfig = dataclasses.field(default_factory=RehearsalConfig)
    """The rehearsed robot."""


def main(argv: list[str]) -> int:
    """Rehearse and print the means."""
    options = parse(RehearseOptions, argv, "twirl rehearse")
    check_range("episodes", options.episodes, 1, 100_000)
    check_range("seed", options.seed, 0, 2**32 - 1)
    from twirl_mjx.deploy.rehearsal import rehearse

    result = rehearse(
        options.policy,
        task=options.task,
        episodes=options.episodes,
        seed=options.seed,
        config=options.robot,
    )
    for name, value in result.summary().items():
        say(f"{name:24} {value}")
    return 0
