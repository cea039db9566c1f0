"""``twirl view``."""

from __future__ import annotations

import dataclasses
import time
import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro

from twirl_mjx import array_files
from twirl_mjx.assets import asset_path
from twirl_mjx.checks import check_choice, check_range
from twirl_mjx.commands.console import parse, say
from twirl_mjx.commands.render import FILM_SECONDS, RenderOptions, config_of, record
from twirl_mjx.commands.selection import the_one
from twirl_mjx.deploy.conditions import CONTROL_HZ, SHIFTS, RehearsalConfig
from twirl_mjx.deploy.reference import BIPED, TASKS
from twirl_mjx.policies.learned import BEST_POLICY, LAST_POLICY, resolve_policy_path

if TYPE_CHECKING:
    import mujoco

    from twirl_mjx.evaluation.record import Recording
    from twirl_mjx.view.stage import Actor
    from twirl_mjx.worlds.config import WorldConfig

CALM = RehearsalConfig(latency_ms=0.0, noise=0.0, full_torque_speed=1e6, no_load_speed=2e6)
"""The ideal loop with noise ready at a slider, and a goal 1 m away."""
MOTIONS = (".json", ".txt", ".npy", ".csv")
"""Endings of clip files."""
MOTION_DT = 0.025
"""s between the frames of a clip's replay."""
LOOK_S = 2.0
"""s between looks for the first policy of a run."""


@dataclasses.dataclass(frozen=True)
class ViewOptions:
    """Watch a policy in a browser and touch it, or write a replay as one HTML file.

    The live page runs the rehearsal's independent simulator and compiles nothing. Of a run that
    still trains it shows the newest policy, and each new one as it comes.
    """

    policy: Annotated[str, tyro.conf.Positional] = ""
    """Run, policy file (.npz, .onnx), file.py:function or scripted name; the shipped
    biped by default. For --html also a policy of a task of your own, a clip, or a trace: an .npz
    with qpos [T, 19]."""
    html: Path | None = None
    """Write a replay to this file, which opens offline, instead of serving a page."""
    task: str | None = None
    """Task to act in; the one the policy was trained for by default."""
    shift: str = "none"
    """Conditions to begin with."""
    seed: int = 0
    """Seed of goals, noise and courses."""
    overwrite: bool = False
    """Replace a page that this command did not write."""
    seconds: float = 20.0
    """Longest replay."""
    host: str = "127.0.0.1"
    """Name or address of this machine to serve at; with 0.0.0.0 others can open the page, too."""
    port: int | None = None
    """Port to serve at, 0 for any free one; 8900, or a free one where that is in use, by
    default."""
    open: bool = True
    """Open the page, where there is a browser with windows."""
    robot: RehearsalConfig = CALM
    """The rehearsed robot and its conditions; without latency and noise, which sliders add."""

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ValueError: A value is out of range.
        """
        check_range("seconds", self.seconds, *FILM_SECONDS)
        check_range("seed", self.seed, 0, 2**32 - 1)
        if self.port is not None:
            check_range("port", self.port, 0, 65535)


def main(argv: list[str]) -> int:
    """Serve a page until interrupted, or write a replay."""
    options = parse(ViewOptions, argv, "twirl view")
    options = dataclasses.replace(options, policy=the_one(options.policy))
    if options.html is not None:
        from twirl_mjx.view.page import check_page

        check_page(options.html, overwrite=options.overwrite)
        say(f"wrote {_write(options, options.html)}: open it in any browser")
        return 0
    check_choice("shift", options.shift, tuple(SHIFTS))
    return _serve(options)


# ---- live


def _serve(options: ViewOptions) -> int:
    from twirl_mjx.view.server import serving
    from twirl_mjx.view.stage import Stage

    stage = Stage(
        _cast(options), config=options.robot, shift=options.shift, seed=options.seed, note=say
    )
    title = f"twirl view {Path(options.policy).name}".rstrip()
    with serving(stage, title, host=options.host, port=options.port) as address:
        say(f"{address} shows it; Ctrl-C ends it")
        if options.open and _has_windows():
            webbrowser.open(address)
        try:
            while True:
                time.sleep(3600)
        except KeyboardInterrupt:
            say("ended")
    return 0


def _has_windows() -> bool:
    """Return whether a browser with windows is found; one of text would take the terminal."""
    try:
        return type(webbrowser.get()) is not webbrowser.GenericBrowser
    except webbrowser.Error:
        return False


def _cast(options: ViewOptions) -> dict[str, Actor]:
    """Return who can be chosen on the page: what was named, then the shipped policies."""
    from twirl_mjx.view.stage import Actor

    folder = asset_path("policies")
    shipped = {path.stem: Actor(path) for path in sorted(folder.glob("*.npz"))}
    if not options.policy:
        first = {BIPED: shipped.pop(BIPED)._replace(task=options.task)}
        return first | shipped
    first = _named(options)
    others = {k: v for k, v in shipped.items() if v.policy != Path(options.policy)}
    return first | {name: actor for name, actor in others.items() if name not in first}


def _named(options: ViewOptions) -> dict[str, Actor]:
    from twirl_mjx.view.stage import Actor

    name, path, task = options.policy, Path(options.policy), options.task
    if not path.is_dir():
        return {path.stem: Actor(path if path.is_file() else name, task)}
    _wait_for_policy(path)
    found = {"newest": path / LAST_POLICY, "best": path / BEST_POLICY}
    return {
        f"{path.resolve().name}, {which}": Actor(file, task)
        for which, file in found.items()
        if file.is_file()
    }


def _wait_for_policy(run: Path) -> None:
    """Wait until a run that has begun has a policy; other folders are refused as ever."""
    files = (run / LAST_POLICY, run / BEST_POLICY)
    if (run / "config.json").is_file() and not any(file.is_file() for file in files):
        say(f"{run} has no policy yet; waiting for the first evaluation of its training")
        while not any(file.is_file() for file in files):
            time.sleep(LOOK_S)
    if not any(file.is_file() for file in files):
        resolve_policy_path(run)


# ---- replays


def _write(options: ViewOptions, path: Path) -> Path:
    name = options.policy or str(asset_path("policies", "biped.npz"))
    options = dataclasses.replace(options, policy=name)
    if Path(name).suffix in MOTIONS:
        return _write_clip(options, path)
    if _is_trace(Path(name)):
        return _write_trace(options, path)
    from twirl_mjx.policies.resolve import header_of, robot_of_card
    from twirl_mjx.sim.robots import A1

    header = header_of(name)
    task = options.task or (header.task if header else None)
    robot = robot_of_card(header) if header else A1.name
    if task in TASKS and options.shift in SHIFTS and robot == A1.name:
        return _write_rehearsal(options, path)
    what = f"task {task} under {options.shift}" if robot == A1.name else f"robot {robot}"
    say(f"{name}: {what} is not rehearsed, so its worlds are compiled")
    return _write_recording(options, path)


def _write_rehearsal(options: ViewOptions, path: Path) -> Path:
    from twirl_mjx.deploy.pilots import find_pilot
    from twirl_mjx.deploy.trial import Trial
    from twirl_mjx.policies.resolve import PLAIN
    from twirl_mjx.view.page import write_replay
    from twirl_mjx.view.stage import GOAL_TASKS, readouts

    config = dataclasses.replace(options.robot, **SHIFTS[options.shift])  # pyright: ignore
    pilot, task = find_pilot(options.policy, options.task, None, PLAIN, say)
    trial = Trial(pilot, task, config, np.random.default_rng([options.seed, 0]))
    qpos, goals, values = [], [], []
    for _ in range(round(options.seconds * CONTROL_HZ)):
        trial.step()
        if trial.cause == "diverged":
            break
        qpos.append(trial.data.qpos.copy())
        goals.append(trial.goal)
        values.append(readouts(trial))
        if trial.cause is not None:
            break
    ends = {
        None: "",
        "fall": "; it fell",
        "hurdle": "; it touched a hurdle",
        "lost": "; it lost the clip",
    }
    return write_replay(
        path,
        trial.model,
        np.array(qpos),
        title=f"{task}: {Path(options.policy).name}",
        note="rehearsed in C MuJoCo at 1 ms" + ends.get(trial.cause, "; it diverged"),
        frame_dt=1.0 / CONTROL_HZ,
        overwrite=options.overwrite,
        goals=np.array(goals) if task in GOAL_TASKS else None,
        values={name: [row[name] for row in values] for name in values[0]},
    )


def _write_recording(options: ViewOptions, path: Path) -> Path:
    config = config_of(options.policy, options.task)
    config = dataclasses.replace(config, shift=options.shift)
    wanted = RenderOptions(options.policy, seed=options.seed, seconds=options.seconds)
    title = f"{config.task}: {Path(options.policy).name}"
    recording = record(config, wanted)
    return write_recording(path, config, recording, title=title, overwrite=options.overwrite)


def write_recording(
    path: Path, config: WorldConfig, recording: Recording, *, title: str, overwrite: bool = False
) -> Path:
    """Write a recorded episode as a replay."""
    from twirl_mjx.evaluation.record import scene_model
    from twirl_mjx.view.page import write_replay

    shown = {name: recording.metrics[name].tolist() for name in config.task_type.caption}
    return write_replay(
        path,
        scene_model(config, recording),
        recording.qpos,
        title=title,
        note=f"{len(recording.reward)} control steps of the training simulation",
        frame_dt=recording.robot.control_dt,
        overwrite=overwrite,
        goals=recording.goals if config.task_type.shows_goal else None,
        values={"return": np.cumsum(recording.reward).tolist()} | shown,
    )


def _write_clip(options: ViewOptions, path: Path) -> Path:
    from twirl_mjx.motion.clip import configurations
    from twirl_mjx.motion.formats import read_clip
    from twirl_mjx.view.page import write_replay

    clip = read_clip(options.policy)
    times = np.arange(0.0, min(options.seconds, 4 * clip.cycle_duration), MOTION_DT)
    qpos = configurations(clip, times)
    return write_replay(
        path,
        _plain_model(),
        qpos,
        title=f"clip {Path(options.policy).name}",
        frame_dt=MOTION_DT,
        overwrite=options.overwrite,
        values={"root height (m)": qpos[:, 2].tolist()},
    )


def _is_trace(path: Path) -> bool:
    if path.suffix != ".npz" or not path.is_file():
        return False
    return "qpos" in array_files.names_in_npz(path, "a policy or a trace")


def _write_trace(options: ViewOptions, path: Path) -> Path:
    """Write a trace: ``qpos`` [T, 19], and if it likes ``goals`` [T, 2] and ``frame_dt`` (s)."""
    from twirl_mjx.view.page import write_replay

    trace = Path(options.policy)
    arrays = array_files.read_npz(trace, "a trace")
    frame_dt = float(arrays.get("frame_dt", np.array(1.0 / CONTROL_HZ)))
    check_range(f"frame_dt of {trace}", frame_dt, 1e-4, 10.0)
    qpos = arrays["qpos"]
    return write_replay(
        path,
        _plain_model(),
        qpos,
        title=f"trace {trace.name}",
        frame_dt=frame_dt,
        overwrite=options.overwrite,
        goals=arrays.get("goals"),
        values={"root height (m)": qpos[:, 2].tolist()} if qpos.ndim == 2 else {},
    )


def _plain_model() -> mujoco.MjModel:
    from twirl_mjx.deploy.ground import build_model

    return build_model(RehearsalConfig(), np.zeros(0))
