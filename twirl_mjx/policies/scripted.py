"""Source policies nobody trained: open-loop gaits with a phase clock, stillness and noise.

A gait is a table of one period. Foot paths (a half-ellipse swing, a flat stance) become joint
angles by closed-form leg kinematics, and the joint angles become actions by inverting the
command filter harmonic by harmonic: a periodic signal keeps its frequencies, so what comes out
of the filter is the wanted joint path itself, without lag.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from twirl_mjx.checks import check_choice
from twirl_mjx.sim import kinematics
from twirl_mjx.sim.robot import NUM_LEGS, Robot
from twirl_mjx.sim.robots import A1
from twirl_mjx.types import SourcePolicy

LEG_LENGTH = 0.4
"""m, thigh and calf of the robot whose gaits are written here; others take longer steps."""


@dataclasses.dataclass(frozen=True)
class Gait:
    """A periodic gait; legs in the order FR FL RR RL, hips in the order front, hind.

    Lengths are those of a robot with legs of ``LEG_LENGTH``.
    """

    period_steps: int
    """Control steps of one period."""
    offsets: tuple[float, float, float, float]
    """Phase offset of each leg in periods; a leg touches down when its phase passes 0."""
    duty: float
    """Share of the period a foot is on the ground."""
    stride: tuple[float, float]
    """Foot travel relative to the hip during stance, m."""
    lift: tuple[float, float]
    """Foot height at mid-swing over the stance line, m."""
    depth: tuple[float, float]
    """Distance of the stance line below the hip joint, m."""
    centre: tuple[float, float]
    """Foot position at mid-stance, ahead of the hip joint, m."""
    push: tuple[float, float] = (0.0, 0.0)
    """Extra leg extension at the end of stance, m (negative shortens the leg)."""
    ramp_steps: int = 10
    """Control steps over which the gait fades in from the zero action."""


TROT = Gait(
    period_steps=8,
    offsets=(0.0, 0.5, 0.5, 0.0),
    duty=0.447,
    stride=(0.167, 0.254),
    lift=(0.113, 0.079),
    depth=(0.3, 0.283),
    centre=(-0.004, -0.054),
    push=(0.008, -0.002),
)
"""Diagonal legs together, 2.5 Hz: 0.70 m/s on the nominal floor, upright on friction 0.4 too.

Found by random search in C MuJoCo; it drifts a few degrees in 10 s, as open loops do.
"""

BOUND = Gait(
    period_steps=10,
    offsets=(0.0, 0.0, 0.5, 0.5),
    duty=0.407,
    stride=(0.3, 0.3),
    lift=(0.055, 0.04),
    depth=(0.27, 0.242),
    centre=(0.016, -0.021),
    push=(0.016, -0.007),
)
"""Front legs, then hind legs, 2 Hz: 0.85 m/s on the nominal floor (same search)."""


def foot_path(gait: Gait, phase: np.ndarray, hind: int) -> tuple[np.ndarray, np.ndarray]:
    """Return foot x (forward) and z (up) relative to the hip joint, m.

    Args:
        gait: the gait.
        phase: [P] leg phase in [0, 1); stance comes first.
        hind: 0 for a front leg, 1 for a hind leg.
    """
    stance = np.clip(phase / gait.duty, 0.0, 1.0)
    swing = np.clip((phase - gait.duty) / (1.0 - gait.duty), 0.0, 1.0)
    in_swing = phase >= gait.duty
    reach = np.where(in_swing, -0.5 * np.cos(np.pi * swing), 0.5 - stance)
    x = gait.centre[hind] + gait.stride[hind] * reach
    height = np.where(
        in_swing,
        gait.lift[hind] * np.sin(np.pi * swing),
        -gait.push[hind] * np.sin(0.5 * np.pi * stance) ** 4,
    )
    return x, height - gait.depth[hind]


def unfilter(robot: Robot, targets: np.ndarray) -> np.ndarray:
    """Return the periodic command whose filtered form is ``targets`` [P, K].

    Harmonics that the filter passes at less than a quarter are left out: they would ask for
    commands of several times the motion.
    """
    period = len(targets)
    z = np.exp(-2j * np.pi * np.arange(period // 2 + 1) / period)
    b, a = robot.lowpass
    gain = np.polyval(b[::-1], z) / np.polyval(a[::-1], z)
    keep = np.abs(gain) >= 0.25
    spectrum = np.fft.rfft(targets, axis=0)
    command = np.where(keep[:, None], spectrum / np.where(keep, gain, 1.0)[:, None], 0.0)
    return np.fft.irfft(command, period, axis=0)


@functools.cache
def action_table(gait: Gait, robot: Robot = A1) -> np.ndarray:
    """Return one period of actions [P, A] float32 in [-1, 1].

    Raises:
        ValueError: a foot out of reach, or a joint path outside the action box.
    """
    feet = np.zeros((gait.period_steps, NUM_LEGS, 3))
    feet[:, :, 1] = robot.side_signs * robot.thigh_offset
    size = (robot.thigh_length + robot.calf_length) / LEG_LENGTH
    for leg, offset in zip(robot.corners, gait.offsets, strict=True):
        phase = (np.arange(gait.period_steps) / gait.period_steps + offset) % 1.0
        x, z = foot_path(gait, phase, int(leg in robot.hind_legs))
        feet[:, leg, 0], feet[:, leg, 2] = size * x, size * z
    joints = kinematics.leg_inverse(robot, feet + robot.hip_offsets)
    action = (unfilter(robot, joints) - robot.default_pose) / robot.action_half_range
    worst = np.abs(action).max()
    if worst > 1.0:
        raise ValueError(
            f"the gait needs actions up to {worst:.2f}, allowed are [-1, 1]: make it smaller"
        )
    return action.astype(np.float32)


@dataclasses.dataclass(frozen=True)
class GaitPolicy:
    """Plays a gait in every world; its memory is a clock [N] int32 in control steps."""

    gait: Gait
    """The gait."""
    robot: Robot = A1
    """Whose legs play it."""

    def init(self, state: Any) -> jax.Array:
        """Return stopped clocks [N]."""
        return jnp.zeros(state.world.episode_step.shape, jnp.int32)

    def act(self, memory: jax.Array, state: Any, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return actions [N, A] and the advanced clocks [N]."""
        del key
        clock = jnp.where(state.world.episode_step == 0, 0, memory)
        table = jnp.asarray(action_table(self.gait, self.robot))
        fade = jnp.minimum(clock.astype(jnp.float32) / max(self.gait.ramp_steps, 1), 1.0)
        return table[clock % self.gait.period_steps] * fade[..., None], clock + 1


@dataclasses.dataclass(frozen=True)
class ZeroPolicy:
    """Holds the default pose."""

    def init(self, state: Any) -> None:
        """Return no memory."""
        del state

    def act(self, memory: None, state: Any, key: jax.Array) -> tuple[jax.Array, None]:
        """Return zero actions [N, A]."""
        del key
        return jnp.zeros(state.world.action.shape, jnp.float32), memory


@dataclasses.dataclass(frozen=True)
class RandomPolicy:
    """Draws every action component from U(-1, 1)."""

    def init(self, state: Any) -> None:
        """Return no memory."""
        del state

    def act(self, memory: None, state: Any, key: jax.Array) -> tuple[jax.Array, None]:
        """Return random actions [N, A]."""
        return jax.random.uniform(key, state.world.action.shape, jnp.float32, -1.0, 1.0), memory


SCRIPTED: dict[str, Callable[[Robot], SourcePolicy]] = {
    "trot": functools.partial(GaitPolicy, TROT),
    "bound": functools.partial(GaitPolicy, BOUND),
    "zero": lambda robot: ZeroPolicy(),
    "random": lambda robot: RandomPolicy(),
}
"""Scripted source policies of a robot, by name."""


def get_scripted(name: str, robot: Robot = A1) -> SourcePolicy:
    """Return a scripted source policy of a robot.

    Raises:
        ValueError: unknown name; the message gives the closest one.
    """
    check_choice("scripted policy", name, tuple(SCRIPTED))
    return SCRIPTED[name](robot)
