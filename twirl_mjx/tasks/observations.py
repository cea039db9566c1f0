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

HISTORY = 3
"""Control steps in the observation history, oldest first (paper, section "Observations")."""


class Entry(NamedTuple):
    """One row of an observation layout."""

    name: str
    size: int
    unit: str
    noise: float = 0.0
    """Standard deviation of the sensors' noise at ``Dynamics.obs_noise`` 1."""


FRAME: tuple[Entry, ...] = (
    Entry("roll_pitch", 2, "rad", 0.01),
    Entry("roll_pitch_rate_b", 2, "rad/s", 0.05),
    Entry("joint_pos", 12, "rad", 0.005),
    Entry("base_displacement_w", 3, "m", 0.01),
    Entry("previous_action", 12, "1"),
)
"""One step of the proprioceptive history (paper appendix; README, decisions 1 and 2)."""
FRAME_SIZE = sum(e.size for e in FRAME)

PROPRIOCEPTIVE: tuple[Entry, ...] = (
    Entry("goal_displacement_w", 2, "m", 0.02),
    *(e._replace(name=f"{e.name}[{i - HISTORY + 1}]") for i in range(HISTORY) for e in FRAME),
)
"""Layout of the hurdles observation, 95 numbers."""

UPRIGHT: tuple[Entry, ...] = (
    *PROPRIOCEPTIVE,
    Entry("base_x_axis_w", 3, "1", 0.01),
    Entry("base_z_axis_w", 3, "1", 0.01),
)
"""Layout of the stand and biped observation, 101 numbers."""


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
    """[3, 31] the last frames, oldest first."""


def proprioceptive_frame(
    qpos: jax.Array, qvel: jax.Array, start_pos: jax.Array, action: jax.Array
) -> jax.Array:
    """Return one step of the history [31] in the order of ``FRAME``."""
    return jnp.concatenate(
        [frames.roll_pitch(qpos[3:7]), qvel[3:5], qpos[7:19], qpos[:3] - start_pos, action]
    )


class ProprioceptiveObserver:
    """Goal displacement and a 3-step history; with the base axes for upright tasks."""

    def __init__(self, *, axes: bool) -> None:
        """Choose the layout: ``UPRIGHT`` with the base axes, else ``PROPRIOCEPTIVE``."""
        self._axes = axes
        self.layout = UPRIGHT if axes else PROPRIOCEPTIVE

    def init(self, qpos: jax.Array, qvel: jax.Array) -> HistoryMemory:
        """Fill the history with the first state and no action."""
        frame = proprioceptive_frame(qpos, qvel, qpos[:3], jnp.zeros(12, qpos.dtype))
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
        """Return [95] or [101] numbers in the order of ``layout``."""
        del qvel
        parts = [goal - qpos[:2], memory.history.ravel()]
        if self._axes:
            x_axis, _, z_axis = frames.base_axes(qpos[3:7])
            parts += [x_axis, z_axis]
        return jnp.concatenate(parts)
