"""Reward terms: one pure function each, unweighted (paper appendix)."""

from __future__ import annotations

import jax
import jax.numpy as jnp


def normalised_cosine(cosine: jax.Array) -> jax.Array:
    """Return (0.5 c + 0.5)^2 in [0, 1] for a cosine in [-1, 1] (paper eq. "upright")."""
    return (0.5 * cosine + 0.5) ** 2


def height_bonus(height: jax.Array) -> jax.Array:
    """Return exp(h) - 1 for a height in m (paper, term "max height")."""
    return jnp.exp(height) - 1.0


def facing_cosine(base_z_axis_w: jax.Array, displacement: jax.Array) -> jax.Array:
    """Return the cosine between the base's down vector and the way to the goal.

    Args:
        base_z_axis_w: [3] unit base z-axis, world frame.
        displacement: [2] m, horizontal displacement from the base to the goal, world frame.

    Returns:
        Cosine in [-1, 1]; 0 when the base is at the goal.
    """
    distance = jnp.linalg.norm(displacement)
    return -jnp.dot(base_z_axis_w[:2], displacement) / jnp.maximum(distance, 1e-6)


def distance_progress(distance: jax.Array, previous: jax.Array) -> jax.Array:
    """Return 1 within 0.01 m of the goal, 0.5 when nearer than before, else 0."""
    return jnp.where(distance <= 0.01, 1.0, jnp.where(distance < previous, 0.5, 0.0))


FULL_APPROACH_SPEED = 0.5
"""m/s, speed towards the goal that earns the whole of :func:`approach_speed`."""


def approach_speed(distance: jax.Array, previous: jax.Array, control_dt: float) -> jax.Array:
    """Return 1 within 0.01 m of the goal, else 0.5 times the speed towards it over 0.5 m/s.

    The graded form of :func:`distance_progress`: swaying on the spot earns nothing on average,
    where the paper's form pays it half of the bonus. In [-0.5, 0.5] away from the goal.
    """
    speed = (previous - distance) / control_dt
    graded = 0.5 * jnp.clip(speed / FULL_APPROACH_SPEED, -1.0, 1.0)
    return jnp.where(distance <= 0.01, 1.0, graded)


def forward(speed: jax.Array) -> jax.Array:
    """Return 1 when the base moves along x faster than 0.5 m/s, else 0.007 (paper, "Forward")."""
    return jnp.where(speed > 0.5, 1.0, 0.007)


def orientation(angle: jax.Array) -> jax.Array:
    """Return exp(-2 theta), theta in rad from upright-forward (paper, "Orientation")."""
    return jnp.exp(-2.0 * angle)


def joint_calm(joint_vel: jax.Array) -> jax.Array:
    """Return exp(-0.1 |qdot|_2) of joint velocities [J] in rad/s (paper, "Joint velocity")."""
    return jnp.exp(-0.1 * jnp.linalg.norm(joint_vel))


def kernel(weighted_square_error: jax.Array) -> jax.Array:
    """Return exp(-e) of a weighted squared error (paper Table 2; Peng et al. 2020)."""
    return jnp.exp(-weighted_square_error)


def joint_tracking(error: jax.Array) -> jax.Array:
    """Return exp(-5 sum dq^2) of joint errors [J] in rad."""
    return kernel(5.0 * jnp.sum(error**2))


def joint_vel_tracking(error: jax.Array) -> jax.Array:
    """Return exp(-0.1 sum dqdot^2) of joint velocity errors [J] in rad/s."""
    return kernel(0.1 * jnp.sum(error**2))


def root_tracking(error: jax.Array, angle: jax.Array) -> jax.Array:
    """Return exp(-20 |dx|^2 - 10 theta^2), dx [3] in m and theta the rotation error in rad."""
    return kernel(20.0 * jnp.sum(error**2) + 10.0 * angle**2)


def root_vel_tracking(linear: jax.Array, angular: jax.Array) -> jax.Array:
    """Return exp(-2 |dv|^2 - 0.2 |dw|^2) of errors [3] in m/s and [3] in rad/s, world frame."""
    return kernel(2.0 * jnp.sum(linear**2) + 0.2 * jnp.sum(angular**2))


def foot_tracking(error: jax.Array) -> jax.Array:
    """Return exp(-40 sum_e |dx_e|^2) of errors [4, 3] in m of the feet relative to the root."""
    return kernel(40.0 * jnp.sum(error**2))
