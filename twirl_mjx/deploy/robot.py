"""The rehearsal's robot: physics model, motors, command filter, sensors and contacts.

Numbers are written out here once more on purpose: a rehearsal shares no code with the training
simulation, only the robot's MJCF file.
"""

from __future__ import annotations

import dataclasses
from typing import Literal

import mujoco
import numpy as np

from twirl_mjx.assets import asset_path
from twirl_mjx.deploy.reference import FALL_PARTS, Reading, quaternion_matrix

CONTROL_HZ = 20
POSE = np.tile([0.0, 0.9, -1.8], 4)
SWING = np.tile([0.6, 1.2, 1.2], 4)
LOWER = np.tile([-0.802851455917, -1.0471975512, -2.69653369433], 4)
UPPER = np.tile([0.802851455917, 4.18879020479, -0.916297857297], 4)
BAND_HALF_SIZE = (0.1, 20.0, 0.005)
"""m, half extents of a hurdle band: 0.2 m long, endless for the robot, 0.01 m tall."""


@dataclasses.dataclass(frozen=True)
class RehearsalConfig:
    """How far the rehearsal is from the ideal loop; the defaults are like the real robot's."""

    sim_dt: float = 0.001
    """Physics step, s; the control step of 0.05 s must be a multiple of it."""
    latency_ms: float = 15.0
    """Time from reading the sensors to the motors' new targets, ms."""
    orientation_noise: float = 0.01
    """Standard deviation of the measured orientation per axis, rad."""
    rate_noise: float = 0.05
    """Standard deviation of the measured angular velocity, rad/s."""
    joint_noise: float = 0.005
    """Standard deviation of the measured joint angles, rad."""
    position_noise: float = 0.005
    """Standard deviation of the estimated base position per reading, m."""
    position_drift: float = 0.01
    """Random walk of the estimated base position, m per square root of a second."""
    torque_limit: float = 33.5
    """Motor torque limit, N m (URDF)."""
    full_torque_speed: float = 10.5
    """Joint speed up to which the full torque is available, rad/s; half the no-load speed."""
    no_load_speed: float = 21.0
    """Joint speed at which no torque is left to accelerate further, rad/s (URDF)."""
    kp: float = 60.0
    """Position gain, N m/rad."""
    kd: float = 3.0
    """Velocity gain, N m s/rad."""
    friction: float = 1.0
    """Friction coefficient between feet and ground."""
    episode_s: float = 20.0
    """Length of an episode, s."""
    goal_distance: float | None = 1.0
    """Distance of the biped's goal, m, in a random direction; ``None`` draws it as in training."""
    hurdle_gap: float | None = None
    """Distance between hurdles, m; ``None`` draws every gap from U(1.6, 2.6) m."""
    height_of: Literal["root", "front_feet"] = "front_feet"
    """Height that ``stand`` rewards."""

    def __post_init__(self) -> None:
        """Check the steps and ranges."""
        steps = 1.0 / (CONTROL_HZ * self.sim_dt) if self.sim_dt > 0.0 else 0.0
        if steps < 1.0 or abs(steps - round(steps)) > 1e-6:
            nearest = 1.0 / (CONTROL_HZ * max(1, round(steps or 50.0)))
            raise ValueError(
                f"sim_dt {self.sim_dt} s does not divide the control step of 0.05 s (nearest:"
                f" {nearest:.6g})"
            )
        if not 0.0 <= self.latency_ms <= 200.0:
            raise ValueError(f"latency_ms must be in [0, 200], got {self.latency_ms}")
        if not 0.0 <= self.full_torque_speed < self.no_load_speed:
            raise ValueError(
                f"full_torque_speed {self.full_torque_speed} rad/s must be at least 0 and below "
                f"no_load_speed {self.no_load_speed} rad/s"
            )
        for name in (f.name for f in dataclasses.fields(self) if f.name.endswith("_noise")):
            if getattr(self, name) < 0.0:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}")

    @property
    def n_substeps(self) -> int:
        """Physics steps per control step."""
        return round(1.0 / (CONTROL_HZ * self.sim_dt))

    @property
    def latency_steps(self) -> int:
        """Latency in physics steps, rounded."""
        return round(0.001 * self.latency_ms / self.sim_dt)


IDEAL = RehearsalConfig(
    latency_ms=0.0,
    orientation_noise=0.0,
    rate_noise=0.0,
    joint_noise=0.0,
    position_noise=0.0,
    position_drift=0.0,
    full_torque_speed=1e6,
    no_load_speed=2e6,
    goal_distance=None,
)
"""No latency, no noise, torque limit only: the training task in C MuJoCo at 1 ms."""


def build_model(config: RehearsalConfig, hurdles: np.ndarray) -> mujoco.MjModel:
    """Compile robot, floor and hurdle bands; the actuators become plain torque motors.

    Args:
        config: physics step and friction.
        hurdles: [K] m, x of the band centres.
    """
    spec = mujoco.MjSpec.from_file(str(asset_path("a1", "a1.xml")))
    spec.option.timestep = config.sim_dt
    spec.option.iterations, spec.option.ls_iterations = 50, 50
    for geom in spec.geoms:
        if geom.name.endswith(("_collision", "_foot")):
            geom.conaffinity = 1
    ground = {"contype": 1, "conaffinity": 0, "priority": 1}
    spec.worldbody.add_geom(
        name="floor",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[0, 0, 0.05],
        friction=[config.friction, 0.005, 0.0001],
        rgba=[0.78, 0.81, 0.84, 1.0],
        **ground,
    )
    for i, x in enumerate(hurdles):
        spec.worldbody.add_geom(
            name=f"hurdle_{i}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=list(BAND_HALF_SIZE),
            pos=[x, 0.0, BAND_HALF_SIZE[2]],
            rgba=[0.90, 0.33, 0.12, 1.0],
            **ground,
        )
    sun = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    spec.worldbody.add_light(pos=[0, 0, 5], dir=[0.2, 0.3, -1.0], type=sun, castshadow=True)
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.93, 0.96, 1.0],
        rgb2=[0.55, 0.66, 0.78],
        width=64,
        height=64,
    )
    model = spec.compile()
    model.actuator_gainprm[:], model.actuator_biasprm[:] = 0.0, 0.0
    model.actuator_gainprm[:, 0] = 1.0
    model.actuator_ctrllimited[:] = model.actuator_forcelimited[:] = 0
    return model


def motor_torque(
    config: RehearsalConfig, target: np.ndarray, joint_pos: np.ndarray, joint_vel: np.ndarray
) -> np.ndarray:
    """Return the torque of a PD law behind a torque-speed limit, N m [12].

    Up to ``full_torque_speed`` the motor gives its whole torque; from there the torque it can
    give in the direction of motion falls linearly to 0 at ``no_load_speed``. Braking is not
    weakened.

    Args:
        config: gains and limits.
        target: [12] rad.
        joint_pos: [12] rad.
        joint_vel: [12] rad/s.
    """
    span = config.no_load_speed - config.full_torque_speed
    up = config.torque_limit * np.clip((config.no_load_speed - joint_vel) / span, 0.0, 1.0)
    down = config.torque_limit * np.clip((config.no_load_speed + joint_vel) / span, 0.0, 1.0)
    return np.clip(config.kp * (target - joint_pos) - config.kd * joint_vel, -down, up)


class CommandFilter:
    """The 4 Hz second-order Butterworth low-pass on absolute joint targets, at 20 Hz."""

    def __init__(self, joint_pos: np.ndarray) -> None:
        """Start at rest at ``joint_pos`` [12] rad."""
        from scipy.signal import butter

        self._b, self._a = np.asarray(butter(2, 4.0, fs=CONTROL_HZ))
        self._in, self._out = [joint_pos.copy()] * 2, [joint_pos.copy()] * 2

    def __call__(self, action: np.ndarray) -> np.ndarray:
        """Return the joint target [12] rad for an action [12] in [-1, 1]."""
        new = POSE + SWING * np.clip(action, -1.0, 1.0)
        inputs, (b, a) = [new, *self._in], (self._b, self._a)
        forward = sum(k * x for k, x in zip(b, inputs, strict=True))
        out = forward - sum(k * y for k, y in zip(a[1:], self._out, strict=True))
        self._in, self._out = inputs[:2], [out, self._out[0]]
        return np.clip(out, LOWER, UPPER)


class Sensors:
    """Reads the simulated robot with noise and drift."""

    def __init__(self, config: RehearsalConfig, rng: np.random.Generator) -> None:
        self._config, self._rng = config, rng
        self._drift = np.zeros(3)

    def read(self, data: mujoco.MjData) -> Reading:
        """Return the reading of one control step."""
        c, normal = self._config, self._rng.standard_normal
        self._drift += c.position_drift / np.sqrt(CONTROL_HZ) * normal(3)
        turn = c.orientation_noise * normal(3)
        small = np.concatenate([[1.0], 0.5 * turn])
        tilt = quaternion_matrix(small / np.linalg.norm(small))
        return Reading(
            rotation=quaternion_matrix(data.qpos[3:7]) @ tilt,
            angular_velocity=data.qvel[3:6] + c.rate_noise * normal(3),
            joint_pos=data.qpos[7:19] + c.joint_noise * normal(12),
            position=data.qpos[:3] + self._drift + c.position_noise * normal(3),
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

    def cause(self, data: mujoco.MjData) -> str | None:
        """Return ``hurdle``, ``fall`` or, when the episode goes on, ``None``.

        The robot does not touch itself, so every contact has one geom of the ground.
        """
        pairs = data.contact.geom
        if not self._watched[pairs].any():
            return None
        if self._band[pairs].any():
            return "hurdle"
        return "fall"
