"""Record the motion of a policy for pictures: one world, one episode."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from twirl_mjx.sim import look
from twirl_mjx.sim.engine import world_model
from twirl_mjx.sim.leaves import get_shift
from twirl_mjx.sim.robot import NUM_LEGS, Robot
from twirl_mjx.sim.scene import Bands, build_scene
from twirl_mjx.tasks.base import ground_at
from twirl_mjx.types import SourcePolicy
from twirl_mjx.worlds.config import WorldConfig
from twirl_mjx.worlds.make import make_env

BANDS_AHEAD = 4.0
"""m, bands are drawn up to this far beyond the farthest point of the way."""


@dataclasses.dataclass(frozen=True)
class Recording:
    """One episode of one world."""

    qpos: np.ndarray
    """[T, 7 + J] at the end of every control step; the last state before the episode ended."""
    goals: np.ndarray
    """[T, 3] m, on the ground."""
    reward: np.ndarray
    """[T]."""
    metrics: dict[str, np.ndarray]
    """Per-step task metrics, each [T]."""
    hurdles: tuple[float, ...]
    """x of the hurdle bands up to just beyond the way gone, m; empty in tasks without."""
    leg_strength: np.ndarray
    """[4] in [0, 1] of the episode, order ``robot.legs``."""
    robot: Robot
    """Who moves."""
    band_height: float = 0.0
    """m, of the hurdle bands."""


def record_episode(
    config: WorldConfig, policy: SourcePolicy, *, seed: int, steps: int | None = None
) -> Recording:
    """Roll one episode out.

    Args:
        config: Task, shift and options.
        policy: Any policy that acts in the task's worlds.
        seed: Seed of the episode.
        steps: Control steps at most; the episode length by default.
    """
    env = make_env(config, num_envs=1)
    reset_key, act_key = jax.random.split(jax.random.key(seed))
    state = jax.jit(env.reset)(reset_key)
    memory = policy.init(state)
    hurdles = env.task.bands(jax.tree.map(lambda leaf: leaf[0], state.world.task))
    strength = np.asarray(state.world.motors.strength[0]).reshape(NUM_LEGS, -1).min(axis=1)

    @jax.jit
    def step(state: Any, memory: Any, key: jax.Array) -> tuple[Any, Any]:
        action, memory = policy.act(memory, state, key)
        return env.step(state, action), memory

    @jax.jit
    def place(goal: jax.Array) -> jax.Array:
        dynamics = jax.tree.map(lambda leaf: leaf[0], env.dynamics)
        return jnp.append(goal, ground_at(env.scene, dynamics, goal))

    rows: list[tuple[np.ndarray, ...]] = []
    metrics: list[dict[str, np.ndarray]] = []
    keys = jax.random.split(act_key, steps or config.episode_length)
    for key in keys:
        goal = np.asarray(place(state.world.goal[0]))
        before = np.asarray(state.data.qpos[0])
        state, memory = step(state, memory, key)
        ended = bool(state.done[0])
        # After an auto-reset the data are those of the next episode.
        qpos = before if ended else np.asarray(state.data.qpos[0])
        rows.append((qpos, goal, np.asarray(state.reward[0])))
        metrics.append({k: np.asarray(v[0]) for k, v in state.metrics.items()})
        if ended:
            break
    qpos, goals, reward = (np.stack(column) for column in zip(*rows, strict=True))
    stacked = jax.tree.map(lambda *x: np.stack(x), *metrics)
    reached = hurdles[hurdles < qpos[:, 0].max() + BANDS_AHEAD]
    hurdles_reached = tuple(map(float, reached))
    return Recording(
        qpos,
        goals,
        reward,
        stacked,
        hurdles_reached,
        strength,
        env.scene.robot,
        env.task.band_height,
    )


def scene_model(config: WorldConfig, recording: Recording) -> mujoco.MjModel:
    """Return the model to draw an episode in: its ground, bands and colours."""
    dynamics = config.make_dynamics()
    bands = Bands(
        recording.hurdles,
        y=float(recording.qpos[0, 1]),
        height=recording.band_height,
        incline=float(dynamics.incline),
        bump_height=float(dynamics.bump_height),
    )
    scene = build_scene(
        get_shift(config.shift).scene, robot=recording.robot, bands=bands, meshes=True
    )
    model = world_model(scene, dynamics)
    look.paint(model, recording.robot, dynamics, recording.leg_strength)
    return model
