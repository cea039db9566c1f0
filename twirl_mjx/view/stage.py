"""The loop behind a live page: a rehearsed robot that people may touch while it moves.

A :class:`Stage` owns one :class:`~twirl_mjx.deploy.trial.Trial` after another. It knows no page:
:meth:`Stage.do` takes what people ask for, :meth:`Stage.tick` advances by one control step and
returns what is to be seen. :func:`play` calls it in time.
"""

from __future__ import annotations

import dataclasses
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from twirl_mjx.checks import check_choice, check_range
from twirl_mjx.deploy.conditions import CONTROL_HZ, LIVE, RANGES, SHIFTS, RehearsalConfig
from twirl_mjx.deploy.ground import ground_height
from twirl_mjx.deploy.pilots import find_pilot
from twirl_mjx.deploy.reference import BIPED, HURDLES, IMITATE, STAND, TASKS
from twirl_mjx.deploy.trial import BANDS, Trial
from twirl_mjx.policies.learned import resolve_policy_path
from twirl_mjx.policies.resolve import PLAIN, header_of
from twirl_mjx.sim.engine import silence
from twirl_mjx.view.picture import Picture

DT = 1.0 / CONTROL_HZ
GOAL_TASKS = (BIPED, HURDLES)
"""Tasks that show a goal."""
PUSH_S = 0.2
"""s, how long a push lasts."""
MAX_FORCE = 500.0
"""N, largest force of a push or pull."""
MAX_GOAL = 30.0
"""m, farthest goal in x and y."""
REST_S = 1.5
"""s, an episode that has ended is looked at before the next begins."""
LOOK_S = 1.0
"""s between looks at the policy's file."""
SPEEDS = (0.05, 4.0)
"""Slowest and fastest speed, as a share of real time."""


class Slider(NamedTuple):
    """A condition that a page offers; its field of ``RehearsalConfig``."""

    name: str
    label: str
    low: float
    high: float
    step: float
    unit: str = ""
    tasks: tuple[str, ...] = TASKS


SLIDERS = (
    Slider("friction", "friction", 0.05, 1.5, 0.05),
    Slider("gravity", "gravity", 1.0, 20.0, 0.01, "m/s²"),
    Slider("payload", "payload", 0.0, 8.0, 0.25, "kg"),
    Slider("latency_ms", "latency", 0.0, 100.0, 5.0, "ms"),
    Slider("noise", "noise", 0.0, 10.0, 0.5, "x"),
    Slider("torque_limit", "motor torque", 5.0, 40.0, 0.5, "N m"),
    Slider("incline_deg", "hill", 0.0, 20.0, 1.0, "°", (STAND, BIPED, HURDLES)),
    Slider("bump_height", "bumps", 0.0, 0.1, 0.005, "m", (STAND, BIPED)),
    Slider("hurdle_gap", "hurdle gap", 1.0, 4.0, 0.1, "m", (HURDLES,)),
    Slider("hurdle_height", "hurdle height", 0.005, 0.1, 0.005, "m", (HURDLES,)),
)


class Actor(NamedTuple):
    """Somebody who can be on the stage."""

    policy: Any
    """A path, looked at again and again, the name of any source, or an object with ``act``."""
    task: str | None = None
    """Task to act in; the one the policy was trained for by default."""


class Stage:
    """A robot on a stage; every method may be called from any thread."""

    def __init__(
        self,
        actors: Mapping[str, Actor],
        *,
        config: RehearsalConfig | None = None,
        shift: str = "none",
        seed: int = 0,
        note: Callable[[str], None] = lambda text: None,
    ) -> None:
        """Begin the first episode.

        Args:
            actors: who can be chosen, by name; the first begins.
            config: conditions; those like the real robot's by default. Its length of an episode
                does not count: one ends when the robot fails, or has passed every hurdle.
            shift: one of ``conditions.SHIFTS``.
            seed: of the first episode; the next has the next one.
            note: gets what is worth a line of the log.

        Raises:
            ValueError: The first policy has no task that can be rehearsed, or sees another
                observation than its task shows.
        """
        silence()
        self._lock = threading.RLock()
        self._actors, self._note = dict(actors), note
        self._base = dataclasses.replace(config or RehearsalConfig(), episode_s=1e9)
        self._shift, self._seed, self._goal = shift, seed, None
        self._pause, self._speed = False, 1.0
        self._message, self._unread = "", ""
        self._force, self._force_until = np.zeros(3), 0.0
        self._scene, self._rest = 0, 0.0
        self.choose(next(iter(self._actors)))

    # ---- what people do

    def do(self, name: str, value: Any = None) -> None:
        """Do one thing that a person asks for.

        ``pause`` (bool), ``speed`` (share of real time), ``restart``, ``policy`` (a name),
        ``shift`` (a name), ``goal`` ([x, y] m), ``push`` ([x, y, z] N for 0.2 s), ``pull`` (the
        same until the next one), or the name of a slider with its value.

        Raises:
            ValueError: Nothing of that name, or a value that it cannot have; nothing changed.
        """
        sliders = tuple(slider.name for slider in SLIDERS)
        actions: dict[str, Callable[[Any], None]] = {
            "pause": self._set_pause,
            "speed": self._set_speed,
            "restart": lambda _: self._begin(),
            "policy": self.choose,
            "shift": self._set_shift,
            "goal": self._aim,
            "push": lambda force: self._pull(force, PUSH_S),
            "pull": lambda force: self._pull(force, np.inf),
        } | {name: lambda value, name=name: self._set(name, value) for name in sliders}
        check_choice("control", str(name), tuple(actions))
        with self._lock:
            actions[name](value)

    def choose(self, name: str) -> None:
        """Begin an episode of another policy.

        Raises:
            ValueError: No such policy, or one that cannot be rehearsed; the old one goes on.
        """
        check_choice("policy", str(name), tuple(self._actors))
        actor = self._actors[name]
        stamp = _stamp_of(actor.policy)
        pilot, task = find_pilot(actor.policy, actor.task, None, PLAIN, self._note)
        age = _age(actor.policy)
        with self._lock:
            shift = self._shift if self._shift in shifts_of(task) else "none"
            config = dataclasses.replace(self._base, **SHIFTS[shift])  # pyright: ignore
            trial = Trial(pilot, task, config, np.random.default_rng(self._seed))
            trial.decide()  # refuses an observation that it does not know
            self._shift, self._config = shift, config
            self._name, self._pilot, self._age, self._stamp = name, pilot, age, stamp
            self._looked = time.monotonic()
            self._begin(task)

    def _begin(self, task: str | None = None) -> None:
        """Begin the next episode, under the conditions that hold."""
        task = task or self._trial.task
        self._trial = Trial(self._pilot, task, self._config, np.random.default_rng(self._seed))
        self._seed += 1
        if self._goal is not None:
            self._trial.aim(self._goal)
        self._picture = Picture(self._trial.model)
        self._scene, self._rest, self._message = self._scene + 1, 0.0, ""
        self._force, self._force_until = np.zeros(3), 0.0

    def _set_pause(self, value: Any) -> None:
        if not isinstance(value, bool):
            raise ValueError(f"pause = {value!r} is neither true nor false (nearest: true)")
        self._pause = value

    def _set_speed(self, value: Any) -> None:
        self._speed = _number("speed", value, *SPEEDS)

    def _set_shift(self, shift: Any) -> None:
        check_choice("shift", str(shift), shifts_of(self._trial.task))
        self._shift = shift
        self._config = dataclasses.replace(self._base, **SHIFTS[shift])  # pyright: ignore
        self._begin()

    def _aim(self, goal: Any) -> None:
        if self._trial.task not in (STAND, BIPED):
            raise ValueError(f"the goal of task {self._trial.task} stays where it is")
        self._goal = np.array(_numbers("goal", goal, 2, MAX_GOAL))
        self._trial.aim(self._goal)

    def _pull(self, force: Any, seconds: float) -> None:
        self._force = np.array(_numbers("force", force, 3, MAX_FORCE))
        self._force_until = self._trial.data.time + seconds

    def _set(self, name: str, value: Any) -> None:
        slider = next(slider for slider in SLIDERS if slider.name == name)
        if self._trial.task not in slider.tasks:
            raise ValueError(f"{name} does nothing in task {self._trial.task}")
        changes = {name: _number(name, value, *RANGES[name])}
        if name in ("bump_height", "incline_deg") and value:  # one of them at a time
            changes |= {"bump_height": 0.0, "incline_deg": 0.0} | changes
        self._config = dataclasses.replace(self._config, **changes)  # pyright: ignore
        if name in LIVE:
            self._trial.change(self._config)
        else:
            self._begin()

    # ---- what is seen

    def scene(self) -> dict[str, Any]:
        """Return what is drawn and what can be chosen, JSON-ready; see ``Picture.scene``."""
        with self._lock:
            return self._picture.scene | {
                "number": self._scene,
                "controls": [slider._asdict() for slider in SLIDERS],
                "policies": list(self._actors),
                "shifts": list(shifts_of(self._trial.task)),
            }

    def tick(self) -> dict[str, Any]:
        """Advance by one control step, unless paused, and return a frame; see :meth:`frame`."""
        with self._lock:
            self._reload()
            if not self._pause:
                self._advance()
            return self.frame()

    def _advance(self) -> None:
        trial = self._trial
        if trial.cause is not None or trial.score.passed >= BANDS:
            self._rest += DT
            if self._rest >= REST_S:
                self._begin()
            return
        if trial.data.time >= self._force_until:
            self._force = np.zeros(3)
        trial.push(self._force)
        trial.step()
        if trial.cause == "diverged":  # nothing of it can be shown
            self._begin()
            self._message = "the simulation diverged; a new episode has begun"

    def _reload(self) -> None:
        """Begin anew with what the policy's file holds now, when it has changed."""
        now, policy = time.monotonic(), self._actors[self._name].policy
        if now - self._looked < LOOK_S:
            return
        self._looked, stamp = now, _stamp_of(policy)
        if stamp in (self._stamp, None):
            return
        try:
            self.choose(self._name)
        except (OSError, ValueError) as error:  # the old one goes on
            self._unread, self._stamp = str(error), stamp
            self._note(self._unread)
        else:
            self._unread = ""
            self._note(f"{self._name} has changed{self._age}")

    def frame(self) -> dict[str, Any]:
        """Return the state as JSON-ready data.

        ``poses`` [7 B] of the bodies of :meth:`scene`, ``goal`` [3] m or None, ``force`` [3] N,
        ``values`` (name with unit -> number), ``conditions`` (slider -> value) and what is chosen.
        """
        with self._lock:
            trial, qpos = self._trial, self._trial.data.qpos
            place = trial.goal
            height = float(ground_height(self._config, place[None])[0])
            sliders = [s for s in SLIDERS if self._trial.task in s.tasks]
            conditions = {s.name: getattr(self._config, s.name) for s in sliders}
            gap = conditions.get("hurdle_gap", 0.0)
            return {
                "scene": self._scene,
                "time": round(trial.steps * DT, 3),
                "dt": DT,
                "speed": self._speed,
                "paused": self._pause,
                "poses": self._picture.poses(qpos).round(4).tolist(),
                "goal": [*place.tolist(), height] if self._trial.task in GOAL_TASKS else None,
                "goalMoves": self._trial.task == BIPED,
                "force": self._force.tolist(),
                "values": readouts(trial),
                "status": self._status(),
                "policy": self._name,
                "shift": self._shift,
                "conditions": conditions | ({"hurdle_gap": 2.1} if gap is None else {}),
            }

    def _status(self) -> str:
        cause = self._trial.cause
        ends = {"fall": "it fell", "hurdle": "it touched a hurdle", "lost": "it lost the clip"}
        what = f"{self._trial.task}, {self._name}{self._age}"
        state = f"{ends[cause]}; the next episode begins" if cause else ""
        return "\n".join(filter(None, [what, state, self._message, self._unread]))


def readouts(trial: Trial) -> dict[str, float]:
    """Return what is read beside a picture of a trial: name with unit -> number, the main first."""
    score, qpos = trial.score, trial.data.qpos
    values: dict[str, float] = {}
    if trial.task == HURDLES:
        values["hurdles passed"] = score.passed
    if trial.task == BIPED:
        values["distance to goal (m)"] = score.previous_distance
        values["closest so far (m)"] = score.min_distance
    if trial.task in (STAND, BIPED):
        values["on hind legs (s)"] = score.standing_steps * DT
    values |= {
        "speed (m/s)": float(np.linalg.norm(trial.data.qvel[:2])),
        "height (m)": float(qpos[2] - ground_height(trial.config, qpos[None, :2])[0]),
        "return": score.reward_sum,
        "peak torque (N m)": float(trial.drive.peak.max()),
    }
    return {name: round(float(value), 4) for name, value in values.items()}


def _age(policy: Any) -> str:
    """Return how long a policy was trained, as the end of its name."""
    header = header_of(str(policy)) if isinstance(policy, str | Path) else None
    steps = header.card.get("env_steps") if header else None
    return f" ({steps:,} transitions)" if isinstance(steps, int) else ""


def shifts_of(task: str) -> tuple[str, ...]:
    """Names of the shifts that a task can be rehearsed under."""
    other = {HURDLES: ("bumpy",), IMITATE: ("bumpy", "sloped")}.get(task, ())
    return tuple(name for name in SHIFTS if name not in other)


def _stamp_of(policy: Any) -> Any:
    """Return what changes when a policy's file is replaced; None where there is none."""
    if not isinstance(policy, Path):
        return None
    try:
        status = resolve_policy_path(policy).stat()
    except OSError:
        return None
    return status.st_ino, status.st_mtime_ns, status.st_size


def _number(name: str, value: Any, low: float, high: float) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{name} = {value!r} is not a number in [{low}, {high}] (nearest: {low})")
    check_range(name, value, low, high)
    return float(value)


def _numbers(name: str, values: Any, count: int, limit: float) -> list[float]:
    if not isinstance(values, list | tuple) or len(values) != count:
        raise ValueError(f"{name} = {values!r} is not a list of {count} numbers")
    return [_number(f"{name}[{i}]", v, -limit, limit) for i, v in enumerate(values)]


def play(stage: Stage, show: Callable[[dict[str, Any]], None], stop: threading.Event) -> None:
    """Tick a stage in time until told to stop, and show every frame.

    A machine that is too slow shows slow motion, and what was missed is not caught up.
    """
    due = time.monotonic()
    while not stop.is_set():
        frame = stage.tick()
        show(frame)
        due = max(due + DT / frame["speed"], time.monotonic() - DT)
        stop.wait(max(0.0, due - time.monotonic()))
