"""``twirl render``."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro

from twirl_mjx.checks import check_choice, check_range
from twirl_mjx.commands.options import parse, say
from twirl_mjx.config import SCRIPTED_SOURCES, SHIFTS, TrainConfig
from twirl_mjx.policies.learned import BEST_POLICY, LAST_POLICY, load_policy
from twirl_mjx.presets import make_config
from twirl_mjx.training import rundir

if TYPE_CHECKING:
    from twirl_mjx.evaluation.record import Recording

FILM_SECONDS = (0.1, 3600.0)
"""s, shortest and longest film that can be asked for; an episode may end before."""
MAX_PANELS = 1000
"""Most frames in a strip."""


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

    def __post_init__(self) -> None:
        """Check the numbers and the name of the shift.

        Raises:
            ValueError: A value is out of range, or the shift is unknown.
        """
        check_range("seconds", self.seconds, *FILM_SECONDS)
        check_range("panels", self.panels, 1, MAX_PANELS)
        if self.shift is not None:
            check_choice("shift", self.shift, SHIFTS)


def main(argv: list[str], set_up: Callable[[bool], None]) -> int:
    """Record and film.

    Args:
        argv: Options.
        set_up: Gets whether anything is drawn, before the simulation is imported.
    """
    options = parse(RenderOptions, argv, "twirl render")
    set_up(True)
    config = config_of(options.policy, options.task)
    if options.shift is not None:
        config = dataclasses.replace(config, shift=options.shift)
    path = Path(options.policy)
    named = Path("runs") / f"{name_of(options.policy)}-{config.task}"
    film(config, options, options.out or (path / "episode" if path.is_dir() else named))
    return 0


def film(config: TrainConfig, options: RenderOptions, stem: Path) -> Path:
    """Write ``<stem>.mp4`` and ``<stem>.png``; return the strip's path."""
    from twirl_mjx.deploy.render import render_episode
    from twirl_mjx.evaluation.record import record_episode, scene_model
    from twirl_mjx.policies.resolve import resolve_policy
    from twirl_mjx.sim.scene import CONTROL_DT

    found = resolve_policy(options.policy, config)
    steps = min(config.env.episode_length, round(options.seconds / CONTROL_DT))
    recording = record_episode(config, found.policy, seed=options.seed, steps=steps)
    stem.parent.mkdir(parents=True, exist_ok=True)
    video, strip = render_episode(
        scene_model(config, recording),
        recording.qpos,
        stem,
        frame_dt=CONTROL_DT,
        panels=options.panels,
        goals=recording.goals if config.task == "biped" else None,
        captions=captions(config, recording),
    )
    say(f"return {recording.reward.sum():.1f} in {len(recording.reward)} steps; {video}, {strip}")
    return strip


def captions(config: TrainConfig, recording: Recording) -> list[list[str]]:
    """Return the text lines of every frame."""
    from twirl_mjx.sim import look
    from twirl_mjx.sim.dynamics import make_dynamics

    shown = {
        "stand": ("cosine",),
        "biped": ("cosine", "goal_distance"),
        "imitate": ("tracking",),
        "hurdles": ("hurdles_passed",),
    }[config.task]
    total = np.cumsum(recording.reward)
    dynamics = make_dynamics(config.shift, config.shift_strength)
    shift = look.describe(config.shift, recording.robot, dynamics, recording.leg_strength)
    control_dt = recording.robot.control_dt
    title = f"{config.task}, {shift}" if shift else config.task
    return [
        [
            f"{title}  {control_dt * (t + 1):5.2f} s",
            f"return {total[t]:.0f}  "
            + "  ".join(f"{k} {recording.metrics[k][t]:.2f}" for k in shown),
        ]
        for t in range(len(total))
    ]


def config_of(policy: str, task: str | None) -> TrainConfig:
    """Return the config to show a policy under.

    A run directory has its own. A policy file is shown under the paper's of its task, with the
    task options that it was trained with where its card has them, and in a task that is not its
    own under the paper's of that task, as scripts are.

    Raises:
        FileNotFoundError: Nothing to load there.
        PolicyFileError: The file is no policy, or of a task or with options unknown here.
        ValueError: The policy does not say its task and none is given.
    """
    path = Path(policy)
    if (path / rundir.CONFIG_NAME).is_file():
        config = rundir.read_config(path)
        return config if task is None else dataclasses.replace(config, task=task)
    header = None if policy in SCRIPTED_SOURCES else load_policy(path).header
    if header is not None and task in (None, header.task):
        from twirl_mjx.policies.resolve import config_of_card

        return config_of_card(header, policy)
    if task is None:
        raise ValueError(f"{policy} does not say its task: give --task")
    return make_config(task)


def name_of(policy: str) -> str:
    """Return what a policy is called in tables and files.

    A run directory and its ``policy.npz`` have the directory's name, its other policy files a
    longer one (``NAME-policy_last``); any other file has its own without the ending.
    """
    if policy in SCRIPTED_SOURCES:
        return policy
    path = Path(os.path.abspath(policy))  # ".." and "." have no name
    if path.is_dir():
        return path.name
    of_run = (path.parent / rundir.CONFIG_NAME).is_file() and path.match("policy*.npz")
    if of_run or path.name in (BEST_POLICY, LAST_POLICY):
        folder = path.parent.name
        return folder if path.name == BEST_POLICY else f"{folder}-{path.stem}"
    return path.stem
