"""Goals on the ground: the draw that tasks which show one share."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from twirl_mjx.tasks.cards import GoalOptions


def draw_goal(
    key: jax.Array, options: GoalOptions, start: jax.Array, *, fixed_course: bool
) -> jax.Array:
    """Return a goal [2] in m around ``start`` [2]; the configured one on a fixed course.

    radius = clip(Exp(1.5), 0.3, 5); angle = U(-pi, pi).
    """
    given = options.goal_distance
    if fixed_course:
        fixed = options.fixed_goal if given is None else (given, 0.0)
        return start + jnp.asarray(fixed, jnp.float32)
    low, high = options.goal_min_radius, options.goal_max_radius
    if given is not None:
        low = high = given
    radius_key, angle_key = jax.random.split(key)
    radius = jnp.clip(options.goal_mean_radius * jax.random.exponential(radius_key), low, high)
    angle = jax.random.uniform(angle_key, minval=-jnp.pi, maxval=jnp.pi)
    return start + radius * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
