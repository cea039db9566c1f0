"""Task ``biped``: walk to a goal on the hind legs (paper, "Bipedal Navigation Task").

Observation: ``observations.proprioceptive`` with axes (A1: [101]). Action [A] in [-1, 1]. Goal:
uniform on a circle of radius ~ Exp(mean 1.5 m) clipped to [0.3, 5] m.
Reward: r_stand (1 + r_facing + r_distance). Terminates when trunk, hip or thigh touches the ground
(not the calf: the paper's baseline scoots on its knees).
"""

from __future__ import annotations

from collections.abc import Mapping

import flax.struct
import jax
import jax.numpy as jnp

from twirl_mjx.sim import frames
from twirl_mjx.sim.dynamics import Dynamics
from twirl_mjx.sim.robot import HIP, THIGH, TRUNK
from twirl_mjx.sim.scene import Scene
from twirl_mjx.tasks import base, rewards
from twirl_mjx.tasks.cards import BipedCard
from twirl_mjx.tasks.goals import draw_goal
from twirl_mjx.tasks.observations import Observer, ProprioceptiveObserver
from twirl_mjx.tasks.stand import STANDING_SUCCESS_S


class BipedState(flax.struct.PyTreeNode):
    """State of the task in one world."""

    previous_distance: jax.Array
    """m, planar distance to the goal after the previous step."""


GOAL_SUCCESS_M = 0.14
"""m, distance to the goal the paper's robot reaches (0.14 m), and our bar."""


class Biped(BipedCard):
    """See the module docstring."""

    def make_observer(self) -> Observer:
        """Show the goal, the history and the base axes."""
        return ProprioceptiveObserver(self.robot, axes=True)

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
        displacement = world.goal - view.qpos[:2]
        distance = jnp.linalg.norm(displacement)
        upright, bonus = rewards.normalised_cosine(x_axis[2]), rewards.height_bonus(view.height)
        facing = rewards.normalised_cosine(rewards.facing_cosine(z_axis, displacement))
        progress = self._progress(distance, world.task.previous_distance)
        weight = self.options.distance_weight
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
                **base.standing_metrics(view, x_axis[2]),
                "goal_distance": distance,
                "fall": fall,
            },
        )

    def success(self, measures: Mapping[str, jax.Array]) -> jax.Array:
        """Come within 0.14 m of the goal and stand for 12 s."""
        near = measures["min_distance"] <= GOAL_SUCCESS_M
        return near & (measures["standing_time"] >= STANDING_SUCCESS_S)
