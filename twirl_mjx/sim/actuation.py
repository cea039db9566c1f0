"""From a policy's action to joint torques: scaling, low-pass filter, motor model.

Paper, section "Actions": an action in [-1, 1]^J is an offset around the default
pose, low-pass filtered as an absolute joint target, clipped to the joint limits and tracked by a
PD controller inside the physics engine.
"""

from __future__ import annotations

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from twirl_mjx.sim.dynamics import Dynamics
from twirl_mjx.sim.leaves import Place
from twirl_mjx.sim.robot import LEG_SIZE, NUM_LEGS, Robot

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
    """[2, J] the last two inputs, newest first."""
    outputs: jax.Array
    """[2, J] the last two outputs, newest first, before the joint-limit clip."""


class MotorState(flax.struct.PyTreeNode):
    """Condition of the J motors of one world, in the order of the robot's joints."""

    strength: jax.Array
    """[J] scale of gains and torque limit, constant within an episode."""
    temperature: jax.Array
    """[J] deg C."""


class MotorCommand(flax.struct.PyTreeNode):
    """What the physics engine is given for one control step of one world."""

    target: jax.Array
    """[J] rad, PD set-point."""
    kp: jax.Array
    """[J] N m / rad."""
    kd: jax.Array
    """[J] N m s / rad."""
    torque_limit: jax.Array
    """[J] N m."""
    late_targets: jax.Array | None = None
    """[S, J] rad, PD set-point in every physics substep where targets come late."""


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
    """Start the filter at rest at ``joint_pos`` [J] rad."""
    both = jnp.stack([joint_pos, joint_pos])
    return FilterState(inputs=both, outputs=both)


def action_to_target(robot: Robot, action: jax.Array) -> jax.Array:
    """Scale an action [..., J] in [-1, 1] to an absolute joint target in rad, unfiltered."""
    half_range = jnp.asarray(robot.action_half_range, action.dtype)
    return jnp.asarray(robot.default_pose, action.dtype) + action * half_range


def filter_step(
    robot: Robot, state: FilterState, target: jax.Array
) -> tuple[jax.Array, FilterState]:
    """Advance the low-pass filter by one control step.

    Args:
        robot: Whose filter and limits.
        state: Filter memory.
        target: [J] rad, unfiltered joint target.

    Returns:
        The filtered target [J] rad clipped to the joint limits, and the new memory.
    """
    x, y = state.inputs, state.outputs
    b, a = robot.lowpass
    filtered = b[0] * target + b[1] * x[0] + b[2] * x[1] - a[1] * y[0] - a[2] * y[1]
    limits = jnp.asarray(robot.joint_limits, target.dtype)
    new_state = FilterState(inputs=jnp.stack([target, x[0]]), outputs=jnp.stack([filtered, y[0]]))
    return jnp.clip(filtered, limits[:, 0], limits[:, 1]), new_state


def whole_motors(robot: Robot) -> MotorState:
    """Return motors of full strength without load."""
    return MotorState(
        strength=jnp.ones(robot.num_joints),
        temperature=jnp.full(robot.num_joints, AMBIENT_TEMPERATURE),
    )


def motor_init(key: jax.Array, dynamics: Dynamics) -> MotorState:
    """Draw the motors' condition for one episode.

    leg = U{0, 1, 2, 3}; strength[leg] = U(leg_strength_min, 1), others 1;
    temperature = U(25, 60) deg C per motor where motors heat, else 25.
    """
    leg_key, strength_key, heat_key = jax.random.split(key, 3)
    leg = jax.random.randint(leg_key, (), 0, NUM_LEGS)
    low = dynamics.leg_strength_min
    strength = low + (1.0 - low) * jax.random.uniform(strength_key)
    weak = jnp.repeat(jnp.arange(NUM_LEGS) == leg, LEG_SIZE)
    spread = MAX_START_TEMPERATURE - AMBIENT_TEMPERATURE
    warm = jax.random.uniform(heat_key, weak.shape) * spread * (dynamics.heat_rate > 0.0)
    return MotorState(
        strength=jnp.where(weak, strength, 1.0), temperature=AMBIENT_TEMPERATURE + warm
    )


def derating(temperature: jax.Array) -> jax.Array:
    """Return the share of the torque limit available at a motor temperature [...] in deg C."""
    excess = (temperature - DERATING_START) / (DERATING_END - DERATING_START)
    return 1.0 - (1.0 - DERATED_FRACTION) * jnp.clip(excess, 0.0, 1.0)


def motor_command(
    robot: Robot, motors: MotorState, target: jax.Array, dynamics: Dynamics
) -> MotorCommand:
    """Return gains and torque limits for one control step towards ``target`` [J] rad."""

    def scaled(value: np.ndarray, name: str) -> jax.Array:
        scale = getattr(dynamics, name)
        whole = jnp.asarray(value, jnp.float32) * motors.strength
        return whole if scale is None else whole * scale

    return MotorCommand(
        target=target,
        kp=scaled(robot.kp, "kp_scale"),
        kd=scaled(robot.kd, "kd_scale"),
        torque_limit=scaled(robot.torque_limit, "motor_strength") * derating(motors.temperature),
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
    """Return the torques [..., J] in N m the engine applies at the given joint state [..., J].

    Of a command with late targets, the joint states are those of its substeps [S, J].
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
        torque: [S, J] N m at every physics substep.
        dt: s, control step.
    """
    gain = dynamics.heat_rate * jnp.mean(torque**2, axis=0)
    cooling = (motors.temperature - AMBIENT_TEMPERATURE) / COOLING_TIME
    rate = jnp.where(dynamics.heat_rate > 0.0, gain - cooling, 0.0)
    return motors.replace(temperature=motors.temperature + dt * rate)
