"""Learning curves with the plain, the fast and the bfloat16 form of the learner, at equal updates.

All forms train the same seeds of one preset for the same transitions. They draw other random
numbers (dropout bits above all) or round otherwise, so the curves of one seed part after a while;
what must agree is where the seeds of a form and those of the plain one lie.
"""

from __future__ import annotations

import time

import jax
import numpy as np

from twirl_mjx.bench.measure import Record, machine, progress
from twirl_mjx.bench.options import QUARTERS, FormsBench
from twirl_mjx.training import seeds
from twirl_mjx.worlds.make import make_env


def returns_of(options: FormsBench, form: str) -> tuple[np.ndarray, int, float]:
    """Train all seeds with one form.

    Returns:
        Mean episode returns [epochs, seeds] (NaN where no episode ended), the critic updates of
        each seed, and the seconds it took.
    """
    config = options.config(form)
    env = make_env(config)
    states = seeds.init_seeds(config, env, range(options.seeds), None)
    epoch = seeds.compile_epoch_seeds(config, env)
    epochs = options.env_steps // (config.steps_per_epoch * env.num_envs)
    began, rows = time.perf_counter(), []
    for number in range(epochs):
        states, metrics = epoch(states)
        rows.append(np.asarray(metrics["return"]))
        progress(
            f"bench forms: {form}, epoch {number + 1} of {epochs}, return {rows[-1].mean():.1f}"
        )
    updates = int(np.asarray(jax.device_get(states.learner.grad_steps))[0])
    return np.stack(rows), updates, time.perf_counter() - began


def overlap(a: np.ndarray, b: np.ndarray) -> bool:
    """Return whether the ranges of two sets of numbers have a point in common."""
    return bool(a.min() <= b.max() and b.min() <= a.max())


def measure(options: FormsBench) -> Record:
    """Train with all forms; compare every quarter of the run."""
    record_machine = machine()
    found = {form: returns_of(options, form) for form in ("plain", *options.forms)}
    quarters = []
    for number in range(QUARTERS):
        parts = {
            form: np.nanmean(np.array_split(rows, QUARTERS)[number], axis=0)
            for form, (rows, _, _) in found.items()
        }
        quarters.append(
            {form: part.tolist() for form, part in parts.items()}
            | {"overlap": {form: overlap(parts[form], parts["plain"]) for form in parts}}
        )
    return {
        "part": "forms",
        "task": options.task,
        "preset": options.preset,
        "seeds": options.seeds,
        "env_steps": options.env_steps,
        "critic_updates": found["plain"][1],
        "quarters": quarters,
        "wall_s": {form: wall for form, (_, _, wall) in found.items()},
        "returns": {form: rows.tolist() for form, (rows, _, _) in found.items()},
        "machine": record_machine,
    }
