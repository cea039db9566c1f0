"""What all tasks share: the state of a world, the view a task judges, and starting poses."""

from __future__ import annotations

from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from twirl_mjx.sim import frames, kinematics
from twirl_mjx.sim.actuation import FilterState, MotorState
from twirl_mjx.sim.dynamics import Dynamics
from twirl_mjx.sim.robot import CALF, FOOT, LEG_SIZE, NUM_LEGS, Robot
from twirl_mjx.sim.scene import Scene, terrain_height
from twirl_mjx.types import Metrics

START_NOISE = 0.05
"""rad, joint angles at the start of an episode get + U(-0.05, 0.05)."""
BUMPY_START_HALF_SIZE = 20.0
"""m, on bumpy ground episodes start at x, y = U(-20, 20)."""
STANDING_COSINE = 0.7
"""Vertical part of the base x-axis from which on the robot counts as upright."""
LIFTED = 0.01
"""m, a foot counts as off the ground above this clearance."""
CALF_RISE = 0.6
"""rad, by which the hind calves of a robot that stands upright are straighter than at rest."""


class World(flax.struct.PyTreeNode):
    """Everything about one world that is not physics: clocks, memories, the episode's draws."""

    key: jax.Array
    """PRNG key of the world, split at every reset."""
    episode_step: jax.Array
    """int32, control steps since the last reset."""
    action: jax.Array
    """[A] last action, zeros after a reset."""
    filter: FilterState
    """Low-pass filter of the joint targets."""
    motors: MotorState
    """Condition of the motors."""
    dynamics: Dynamics
    """Physical parameters, constant within an episode."""
    goal: jax.Array
    """[2] m, world frame."""
    memory: Any
    """Memory of the task's observer."""
    task: Any
    """State of the task itself (a struct of the task's own)."""


class Start(flax.struct.PyTreeNode):
    """The first state of an episode of one world."""

    qpos: jax.Array
    qvel: jax.Array
    goal: jax.Array
    memory: Any
    task: Any


class View(flax.struct.PyTreeNode):
    """What happened to one world in one control step, as the terms of a task see it."""

    qpos: jax.Array
    """[7 + J] at the end of the step."""
    qvel: jax.Array
    """[6 + J] at the end of the step."""
    qpos_trace: jax.Array
    """[S, 7 + J] after every physics substep."""
    end_clearance: jax.Array
    """[G, 2] m, lowest points of both ends of every contact shape over the local ground, at the
    end of the step."""
    height: jax.Array
    """m, base over the local ground."""
    robot: Robot = flax.struct.field(pytree_node=False)
    """Whom it happened to."""

    @property
    def clearance(self) -> jax.Array:
        """[G] m, lowest point of every contact shape over the local ground."""
        return jnp.min(self.end_clearance, axis=-1)


class Outcome(flax.struct.PyTreeNode):
    """A task's verdict on one control step of one world."""

    reward: jax.Array
    terminated: jax.Array
    goal: jax.Array
    task: Any
    metrics: Metrics


def ground_at(scene: Scene, dynamics: Dynamics, xy: jax.Array) -> jax.Array:
    """Return the ground height [...] in m at ``xy`` [..., 2] for the world's dynamics."""
    return terrain_height(scene, xy, dynamics.incline, dynamics.bump_height)


def clearances(scene: Scene, dynamics: Dynamics, endpoints: jax.Array) -> jax.Array:
    """Return the lowest heights [..., G, 2] in m of both ends of shapes [..., G, 2, 3]."""
    ground = ground_at(scene, dynamics, endpoints[..., :2])
    radii = jnp.asarray(scene.robot.contact_radii, jnp.float32)
    return endpoints[..., 2] - ground - radii[:, None]


def make_view(scene: Scene, dynamics: Dynamics, qpos: jax.Array, qvel: jax.Array) -> View:
    """Return the view of one world from its substep trace ``qpos`` [S, 7 + J], ``qvel``."""
    last = qpos[-1]
    endpoints = kinematics.forward(scene.robot, last).endpoints
    return View(
        qpos=last,
        qvel=qvel[-1],
        qpos_trace=qpos,
        end_clearance=clearances(scene, dynamics, endpoints),
        height=last[2] - ground_at(scene, dynamics, last[:2]),
        robot=scene.robot,
    )


def touches(view: View, *bodies: str) -> jax.Array:
    """Return whether any shape of the named body classes touches the ground."""
    return jnp.any(view.clearance[np.flatnonzero(view.robot.contact_mask(*bodies))] <= 0.0)


def knees_touch(view: View) -> jax.Array:
    """Return whether the upper end of any calf touches the ground."""
    calves = np.flatnonzero(view.robot.contact_mask(CALF))
    return jnp.any(view.end_clearance[calves, 0] <= 0.0)


def foot_clearance(view: View) -> jax.Array:
    """Return the clearance [4] in m of the feet, in the order of the robot's legs."""
    return view.clearance[np.flatnonzero(view.robot.contact_mask(FOOT))]


def front_feet(view: View) -> jax.Array:
    """Return the clearance [2] in m of the front feet."""
    return foot_clearance(view)[jnp.asarray(view.robot.front_legs)]


def front_feet_lifted(view: View) -> jax.Array:
    """Return whether both front feet are off the ground."""
    return jnp.all(front_feet(view) > LIFTED)


def standing_metrics(view: View, cosine: jax.Array) -> Metrics:
    """Return whether the robot stands: upright, front feet lifted, and then with no calf down.

    Args:
        view: The control step.
        cosine: Vertical part of the base x-axis.
    """
    standing = (cosine >= STANDING_COSINE) & front_feet_lifted(view)
    return {"standing": standing, "on_feet": standing & ~touches(view, CALF)}


def place_on_ground(scene: Scene, dynamics: Dynamics, qpos: jax.Array) -> jax.Array:
    """Return ``qpos`` [7 + J] raised or lowered until its lowest point just touches the ground."""
    lowest = jnp.min(clearances(scene, dynamics, kinematics.forward(scene.robot, qpos).endpoints))
    return qpos.at[2].add(-lowest)


def start_xy(key: jax.Array, scene: Scene) -> jax.Array:
    """Return the start position [2] in m: random on bumpy ground, else the origin."""
    if scene.kind != "bumpy":
        return jnp.zeros(2)
    return jax.random.uniform(
        key, (2,), minval=-BUMPY_START_HALF_SIZE, maxval=BUMPY_START_HALF_SIZE
    )


def start_on_feet(key: jax.Array, scene: Scene, dynamics: Dynamics) -> tuple[jax.Array, jax.Array]:
    """Return qpos [7 + J] and qvel [6 + J] at rest on four feet, facing +x.

    joint_pos = default + U(-0.05, 0.05); xy = start_xy.
    """
    robot = scene.robot
    place_key, noise_key = jax.random.split(key)
    pose = jnp.asarray(robot.default_pose, jnp.float32)
    joints = pose + jax.random.uniform(
        noise_key, pose.shape, minval=-START_NOISE, maxval=START_NOISE
    )
    upright = jnp.array([robot.home_height, 1.0, 0.0, 0.0, 0.0], jnp.float32)
    qpos = jnp.concatenate([start_xy(place_key, scene), upright, joints])
    return place_on_ground(scene, dynamics, qpos), jnp.zeros(robot.nq - 1)


def risen_pose(robot: Robot, pitch: jax.Array) -> jax.Array:
    """Return qpos [7 + J] with the nose up by ``pitch`` rad and the hind legs extended to match.

    The hind legs point at the ground under the centre of mass (of a robot with thighs and calves
    of like length); the height is left to ``place_on_ground``.
    """
    rise = pitch / (jnp.pi / 2)
    pose = robot.default_pose.reshape(NUM_LEGS, LEG_SIZE)
    calf = float(pose[robot.hind_legs[0], -1]) + CALF_RISE * rise
    thigh = -calf / 2 + 0.95 * pitch
    zero = jnp.zeros_like(pitch)
    hind = jnp.stack([zero, thigh, calf])
    legs = jnp.asarray(pose, jnp.float32).at[jnp.asarray(robot.hind_legs)].set(hind)
    position = jnp.stack([zero, zero, zero + robot.home_height])
    return jnp.concatenate([position, frames.from_pitch(-pitch), legs.ravel()])
