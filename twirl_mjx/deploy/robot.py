"""The rehearsal's robot: motors, command filter, sensors and contacts.

Numbers are written out here once more on purpose: a rehearsal shares no code with the training
simulation, only the robot's MJCF file.
"""

from __future__ import annotations

from collections import deque

import mujoco
import numpy as np

from twirl_mjx.deploy.conditions import CONTROL_HZ, RehearsalConfig
from twirl_mjx.deploy.reference import FALL_PARTS, IMITATE, Reading, quaternion_matrix

LEGS = ("FR", "FL", "RR", "RL")
POSE = np.tile([0.0, 0.9, -1.8], 4)
SWING = np.tile([0.6, 1.2, 1.2], 4)
LOWER = np.tile([-0.802851455917, -1.0471975512, -2.69653369433], 4)
KNEE_RADIUS = 0.015
"""m, of the calf at the knee."""
UPPER = np.tile([0.802851455917, 4.18879020479, -0.916297857297], 4)


def motor_shares(config: RehearsalConfig) -> np.ndarray:
    """Return the share [12] of torque limit and gains that every motor has, order of the legs."""
    legs = [config.leg_strength if leg == config.weak_leg else 1.0 for leg in LEGS]
    return np.repeat(legs, 3)


def motor_torque(
    config: RehearsalConfig,
    target: np.ndarray,
    seen_pos: np.ndarray,
    seen_vel: np.ndarray,
    joint_vel: np.ndarray,
    share: np.ndarray | float = 1.0,
) -> np.ndarray:
    """Return the torque of a PD law behind a torque-speed limit, N m [12].

    Up to ``full_torque_speed`` the motor gives its whole torque; from there the torque it can
    give in the direction of motion falls linearly to 0 at ``no_load_speed``. Braking is not
    weakened.

    Args:
        config: gains and limits.
        target: [12] rad.
        seen_pos: [12] rad, what the encoders say.
        seen_vel: [12] rad/s, the same.
        joint_vel: [12] rad/s, at which the motors turn.
        share: [12] of gains and limits that a motor has.
    """
    span = config.no_load_speed - config.full_torque_speed
    up = config.torque_limit * np.clip((config.no_load_speed - joint_vel) / span, 0.0, 1.0)
    down = config.torque_limit * np.clip((config.no_load_speed + joint_vel) / span, 0.0, 1.0)
    return share * np.clip(config.kp * (target - seen_pos) - config.kd * seen_vel, -down, up)


class CommandFilter:
    """The 4 Hz second-order Butterworth low-pass on absolute joint targets, at 20 Hz."""

    def __init__(self, joint_pos: np.ndarray) -> None:
        """Start at rest at ``joint_pos`` [12] rad."""
        from scipy.signal import butter

        self.b, self.a = np.asarray(butter(2, 4.0, fs=CONTROL_HZ))
        self._in, self._out = [joint_pos.copy()] * 2, [joint_pos.copy()] * 2

    def __call__(self, action: np.ndarray) -> np.ndarray:
        """Return the joint target [12] rad for an action [12] in [-1, 1]."""
        new = POSE + SWING * np.clip(action, -1.0, 1.0)
        inputs, (b, a) = [new, *self._in], (self.b, self.a)
        forward = sum(k * x for k, x in zip(b, inputs, strict=True))
        out = forward - sum(k * y for k, y in zip(a[1:], self._out, strict=True))
        self._in, self._out = inputs[:2], [out, self._out[0]]
        return np.clip(out, LOWER, UPPER)


class Encoder:
    """Joint angles and speeds as the robot knows them: late, and the angles in steps."""

    def __init__(self, config: RehearsalConfig, data: mujoco.MjData) -> None:
        """Start as if the robot had always stood as it does in ``data``."""
        self._step, length = config.encoder_step, config.encoder_steps + 1
        self._queue = deque([self._sample(data)] * length, maxlen=length)

    def _sample(self, data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray]:
        angles = data.qpos[7:].copy()
        if self._step:
            angles = self._step * np.round(angles / self._step)
        return angles, data.qvel[6:].copy()

    def push(self, data: mujoco.MjData) -> None:
        """Take the state after one physics step."""
        self._queue.append(self._sample(data))

    def read(self) -> tuple[np.ndarray, np.ndarray]:
        """Return angles [12] rad and speeds [12] rad/s."""
        return self._queue[0]


class Sensors:
    """Reads the simulated robot with noise and drift."""

    def __init__(self, config: RehearsalConfig, rng: np.random.Generator) -> None:
        self.config, self._rng = config, rng
        self._more = rng.spawn(1)[0]  # what is drawn for foreign policies changes nothing else
        self._drift = np.zeros(3)

    def read(self, data: mujoco.MjData, encoder: Encoder) -> Reading:
        """Return the reading of one control step."""
        c, (joint_pos, joint_vel) = self.config, encoder.read()

        def normal(size: int) -> np.ndarray:
            return c.noise * self._rng.standard_normal(size)

        def more(size: int) -> np.ndarray:
            return c.noise * self._more.standard_normal(size)

        self._drift += c.position_drift / np.sqrt(CONTROL_HZ) * normal(3)
        turn = c.orientation_noise * normal(3)
        small = np.concatenate([[1.0], 0.5 * turn])
        tilt = quaternion_matrix(small / np.linalg.norm(small))
        return Reading(
            rotation=quaternion_matrix(data.qpos[3:7]) @ tilt,
            angular_velocity=data.qvel[3:6] + c.rate_noise * normal(3),
            joint_pos=joint_pos + c.joint_noise * normal(12),
            position=data.qpos[:3] + self._drift + c.position_noise * normal(3),
            velocity=data.qvel[:3] + c.velocity_noise * more(3),
            joint_vel=joint_vel + c.joint_velocity_noise * more(12),
        )


class Contacts:
    """Which parts of the robot may not touch the ground, and which touch a hurdle."""

    def __init__(self, model: mujoco.MjModel, task: str) -> None:
        names = [model.geom(i).name for i in range(model.ngeom)]
        self._fall = np.array(
            [n.endswith("_collision") and any(p in n for p in FALL_PARTS[task]) for n in names]
        )
        self._band = np.array([name.startswith("hurdle_") for name in names])
        self._watched = self._fall | self._band
        knees = range(model.nbody) if task == IMITATE else ()
        self._knees = [i for i in knees if model.body(i).name.endswith("_calf")]

    def cause(self, data: mujoco.MjData) -> str | None:
        """Return ``hurdle``, ``fall`` or, when the episode goes on, ``None``.

        The robot does not touch itself, so every contact has one geom of the ground.
        """
        if self._knees and data.xpos[self._knees, 2].min() <= KNEE_RADIUS:
            return "fall"
        pairs = data.contact.geom
        if not self._watched[pairs].any():
            return None
        if self._band[pairs].any():
            return "hurdle"
        return "fall"
