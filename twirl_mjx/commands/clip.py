"""``twirl clip make``, ``twirl clip show`` and ``twirl clip check``."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro

from twirl_mjx import files
from twirl_mjx.assets import asset_path
from twirl_mjx.checks import check_choice
from twirl_mjx.commands.console import parse, say
from twirl_mjx.commands.render import stem_of
from twirl_mjx.motion.conversion import ClipOptions
from twirl_mjx.motion.leap_config import LeapConfig

if TYPE_CHECKING:
    from twirl_mjx.motion.clip import Clip

FRAME_DT = 0.025
"""s between the frames of a film, half speed at 20 frames per second."""
BAND_X = 0.26
"""m, where the shipped leap clears a hurdle band best."""


@dataclasses.dataclass(frozen=True)
class MakeOptions:
    """Plan our leap, check it and write it as a clip."""

    out: Path = Path("leap.json")
    """Clip file to write."""
    leap: LeapConfig = dataclasses.field(default_factory=LeapConfig)
    """What the leap shall be like."""
    overwrite: bool = False
    """Replace a clip that this command did not write."""


@dataclasses.dataclass(frozen=True)
class CheckOptions(ClipOptions):
    """Check whether clips can be motions of a robot, and say of each what it holds."""

    clips: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """Clip files (.json, .txt, .npy, .csv); the shipped leap by default."""
    robot: str = "a1"
    """Robot that shall move so, by name or file.py:NAME."""


@dataclasses.dataclass(frozen=True)
class ShowOptions(CheckOptions):
    """Draw and render a clip; with several, compare them (the first is drawn as ours)."""

    out: Path = Path("runs/clip")
    """Writes <out>.png, <out>-film.mp4 and .png and, for several clips, <out>-compare.png; with or
    without an ending."""
    source: str = ""
    """Where the other clips come from, written into the comparison."""
    overwrite: bool = False
    """Replace pictures and films that this command did not write."""


def main(argv: list[str], set_up: Callable[[bool], None]) -> int:
    """Run ``make``, ``show`` or ``check``.

    Args:
        argv: What to do, and its options.
        set_up: Gets whether the robot is drawn, before the simulation is imported.
    """
    verb, rest = (argv[0], argv[1:]) if argv else ("", [])
    if verb in ("-h", "--help", ""):
        say("usage: twirl clip {make,show,check} [options]; `twirl clip make --help` lists them")
        return 0 if verb else 2
    check_choice("clip action", verb, ("make", "show", "check"))
    return {"make": _make, "show": _show, "check": _check}[verb](rest, set_up)


def _check(argv: list[str], set_up: Callable[[bool], None]) -> int:
    options = parse(CheckOptions, argv, "twirl clip check")
    set_up(False)
    for clip in _read_all(options):
        speed = np.linalg.norm(np.diff(clip.root_pos[[0, -1], :2], axis=0)) / clip.cycle_duration
        low, high = clip.root_pos[:, 2].min(), clip.root_pos[:, 2].max()
        say(
            f"{clip.name}: a motion of {clip.robot.name}: {clip.num_frames} frames in"
            f" {clip.cycle_duration:.3g} s, {speed:.3g} m/s, root at {low:.3g} to {high:.3g} m,"
            f" {clip.loop}"
        )
    return 0


def _read_all(options: CheckOptions) -> list[Clip]:
    """Return the clips as motions of the robot; the first that cannot be one is refused."""
    from twirl_mjx.motion.retarget import read_motion
    from twirl_mjx.sim.robots import ROBOTS

    robot = ROBOTS.get(ROBOTS.admit(options.robot))
    other = ROBOTS.get(ROBOTS.admit(options.clip_robot)) if options.clip_robot else None
    paths = options.clips or (asset_path("a1", "leap.json"),)
    try:
        return [
            read_motion(path, robot, options.clip_legs, options.conversion, other) for path in paths
        ]
    except ValueError as error:  # the gates name the options of the task
        raise ValueError(str(error).replace("--imitate.clip-", "--clip-")) from error


def _make(argv: list[str], set_up: Callable[[bool], None]) -> int:
    options = parse(MakeOptions, argv, "twirl clip make")
    files.check_ours(options.out, overwrite=options.overwrite)
    set_up(False)
    from twirl_mjx.motion.formats import write_clip
    from twirl_mjx.motion.leap import make_leap
    from twirl_mjx.motion.leap_checks import require_leap

    clip = make_leap(options.leap, say)
    for finding in require_leap(clip):
        say(str(finding))
    write_clip(clip, options.out)
    say(f"wrote {options.out}")
    return 0


def _show(argv: list[str], set_up: Callable[[bool], None]) -> int:
    options = parse(ShowOptions, argv, "twirl clip show")
    stem = stem_of(options.out)
    endings = (
        ".png",
        "-film.mp4",
        "-film.png",
        *(["-compare.png"] if len(options.clips) > 1 else []),
    )
    for ending in endings:
        files.check_ours(f"{stem}{ending}", overwrite=options.overwrite)
    set_up(True)
    from twirl_mjx.deploy.render import render_episode
    from twirl_mjx.motion import show as show_lib
    from twirl_mjx.motion.clip import configurations
    from twirl_mjx.sim.scene import Bands, build_scene

    clips = _read_all(options)
    show_lib.show(clips[0], f"{stem}.png")
    written = [f"{stem}.png"]
    times = np.arange(0.0, 2 * clips[0].cycle_duration, FRAME_DT)
    model = build_scene(robot=clips[0].robot, bands=Bands((BAND_X,))).mj_model
    film = Path(f"{stem}-film")
    written += map(
        str, render_episode(model, configurations(clips[0], times), film, frame_dt=FRAME_DT)
    )
    if len(clips) > 1:
        show_lib.compare(clips, f"{stem}-compare.png", options.source)
        written.append(f"{stem}-compare.png")
    say(f"wrote {', '.join(written)}")
    return 0
