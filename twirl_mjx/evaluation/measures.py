"""What is measured of an episode, and when it is a success: one table per task."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from twirl_mjx.sim.scene import CONTROL_DT
from twirl_mjx.tasks.vector import EnvState

How = Literal["sum", "mean", "min", "max"]


class Measure(NamedTuple):
    """A number per episode, folded from one per-step signal."""

    signal: str
    """``reward``, ``step`` (1 each step), ``terminated``, or a metric of the task."""
    how: How
    """Fold over the steps of the episode."""
    scale: float
    """Factor on the folded value."""
    unit: str
    about: str


COMMON: dict[str, Measure] = {
    "return": Measure("reward", "sum", 1.0, "1", "undiscounted return"),
    "episode_length": Measure("step", "sum", 1.0, "steps", "control steps until the end"),
    "terminated": Measure("terminated", "max", 1.0, "share", "ended by the task, not by time"),
}

MEASURES: dict[str, dict[str, Measure]] = {
    "stand": COMMON
    | {
        "standing_time": Measure(
            "standing", "sum", CONTROL_DT, "s", "time with c >= 0.7 and both front feet lifted"
        ),
        "cosine": Measure("cosine", "mean", 1.0, "1", "mean vertical part of the base x-axis"),
    },
    "biped": COMMON
    | {
        "standing_time": Measure(
            "standing", "sum", CONTROL_DT, "s", "time with c >= 0.7 and both front feet lifted"
        ),
        "min_distance": Measure("goal_distance", "min", 1.0, "m", "closest approach to the goal"),
        "cosine": Measure("cosine", "mean", 1.0, "1", "mean vertical part of the base x-axis"),
    },
    "imitate": COMMON
    | {
        "tracking": Measure("tracking", "mean", 1.0, "1", "mean reward over its maximum"),
        "leaps": Measure("leaps", "max", 1.0, "1", "cycles of the clip survived"),
        "flights": Measure("flights", "max", 1.0, "1", "cycles with a flight of 4 steps or more"),
    },
    "hurdles": COMMON
    | {
        "hurdles_passed": Measure("hurdles_passed", "max", 1.0, "1", "hurdles passed"),
        "clean_clearances": Measure(
            "clean_clearances", "max", 1.0, "1", "hurdles passed in a single flight phase"
        ),
        "hit_hurdle": Measure("hit_hurdle", "max", 1.0, "share", "ended by touching a hurdle"),
        "fall": Measure("fall", "max", 1.0, "share", "ended by the trunk touching the ground"),
        "distance_x": Measure("distance_x", "max", 1.0, "m", "way made along x"),
    },
}

STANDING_SUCCESS_S = 12.0
"""s, standing time the paper's robot reaches (12.12 s), and our bar for ``stand``."""
GOAL_SUCCESS_M = 0.14
"""m, distance to the goal the paper's robot reaches (0.14 m), and our bar for ``biped``."""
LEAPS_SUCCESS = 3
"""Leaps in a row that make an ``imitate`` episode a success."""
HURDLES_SUCCESS = 2
"""Hurdles passed that make a ``hurdles`` episode a success (the paper's courses have two)."""


def success(task: str, values: dict[str, jax.Array]) -> jax.Array:
    """Return which episodes succeeded, given their measures (arrays of one shape).

    stand: standing time >= 12 s. biped: minimum distance <= 0.14 m and standing time >= 12 s.
    imitate: >= 3 cycles with a flight. hurdles: >= 2 hurdles passed.
    """
    if task == "stand":
        return values["standing_time"] >= STANDING_SUCCESS_S
    if task == "biped":
        near = values["min_distance"] <= GOAL_SUCCESS_M
        return near & (values["standing_time"] >= STANDING_SUCCESS_S)
    if task == "imitate":
        return values["flights"] >= LEAPS_SUCCESS
    return values["hurdles_passed"] >= HURDLES_SUCCESS


_EMPTY = {"sum": 0.0, "mean": 0.0, "min": jnp.inf, "max": -jnp.inf}


class Tracker(flax.struct.PyTreeNode):
    """Running measures of the present episode of every world."""

    values: dict[str, jax.Array]
    """Folded signals, each [N], before ``scale`` and ``mean`` are applied."""
    steps: jax.Array
    """[N] steps of the present episode."""


def tracker_init(task: str, num_envs: int) -> Tracker:
    """Return empty measures of N worlds."""
    values = {
        name: jnp.full(num_envs, _EMPTY[m.how], jnp.float32) for name, m in MEASURES[task].items()
    }
    return Tracker(values=values, steps=jnp.zeros(num_envs, jnp.float32))


def tracker_step(task: str, tracker: Tracker, state: EnvState) -> Tracker:
    """Fold one step in; ``state`` is what ``env.step`` returned."""
    signals = state.metrics | {
        "reward": state.reward,
        "step": jnp.ones_like(state.reward),
        "terminated": state.terminated.astype(jnp.float32),
    }
    fold = {"sum": jnp.add, "mean": jnp.add, "min": jnp.minimum, "max": jnp.maximum}
    values = {
        name: fold[m.how](tracker.values[name], signals[m.signal])
        for name, m in MEASURES[task].items()
    }
    return Tracker(values=values, steps=tracker.steps + 1.0)


def tracker_read(task: str, tracker: Tracker) -> dict[str, jax.Array]:
    """Return the measures so far, each [N], and ``success`` as 0 or 1.

    Sums of an episode without a step are 0; its means, minima and maxima are not defined (NaN).
    """
    values = {}
    for name, m in MEASURES[task].items():
        value = tracker.values[name] / tracker.steps if m.how == "mean" else tracker.values[name]
        defined = (tracker.steps > 0.0) | (m.how == "sum")
        values[name] = jnp.where(defined, value * m.scale, jnp.nan)
    return values | {"success": success(task, values).astype(jnp.float32)}


def episode_means(values: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Return the mean of every measure over the episodes in which it is defined.

    A measure that is defined in none is left out.
    """
    defined = {name: np.asarray(v)[~np.isnan(v)] for name, v in values.items()}
    return {name: float(v.mean()) for name, v in defined.items() if v.size}


def tracker_reset(task: str, tracker: Tracker, done: jax.Array) -> Tracker:
    """Empty the measures of the worlds in ``done`` [N]."""
    empty = tracker_init(task, done.shape[0])
    return jax.tree.map(lambda new, old: jnp.where(done, new, old), empty, tracker)


LEADS: dict[str, tuple[str, ...]] = {
    "stand": ("return", "standing_time"),
    "biped": ("return", "standing_time", "success"),
    "hurdles": ("hurdles_passed", "single_flight", "return"),
}
"""What a task is judged by in figures and tables, the main measure first; its return otherwise."""
RATIOS: dict[str, tuple[str, str]] = {"single_flight": ("clean_clearances", "hurdles_passed")}
"""Measures that figures and tables compute: the first over the second, where that is not zero."""
SMALLER_IS_BETTER = ("terminated", "min_distance", "hit_hurdle", "fall")
"""Measures of which less is better."""
