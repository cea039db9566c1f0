"""Goals on the ground: the draw that tasks which show one share."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

from etils import epy

from twirl_mjx.checks import check_range

with epy.lazy_imports():  # needed by worlds, not by options
    import jax
    import jax.numpy as jnp

HEADING = 1004
"""What is folded into a world's key for the heading of its goal, beside ``worlds.vector``'s."""


@dataclasses.dataclass(frozen=True)
class GoalOptions:
    """Where the goal of an episode is."""

    goal_mean_radius: float = 1.5
    """m, mean of the exponential distribution of the goal's distance."""
    goal_min_radius: float = 0.3
    """m, the drawn distance is clipped from below."""
    goal_max_radius: float = 5.0
    """m, the drawn distance is clipped from above."""
    fixed_goal: tuple[float, float] = (1.5, 0.0)
    """m, the goal when the course is fixed (dynamics shifts); on the hill in ``sloped``."""
    goal_distance: float | None = None
    """m, distance of every goal instead of a drawn one; straight ahead on a fixed course."""

    PREFIX: ClassVar[str] = ""

    def __post_init__(self) -> None:
        """Check every option, or raise ValueError."""
        check_range(f"{self.PREFIX}goal_mean_radius", self.goal_mean_radius, 0.0, 100.0)
        check_range(f"{self.PREFIX}goal_max_radius", self.goal_max_radius, 0.0, 100.0)
        high = self.goal_max_radius
        check_range(f"{self.PREFIX}goal_min_radius", self.goal_min_radius, 0.0, high)
        for coordinate in self.fixed_goal:
            check_range(f"{self.PREFIX}fixed_goal", coordinate, -100.0, 100.0)
        if self.goal_distance is not None:
            check_range(f"{self.PREFIX}goal_distance", self.goal_distance, 0.01, 100.0)


GOAL_OPTIONS = tuple(field.name for field in dataclasses.fields(GoalOptions))
"""Options that only place the goal."""


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


def walked(key: jax.Array, goal: jax.Array, step: float) -> jax.Array:
    """Return a goal [2] in m after one step of ``step`` m.

    heading = U(-pi, pi), the same for every step of an episode, from the key of its world.
    """
    heading = jax.random.uniform(jax.random.fold_in(key, HEADING), minval=-jnp.pi, maxval=jnp.pi)
    return goal + step * jnp.stack([jnp.cos(heading), jnp.sin(heading)])
