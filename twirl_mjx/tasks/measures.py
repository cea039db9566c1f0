"""Measures of episodes: folded step by step, for any task."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from twirl_mjx.tasks.task import Measure, Task

COMMON: dict[str, Measure] = {
    "return": Measure("reward", "sum", 1.0, "1", "undiscounted return"),
    "episode_length": Measure("step", "sum", 1.0, "steps", "control steps until the end"),
    "terminated": Measure(
        "terminated", "max", 1.0, "share", "ended by the task, not by time", True
    ),
}
"""What is measured of every task."""
SUCCESS = Measure("", "max", 1.0, "share", "met the task's criterion")
"""What ``success`` is, which no single signal decides."""


def measures_of(task: Task | type[Task]) -> dict[str, Measure]:
    """Return everything that is measured of an episode of a task, by name, ``success`` apart."""
    return COMMON | dict(task.measures)


_EMPTY = {"sum": 0.0, "time": 0.0, "mean": 0.0, "min": jnp.inf, "max": -jnp.inf}


class Tracker(flax.struct.PyTreeNode):
    """Running measures of the present episode of every world."""

    values: dict[str, jax.Array]
    """Folded signals, each [N], before ``scale`` and ``mean`` are applied."""
    steps: jax.Array
    """[N] steps of the present episode."""


def tracker_init(task: Task, num_envs: int) -> Tracker:
    """Return empty measures of N worlds."""
    values = {
        name: jnp.full(num_envs, _EMPTY[m.how], jnp.float32)
        for name, m in measures_of(task).items()
    }
    return Tracker(values=values, steps=jnp.zeros(num_envs, jnp.float32))


def tracker_step(task: Task, tracker: Tracker, state: Any) -> Tracker:
    """Fold one step in; ``state`` is what ``env.step`` returned."""
    signals = state.metrics | {
        "reward": state.reward,
        "step": jnp.ones_like(state.reward),
        "terminated": state.terminated.astype(jnp.float32),
    }
    fold = {
        "sum": jnp.add,
        "time": jnp.add,
        "mean": jnp.add,
        "min": jnp.minimum,
        "max": jnp.maximum,
    }
    values = {
        name: fold[m.how](tracker.values[name], signals[m.signal])
        for name, m in measures_of(task).items()
    }
    return Tracker(values=values, steps=tracker.steps + 1.0)


def tracker_read(task: Task, tracker: Tracker) -> dict[str, jax.Array]:
    """Return the measures so far, each [N], and ``success`` as 0 or 1.

    Sums of an episode without a step are 0; its means, minima and maxima are not defined (NaN).
    """
    values = {}
    for name, m in measures_of(task).items():
        value = tracker.values[name] / tracker.steps if m.how == "mean" else tracker.values[name]
        defined = (tracker.steps > 0.0) | (m.how in ("sum", "time"))
        scale = m.scale * task.robot.control_dt if m.how == "time" else m.scale
        values[name] = jnp.where(defined, value * scale, jnp.nan)
    return values | {"success": task.success(values).astype(jnp.float32)}


def episode_means(values: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Return the mean of every measure over the episodes in which it is defined.

    A measure that is defined in none is left out.
    """
    defined = {name: np.asarray(v)[~np.isnan(v)] for name, v in values.items()}
    return {name: float(v.mean()) for name, v in defined.items() if v.size}


def tracker_reset(task: Task, tracker: Tracker, done: jax.Array) -> Tracker:
    """Empty the measures of the worlds in ``done`` [N]."""
    empty = tracker_init(task, done.shape[0])
    return jax.tree.map(lambda new, old: jnp.where(done, new, old), empty, tracker)
