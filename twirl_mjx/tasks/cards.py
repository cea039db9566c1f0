"""What is known of the built-in tasks before anything is simulated: one card for each.

A card holds options, measures, presets and the like of a task. Its MDP is in the file of that name
and derives from the card (``Task.mdp``). Nothing here needs jax or MuJoCo, so that options are
parsed without them.
"""

from __future__ import annotations

import dataclasses
from typing import ClassVar, Literal

from twirl_mjx.checks import check_choice, check_range
from twirl_mjx.motion.conversion import ClipOptions
from twirl_mjx.tasks.task import Link, Measure, Task


@dataclasses.dataclass(frozen=True)
class GoalOptions:
    """Where the goal of an episode is."""

    goal_mean_radius: float = 1.5
    """m, mean of the exponential distribution of the goal's distance."""
    goal_min_radius: float = 0.3
    """m, the drawn distance is clipped from below."""
    goal_max_radius: float = 5.0
    """m, the drawn distance is clipped from above."""
    fixed_goal: tuple[float, float] = (1.5, 0.0)
    """m, the goal when the course is fixed (dynamics shifts); on the hill in ``sloped``."""
    goal_distance: float | None = None
    """m, distance of every goal instead of a drawn one; straight ahead on a fixed course."""

    PREFIX: ClassVar[str] = ""

    def __post_init__(self) -> None:
        """Check every option, or raise ValueError."""
        check_range(f"{self.PREFIX}goal_mean_radius", self.goal_mean_radius, 0.0, 100.0)
        check_range(f"{self.PREFIX}goal_max_radius", self.goal_max_radius, 0.0, 100.0)
        high = self.goal_max_radius
        check_range(f"{self.PREFIX}goal_min_radius", self.goal_min_radius, 0.0, high)
        for coordinate in self.fixed_goal:
            check_range(f"{self.PREFIX}fixed_goal", coordinate, -100.0, 100.0)
        if self.goal_distance is not None:
            check_range(f"{self.PREFIX}goal_distance", self.goal_distance, 0.01, 100.0)


GOAL_OPTIONS = tuple(field.name for field in dataclasses.fields(GoalOptions))
"""Options that only place the goal."""

STANDING_MEASURES = {
    "standing_time": Measure(
        "standing", "time", 1.0, "s", "time with c >= 0.7 and both front feet lifted"
    ),
    "on_feet": Measure("on_feet", "time", 1.0, "s", "standing time with no calf on the ground"),
    "cosine": Measure("cosine", "mean", 1.0, "1", "mean vertical part of the base x-axis"),
}
"""What is measured of a robot that should be on its hind legs."""


@dataclasses.dataclass(frozen=True)
class StandOptions(GoalOptions):
    """Task ``stand``: get up on the hind legs."""

    height_of: Literal["root", "front_feet"] = "root"
    """Which height r_height rewards: the root's or the front feet's mean (docs/decisions.md)."""
    risen_fraction: float = 0.0
    """Share of episodes started part-way up on the hind legs, at pitch U(0, 83 deg)."""

    PREFIX = "stand."

    def __post_init__(self) -> None:
        """Check the options.

        Raises:
            ValueError: A value is out of range.
        """
        super().__post_init__()
        check_choice("stand.height_of", self.height_of, ("root", "front_feet"))
        check_range("stand.risen_fraction", self.risen_fraction, 0.0, 1.0)


class StandCard(Task[StandOptions]):
    """Get up on the hind legs and stay there; see ``stand``."""

    name = "stand"
    Options = StandOptions
    collision = "feet"
    measures = STANDING_MEASURES
    lead = ("return", "standing_time", "on_feet")
    presets = {
        "paper": {"stand.height_of": "front_feet"},
        "cpu": {"stand.risen_fraction": 0.9, "episode_length": 100},
    }
    course_options = (*GOAL_OPTIONS, "risen_fraction")
    training_options = ("risen_fraction",)
    caption = ("cosine",)
    mdp = "twirl_mjx.tasks.stand:Stand"


@dataclasses.dataclass(frozen=True)
class BipedOptions(GoalOptions):
    """Task ``biped``: walk to a goal on the hind legs."""

    distance_reward: Literal["nearer", "speed"] = "nearer"
    """Pay 0.5 for being nearer than a step before (the paper's), or by the speed of approach."""
    distance_weight: float = 1.0
    """Factor on the distance term; above 1 in an easier task whose policy is a source."""

    PREFIX = "biped."

    def __post_init__(self) -> None:
        """Check every option, or raise ValueError."""
        super().__post_init__()
        check_choice("biped.distance_reward", self.distance_reward, ("nearer", "speed"))
        check_range("biped.distance_weight", self.distance_weight, 0.0, 100.0)


POLISH = {
    "variant": "twirl+weights",
    "droq.target_entropy": -12.0,
    "droq.learning_rate": 1e-4,
}
"""Less exploration noise and smaller steps, for a skill that is there already."""

WALK = {
    "variant": "twirl+weights",
    "biped.distance_reward": "speed",
    "biped.distance_weight": 4.0,
    "episode_length": 200,
    "droq.target_entropy": -12.0,
}
"""An easier reward: the distance term is graded and four times as large, because leaning towards
the goal earns little in the paper's reward as long as it costs balance."""


class BipedCard(Task[BipedOptions]):
    """Walk to a goal on the hind legs; see ``biped``."""

    name = "biped"
    Options = BipedOptions
    source = "stand"
    measures = {
        "standing_time": STANDING_MEASURES["standing_time"],
        "on_feet": STANDING_MEASURES["on_feet"],
        "min_distance": Measure(
            "goal_distance", "min", 1.0, "m", "closest approach to the goal", smaller_is_better=True
        ),
        "cosine": STANDING_MEASURES["cosine"],
    }
    lead = ("return", "standing_time", "on_feet", "success")
    chain = (
        Link("stand", {"task": "stand"}),
        Link("walk", {"task": "biped"} | WALK),
        Link("biped", {"task": "biped"} | POLISH),
    )
    presets = {"cpu": {"total_env_steps": 800_000}}
    course_options = GOAL_OPTIONS
    caption = ("cosine", "goal_distance")
    shows_goal = True
    mdp = "twirl_mjx.tasks.biped:Biped"


@dataclasses.dataclass(frozen=True)
class ImitateOptions(ClipOptions):
    """Task ``imitate``: track a leap clip."""

    clip: str = "leap"
    """``leap`` (ours) or the path of a clip file (.json, .txt, .npy, .csv)."""
    standing_fraction: float = 0.0
    """Share of episodes started at rest on four feet, as the episodes of ``hurdles`` are."""
    max_root_error: float = 1.0
    """m, an episode ends beyond this distance from the reference root."""
    max_root_angle: float = 1.5707963
    """rad, an episode ends beyond this rotation from the reference root."""

    def __post_init__(self) -> None:
        """Check every number, or raise ValueError."""
        super().__post_init__()
        check_range("imitate.standing_fraction", self.standing_fraction, 0.0, 1.0)
        check_range("imitate.max_root_error", self.max_root_error, 1e-3, 1e3)
        check_range("imitate.max_root_angle", self.max_root_angle, 1e-3, 3.1416)


class ImitateCard(Task[ImitateOptions]):
    """Track a leap clip; see ``imitate``."""

    name = "imitate"
    Options = ImitateOptions
    collision = "feet"
    measures = {
        "tracking": Measure("tracking", "mean", 1.0, "1", "mean reward over its maximum"),
        "leaps": Measure("leaps", "max", 1.0, "1", "cycles of the clip survived"),
        "flights": Measure("flights", "max", 1.0, "1", "cycles with a flight of 4 steps or more"),
    }
    presets = {
        "paper": {"imitate.standing_fraction": 0.2},
        # Random actions hardly ever track the clip: it starts from planned ones.
        "cpu": {"variant": "twirl", "source": "clip", "total_env_steps": 1_600_000,
                "droq.discount": 0.95},
    }  # fmt: skip
    course_options = ("standing_fraction",)
    training_options = ("standing_fraction",)
    caption = ("tracking",)
    mdp = "twirl_mjx.tasks.imitate:Imitate"


@dataclasses.dataclass(frozen=True)
class HurdlesOptions:
    """Task ``hurdles``: jump over randomly spaced hurdles."""

    min_gap: float = 1.6
    """m, smallest distance between neighbouring hurdles, and to the first."""
    max_gap: float = 2.6
    """m, largest distance."""
    fixed_gap: float = 2.1
    """m, distance when the course is fixed (dynamics shifts)."""
    gap: float | None = None
    """m, distance of all hurdles, on a fixed and on a random course, instead of the above."""
    hurdle_bonus: Literal["count", "event", "clean"] = "count"
    """Pay the number of hurdles passed so far at every step, or 1 when one is passed, or the
    number passed in a single flight so far at every step."""

    def __post_init__(self) -> None:
        """Check the options (the task has a stricter check of the gaps), or raise ValueError."""
        check_choice("hurdles.hurdle_bonus", self.hurdle_bonus, ("count", "event", "clean"))
        for name in ("min_gap", "max_gap", "fixed_gap"):
            check_range(f"hurdles.{name}", getattr(self, name), 0.0, 1000.0)
        if self.gap is not None:
            check_range("hurdles.gap", self.gap, 0.0, 1000.0)


class HurdlesCard(Task[HurdlesOptions]):
    """Jump over randomly spaced hurdles; see ``hurdles``."""

    name = "hurdles"
    Options = HurdlesOptions
    source = "imitate"
    measures = {
        "hurdles_passed": Measure("hurdles_passed", "max", 1.0, "1", "hurdles passed"),
        "clean_clearances": Measure(
            "clean_clearances", "max", 1.0, "1", "hurdles passed in a single flight phase"
        ),
        "hit_hurdle": Measure(
            "hit_hurdle", "max", 1.0, "share", "ended by touching a hurdle", True
        ),
        "fall": Measure(
            "fall", "max", 1.0, "share", "ended by the trunk touching the ground", True
        ),
        "distance_x": Measure("distance_x", "max", 1.0, "m", "way made along x"),
    }
    lead = ("hurdles_passed", "single_flight", "return")
    ratios = {"single_flight": ("clean_clearances", "hurdles_passed")}
    chain = (
        Link("imitate", {"task": "imitate"}),
        Link("hurdles", {"task": "hurdles"}),
        # Gaps up to a little more than the 3.6 m of the paper's tests: the task has no such.
        Link("polish", {"task": "hurdles", "hurdles.max_gap": 3.7} | POLISH),
    )
    course_options = ("min_gap", "max_gap", "fixed_gap", "gap")
    caption = ("hurdles_passed",)
    mdp = "twirl_mjx.tasks.hurdles:Hurdles"
