"""``twirl clip make`` and ``twirl clip show``."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from twirl_mjx import files
from twirl_mjx.assets import asset_path
from twirl_mjx.checks import check_choice
from twirl_mjx.commands.console import parse, say
from twirl_mjx.commands.render import stem_of
from twirl_mjx.motion.leap_config import LeapConfig

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


@dataclasses.dataclass(frozen=True)
class ShowOptions:
    """Draw and render a clip; with several, compare them (the first is drawn as ours)."""

    clips: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """Clip files; the shipped leap by default."""
    out: Path = Path("runs/clip")
    """Writes <out>.png, <out>-film.mp4 and .png and, for several clips, <out>-compare.png; with or
    without an ending."""
    source: str = ""
    """Where the other clips come from, written into the comparison."""


def main(argv: list[str], set_up: Callable[[bool], None]) -> int:
    """Run ``make`` or ``show``.

    Args:
        argv: What to do, and its options.
        set_up: Gets whether the robot is drawn, before the simulation is imported.
    """
    verb, rest = (argv[0], argv[1:]) if argv else ("", [])
    if verb in ("-h", "--help", ""):
        say("usage: twirl clip {make,show} [options]; `twirl clip make --help` lists them")
        return 0 if verb else 2
    check_choice("clip action", verb, ("make", "show"))
    return _make(rest, set_up) if verb == "make" else _show(rest, set_up)


def _make(argv: list[str], set_up: Callable[[bool], None]) -> int:
    options = parse(MakeOptions, argv, "twirl clip make")
    files.check_target(options.out)
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
    set_up(True)
    from twirl_mjx.deploy.render import render_episode
    from twirl_mjx.motion import show as show_lib
    from twirl_mjx.motion.clip import configurations
    from twirl_mjx.motion.formats import read_clip
    from twirl_mjx.sim.scene import Bands, build_scene

    clips = [read_clip(path) for path in options.clips or (asset_path("a1", "leap.json"),)]
    stem = stem_of(options.out)
    show_lib.show(clips[0], f"{stem}.png")
    written = [f"{stem}.png"]
    times = np.arange(0.0, 2 * clips[0].cycle_duration, FRAME_DT)
    model = build_scene(bands=Bands((BAND_X,))).mj_model
    film = Path(f"{stem}-film")
    written += map(
        str, render_episode(model, configurations(clips[0], times), film, frame_dt=FRAME_DT)
    )
    if len(clips) > 1:
        show_lib.compare(clips, f"{stem}-compare.png", options.source)
        written.append(f"{stem}-compare.png")
    say(f"wrote {', '.join(written)}")
    return 0
