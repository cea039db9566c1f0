"""``twirl render``."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro

from twirl_mjx import files
from twirl_mjx.checks import check_range
from twirl_mjx.commands.console import say
from twirl_mjx.commands.selection import the_one
from twirl_mjx.plugins import is_reference
from twirl_mjx.policies.learned import BEST_POLICY, LAST_POLICY, PolicyFileError

if TYPE_CHECKING:
    from twirl_mjx.evaluation.record import Recording
    from twirl_mjx.worlds.config import WorldConfig

FILM_SECONDS = (0.1, 3600.0)
"""s, shortest and longest film that can be asked for; an episode may end before."""
MAX_PANELS = 1000
"""Most frames in a strip."""


@dataclasses.dataclass(frozen=True)
class RenderOptions:
    """Film one episode of a policy, without a display: a film and a strip of frames."""

    policy: Annotated[str, tyro.conf.Positional]
    """Run (name or directory), policy file (.npz, .onnx), file.py:function or scripted name."""
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
    """Name of the film: x.mp4, x.webp (an animated picture), or without ending for mp4; the strip
    lies beside it as png. <run>/episode, or runs/<policy>-<task>, by default."""
    source_contract: str = ""
    """How a foreign policy meets the robot, by name or file (docs/sources.md)."""
    source_command: str = ""
    """What a foreign policy is told to do: 0.5,0,0 or towards-goal:0.5."""
    allow_clipping: bool = False
    """Show a foreign policy without a contract although its outputs leave [-1, 1]."""
    overwrite: bool = False
    """Replace a film or a strip that this command did not write."""

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ValueError: A value is out of range.
        """
        check_range("seconds", self.seconds, *FILM_SECONDS)
        check_range("panels", self.panels, 1, MAX_PANELS)
        check_range("seed", self.seed, 0, 2**32 - 1)


def main(argv: list[str], set_up: Callable[[bool], None]) -> int:
    """Record and film.

    Args:
        argv: Options.
        set_up: Gets whether anything is drawn, before MuJoCo is imported.
    """
    from twirl_mjx.commands.options import parse_in_tasks, with_overrides

    options, overrides = parse_in_tasks(RenderOptions, argv, "twirl render")
    options = dataclasses.replace(options, policy=the_one(options.policy))
    set_up(True)
    config = with_overrides(config_of(options.policy, options.task), overrides)
    if options.shift is not None:
        config = dataclasses.replace(config, shift=options.shift)
    path = Path(options.policy)
    named = Path("runs") / f"{name_of(options.policy)}-{config.task}"
    stem = stem_of(options.out or (path / "episode" if path.is_dir() else named))
    check_film(stem, options)
    film(config, record(config, options), stem, options)
    return 0


def stem_of(path: Path) -> Path:
    """Return the common part of the names of a film and its strip, given any of them."""
    return path.with_suffix("") if path.suffix in (".mp4", ".png") else path


def record(config: WorldConfig, options: RenderOptions) -> Recording:
    """Return one episode of a policy, and say what should be known of it."""
    from twirl_mjx.evaluation.record import record_episode
    from twirl_mjx.policies.resolve import Terms, resolve_actor
    from twirl_mjx.sim.robots import ROBOTS

    terms = Terms(options.source_contract, options.source_command, options.allow_clipping)
    found = resolve_actor(options.policy, config, terms=terms)
    for note in found.notes:
        say(f"{options.policy}: {note}")
    steps = min(config.episode_length, round(options.seconds / ROBOTS.get(config.robot).control_dt))
    return record_episode(config, found.policy, seed=options.seed, steps=steps)


def check_film(stem: Path, options: RenderOptions) -> None:
    """Check that a film and its strip can be written.

    Raises:
        FileError: One of them is there and was not written by this project.
    """
    from twirl_mjx.deploy.video import film_paths

    for path in film_paths(stem):
        files.check_ours(path, overwrite=options.overwrite)


def film(config: WorldConfig, recording: Recording, stem: Path, options: RenderOptions) -> Path:
    """Write the film and its strip, as ``render_episode`` names them; return the strip's path.

    Raises:
        FileError: As :func:`check_film`.
    """
    check_film(stem, options)
    from twirl_mjx.deploy.render import render_episode
    from twirl_mjx.evaluation.record import scene_model

    video, strip = render_episode(
        scene_model(config, recording),
        recording.qpos,
        stem,
        frame_dt=recording.robot.control_dt,
        panels=options.panels,
        goals=recording.goals if config.task_type.shows_goal else None,
        captions=captions(config, recording),
    )
    say(f"return {recording.reward.sum():.1f} in {len(recording.reward)} steps; {video}, {strip}")
    return strip


def captions(config: WorldConfig, recording: Recording) -> list[list[str]]:
    """Return the text lines of every frame."""
    from twirl_mjx.sim import look

    total = np.cumsum(recording.reward)
    dynamics = config.make_dynamics()
    shift = look.describe(config.shift, recording.robot, dynamics, recording.leg_strength)
    control_dt = recording.robot.control_dt
    title = f"{config.task}, {shift}" if shift else config.task
    return [
        [
            f"{title}  {control_dt * (t + 1):5.2f} s",
            f"return {total[t]:.0f}  "
            + "  ".join(f"{k} {recording.metrics[k][t]:.2f}" for k in config.task_type.caption),
        ]
        for t in range(len(total))
    ]


def config_of(policy: str, task: str | None) -> WorldConfig:
    """Return the worlds to show a policy in.

    A run directory has its own. A policy file is shown in those of its task, with the task
    options that it was trained with where its card has them, and in a task that is not its
    own under the paper's options of that task, as scripts are.

    Raises:
        FileNotFoundError: Nothing to load there.
        PolicyFileError: The file is no policy, or of a task or with options unknown here.
        ValueError: The policy does not say its task and none is given.
    """
    from twirl_mjx.policies.resolve import config_of_card, header_of, robot_of_card
    from twirl_mjx.tasks.registry import TASKS
    from twirl_mjx.training.rundir import RunDir
    from twirl_mjx.worlds.config import WorldConfig, in_task

    run_dir, name = RunDir(policy), None if task is None else TASKS.admit(task)
    if run_dir.config.is_file():
        config = run_dir.read_config().evaluation
        if name in (None, config.task):
            return config
        return in_task(config, name, TASKS.get(name).paper_options())
    header = header_of(policy)
    if header is not None and name in (None, header.task):
        return config_of_card(header, policy)
    if name is None:
        raise ValueError(f"{policy} does not say its task: give --task")
    robot = WorldConfig.robot if header is None else robot_of_card(header)
    try:
        return WorldConfig(task=name, options=TASKS.get(name).paper_options(), robot=robot)
    except ValueError as error:
        raise PolicyFileError(f"{policy}: {error}") from error


def name_of(policy: str) -> str:
    """Return what a policy is called in tables and files.

    A run directory and its ``policy.npz`` have the directory's name, its other policy files a
    longer one (``NAME-policy_last``); any other file has its own without the ending.
    """
    from twirl_mjx.policies.resolve import SCRIPTED_SOURCES
    from twirl_mjx.training.rundir import RunDir

    if policy in SCRIPTED_SOURCES:
        return policy
    if is_reference(policy):
        file, _, function = policy.rpartition(":")
        return f"{Path(file).stem}-{function}"
    path = Path(os.path.abspath(policy))  # ".." and "." have no name
    if path.is_dir():
        return path.name
    of_run = RunDir(path.parent).config.is_file() and path.match("policy*.npz")
    if of_run or path.name in (BEST_POLICY, LAST_POLICY):
        folder = path.parent.name
        return folder if path.name == BEST_POLICY else f"{folder}-{path.stem}"
    return path.stem
