"""Which worlds: task and options, dynamics, course, how many, and the engine that steps them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from twirl_mjx.checks import check_choice, check_range
from twirl_mjx.sim.leaves import LEAVES, SHIFTS, leaf_values
from twirl_mjx.sim.ranges import Ranges, parse_ranges
from twirl_mjx.sim.robots import DEFAULT_ROBOT, ROBOTS
from twirl_mjx.tasks.registry import TASKS
from twirl_mjx.tasks.task import Task

if TYPE_CHECKING:
    from twirl_mjx.sim.dynamics import Dynamics

REGISTRIES = (TASKS, SHIFTS, ROBOTS)
"""What a config may name that can come from a user's own file."""

_ByLeaf: Any = dataclasses.make_dataclass(
    "_ByLeaf",
    [
        (
            leaf.name,
            Annotated[
                float | None,
                tyro.conf.arg(help=f"{leaf.about} ({leaf.unit}; {leaf.low} to {leaf.high})"),
            ],
            dataclasses.field(default=None),
        )
        for leaf in LEAVES
    ],
    frozen=True,
)


class DynamicsOverrides(_ByLeaf):
    """Physical parameters set by hand, after the shift: one optional value per leaf."""


NO_OVERRIDES = DynamicsOverrides()


@dataclasses.dataclass(frozen=True)
class WorldConfig:
    """Worlds of one task; nothing of it knows that anybody learns there."""

    task: str = "biped"
    """Name of the task, or file.py:Name of your own."""
    options: Any = None
    """Options of the task, of its own kind; the defaults when not given."""
    robot: str = DEFAULT_ROBOT
    """Name of the robot, or file.py:NAME of your own."""
    shift: str = "none"
    """Dynamics shift, by name, or file.py:NAME of your own."""
    shift_strength: float = 1.0
    """0 is nominal, 1 the paper's value."""
    dynamics: DynamicsOverrides = NO_OVERRIDES
    """Physical parameters set by hand, after the shift."""
    randomize: tuple[str, ...] = ()
    """Physical parameters drawn for every world and episode: leaf=low:high, friction=0.4:1.25."""
    course: Literal["auto", "random", "fixed"] = "auto"
    """Goals and hurdles; auto is random without a shift, fixed under one (docs/decisions.md)."""
    num_envs: int = 16
    """Worlds stepped together."""
    episode_length: int = 400
    """Control steps before an episode is truncated (400: 20 s at 20 Hz)."""
    engine: Literal["auto", "mjx", "native"] = "auto"
    """Physics engine; auto is native (C MuJoCo threads) on a CPU and below 1,024 worlds, else
    mjx."""
    uses: tuple[str, ...] = ()
    """file.py:Name of everything named above that is not built in; filled in by itself."""

    def __post_init__(self) -> None:
        """Check names and ranges, load what comes from files, and fill in the options.

        Raises:
            ValueError: With the value, what is allowed and the nearest valid choice.
        """
        for reference in self.uses:
            for registry in REGISTRIES:
                registry.admit_if_fits(reference)
        self._set("task", TASKS.admit(self.task))
        self._set("robot", ROBOTS.admit(self.robot))
        self._set("shift", SHIFTS.admit(self.shift))
        self._set("uses", self._references())
        leaf_values(self.shift, self.shift_strength, self._given)
        self.ranges.check_scene(SHIFTS.get(self.shift).scene)
        self._set("randomize", self.ranges.texts())
        if self.options is None:
            self._set("options", self.task_type.Options())
        self.task_type.check_options(self.options)
        check_range("shift_strength", self.shift_strength, 0.0, 2.0)
        check_range("num_envs", self.num_envs, 1, 1_000_000)
        check_range("episode_length", self.episode_length, 1, 1_000_000)
        check_choice("engine", self.engine, ("auto", "mjx", "native"))
        check_choice("course", self.course, ("auto", "random", "fixed"))

    def _set(self, name: str, value: Any) -> None:
        object.__setattr__(self, name, value)

    def _references(self) -> tuple[str, ...]:
        found = [
            TASKS.reference(self.task),
            ROBOTS.reference(self.robot),
            SHIFTS.reference(self.shift),
        ]
        return tuple(sorted({*self.uses, *(f for f in found if f)}))

    @property
    def task_type(self) -> type[Task]:
        """The class of the task, of a built-in one its card."""
        return TASKS.get(self.task)

    @property
    def ranges(self) -> Ranges:
        """What is drawn for every world and episode."""
        return parse_ranges(self.randomize)

    @property
    def _given(self) -> dict[str, float]:
        return {name: value for name, value in vars(self.dynamics).items() if value is not None}

    def make_dynamics(self, shift: str | None = None, strength: float | None = None) -> Dynamics:
        """Return the physical parameters (scalars), those set by hand last.

        Args:
            shift: Another shift than the config's.
            strength: Another strength than the config's.

        Raises:
            ValueError: An unknown name, or a value that is out of range or without effect.
        """
        from twirl_mjx.sim.dynamics import make_dynamics  # needs jax, which options do not

        return make_dynamics(
            self.shift if shift is None else shift,
            self.shift_strength if strength is None else strength,
            self._given,
        )

    @property
    def fixed_course(self) -> bool:
        """Whether goals and hurdles are fixed."""
        if self.course == "auto":
            return self.shift != "none"
        return self.course == "fixed"

    def make_task(self) -> Task:
        """Return the task, bound to its options.

        Raises:
            ValueError: Options that do not fit one another.
            FileNotFoundError: A file that they name does not exist.
        """
        return self.task_type(
            self.options,
            robot=ROBOTS.get(self.robot),
            fixed_course=self.fixed_course,
            episode_length=self.episode_length,
        )


def world_fields(config: WorldConfig) -> Mapping[str, Any]:
    """Return the fields of a config that say which worlds, whatever else it holds."""
    return {field.name: getattr(config, field.name) for field in dataclasses.fields(WorldConfig)}


def in_task[W: WorldConfig](config: W, task: str, options: Any = None) -> W:
    """Return a config with another task, under that task's options (the defaults if not given)."""
    return dataclasses.replace(config, task=task, options=options)
