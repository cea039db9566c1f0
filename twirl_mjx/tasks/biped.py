"""Task ``biped``: walk to a goal on the hind legs (paper, "Bipedal Navigation Task").

Observation: ``observations.proprioceptive`` with axes (A1: [101]). Action [A] in [-1, 1]. Goal:
uniform on a circle of radius ~ Exp(mean 1.5 m) clipped to [0.3, 5] m.
Reward: r_stand (1 + r_facing + r_distance). Terminates when trunk, hip or thigh touches the ground
(not the calf: the paper's baseline scoots on its knees).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Literal, NamedTuple

from etils import epy

from twirl_mjx.checks import check_choice, check_range
from twirl_mjx.sim.robot import HIP, THIGH, TRUNK
from twirl_mjx.tasks.goals import GOAL_OPTIONS, GoalOptions, draw_goal, walked
from twirl_mjx.tasks.stand import STANDING_MEASURES, STANDING_SUCCESS_S
from twirl_mjx.tasks.task import POLISH, Link, Measure, Task

with epy.lazy_imports():  # needed by worlds, not by options
    import jax
    import jax.numpy as jnp

    from twirl_mjx.sim import frames
    from twirl_mjx.tasks import base, observations, rewards

if TYPE_CHECKING:
    from twirl_mjx.sim.dynamics import Dynamics
    from twirl_mjx.sim.scene import Scene
    from twirl_mjx.tasks.observations import Observer


class BipedState(NamedTuple):
    """State of the task in one world."""

    previous_distance: jax.Array
    """m, planar distance to the goal after the previous step."""


GOAL_SUCCESS_M = 0.14
"""m, distance to the goal the paper's robot reaches (0.14 m), and our bar."""

WALK = {
    "variant": "twirl+weights",
    "biped.distance_reward": "speed",
    "biped.distance_weight": 4.0,
    "episode_length": 200,
    "droq.target_entropy": -12.0,
}
"""An easier reward: the distance term is graded and four times as large, because leaning towards
the goal earns little in the paper's reward as long as it costs balance."""


@dataclasses.dataclass(frozen=True)
class BipedOptions(GoalOptions):
    """Task ``biped``: walk to a goal on the hind legs."""

    goal_speed: float = 0.0
    """m/s, of a goal that walks straight on, in a direction drawn per episode."""
    distance_reward: Literal["nearer", "speed"] = "nearer"
    """Pay 0.5 for being nearer than a step before (the paper's), or by the speed of approach."""
    distance_weight: float = 1.0
    """Factor on the distance term; above 1 in an easier task whose policy is a source."""

    PREFIX = "biped."

    def __post_init__(self) -> None:
        """Check every option, or raise ValueError."""
        super().__post_init__()
        check_range("biped.goal_speed", self.goal_speed, 0.0, 2.0)
        check_choice("biped.distance_reward", self.distance_reward, ("nearer", "speed"))
        check_range("biped.distance_weight", self.distance_weight, 0.0, 100.0)


class Biped(Task[BipedOptions]):
    """See the module docstring."""

    name = "biped"
    Options = BipedOptions
    source = "stand"
    measures = {
        "standing_time": STANDING_MEASURES["standing_time"],
        "on_feet": STANDING_MEASURES["on_feet"],
        "min_distance": Measure(
            "goal_distance", "min", 1.0, "m", "closest approach to the goal", smaller_is_better=True
        ),
        "mean_distance": Measure(
            "goal_distance", "mean", 1.0, "m", "mean distance to the goal", smaller_is_better=True
        ),
        "goal_time": Measure(
            "at_goal", "time", 1.0, "s", "time upright, weighted by exp(-distance to the goal / m)"
        ),
        "cosine": STANDING_MEASURES["cosine"],
    }
    lead = ("standing_time", "return", "on_feet", "success")
    aim = "goal_time"
    chain = (
        Link("stand", {"task": "stand"}),
        Link("walk", {"task": "biped"} | WALK),
        Link("biped", {"task": "biped"} | POLISH),
    )
    presets = {"cpu": {"total_env_steps": 800_000}}
    course_options = (*GOAL_OPTIONS, "goal_speed")
    caption = ("cosine", "goal_distance")
    shows_goal = True

    def make_observer(self) -> Observer:
        """Show the goal, the history and the base axes."""
        return observations.ProprioceptiveObserver(self.robot, axes=True)

    def start(self, key: jax.Array, scene: Scene, dynamics: Dynamics) -> base.Start:
        """Start on four feet with a goal."""
        pose_key, goal_key = jax.random.split(key)
        qpos, qvel = base.start_on_feet(pose_key, scene, dynamics)
        goal = draw_goal(goal_key, self.options, qpos[:2], fixed_course=self.fixed_course)
        return base.Start(
            qpos=qpos,
            qvel=qvel,
            goal=goal,
            memory=self.observer.init(qpos, qvel),
            task=BipedState(previous_distance=jnp.linalg.norm(goal - qpos[:2])),
        )

    def _progress(self, distance: jax.Array, previous: jax.Array) -> jax.Array:
        if self.options.distance_reward == "speed":
            return rewards.approach_speed(distance, previous, self.robot.control_dt)
        return rewards.distance_progress(distance, previous)

    def judge(self, world: base.World, view: base.View, scene: Scene) -> base.Outcome:
        """Score one control step."""
        x_axis, _, z_axis = frames.base_axes(view.qpos[3:7])
        goal, speed = world.goal, self.options.goal_speed
        if speed:
            goal = walked(world.key, goal, speed * self.robot.control_dt)
        displacement = goal - view.qpos[:2]
        distance = jnp.linalg.norm(displacement)
        upright, bonus = rewards.normalised_cosine(x_axis[2]), rewards.height_bonus(view.height)
        facing = rewards.normalised_cosine(rewards.facing_cosine(z_axis, displacement))
        progress = self._progress(distance, world.task.previous_distance)
        weight = self.options.distance_weight
        fall = base.touches(view, TRUNK, HIP, THIGH)
        standing = base.standing_metrics(view, x_axis[2])
        return base.Outcome(
            reward=(upright + bonus) * (1.0 + facing + weight * progress),
            terminated=fall,
            goal=goal,
            task=BipedState(previous_distance=distance),
            metrics={
                "stand": upright + bonus,
                "upright": upright,
                "height": bonus,
                "facing": facing,
                "distance": progress,
                "cosine": x_axis[2],
                **standing,
                "goal_distance": distance,
                "at_goal": standing["standing"] * jnp.exp(-distance),
                "fall": fall,
            },
        )

    def success(self, measures: Mapping[str, jax.Array]) -> jax.Array:
        """Come within 0.14 m of the goal and stand for 12 s."""
        near = measures["min_distance"] <= GOAL_SUCCESS_M
        return near & (measures["standing_time"] >= STANDING_SUCCESS_S)
