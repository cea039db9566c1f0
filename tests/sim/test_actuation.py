"""Action scaling, the 4 Hz low-pass and the motor model, against scipy and by hand."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import signal

from twirl_mjx.sim import actuation
from twirl_mjx.sim.actuation import MotorCommand, MotorState
from twirl_mjx.sim.dynamics import Dynamics, make_dynamics
from twirl_mjx.sim.robots import A1

CUTOFF = 4.0 / (20.0 / 2)  # 4 Hz at a control rate of 20 Hz, as a share of the Nyquist frequency


def run_filter(start: np.ndarray, targets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the clipped outputs [T, 12] and the filter's own outputs [T, 12]."""

    def step(
        state: actuation.FilterState, target: jax.Array
    ) -> tuple[actuation.FilterState, tuple[jax.Array, jax.Array]]:
        clipped, state = actuation.filter_step(A1, state, target)
        return state, (clipped, state.outputs[0])

    first = actuation.filter_init(jnp.asarray(start, jnp.float32))
    _, out = jax.lax.scan(step, first, jnp.asarray(targets, jnp.float32))
    return np.asarray(out[0]), np.asarray(out[1])


def scipy_filter(start: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Return lfilter's output [T, 12] when all inputs and outputs before were ``start`` [12]."""
    b, a = signal.butter(2, CUTOFF)
    initial = np.stack([signal.lfiltic(b, a, [q, q], [q, q]) for q in start], axis=-1)
    return signal.lfilter(b, a, targets, axis=0, zi=initial)[0]


def test_coefficients_are_scipy_s() -> None:
    b, a = signal.butter(2, 0.4)
    np.testing.assert_allclose(A1.lowpass[0], b, atol=5e-9)  # eight digits are written down
    np.testing.assert_allclose(A1.lowpass[1], a, atol=5e-9)


def test_filter_equals_lfilter() -> None:
    rng = np.random.default_rng(0)
    start = A1.default_pose + rng.uniform(-0.05, 0.05, 12)
    targets = A1.default_pose + A1.action_half_range * rng.uniform(-1, 1, (60, 12))
    clipped, raw = run_filter(start, targets)
    expected = scipy_filter(start, targets)
    assert (expected != np.clip(expected, *A1.joint_limits.T)).any()  # the clip is exercised
    np.testing.assert_allclose(raw, expected, atol=5e-6)
    np.testing.assert_allclose(clipped, np.clip(expected, *A1.joint_limits.T), atol=5e-6)


def test_filter_rests_and_settles() -> None:
    start = np.linspace(-0.5, 0.5, 12) + A1.default_pose
    _, raw = run_filter(start, np.tile(start, (20, 1)))
    np.testing.assert_allclose(raw, np.tile(start, (20, 1)), atol=1e-5)  # no jump at the start
    _, raw = run_filter(start, np.tile(A1.default_pose, (60, 1)))
    np.testing.assert_allclose(raw[-1], A1.default_pose, atol=1e-5)  # unit gain at rest


def test_first_filtered_step_by_hand() -> None:
    """From rest at 0, a unit step gives b0, then b0 + b1 - a1 b0."""
    _, raw = run_filter(np.zeros(12), np.ones((2, 12)))
    np.testing.assert_allclose(raw[0], 0.20657208, atol=1e-6)
    np.testing.assert_allclose(raw[1], 0.20657208 + 0.41314417 + 0.36952738 * 0.20657208, atol=1e-6)


@pytest.mark.parametrize(
    ("action", "hip", "thigh", "calf"),
    [(0.0, 0.0, 0.9, -1.8), (1.0, 0.6, 2.1, -0.6), (-1.0, -0.6, -0.3, -3.0), (0.5, 0.3, 1.5, -1.2)],
)
def test_action_scaling_by_hand(action: float, hip: float, thigh: float, calf: float) -> None:
    target = actuation.action_to_target(A1, jnp.full(12, action))
    np.testing.assert_allclose(target, np.tile([hip, thigh, calf], 4), atol=1e-6)


def test_target_is_clipped_to_joint_limits() -> None:
    clipped, raw = run_filter(A1.default_pose, np.tile(A1.default_pose - 1.2, (30, 1)))
    np.testing.assert_allclose(clipped[-1], np.tile([-0.80285, -0.3, -2.69653], 4), atol=1e-4)
    np.testing.assert_allclose(raw[-1], A1.default_pose - 1.2, atol=1e-4)  # memory is not clipped


def make_motors(strength: float = 1.0, temperature: float = 25.0) -> MotorState:
    return MotorState(strength=jnp.full(12, strength), temperature=jnp.full(12, temperature))


@pytest.mark.parametrize(
    ("temperature", "share"), [(25, 1.0), (60, 1.0), (70, 0.85), (80, 0.7), (100, 0.4), (150, 0.4)]
)
def test_derating_by_hand(temperature: float, share: float) -> None:
    np.testing.assert_allclose(actuation.derating(jnp.float32(temperature)), share, atol=1e-6)


def test_motor_command_by_hand() -> None:
    whole = actuation.motor_command(A1, make_motors(), jnp.zeros(12), make_dynamics())
    np.testing.assert_allclose(whole.kp, 60.0)
    np.testing.assert_allclose(whole.kd, 3.0)
    np.testing.assert_allclose(whole.torque_limit, 33.5)
    worn = actuation.motor_command(A1, make_motors(0.5, 80.0), jnp.zeros(12), make_dynamics())
    np.testing.assert_allclose(worn.kp, 30.0)  # heat takes torque, not gains
    np.testing.assert_allclose(worn.kd, 1.5)
    np.testing.assert_allclose(worn.torque_limit, 33.5 * 0.5 * 0.7, rtol=1e-6)


def test_scales_of_gains_and_limits_by_hand() -> None:
    """A motor at half strength and 80 deg C (70 %), under the world's own scales."""
    scales = make_dynamics(overrides={"motor_strength": 0.8, "kp_scale": 1.2, "kd_scale": 0.5})
    command = actuation.motor_command(A1, make_motors(0.5, 80.0), jnp.zeros(12), scales)
    np.testing.assert_allclose(command.kp, 60 * 0.5 * 1.2, rtol=1e-6)
    np.testing.assert_allclose(command.kd, 3 * 0.5 * 0.5, rtol=1e-6)
    np.testing.assert_allclose(command.torque_limit, 33.5 * 0.5 * 0.7 * 0.8, rtol=1e-6)


@pytest.mark.parametrize(
    ("latency", "late"), [(0.0, 0), (0.002, 0), (0.003, 1), (0.02, 4), (0.0349, 7), (0.05, 10)]
)
def test_latency_keeps_the_last_target_for_whole_substeps(latency: float, late: int) -> None:
    """Ten substeps of 5 ms; 2 ms round to none of them, 3 ms to one."""
    dynamics = make_dynamics().replace(latency=jnp.float32(latency))
    command = actuation.motor_command(A1, make_motors(), jnp.full(12, 0.1), dynamics)
    command = actuation.delay(command, jnp.full(12, 0.3), dynamics, 0.005, 10)
    expected = np.repeat([0.3] * late + [0.1] * (10 - late), 12).reshape(10, 12)
    np.testing.assert_allclose(command.late_targets, expected, rtol=1e-6)
    np.testing.assert_allclose(command.target, 0.1, rtol=1e-6)  # what holds in the end
    torque = actuation.pd_torque(command, jnp.zeros((10, 12)), jnp.zeros((10, 12)))
    np.testing.assert_allclose(torque, 60 * expected, rtol=1e-6)


def test_without_latency_a_command_is_left_alone() -> None:
    command = actuation.motor_command(A1, make_motors(), jnp.zeros(12), make_dynamics())
    assert actuation.delay(command, jnp.ones(12), make_dynamics(), 0.005, 10) is command


@pytest.mark.parametrize(
    ("strength", "error", "velocity", "torque"),
    [
        (1.0, 0.1, 1.0, 3.0),  # 60 * 0.1 - 3 * 1
        (0.5, 0.1, 1.0, 1.5),
        (1.0, 1.0, 0.0, 33.5),  # 60 > 33.5
        (0.5, 1.0, 0.0, 16.75),  # 30 > 16.75
        (1.0, -1.0, 2.0, -33.5),
        (1.0, 0.0, -2.0, 6.0),
    ],
)
def test_pd_torque_by_hand(strength: float, error: float, velocity: float, torque: float) -> None:
    command = actuation.motor_command(A1, make_motors(strength), jnp.full(12, 0.2), make_dynamics())
    result = actuation.pd_torque(command, jnp.full(12, 0.2 - error), jnp.full(12, velocity))
    np.testing.assert_allclose(result, torque, rtol=1e-5)


def test_smaller_limits_never_give_larger_torque() -> None:
    rng = np.random.default_rng(1)
    pos, vel = rng.standard_normal((2, 50, 12)).astype(np.float32)

    def torque(limit: float) -> np.ndarray:
        gains = {"kp": jnp.full(12, 60.0), "kd": jnp.full(12, 3.0)}
        command = MotorCommand(target=jnp.zeros(12), torque_limit=jnp.full(12, limit), **gains)
        return np.abs(actuation.pd_torque(command, jnp.asarray(pos), jnp.asarray(vel)))

    assert (torque(10.0) <= torque(33.5)).all()
    assert torque(10.0).max() == 10.0
    assert (torque(10.0) < torque(33.5)).mean() > 0.5


@jax.jit
def draw_motors(dynamics: Dynamics) -> MotorState:
    """Return the motors [4000] of as many episodes."""
    keys = jax.random.split(jax.random.key(5), 4000)
    return jax.vmap(actuation.motor_init, (0, None))(keys, dynamics)


def test_nominal_motors_are_whole_and_cold() -> None:
    motors = draw_motors(make_dynamics("none"))
    np.testing.assert_array_equal(motors.strength, np.ones((4000, 12)))
    np.testing.assert_array_equal(motors.temperature, np.full((4000, 12), 25.0))


def test_weakened_motors_by_distribution() -> None:
    """One leg is weak, any of the four alike, at U(0.5, 1); temperatures are U(25, 60) deg C."""
    motors = draw_motors(make_dynamics("weakened"))
    legs = np.asarray(motors.strength).reshape(-1, 4, 3)
    np.testing.assert_array_equal(legs.min(axis=2), legs.max(axis=2))  # a leg is weak as a whole
    weak = legs[:, :, 0] < 1.0
    np.testing.assert_array_equal(weak.sum(axis=1), 1)
    np.testing.assert_allclose(weak.mean(axis=0), 0.25, atol=0.03)
    strength = legs[:, :, 0][weak]
    assert 0.5 <= strength.min() < 0.51
    assert 0.99 < strength.max() < 1.0
    assert strength.mean() == pytest.approx(0.75, abs=0.01)
    temperature = np.asarray(motors.temperature)
    assert 25.0 <= temperature.min() < 25.1
    assert 59.9 < temperature.max() <= 60.0
    assert temperature.mean() == pytest.approx(42.5, abs=0.2)


def test_motors_heat_with_squared_torque() -> None:
    """50 deg C, torques 10 and 30 N m: 0.02 * (100 + 900) / 2 - 25 / 60 = 9.58333 K/s."""
    torque = jnp.stack([jnp.full(12, 10.0), jnp.full(12, -30.0)])
    motors = make_motors(temperature=50.0)
    hot = actuation.motor_heat(motors, make_dynamics("weakened"), torque, 0.05)
    np.testing.assert_allclose(hot.temperature, 50.0 + 0.05 * 9.583333, rtol=1e-6)
    still = actuation.motor_heat(motors, make_dynamics("weakened"), 0.0 * torque, 0.05)
    np.testing.assert_allclose(still.temperature, 50.0 - 0.05 * 25.0 / 60.0, rtol=1e-6)
    same = actuation.motor_heat(motors, make_dynamics("none"), torque, 0.05)
    np.testing.assert_array_equal(same.temperature, motors.temperature)
