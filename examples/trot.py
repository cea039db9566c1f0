"""A task of your own in one file: trot to a goal on four feet.

twirl train --task examples/trot.py:Trot --variant twirl --source trot --trot.speed 0.5
"""

import dataclasses

import jax
import jax.numpy as jnp

import twirl_mjx
from twirl_mjx.sim import frames
from twirl_mjx.sim.robot import HIP, TRUNK
from twirl_mjx.tasks import base


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of the task, on the command line as ``--trot.speed`` and so on."""

    speed: float = 0.5
    """m/s towards the goal that earns the full reward."""
    distance: float = 3.0
    """m, from the start to the goal."""


class Trot(twirl_mjx.Task[Options]):
    """Reward: speed towards the goal over ``speed``, at most 1, times how level the trunk is."""

    name = "trot"
    Options = Options
    measures = {
        "min_distance": twirl_mjx.Measure("goal_distance", "min", unit="m", about="closest"),
        "speed": twirl_mjx.Measure("speed", "mean", unit="m/s", about="speed towards the goal"),
    }
    caption = ("speed", "goal_distance")
    shows_goal = True

    def start(self, key, scene, dynamics):
        pose_key, angle_key = jax.random.split(key)
        qpos, qvel = base.start_on_feet(pose_key, scene, dynamics)
        angle = jax.random.uniform(angle_key, minval=-1.0, maxval=1.0)
        goal = qpos[:2] + self.options.distance * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
        memory = self.observer.init(qpos, qvel)
        return twirl_mjx.Start(qpos=qpos, qvel=qvel, goal=goal, memory=memory, task=())

    def judge(self, world, view, scene):
        way = world.goal - view.qpos[:2]
        distance = jnp.linalg.norm(way)
        speed = jnp.where(distance < 0.2, self.options.speed, view.qvel[:2] @ way / distance)
        level = jnp.maximum(frames.base_axes(view.qpos[3:7])[2][2], 0.0)
        reward = jnp.clip(speed / self.options.speed, 0.0, 1.0) * level**2
        fall = base.touches(view, TRUNK, HIP)
        metrics = {"speed": speed, "level": level, "goal_distance": distance}
        return twirl_mjx.Outcome(
            reward=reward, terminated=fall, goal=world.goal, task=(), metrics=metrics
        )

    def success(self, measures):
        return measures["min_distance"] < 0.2
