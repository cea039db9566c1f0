"""Task ``hurdles``: jump over randomly spaced hurdles (paper, "Jumping Task").

Observation: ``observations.proprioceptive`` (A1: [95]). Action [A] in [-1, 1]. Goal: centre of the
next hurdle; a hurdle is passed when the root is 0.4 m beyond it. Reward: the terms of ``WEIGHTS``.
Terminates when any part of the robot touches a hurdle at any physics substep, or the trunk touches
the ground.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from etils import epy

from twirl_mjx.checks import check_choice, check_range
from twirl_mjx.sim.robot import FOOT, TRUNK
from twirl_mjx.tasks.task import POLISH, Link, Measure, Task

with epy.lazy_imports():  # needed by worlds, not by options
    import jax
    import jax.numpy as jnp

    from twirl_mjx.sim import frames, kinematics
    from twirl_mjx.sim import scene as scenes
    from twirl_mjx.tasks import bands, base, rewards

if TYPE_CHECKING:
    from twirl_mjx.sim.dynamics import Dynamics
    from twirl_mjx.sim.scene import Scene

WEIGHTS = {"forward": 0.7, "orientation": 0.05, "joint_calm": 0.15, "hurdle": 0.1}
"""Weights of the reward terms (paper appendix, table of the jumping task)."""

HEIGHTS = (0.001, 0.2)
"""m, least and largest height of a band."""
PASSED = 0.4
"""m, a hurdle counts as passed when the root is this far beyond its centre (paper)."""
MAX_SPEED = 4.0
"""m/s, there are hurdles enough for an episode at this speed (the A1's best is 3.3 m/s)."""
BUMPY_START_X = (1.0, 11.0)
"""m, on bumpy ground episodes start this far from one edge in x, to run across it."""
FOOT_CONTACT = 0.001
"""m, a foot below this clearance is on the ground: contacts on a slope, measured straight down,
begin above 0."""


class HurdlesState(NamedTuple):
    """State of the task in one world."""

    start: jax.Array
    """[2] m, where the episode began, world frame."""
    positions: jax.Array
    """[H] m, world x of the hurdles' centres, ascending."""
    passed: jax.Array
    """int32, hurdles passed so far: the index of the next one."""
    stepped_in: jax.Array
    """[H] bool, a foot was on the ground while the hurdle was being crossed."""
    cleared: jax.Array
    """[H] bool, passed with all feet off the ground during the whole crossing."""


class Crossing(NamedTuple):
    """What the substeps of one control step mean for the hurdles."""

    hit: jax.Array
    """bool, a part of the robot touched a hurdle."""
    stepped_in: jax.Array
    """[H] bool, see ``bands.stepped_in``."""
    last_foot: jax.Array
    """m, world x of the hindmost foot at the end of the step."""


def watch(
    scene: Scene,
    dynamics: Dynamics,
    qpos_trace: jax.Array,
    positions: jax.Array,
    band_height: float,
) -> Crossing:
    """Test every physics substep ``qpos_trace`` [S, 7 + J] against hurdles at ``positions`` [H]."""
    robot = scene.robot
    points = kinematics.forward(robot, qpos_trace)
    x = points.endpoints[..., 0]
    height = points.endpoints[..., 2] - base.ground_at(scene, dynamics, points.endpoints[..., :2])
    radii = jnp.asarray(robot.contact_radii, jnp.float32)
    band = bands.nearest(positions, qpos_trace[:, 0])
    feet = np.flatnonzero(robot.contact_mask(FOOT))
    return Crossing(
        hit=jnp.any(bands.shape_distance(x, height, radii, band, band_height) <= 0.0),
        stepped_in=bands.stepped_in(
            positions, x[:, feet, 0], height[:, feet, 0] < robot.foot_radius + FOOT_CONTACT
        ),
        last_foot=jnp.min(x[-1, feet, 0]),
    )


def advance(state: HurdlesState, crossing: Crossing, x: jax.Array) -> HurdlesState:
    """Return the state after a control step that ends with the root at ``x`` in m."""
    beyond = state.positions + PASSED < x
    stepped_in = state.stepped_in | crossing.stepped_in
    behind = crossing.last_foot > state.positions + bands.HURDLE_LENGTH / 2
    return state._replace(
        passed=jnp.maximum(state.passed, jnp.sum(beyond, dtype=jnp.int32)),
        stepped_in=stepped_in,
        cleared=state.cleared | (beyond & behind & ~stepped_in),
    )


def next_goal(state: HurdlesState) -> jax.Array:
    """Return the goal [2] in m: the next hurdle's centre, straight ahead of the start."""
    index = jnp.minimum(state.passed, state.positions.shape[0] - 1)
    return jnp.stack([state.positions[index], state.start[1]])


def bonus(
    kind: Literal["count", "event", "clean"], before: HurdlesState, after: HurdlesState
) -> jax.Array:
    """Return the hurdle term of a control step, see ``HurdlesOptions.hurdle_bonus``."""
    if kind == "event":
        return (after.passed - before.passed) * 1.0
    return jnp.sum(after.cleared) * 1.0 if kind == "clean" else after.passed * 1.0


HURDLES_SUCCESS = 2
"""Hurdles passed that make an episode a success (the paper's courses have two)."""


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
    height: float = 0.01
    """m, height of the bands; the paper's are 1 cm, harder courses have 5 or 10 cm."""
    hurdle_bonus: Literal["count", "event", "clean"] = "count"
    """Pay the number of hurdles passed so far at every step, or 1 when one is passed, or the
    number passed in a single flight so far at every step."""

    def __post_init__(self) -> None:
        """Check the options (the task has a stricter check of the gaps), or raise ValueError."""
        check_choice("hurdles.hurdle_bonus", self.hurdle_bonus, ("count", "event", "clean"))
        for name in ("min_gap", "max_gap", "fixed_gap"):
            check_range(f"hurdles.{name}", getattr(self, name), 0.0, 1000.0)
        check_range("hurdles.height", self.height, *HEIGHTS)
        if self.gap is not None:
            check_range("hurdles.gap", self.gap, 0.0, 1000.0)


class Hurdles(Task[HurdlesOptions]):
    """See the module docstring."""

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
    aim = "clean_clearances"
    chain = (
        Link("imitate", {"task": "imitate"}),
        Link("hurdles", {"task": "hurdles"}),
        # Gaps up to a little more than the 3.6 m of the paper's tests: the task has no such.
        Link("polish", {"task": "hurdles", "hurdles.max_gap": 3.7} | POLISH),
    )
    course_options = ("min_gap", "max_gap", "fixed_gap", "gap")
    caption = ("hurdles_passed",)

    def __init__(self, options: HurdlesOptions | None = None, **setting: Any) -> None:
        """Keep the options of the task.

        Raises:
            ValueError: Gaps are out of order, or so small that two hurdles are within reach.
        """
        super().__init__(options, **setting)
        low, high = self.options.min_gap, self.options.max_gap
        if self.fixed_course:
            low = high = self.options.fixed_gap
        if self.options.gap is not None:
            low = high = self.options.gap
        least = bands.min_gap(self.robot)
        if not least <= low <= high:
            raise ValueError(
                f"hurdles have gaps from {low} to {high} m: the smallest must be at least"
                f" {least} m and the largest no smaller"
                f" (nearest: {max(low, least)} to {max(low, high, least)})"
            )
        self._gaps = (low, high)
        self.band_height = self.options.height
        seconds = self.episode_length * self.robot.control_dt
        self.num_hurdles = math.ceil(seconds * MAX_SPEED / low) + 1
        """H, never all passed in an episode."""

    def start(self, key: jax.Array, scene: Scene, dynamics: Dynamics) -> base.Start:
        """Start on four feet, the first hurdle as far ahead as the others are apart."""
        pose_key, place_key, band_key = jax.random.split(key, 3)
        qpos, qvel = base.start_on_feet(pose_key, scene, dynamics)
        if scene.kind == "bumpy":
            low, high = (x - scenes.BUMP_HALF_SIZE for x in BUMPY_START_X)
            x = jax.random.uniform(place_key, minval=low, maxval=high)
            qpos = base.place_on_ground(scene, dynamics, qpos.at[0].set(x))
        none = jnp.zeros(self.num_hurdles, bool)
        state = HurdlesState(
            start=qpos[:2],
            positions=qpos[0] + bands.draw(band_key, self.num_hurdles, *self._gaps),
            passed=jnp.zeros((), jnp.int32),
            stepped_in=none,
            cleared=none,
        )
        return base.Start(
            qpos=qpos,
            qvel=qvel,
            goal=next_goal(state),
            memory=self.observer.init(qpos, qvel),
            task=state,
        )

    def judge(self, world: base.World, view: base.View, scene: Scene) -> base.Outcome:
        """Score one control step."""
        crossing = watch(
            scene, world.dynamics, view.qpos_trace, world.task.positions, self.band_height
        )
        state = advance(world.task, crossing, view.qpos[0])
        terms = {
            "forward": rewards.forward(view.qvel[0]),
            "orientation": rewards.orientation(frames.rotation_angle(view.qpos[3:7])),
            "joint_calm": rewards.joint_calm(view.qvel[6:]),
            "hurdle": bonus(self.options.hurdle_bonus, world.task, state),
        }
        goal = next_goal(state)
        fall = base.touches(view, TRUNK)
        return base.Outcome(
            reward=sum((WEIGHTS[name] * term for name, term in terms.items()), jnp.zeros(())),
            terminated=crossing.hit | fall,
            goal=goal,
            task=state,
            metrics=terms
            | {
                "hurdles_passed": state.passed,
                "clean_clearances": jnp.sum(state.cleared),
                "hit_hurdle": crossing.hit,
                "fall": fall,
                "distance_x": view.qpos[0] - state.start[0],
                "goal_distance": jnp.linalg.norm(goal - view.qpos[:2]),
            },
        )

    def success(self, measures: Mapping[str, jax.Array]) -> jax.Array:
        """Pass two hurdles."""
        return measures["hurdles_passed"] >= HURDLES_SUCCESS

    def bands(self, state: HurdlesState) -> np.ndarray:
        """Return where the hurdles are."""
        return np.asarray(state.positions)
