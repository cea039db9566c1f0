"""Task ``stand``: get up on the hind legs and stay there. Source of ``biped``.

Observation: ``observations.proprioceptive`` with axes (A1: [101]). Action [A] in [-1, 1].
Reward: r_upright + r_height.
Terminates when any part but the feet touches the ground (paper, "Training the source policy").
A goal is drawn as in ``biped`` and shown, but nothing depends on it: both tasks then share their
observation, and the source has learned to ignore the goal.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Literal

from etils import epy

from twirl_mjx.checks import check_choice, check_range
from twirl_mjx.sim.robot import CALF, HIP, THIGH, TRUNK
from twirl_mjx.tasks.goals import GOAL_OPTIONS, GoalOptions, draw_goal
from twirl_mjx.tasks.task import Measure, Task

with epy.lazy_imports():  # needed by worlds, not by options
    import jax
    import jax.numpy as jnp

    from twirl_mjx.sim import frames
    from twirl_mjx.tasks import base, observations, rewards

if TYPE_CHECKING:
    from twirl_mjx.sim.dynamics import Dynamics
    from twirl_mjx.sim.scene import Scene
    from twirl_mjx.tasks.observations import Observer

RISEN_PITCH_DEG = 83.0
"""deg, risen episodes start at pitch = U(0, 83)."""

STANDING_SUCCESS_S = 12.0
"""s, standing time the paper's robot reaches (12.12 s), and our bar."""

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


class Stand(Task[StandOptions]):
    """See the module docstring."""

    name = "stand"
    Options = StandOptions
    collision = "feet"
    measures = STANDING_MEASURES
    lead = ("standing_time", "return", "on_feet")
    presets = {
        "paper": {"stand.height_of": "front_feet"},
        "cpu": {"stand.risen_fraction": 0.9, "episode_length": 100},
    }
    course_options = (*GOAL_OPTIONS, "risen_fraction")
    training_options = ("risen_fraction",)
    caption = ("cosine",)

    def make_observer(self) -> Observer:
        """Show the goal, the history and the base axes."""
        return observations.ProprioceptiveObserver(self.robot, axes=True)

    def start(self, key: jax.Array, scene: Scene, dynamics: Dynamics) -> base.Start:
        """Start on four feet, or part-way up in a share ``risen_fraction`` of the episodes."""
        pose_key, goal_key, risen_key, pitch_key = jax.random.split(key, 4)
        qpos, qvel = base.start_on_feet(pose_key, scene, dynamics)
        if self.options.risen_fraction > 0.0:
            pitch = jax.random.uniform(pitch_key, maxval=RISEN_PITCH_DEG * jnp.pi / 180)
            risen = base.risen_pose(scene.robot, pitch)
            risen = risen.at[:2].set(qpos[:2])
            pose = jnp.asarray(scene.robot.default_pose, jnp.float32)
            risen = risen.at[7:].add(qpos[7:] - pose)
            risen = base.place_on_ground(scene, dynamics, risen)
            take = jax.random.uniform(risen_key) < self.options.risen_fraction
            qpos = jnp.where(take, risen, qpos)
        return base.Start(
            qpos=qpos,
            qvel=qvel,
            goal=draw_goal(goal_key, self.options, qpos[:2], fixed_course=self.fixed_course),
            memory=self.observer.init(qpos, qvel),
            task=(),
        )

    def judge(self, world: base.World, view: base.View, scene: Scene) -> base.Outcome:
        """Score one control step."""
        cosine = frames.base_axes(view.qpos[3:7])[0][2]
        front = jnp.mean(base.front_feet(view)) + view.robot.foot_radius
        height = view.height if self.options.height_of == "root" else front
        upright, bonus = rewards.normalised_cosine(cosine), rewards.height_bonus(height)
        fall = base.touches(view, TRUNK, HIP, THIGH, CALF)
        return base.Outcome(
            reward=upright + bonus,
            terminated=fall,
            goal=world.goal,
            task=world.task,
            metrics={
                "upright": upright,
                "height": bonus,
                "cosine": cosine,
                **base.standing_metrics(view, cosine),
                "front_foot_height": front,
                "fall": fall,
            },
        )

    def success(self, measures: Mapping[str, jax.Array]) -> jax.Array:
        """Stand for 12 s."""
        return measures["standing_time"] >= STANDING_SUCCESS_S
