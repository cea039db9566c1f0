"""What the worlds of a task would have shown and paid for a motion that was recorded elsewhere."""

from __future__ import annotations

import functools
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from twirl_mjx.sim import actuation, frames
from twirl_mjx.sim.engine import Trace
from twirl_mjx.tasks.base import World, make_view
from twirl_mjx.types import Transition
from twirl_mjx.worlds.vector import FAULTS, VectorEnv, in_full_precision

MOST_LANES = 64
"""Episodes that are judged side by side."""


class Motion(flax.struct.PyTreeNode):
    """Control steps of a recording, arrays [n, ...] with the episodes one after another."""

    qpos: Any
    """[n, 7 + J] before the step, in the world of the recording."""
    qvel: Any
    """[n, 6 + J]"""
    next_qpos: Any
    """[n, 7 + J] after it."""
    next_qvel: Any
    """[n, 6 + J]"""
    action: Any
    """[n, J] in [-1, 1]."""
    first: Any
    """[n] bool, an episode begins here."""
    goal: Any = None
    """[n, 2] m in the world of the recording, or None where the task draws it."""


class _Episode(flax.struct.PyTreeNode):
    """What one lane knows of the episode that it is in."""

    world: World
    target: jax.Array
    """[J] rad, where the motors were told to go."""
    place: jax.Array
    """[2] m, where the episode begins in the recording."""
    turn: jax.Array
    """[4] rotation from the recording to the task, about the vertical."""
    start: jax.Array
    """[2] m, where it begins in the task."""
    goes_on: jax.Array
    """bool, the task has not ended it."""


def judge(env: VectorEnv, key: jax.Array, motion: Motion) -> tuple[Transition, np.ndarray]:
    """Let a task observe and judge a recorded motion, as if its own robot had moved so.

    Every episode is moved to where the task starts its episodes, heading along x: on flat ground
    that changes nothing of the motion. Goal and course are drawn by the task, unless the motion
    has a goal. The task sees the end of every control step, not what lies between.

    Args:
        env: Worlds of the task, on flat ground; their number does not matter.
        key: Draws goals and courses.
        motion: n control steps.

    Returns:
        Transitions [n, ...] (numpy), and [n] bool, which of them happened before the task ended
        the episode.

    Raises:
        ValueError: The ground is not flat, or the task's numbers are not finite.
    """
    if env.scene.kind != "flat":
        raise ValueError(
            f"recorded states are judged on flat ground, these worlds are {env.scene.kind}"
            " (nearest: --shift none)"
        )
    place = _lanes(np.asarray(motion.first))
    lanes, length = place.max(axis=1) + 1
    padded = jax.tree.map(lambda x: _spread(np.asarray(x), place, lanes, length), motion)
    keys = jax.random.split(key, lanes)
    data, kept, fault = jax.device_get(jax.jit(functools.partial(_judge, env))(keys, padded))
    row = tuple(place)
    if (fault := fault[row][kept[row]]).any():
        raise ValueError(f"task {env.task.name} cannot judge the motion: {FAULTS[fault.max()]}")
    return jax.tree.map(lambda x: x[row], data), kept[row]


def _lanes(first: np.ndarray) -> np.ndarray:
    """Return [2, n] lane and place of every step: whole episodes, lanes about equally long."""
    begins = np.flatnonzero(first)
    lengths = np.diff(np.append(begins, len(first)))
    filled = np.zeros(np.clip(len(first) // lengths.max(), 1, MOST_LANES), int)
    place = np.empty((2, len(first)), int)
    for begin, length in zip(begins, lengths, strict=True):
        lane = int(filled.argmin())
        place[0, begin : begin + length] = lane
        place[1, begin : begin + length] = filled[lane] + np.arange(length)
        filled[lane] += length
    return place


def _spread(rows: np.ndarray, place: np.ndarray, lanes: int, length: int) -> jax.Array:
    """Return rows [n, ...] as [lanes, length, ...], the first row where there is none."""
    dtype = bool if rows.dtype == bool else np.float32
    out = np.broadcast_to(rows[0], (lanes, length, *rows.shape[1:])).astype(dtype)
    out[tuple(place)] = rows
    return jnp.asarray(out)


@in_full_precision
def _judge(env: VectorEnv, keys: jax.Array, motion: Motion) -> tuple[Transition, Any, Any]:
    def lane(key: jax.Array, steps: Motion) -> tuple[Transition, Any, Any]:
        first = jax.tree.map(lambda x: x[0], steps)
        episode = _begin(env, key, first)
        _, out = jax.lax.scan(functools.partial(_step, env), episode, steps)
        return out

    return jax.vmap(lane)(keys, motion)


def _step(env: VectorEnv, episode: _Episode, step: Motion) -> tuple[_Episode, tuple]:
    fresh = _begin(env, episode.world.key, step)
    episode = jax.tree.map(lambda new, old: jnp.where(step.first, new, old), fresh, episode)
    qpos, qvel = _moved(episode, step.qpos, step.qvel)
    world, observer = episode.world, env.task.observer
    obs = env.sense(world, observer.observe(world.memory, world.goal, qpos, qvel))
    world, command = env.command(world, episode.target, step.action)
    after, speed = _moved(episode, step.next_qpos, step.next_qvel)
    world, next_obs, outcome, fault = env.judge_world(
        world, command, Trace(after[None], speed[None])
    )
    data = Transition(obs, step.action, outcome.reward, outcome.terminated, next_obs)
    kept = episode.goes_on
    episode = episode.replace(
        world=world, target=command.target, goes_on=kept & ~outcome.terminated
    )
    return episode, (data, kept, fault)


def _begin(env: VectorEnv, key: jax.Array, step: Motion) -> _Episode:
    """Return an episode that begins with a step: the task's own start, in the recorded pose."""
    dynamics = jax.tree.map(lambda leaf: leaf[0], env.dynamics)
    qpos, _, world, _ = env.start_world(key, dynamics)
    episode = _Episode(
        world=world,
        target=step.qpos[7:],
        place=step.qpos[:2],
        turn=frames.from_yaw(-frames.yaw(step.qpos[3:7])),
        start=qpos[:2],
        goes_on=jnp.ones((), bool),
    )
    qpos, qvel = _moved(episode, step.qpos, step.qvel)
    world = world.replace(
        memory=env.task.observer.init(qpos, qvel), filter=actuation.filter_init(qpos[7:])
    )
    if step.goal is not None:
        # What a task remembers of the step before, its distance to the goal say, it remembers of
        # the pose in which the episode begins.
        world = world.replace(goal=_to_task(episode, jnp.append(step.goal, 0.0))[:2])
        view = make_view(env.scene, dynamics, qpos[None], qvel[None])
        world = world.replace(task=env.task.judge(world, view, env.scene).task)
    return episode.replace(world=world)


def _to_task(episode: _Episode, point: jax.Array) -> jax.Array:
    """Return a point [3] of the recording in the world of the task."""
    here = frames.rotate(episode.turn, point.at[:2].add(-episode.place))
    return here.at[:2].add(episode.start)


def _moved(episode: _Episode, qpos: jax.Array, qvel: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return a state of the recording in the world of the task."""
    quat = frames.multiply(episode.turn, qpos[3:7])
    speed = frames.rotate(episode.turn, qvel[:3])
    return (
        jnp.concatenate([_to_task(episode, qpos[:3]), quat, qpos[7:]]),
        jnp.concatenate([speed, qvel[3:]]),
    )
