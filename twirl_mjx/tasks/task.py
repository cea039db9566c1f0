"""A task: one Markov decision process over the robot, with everything that is known of it.

A task is one class in one file. It holds the MDP (``start``, ``judge``, an observer), its options,
what is measured of an episode and when it is a success, its default source, and what presets,
courses and films need. Everything that lists tasks, or anything of a task, asks ``registry``.

This module and those of the built-in tasks import neither jax nor MuJoCo before a world is built,
so that options are parsed without them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple

from twirl_mjx.sim.robots import DEFAULT_ROBOT, ROBOTS

if TYPE_CHECKING:
    import jax
    import numpy as np

    from twirl_mjx.sim.dynamics import Dynamics
    from twirl_mjx.sim.robot import Robot
    from twirl_mjx.sim.scene import CollisionSet, Scene
    from twirl_mjx.tasks.base import Outcome, Start, View, World
    from twirl_mjx.tasks.observations import Observer

How = Literal["sum", "time", "mean", "min", "max"]


class Measure(NamedTuple):
    """A number per episode, folded from one per-step signal."""

    signal: str
    """``reward``, ``step`` (1 each step), ``terminated``, or a metric of the task."""
    how: How
    """Fold over the steps of the episode; ``time`` is the sum times the control step, in s."""
    scale: float = 1.0
    """Factor on the folded value."""
    unit: str = "1"
    """``s``, ``m``, ``share``, ``1`` ..."""
    about: str = ""
    """What is measured, in a few words."""
    smaller_is_better: bool = False
    """Direction of improvement."""


class Link(NamedTuple):
    """One run of a chain that ends in a task: what it is called, and its settings."""

    name: str
    settings: Mapping[str, Any]
    """Field of the run's config -> value, ``task`` among them; the rest is the preset's."""


POLISH = {
    "variant": "twirl+weights",
    "droq.target_entropy": -12.0,
    "droq.learning_rate": 1e-4,
}
"""Settings of a link for a skill that is there: less exploration noise and smaller steps."""


@dataclasses.dataclass(frozen=True)
class NoOptions:
    """Options of a task that has none."""


class Task[O]:
    """Base of all tasks; methods are pure, for one world, and vmappable by jax."""

    name: ClassVar[str]
    """Lower case; also the prefix of its options on the command line."""
    Options: ClassVar[type] = NoOptions
    """A frozen dataclass whose fields all have defaults, with a docstring under each."""
    collision: ClassVar[CollisionSet] = "legs"
    """Robot shapes the contact solver sees."""
    measures: ClassVar[Mapping[str, Measure]] = {}
    """What is measured of an episode beside return, length and kind of end."""
    lead: ClassVar[tuple[str, ...]] = ("return",)
    """Measures that the task is judged by in figures and tables, the main one first."""
    ratios: ClassVar[Mapping[str, tuple[str, str]]] = {}
    """Measures that figures and tables compute: the first over the second, where not zero."""
    source: ClassVar[str | None] = None
    """Name of the task whose trained policy is the default source."""
    aim: ClassVar[str] = ""
    """Measure by which candidates for a curriculum compete; the first of ``lead`` by default."""
    chain: ClassVar[tuple[Link, ...]] = ()
    """Runs that lead to a skill one after another; the sources, then the task, where empty."""
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {}
    """Preset -> field of a run's config -> value; those of ``paper`` hold in all presets."""
    course_options: ClassVar[tuple[str, ...]] = ()
    """Options that only place robot, goals or hurdles; all others decide rewards or endings."""
    training_options: ClassVar[tuple[str, ...]] = ()
    """Options for training only: evaluation, collection and films use their defaults."""
    caption: ClassVar[tuple[str, ...]] = ()
    """Metrics written into films."""
    shows_goal: ClassVar[bool] = False
    """Whether films show the goal."""
    band_height: float = 0.0
    """m, of the bands that films show, see ``bands``."""
    observer: Observer
    """What the policy sees."""

    def __init__(
        self,
        options: O | None = None,
        *,
        robot: Robot | None = None,
        fixed_course: bool = False,
        episode_length: int = 400,
    ) -> None:
        """Keep the options.

        Args:
            options: Of the task's own ``Options``; its defaults when not given.
            robot: Whose observations it shows, the A1's when not given; its scene holds the same.
            fixed_course: Whether goals and hurdles stand at fixed places (dynamics shifts).
            episode_length: Control steps of the longest episode.

        Raises:
            ValueError: Options of another kind.
        """
        options = self.Options() if options is None else options
        self.check_options(options)
        self.options: O = options  # type: ignore[assignment]
        self.robot = ROBOTS.get(DEFAULT_ROBOT) if robot is None else robot
        self.fixed_course = fixed_course
        self.episode_length = episode_length
        self.observer = self.make_observer()

    def make_observer(self) -> Observer:
        """Return what the policy sees: goal and a 3-step history, unless a task says otherwise."""
        from twirl_mjx.tasks.observations import ProprioceptiveObserver

        return ProprioceptiveObserver(self.robot, axes=False)

    def start(self, key: jax.Array, scene: Scene, dynamics: Dynamics) -> Start:
        """Draw the first state of an episode."""
        raise TypeError(f"task {self.name} has no method start(key, scene, dynamics)")

    def judge(self, world: World, view: View, scene: Scene) -> Outcome:
        """Score a control step; ``world`` already holds the new memory and action."""
        raise TypeError(f"task {self.name} has no method judge(world, view, scene)")

    def success(self, measures: Mapping[str, jax.Array]) -> jax.Array:
        """Return which episodes succeeded (bool), given their measures (arrays of one shape).

        Without a criterion of its own a task succeeds when it is not ended before time.
        """
        return measures["terminated"] == 0.0

    def bands(self, state: Any) -> np.ndarray:
        """Return the world x [H] in m of hurdle bands to draw, given one world's task state."""
        import numpy as np  # needed by films, not by options

        del state
        return np.zeros(0)

    @classmethod
    def check_options(cls, options: Any) -> None:
        """Refuse options of another kind.

        Raises:
            ValueError: They are not of ``Options``.
        """
        if type(options) is not cls.Options:
            raise ValueError(
                f"task {cls.name} takes options of {cls.Options.__name__}, not"
                f" {type(options).__name__}"
            )

    @classmethod
    def paper_options(cls) -> O:
        """Return the options of the paper's preset, as evaluation uses them."""
        prefix = f"{cls.name}."
        settings = cls.presets.get("paper", {})
        own = {k.removeprefix(prefix): v for k, v in settings.items() if k.startswith(prefix)}
        return cls.evaluation_options(cls.Options(**own))

    @classmethod
    def evaluation_options(cls, options: O) -> O:
        """Return the options with those for training only at their defaults."""
        plain = cls.Options()
        reset = {name: getattr(plain, name) for name in cls.training_options}
        return dataclasses.replace(options, **reset)  # type: ignore[type-var]
