"""One policy across all dynamics conditions: one compiled call per kind of ground."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from twirl_mjx.evaluation.rollout import evaluate_policy
from twirl_mjx.sim.dynamics import stack
from twirl_mjx.sim.leaves import PAPER_SHIFTS, SceneKind, get_shift
from twirl_mjx.types import SourcePolicy
from twirl_mjx.worlds.config import WorldConfig
from twirl_mjx.worlds.make import make_env


def scenes_of(shifts: tuple[str, ...]) -> dict[SceneKind, list[str]]:
    """Group shifts by the ground they need."""
    groups: dict[SceneKind, list[str]] = {}
    for shift in shifts:
        groups.setdefault(get_shift(shift).scene, []).append(shift)
    return groups


def evaluate_shifts(
    config: WorldConfig,
    policy: SourcePolicy,
    *,
    episodes: int,
    seed: int,
    shifts: tuple[str, ...] = PAPER_SHIFTS,
    strength: float = 1.0,
) -> dict[str, dict[str, np.ndarray]]:
    """Evaluate a policy under several conditions on one course, the config's or the fixed one.

    Episode ``e`` of every condition starts from the same draws, so that conditions differ by
    their physics alone (and by the ground under the start).

    Args:
        config: Task and its options; its shift is ignored, and its course is fixed if ``auto``.
            What of the dynamics it sets by hand or draws holds in all conditions.
        policy: Any policy that acts in the task's worlds.
        episodes: E, episodes per condition.
        seed: Seed of the episodes.
        shifts: Names of the conditions.
        strength: Strength of every shift.

    Returns:
        Per shift, every measure as an array [E].
    """
    course = "fixed" if config.course == "auto" else config.course
    config = dataclasses.replace(config, course=course)
    found: dict[str, dict[str, np.ndarray]] = {}
    for kind, names in scenes_of(shifts).items():
        worlds = dataclasses.replace(config, shift=names[0], shift_strength=strength)
        env = make_env(worlds, num_envs=episodes * len(names), scene_kind=kind)
        dynamics = stack([config.make_dynamics(name, strength) for name in names], episodes)
        index = jnp.tile(jnp.arange(episodes), len(names))
        values = evaluate_policy(env, policy)(jax.random.key(seed), dynamics, index)
        for i, name in enumerate(names):
            part = slice(i * episodes, (i + 1) * episodes)
            found[name] = {k: v[part] for k, v in values.items()}
    return {name: found[name] for name in shifts}
