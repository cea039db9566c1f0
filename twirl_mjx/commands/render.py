"""``twirl render``."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from twirl_mjx.checks import check_choice
from twirl_mjx.commands.options import parse, say
from twirl_mjx.config import SHIFTS, TrainConfig
from twirl_mjx.deploy.render import render_episode
from twirl_mjx.evaluation.record import Recording, record_episode, scene_model
from twirl_mjx.policies.resolve import resolve_policy
from twirl_mjx.presets import make_config
from twirl_mjx.sim import look
from twirl_mjx.sim.dynamics import make_dynamics
from twirl_mjx.training import rundir


@dataclasses.dataclass(frozen=True)
class RenderOptions:
    """Film one episode of a policy: an mp4 and a strip of frames, without a display."""

    policy: Annotated[str, tyro.conf.Positional]
    """Run directory, policy file (.npz, .onnx) or scripted name."""
    task: str | None = None
    """Task to act in; the one the policy was trained for by default."""
    shift: str | None = None
    """Dynamics shift; that of the run by default."""
    seed: int = 0
    """Seed of the episode."""
    seconds: float = 20.0
    """Longest film."""
    panels: int = 8
    """Frames in the strip."""
    out: Path | None = None
    """Path without ending; <run>/episode, or runs/<policy>-<task>, by default."""


def main(argv: list[str]) -> int:
    """Record and film."""
    options = parse(RenderOptions, argv, "twirl render")
    config = config_of(options.policy, options.task)
    if options.shift is not None:
        check_choice("shift", options.shift, SHIFTS)
        config = dataclasses.replace(config, shift=options.shift)
    path = Path(options.policy)
    default = path / "episode" if path.is_dir() else Path("runs") / f"{path.stem}-{config.task}"
    film(config, options, options.out or default)
    return 0


def film(config: TrainConfig, options: RenderOptions, stem: Path) -> Path:
    """Write ``<stem>.mp4`` and ``<stem>.png``; return the strip's path."""
    found = resolve_policy(options.policy, config)
    steps = min(config.env.episode_length, round(options.seconds * 20))
    recording = record_episode(config, found.policy, seed=options.seed, steps=steps)
    stem.parent.mkdir(parents=True, exist_ok=True)
    video, strip = render_episode(
        scene_model(config, recording),
        recording.qpos,
        stem,
        panels=options.panels,
        goals=recording.goals if config.task == "biped" else None,
        captions=captions(config, recording),
    )
    say(f"return {recording.reward.sum():.1f} in {len(recording.reward)} steps; {video}, {strip}")
    return strip


def captions(config: TrainConfig, recording: Recording) -> list[list[str]]:
    """Return the text lines of every frame."""
    shown = {
        "stand": ("cosine",),
        "biped": ("cosine", "goal_distance"),
        "imitate": ("tracking",),
        "hurdles": ("hurdles_passed",),
    }[config.task]
    total = np.cumsum(recording.reward)
    shift = look.describe(
        config.shift, make_dynamics(config.shift, config.shift_strength), recording.leg_strength
    )
    title = f"{config.task}, {shift}" if shift else config.task
    return [
        [
            f"{title}  {0.05 * (t + 1):5.2f} s",
            f"return {total[t]:.0f}  "
            + "  ".join(f"{k} {recording.metrics[k][t]:.2f}" for k in shown),
        ]
        for t in range(len(total))
    ]


def config_of(policy: str, task: str | None) -> TrainConfig:
    """Return the config to show a policy under: its run's, or the paper's for its task.

    Raises:
        ValueError: The policy does not say its task and none is given.
    """
    path = Path(policy)
    if (path / rundir.CONFIG_NAME).is_file():
        config = rundir.read_config(path)
        return config if task is None else dataclasses.replace(config, task=task)
    if task is None:
        task = resolve_policy(policy, make_config("biped")).task
    if task is None:
        raise ValueError(f"{policy} does not say its task: give --task")
    return make_config(task)
