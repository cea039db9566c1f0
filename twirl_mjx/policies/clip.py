"""A source nobody trained: the feed-forward actions of a clip, played from where the robot is.

Inverse dynamics of the clip gives motor torques, and these the 20 Hz actions that come closest to
them through filter and PD motors (``motion.leap_checks.feed_forward``). Without feedback a leaping
robot leaves the motion within a cycle or two: as a policy that is poor, as experience of how a
leap feels it is worth a lot.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from twirl_mjx.motion.clip import Clip, sample
from twirl_mjx.motion.leap_checks import feed_forward, inverse_dynamics
from twirl_mjx.tasks.imitate import standing_time, to_heading

STILL = 0.1
"""m/s, a slower base belongs to a robot at rest, which joins the clip at ``standing_time``."""
SCALES = {"height": 0.03, "tilt": 0.1, "joint_pos": 0.3, "base_vel": 0.5, "joint_vel": 5.0}
"""Differences that count alike when the phase of a moving robot is looked for (m, 1, rad, m/s,
rad/s)."""


class ClipPolicy:
    """Plays a wrapping clip open loop; its memory is a clock [N] int32 in control steps."""

    def __init__(self, clip: Clip) -> None:
        """Solve for the actions of one cycle."""
        self.actions = feed_forward(clip, inverse_dynamics(clip))[0].astype(np.float32)
        """[K, A] in [-1, 1]."""
        self._step = clip.cycle_duration / len(self.actions)
        self._standing = round(standing_time(clip) / self._step)
        times = jnp.arange(len(self.actions), dtype=jnp.float32) * self._step
        self._features = np.asarray(jax.vmap(_features)(*_sample_all(clip, times)))

    def init(self, state: Any) -> jax.Array:
        """Return clocks [N] set to the phase the robots are in."""
        return jax.vmap(self.phase)(state.data.qpos, state.data.qvel)

    def phase(self, qpos: jax.Array, qvel: jax.Array) -> jax.Array:
        """Return the control step of the cycle (int32) that a state is nearest to."""
        error = jnp.sum(jnp.square(self._features - _features(qpos, qvel)), axis=-1)
        still = jnp.linalg.norm(qvel[:3]) < STILL
        return jnp.where(still, self._standing, jnp.argmin(error)).astype(jnp.int32)

    def act(self, memory: jax.Array, state: Any, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return actions [N, A] and the advanced clocks [N]."""
        del key
        clock = jnp.where(state.world.episode_step == 0, self.init(state), memory)
        return jnp.asarray(self.actions)[clock % len(self.actions)], clock + 1


def _sample_all(clip: Clip, times: jax.Array) -> tuple[jax.Array, jax.Array]:
    arrays = clip.to_arrays()
    return jax.vmap(lambda time: sample(arrays, time))(times)


def _features(qpos: jax.Array, qvel: jax.Array) -> jax.Array:
    """Return what tells the phase of a state, in units of ``SCALES``; place and heading do not."""
    parts = {
        "height": qpos[2:3],
        "tilt": to_heading(qpos[3:7], jnp.zeros(())),
        "joint_pos": qpos[7:],
        "base_vel": qvel[:3],
        "joint_vel": qvel[6:],
    }
    return jnp.concatenate([parts[name] / scale for name, scale in SCALES.items()])
