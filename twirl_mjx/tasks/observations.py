"""What a policy sees: layout tables and observers.

An observer turns the physical state of one world into an observation and keeps the memory that
needs (a history, a phase clock). A task observes through one; a learned source policy brings the
observer of the task it was trained on into any other task.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from twirl_mjx.sim import frames
from twirl_mjx.sim.robot import ROOT_SIZE, Robot

HISTORY = 3
"""Control steps in the observation history, oldest first (paper, section "Observations")."""


class Entry(NamedTuple):
    """One row of an observation layout."""

    name: str
    size: int
    unit: str
    noise: float = 0.0
    """Standard deviation of the sensors' noise at ``Dynamics.obs_noise`` 1."""


def frame_layout(robot: Robot) -> tuple[Entry, ...]:
    """Return one step of the proprioceptive history (paper appendix; docs/decisions.md)."""
    return (
        Entry("roll_pitch", 2, "rad", 0.01),
        Entry("roll_pitch_rate_b", 2, "rad/s", 0.05),
        Entry("joint_pos", robot.num_joints, "rad", 0.005),
        Entry("base_displacement_w", 3, "m", 0.01),
        Entry("previous_action", robot.num_joints, "1"),
    )


def in_history(frame: tuple[Entry, ...]) -> tuple[Entry, ...]:
    """Return ``HISTORY`` steps of a frame's layout, named ``[-2]`` to ``[0]``."""
    steps = range(1 - HISTORY, 1)
    return tuple(e._replace(name=f"{e.name}[{step}]") for step in steps for e in frame)


def proprioceptive(robot: Robot, *, axes: bool) -> tuple[Entry, ...]:
    """Return the layout of hurdles (A1: 95 numbers), or with ``axes`` of stand and biped (101)."""
    goal = Entry("goal_displacement_w", 2, "m", 0.02)
    layout = (goal, *in_history(frame_layout(robot)))
    if not axes:
        return layout
    axis = Entry("base_x_axis_w", 3, "1", 0.01)
    return (*layout, axis, axis._replace(name="base_z_axis_w"))


def layout_slices(layout: tuple[Entry, ...]) -> dict[str, slice]:
    """Return where every entry of a layout lies in the observation."""
    slices, start = {}, 0
    for entry in layout:
        slices[entry.name] = slice(start, start + entry.size)
        start += entry.size
    return slices


def layout_size(layout: tuple[Entry, ...]) -> int:
    """Return the length of the observation."""
    return sum(entry.size for entry in layout)


def layout_noise(layout: tuple[Entry, ...]) -> np.ndarray:
    """Return the standard deviation [O] of the noise on every number of the observation."""
    return np.repeat([e.noise for e in layout], [e.size for e in layout]).astype(np.float32)


class Observer(Protocol):
    """Turns states of one world into observations; all methods are pure and vmappable."""

    layout: tuple[Entry, ...]

    def init(self, qpos: jax.Array, qvel: jax.Array) -> Any:
        """Return the memory of an episode that starts in this state."""
        ...

    def push(self, memory: Any, qpos: jax.Array, qvel: jax.Array, action: jax.Array) -> Any:
        """Return the memory after a control step: the new state and the action that led to it."""
        ...

    def observe(self, memory: Any, goal: jax.Array, qpos: jax.Array, qvel: jax.Array) -> jax.Array:
        """Return the observation [O] of the present state, which was pushed last."""
        ...


class HistoryMemory(flax.struct.PyTreeNode):
    """Memory of :class:`ProprioceptiveObserver`."""

    start_pos: jax.Array
    """[3] m, base position at the start of the episode, world frame."""
    history: jax.Array
    """[HISTORY, F] the last frames, oldest first."""


def proprioceptive_frame(
    qpos: jax.Array, qvel: jax.Array, start_pos: jax.Array, action: jax.Array
) -> jax.Array:
    """Return one step of the history [F] in the order of ``frame_layout``."""
    joints = qpos[ROOT_SIZE:]
    return jnp.concatenate(
        [frames.roll_pitch(qpos[3:7]), qvel[3:5], joints, qpos[:3] - start_pos, action]
    )


class ProprioceptiveObserver:
    """Goal displacement and a 3-step history; with the base axes for upright tasks."""

    def __init__(self, robot: Robot, *, axes: bool) -> None:
        """Choose the layout: with the base axes, or without."""
        self._axes = axes
        self.layout = proprioceptive(robot, axes=axes)

    def init(self, qpos: jax.Array, qvel: jax.Array) -> HistoryMemory:
        """Fill the history with the first state and no action."""
        frame = proprioceptive_frame(qpos, qvel, qpos[:3], jnp.zeros_like(qpos[ROOT_SIZE:]))
        return HistoryMemory(start_pos=qpos[:3], history=jnp.tile(frame, (HISTORY, 1)))

    def push(
        self, memory: HistoryMemory, qpos: jax.Array, qvel: jax.Array, action: jax.Array
    ) -> HistoryMemory:
        """Drop the oldest frame and append the newest."""
        frame = proprioceptive_frame(qpos, qvel, memory.start_pos, action)
        return memory.replace(history=jnp.concatenate([memory.history[1:], frame[None]]))

    def observe(
        self, memory: HistoryMemory, goal: jax.Array, qpos: jax.Array, qvel: jax.Array
    ) -> jax.Array:
        """Return the numbers [O] in the order of ``layout``."""
        del qvel
        parts = [goal - qpos[:2], memory.history.ravel()]
        if self._axes:
            x_axis, _, z_axis = frames.base_axes(qpos[3:7])
            parts += [x_axis, z_axis]
        return jnp.concatenate(parts)
