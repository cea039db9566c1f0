"""What all tasks share: the state of a world, the view a task judges, and starting poses."""

from __future__ import annotations

from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from twirl_mjx.sim import a1, frames, kinematics
from twirl_mjx.sim.actuation import FilterState, MotorState
from twirl_mjx.sim.dynamics import Dynamics
from twirl_mjx.sim.scene import Scene, terrain_height
from twirl_mjx.types import Metrics

FEET = a1.contact_mask(a1.FOOT)
START_NOISE = 0.05
"""rad, joint angles at the start of an episode get + U(-0.05, 0.05)."""
BUMPY_START_HALF_SIZE = 20.0
"""m, on bumpy ground episodes start at x, y = U(-20, 20)."""
STANDING_COSINE = 0.7
"""Vertical part of the base x-axis from which on the robot counts as upright."""
LIFTED = 0.01
"""m, a foot counts as off the ground above this clearance."""


class World(flax.struct.PyTreeNode):
    """Everything about one world that is not physics: clocks, memories, the episode's draws."""

    key: jax.Array
    """PRNG key of the world, split at every reset."""
    episode_step: jax.Array
    """int32, control steps since the last reset."""
    action: jax.Array
    """[12] last action, zeros after a reset."""
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
    """[19] at the end of the step."""
    qvel: jax.Array
    """[18] at the end of the step."""
    qpos_trace: jax.Array
    """[S, 19] after every physics substep."""
    end_clearance: jax.Array
    """[G, 2] m, lowest points of both ends of every contact shape over the local ground, at the
    end of the step."""
    height: jax.Array
    """m, base over the local ground."""

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
    return endpoints[..., 2] - ground - jnp.asarray(a1.CONTACT_RADII, jnp.float32)[:, None]


def make_view(scene: Scene, dynamics: Dynamics, qpos: jax.Array, qvel: jax.Array) -> View:
    """Return the view of one world from its substep trace ``qpos`` [S, 19], ``qvel`` [S, 18]."""
    last = qpos[-1]
    endpoints = kinematics.forward(last).endpoints
    return View(
        qpos=last,
        qvel=qvel[-1],
        qpos_trace=qpos,
        end_clearance=clearances(scene, dynamics, endpoints),
        height=last[2] - ground_at(scene, dynamics, last[:2]),
    )


def touches(view: View, *bodies: str) -> jax.Array:
    """Return whether any shape of the named body classes touches the ground."""
    return jnp.any(view.clearance[np.flatnonzero(a1.contact_mask(*bodies))] <= 0.0)


def knees_touch(view: View) -> jax.Array:
    """Return whether the upper end of any calf touches the ground."""
    return jnp.any(view.end_clearance[np.flatnonzero(a1.contact_mask(a1.CALF)), 0] <= 0.0)


def foot_clearance(view: View) -> jax.Array:
    """Return the clearance [4] in m of the feet FR FL RR RL."""
    return view.clearance[np.flatnonzero(FEET)]


def front_feet_lifted(view: View) -> jax.Array:
    """Return whether both front feet are off the ground."""
    return jnp.all(foot_clearance(view)[jnp.asarray(a1.FRONT_LEGS)] > LIFTED)


def standing_metrics(view: View, cosine: jax.Array) -> Metrics:
    """Return whether the robot stands: upright, front feet lifted, and then with no calf down.

    Args:
        view: The control step.
        cosine: Vertical part of the base x-axis.
    """
    standing = (cosine >= STANDING_COSINE) & front_feet_lifted(view)
    return {"standing": standing, "on_feet": standing & ~touches(view, a1.CALF)}


def place_on_ground(scene: Scene, dynamics: Dynamics, qpos: jax.Array) -> jax.Array:
    """Return ``qpos`` [19] raised or lowered until its lowest point just touches the ground."""
    lowest = jnp.min(clearances(scene, dynamics, kinematics.forward(qpos).endpoints))
    return qpos.at[2].add(-lowest)


def start_xy(key: jax.Array, scene: Scene) -> jax.Array:
    """Return the start position [2] in m: random on bumpy ground, else the origin."""
    if scene.kind != "bumpy":
        return jnp.zeros(2)
    return jax.random.uniform(
        key, (2,), minval=-BUMPY_START_HALF_SIZE, maxval=BUMPY_START_HALF_SIZE
    )


def start_on_feet(key: jax.Array, scene: Scene, dynamics: Dynamics) -> tuple[jax.Array, jax.Array]:
    """Return qpos [19] and qvel [18] at rest on four feet, facing +x.

    joint_pos = default + U(-0.05, 0.05); xy = start_xy.
    """
    place_key, noise_key = jax.random.split(key)
    noise = jax.random.uniform(noise_key, (12,), minval=-START_NOISE, maxval=START_NOISE)
    joints = jnp.asarray(a1.DEFAULT_POSE, jnp.float32) + noise
    upright = jnp.array([a1.HOME_HEIGHT, 1.0, 0.0, 0.0, 0.0], jnp.float32)
    qpos = jnp.concatenate([start_xy(place_key, scene), upright, joints])
    return place_on_ground(scene, dynamics, qpos), jnp.zeros(18)


def risen_pose(pitch: jax.Array) -> jax.Array:
    """Return qpos [19] with the nose up by ``pitch`` rad and the hind legs extended to match.

    The hind legs point at the ground under the centre of mass; the height is left to
    ``place_on_ground``.
    """
    rise = pitch / (jnp.pi / 2)
    calf = -1.8 + 0.6 * rise
    thigh = -calf / 2 + 0.95 * pitch
    zero = jnp.zeros_like(pitch)
    hind = jnp.stack([zero, thigh, calf])
    front = jnp.asarray(a1.DEFAULT_POSE[:6], jnp.float32)
    position = jnp.stack([zero, zero, zero + a1.HOME_HEIGHT])
    return jnp.concatenate([position, frames.from_pitch(-pitch), front, hind, hind])
