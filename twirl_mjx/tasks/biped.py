"""Task ``biped``: walk to a goal on the hind legs (paper, "Bipedal Navigation Task").

Observation: ``observations.proprioceptive`` with axes (A1: [101]). Action [A] in [-1, 1]. Goal:
uniform on a circle of radius ~ Exp(mean 1.5 m) clipped to [0.3, 5] m.
Reward: r_stand (1 + r_facing + r_distance). Terminates when trunk, hip or thigh touches the ground
(not the calf, README, decision 6).
"""

from __future__ import annotations

import flax.struct
import jax
import jax.numpy as jnp

from twirl_mjx.config import TrainConfig
from twirl_mjx.sim import frames
from twirl_mjx.sim.dynamics import Dynamics
from twirl_mjx.sim.robot import HIP, THIGH, TRUNK, Robot
from twirl_mjx.sim.robots import A1
from twirl_mjx.sim.scene import CollisionSet, Scene
from twirl_mjx.tasks import base, rewards
from twirl_mjx.tasks.observations import ProprioceptiveObserver


class BipedState(flax.struct.PyTreeNode):
    """State of the task in one world."""

    previous_distance: jax.Array
    """m, planar distance to the goal after the previous step."""


def draw_goal(key: jax.Array, config: TrainConfig, start: jax.Array) -> jax.Array:
    """Return a goal [2] in m around ``start`` [2]; the configured one on a fixed course.

    radius = clip(Exp(1.5), 0.3, 5); angle = U(-pi, pi).
    """
    options = config.biped
    if config.fixed_course:
        return start + jnp.asarray(options.fixed_goal, jnp.float32)
    radius_key, angle_key = jax.random.split(key)
    radius = jnp.clip(
        options.goal_mean_radius * jax.random.exponential(radius_key),
        options.goal_min_radius,
        options.goal_max_radius,
    )
    angle = jax.random.uniform(angle_key, minval=-jnp.pi, maxval=jnp.pi)
    return start + radius * jnp.stack([jnp.cos(angle), jnp.sin(angle)])


class Biped:
    """See the module docstring."""

    name = "biped"
    collision: CollisionSet = "legs"
    metric_names = (
        "stand", "upright", "height", "facing", "distance", "cosine", "standing",
        "goal_distance", "fall",
    )  # fmt: skip

    def __init__(self, config: TrainConfig, robot: Robot = A1) -> None:
        """Keep the options of the task."""
        self._config = config
        self.robot = robot
        self.observer = ProprioceptiveObserver(robot, axes=True)

    def start(self, key: jax.Array, scene: Scene, dynamics: Dynamics) -> base.Start:
        """Start on four feet with a goal."""
        pose_key, goal_key = jax.random.split(key)
        qpos, qvel = base.start_on_feet(pose_key, scene, dynamics)
        goal = draw_goal(goal_key, self._config, qpos[:2])
        return base.Start(
            qpos=qpos,
            qvel=qvel,
            goal=goal,
            memory=self.observer.init(qpos, qvel),
            task=BipedState(previous_distance=jnp.linalg.norm(goal - qpos[:2])),
        )

    def _progress(self, distance: jax.Array, previous: jax.Array) -> jax.Array:
        if self._config.biped.distance_reward == "speed":
            return rewards.approach_speed(distance, previous, self.robot.control_dt)
        return rewards.distance_progress(distance, previous)

    def judge(self, world: base.World, view: base.View, scene: Scene) -> base.Outcome:
        """Score one control step."""
        x_axis, _, z_axis = frames.base_axes(view.qpos[3:7])
        displacement = world.goal - view.qpos[:2]
        distance = jnp.linalg.norm(displacement)
        upright, bonus = rewards.normalised_cosine(x_axis[2]), rewards.height_bonus(view.height)
        facing = rewards.normalised_cosine(rewards.facing_cosine(z_axis, displacement))
        progress = self._progress(distance, world.task.previous_distance)
        weight = self._config.biped.distance_weight
        fall = base.touches(view, TRUNK, HIP, THIGH)
        return base.Outcome(
            reward=(upright + bonus) * (1.0 + facing + weight * progress),
            terminated=fall,
            goal=world.goal,
            task=BipedState(previous_distance=distance),
            metrics={
                "stand": upright + bonus,
                "upright": upright,
                "height": bonus,
                "facing": facing,
                "distance": progress,
                "cosine": x_axis[2],
                "standing": (x_axis[2] >= 0.7) & base.front_feet_lifted(view),
                "goal_distance": distance,
                "fall": fall,
            },
        )
