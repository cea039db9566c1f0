"""From a policy's action to joint torques: scaling, low-pass filter, motor model.

Paper, section "Actions": an action in [-1, 1]^12 is an offset around the default
pose, low-pass filtered as an absolute joint target, clipped to the joint limits and tracked by a
PD controller inside the physics engine.
"""

from __future__ import annotations

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from twirl_mjx.sim import a1
from twirl_mjx.sim.dynamics import Dynamics, Place

BUTTER_B = (0.20657208, 0.41314417, 0.20657208)
"""Numerator of ``scipy.signal.butter(2, 0.4)``: 2nd order, 4 Hz cut-off at fs = 20 Hz."""
BUTTER_A = (1.0, -0.36952738, 0.19581571)
"""Denominator of the same filter."""

AMBIENT_TEMPERATURE = 25.0
"""deg C, motor temperature without load."""
MAX_START_TEMPERATURE = 60.0
"""deg C, hottest motor at the start of an episode when the motors heat at all."""
DERATING_START = 60.0
"""deg C at which a motor's torque limit begins to fall."""
DERATING_END = 100.0
"""deg C at which the torque limit has fallen to ``DERATED_FRACTION``."""
DERATED_FRACTION = 0.4
"""Share of the torque limit left at and beyond ``DERATING_END``."""
COOLING_TIME = 60.0
"""s, time constant of cooling towards the ambient temperature."""


class FilterState(flax.struct.PyTreeNode):
    """Memory of the Butterworth filter of one world, joint targets in rad."""

    inputs: jax.Array
    """[2, 12] the last two inputs, newest first."""
    outputs: jax.Array
    """[2, 12] the last two outputs, newest first, before the joint-limit clip."""


class MotorState(flax.struct.PyTreeNode):
    """Condition of the 12 motors of one world (order FR FL RR RL x hip thigh calf)."""

    strength: jax.Array
    """[12] scale of gains and torque limit, constant within an episode."""
    temperature: jax.Array
    """[12] deg C."""


class MotorCommand(flax.struct.PyTreeNode):
    """What the physics engine is given for one control step of one world."""

    target: jax.Array
    """[12] rad, PD set-point."""
    kp: jax.Array
    """[12] N m / rad."""
    kd: jax.Array
    """[12] N m s / rad."""
    torque_limit: jax.Array
    """[12] N m."""
    late_targets: jax.Array | None = None
    """[S, 12] rad, PD set-point in every physics substep where targets come late."""


MOTOR_PLACES: dict[str, tuple[Place, ...]] = {
    "kp": (
        Place("actuator_gainprm", lambda _: np.s_[:, 0]),
        Place("actuator_biasprm", lambda _: np.s_[:, 1], lambda base, kp, scene, xp: -kp),
    ),
    "kd": (Place("actuator_biasprm", lambda _: np.s_[:, 2], lambda base, kd, scene, xp: -kd),),
    "torque_limit": (
        Place(
            "actuator_forcerange",
            None,
            lambda base, limit, scene, xp: xp.stack([-limit, limit], axis=-1),
        ),
    ),
}
"""Where the fields of a command go in a MuJoCo model."""


def filter_init(joint_pos: jax.Array) -> FilterState:
    """Start the filter at rest at ``joint_pos`` [12] rad."""
    both = jnp.stack([joint_pos, joint_pos])
    return FilterState(inputs=both, outputs=both)


def action_to_target(action: jax.Array) -> jax.Array:
    """Scale an action [..., 12] in [-1, 1] to an absolute joint target in rad, unfiltered."""
    return jnp.asarray(a1.DEFAULT_POSE, action.dtype) + action * jnp.asarray(
        a1.ACTION_HALF_RANGE, action.dtype
    )


def filter_step(state: FilterState, target: jax.Array) -> tuple[jax.Array, FilterState]:
    """Advance the low-pass filter by one control step.

    Args:
        state: Filter memory.
        target: [12] rad, unfiltered joint target.

    Returns:
        The filtered target [12] rad clipped to the joint limits, and the new memory.
    """
    x, y = state.inputs, state.outputs
    filtered = (
        BUTTER_B[0] * target
        + BUTTER_B[1] * x[0]
        + BUTTER_B[2] * x[1]
        - BUTTER_A[1] * y[0]
        - BUTTER_A[2] * y[1]
    )
    limits = jnp.asarray(a1.JOINT_LIMITS, target.dtype)
    new_state = FilterState(inputs=jnp.stack([target, x[0]]), outputs=jnp.stack([filtered, y[0]]))
    return jnp.clip(filtered, limits[:, 0], limits[:, 1]), new_state


def whole_motors() -> MotorState:
    """Return motors of full strength without load."""
    return MotorState(
        strength=jnp.ones(a1.NUM_JOINTS),
        temperature=jnp.full(a1.NUM_JOINTS, AMBIENT_TEMPERATURE),
    )


def motor_init(key: jax.Array, dynamics: Dynamics) -> MotorState:
    """Draw the motors' condition for one episode.

    leg = U{FR, FL, RR, RL}; strength[leg] = U(leg_strength_min, 1), others 1;
    temperature = U(25, 60) deg C per motor where motors heat, else 25.
    """
    leg_key, strength_key, heat_key = jax.random.split(key, 3)
    leg = jax.random.randint(leg_key, (), 0, 4)
    low = dynamics.leg_strength_min
    strength = low + (1.0 - low) * jax.random.uniform(strength_key)
    weak = jnp.repeat(jnp.arange(4) == leg, 3)
    spread = MAX_START_TEMPERATURE - AMBIENT_TEMPERATURE
    warm = jax.random.uniform(heat_key, (12,)) * spread * (dynamics.heat_rate > 0.0)
    return MotorState(
        strength=jnp.where(weak, strength, 1.0), temperature=AMBIENT_TEMPERATURE + warm
    )


def derating(temperature: jax.Array) -> jax.Array:
    """Return the share of the torque limit available at a motor temperature [...] in deg C."""
    excess = (temperature - DERATING_START) / (DERATING_END - DERATING_START)
    return 1.0 - (1.0 - DERATED_FRACTION) * jnp.clip(excess, 0.0, 1.0)


def motor_command(motors: MotorState, target: jax.Array, dynamics: Dynamics) -> MotorCommand:
    """Return gains and torque limits for one control step towards ``target`` [12] rad."""

    def scaled(value: float, name: str) -> jax.Array:
        scale = getattr(dynamics, name)
        whole = value * motors.strength
        return whole if scale is None else whole * scale

    return MotorCommand(
        target=target,
        kp=scaled(a1.KP, "kp_scale"),
        kd=scaled(a1.KD, "kd_scale"),
        torque_limit=scaled(a1.TORQUE_LIMIT, "motor_strength") * derating(motors.temperature),
    )


def delay(
    command: MotorCommand, previous: jax.Array, dynamics: Dynamics, sim_dt: float, n_substeps: int
) -> MotorCommand:
    """Return the command with the last target still holding for the time of ``latency``.

    Args:
        command: For one control step.
        previous: [12] rad, target of the control step before.
        dynamics: Scalars of one world; without latency the command is left alone.
        sim_dt: s, physics step, to whole ones of which the latency is rounded.
        n_substeps: S, beyond which no latency reaches.
    """
    if dynamics.latency is None:
        return command
    late = jnp.arange(n_substeps) < jnp.round(dynamics.latency / sim_dt)
    return command.replace(late_targets=jnp.where(late[:, None], previous, command.target))


def pd_torque(command: MotorCommand, joint_pos: jax.Array, joint_vel: jax.Array) -> jax.Array:
    """Return the torques [..., 12] in N m the engine applies at the given joint state [..., 12].

    Of a command with late targets, the joint states are those of its substeps [S, 12].
    """
    target = command.target if command.late_targets is None else command.late_targets
    raw = command.kp * (target - joint_pos) - command.kd * joint_vel
    return jnp.clip(raw, -command.torque_limit, command.torque_limit)


def motor_heat(motors: MotorState, dynamics: Dynamics, torque: jax.Array, dt: float) -> MotorState:
    """Advance the motor temperatures by one control step.

    dT/dt = heat_rate * mean(torque^2) - (T - ambient) / COOLING_TIME; without heating the
    temperature is left alone.

    Args:
        motors: Present condition.
        dynamics: Scalars of one world.
        torque: [S, 12] N m at every physics substep.
        dt: s, control step.
    """
    gain = dynamics.heat_rate * jnp.mean(torque**2, axis=0)
    cooling = (motors.temperature - AMBIENT_TEMPERATURE) / COOLING_TIME
    rate = jnp.where(dynamics.heat_rate > 0.0, gain - cooling, 0.0)
    return motors.replace(temperature=motors.temperature + dt * rate)
