"""Solve for a leap plan: bounded nonlinear least squares over the numbers of ``leap_plan``.

Every wish is a block of residuals: closing the cycle, staying inside leg, joint, torque and pitch
limits, and being gentle. Two blocks speak for the controller, which sets PD targets at 20 Hz
through a 4 Hz low-pass filter. The target that produces a torque exactly,
``q + (torque + kd dq) / kp``, must lie within the joint limits; and the periodic signal that gives
this target through filter and sample-and-hold must stay inside the action box, with little left
over that no signal can give.

Single shooting over a bound somersaults from a bad first guess. So the solver starts with a
fictitious pitch torque and a loosely closed cycle, and takes both away stage by stage.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import optimize

from twirl_mjx.motion.leap_config import ROBOT, LeapConfig
from twirl_mjx.motion.leap_plan import (
    INERTIA,
    SLACK_NODES,
    Layout,
    LeapMotion,
    make_layout,
    plan_motion,
)
from twirl_mjx.motion.planar import GRAVITY, PlanarModel, joint_torques

CONTROL_RATE = 20.0
"""Hz, of the policy (paper, section "Actions")."""
STAGES = (
    (3.0, 1e-3, 3.0, 60),
    (10.0, 1e-2, 3.0, 40),
    (30.0, 3e-2, 3.0, 30),
    (100.0, 0.1, 3.0, 30),
    (100.0, 0.3, 3.0, 30),
    (100.0, 1.0, 3.0, 30),
    (100.0, 3.0, 3.0, 30),
    (100.0, 3.0, 30.0, 60),
    (1000.0, 1000.0, 30.0, 40),
)
"""Weights of closing the cycle, of the fictitious torque and of friction; Gauss-Newton steps."""
WARM_STAGE = 6
"""Index of the first stage when the solver goes on from a given plan."""
LEG_LENGTHS = (0.115, 0.345)
"""m, wished range of hip-to-foot lengths, inside the joint limits' [0.088, 0.359]."""
CLOSURE_TOLERANCE = 1e-3
"""Largest cycle error (m, m/s, rad, rad/s) of an accepted solution."""
JOINT_ORDER = ("front thigh", "hind thigh", "front calf", "hind calf")
"""Rows of ``JointMotion``."""


@dataclass(frozen=True)
class JointMotion:
    """Joints of one leg of each pair, rows ``JOINT_ORDER``, all [..., 4, F+1]."""

    angle: np.ndarray
    """rad."""
    velocity: np.ndarray
    """rad/s."""
    accel: np.ndarray
    """rad/s^2."""
    torque: np.ndarray
    """N m, motor torque the motion needs."""
    target: np.ndarray
    """rad, PD target that produces the torque."""


def periodic_derivatives(
    values: np.ndarray, dt: float, gain: float = 0.0
) -> tuple[np.ndarray, ...]:
    """Return first and second central differences of [..., F+1] that grow by ``gain`` a cycle."""
    behind = np.concatenate([values[..., -2:-1] - gain, values[..., :-1]], axis=-1)
    ahead = np.concatenate([values[..., 1:], values[..., 1:2] + gain], axis=-1)
    return (ahead - behind) / (2 * dt), (ahead - 2 * values + behind) / dt**2


def joint_motion(config: LeapConfig, model: PlanarModel, motion: LeapMotion) -> JointMotion:
    """Return joint angles, their derivatives, torques by inverse dynamics, and PD targets."""
    dt, states = motion.dt, motion.states
    gains = (config.cycle_length, 0.0)
    linear = [
        np.moveaxis(
            periodic_derivatives(np.moveaxis(states.com[..., axis], -2, -1), dt, gains[axis])[1],
            -1,
            -2,
        )
        for axis in (0, 1)
    ]
    angular = periodic_derivatives(np.moveaxis(states.angle, -2, -1), dt)[1]
    torques = joint_torques(
        model,
        states,
        (np.stack(linear, axis=-1), np.moveaxis(angular, -1, -2)),
        (motion.force, motion.contact),
    )
    pose = motion.pose
    angle = np.moveaxis(np.concatenate([pose.thigh, pose.calf], axis=-1), -1, -2)
    velocity, accel = periodic_derivatives(angle, dt)
    torque = np.moveaxis(np.concatenate(torques, axis=-1), -1, -2) + model.armature * accel
    target = angle + (torque + ROBOT.kd[0] * velocity) / ROBOT.kp[0]
    return JointMotion(angle, velocity, accel, torque, target)


def filter_gains(count: int, duration: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the regularised inverse of the controller's low-pass per harmonic of the cycle.

    Only magnitudes matter: a policy that knows the phase can send its actions as early as needed.

    Args:
        count: Samples per cycle.
        duration: s.

    Returns:
        Gain from PD target to unfiltered target, and from PD target to the part reached.
    """
    frequency = np.fft.rfftfreq(count, duration / count)
    delay = np.exp(-2j * np.pi * np.minimum(frequency / CONTROL_RATE, 0.5))
    b, a = ROBOT.lowpass
    response = np.polyval(b[::-1], delay) / np.polyval(a[::-1], delay)
    magnitude = np.abs(response) * np.sinc(frequency / CONTROL_RATE)
    magnitude[frequency > 0.45 * CONTROL_RATE] = 0.0
    inverse = magnitude / (magnitude**2 + 0.02**2)
    return inverse, magnitude * inverse


def closure(config: LeapConfig, motion: LeapMotion) -> np.ndarray:
    """Return how far the cycle is from closing [..., 6]: x, z (m), v (m/s), pitch, its rate."""
    com, velocity = (x[..., -1, :] - x[..., 0, :] for x in (motion.com, motion.com_vel))
    turn = motion.pose.pitch[..., -1] - motion.pose.pitch[..., 0]
    spin = motion.moment[..., :-1].sum(axis=-1) * motion.dt / INERTIA
    return np.stack(
        [
            com[..., 0] - config.cycle_length,
            com[..., 1],
            velocity[..., 0],
            velocity[..., 1],
            turn,
            spin,
        ],
        axis=-1,
    )


def _above(value: float | np.ndarray, limit: float | np.ndarray) -> np.ndarray:
    return np.maximum(value - limit, 0.0)


def _outside(value: np.ndarray, low: float | np.ndarray, high: float | np.ndarray) -> np.ndarray:
    return _above(value, high) + _above(-value, -np.asarray(low))


def _per_joint(thigh: float, calf: float) -> np.ndarray:
    return np.array([thigh, thigh, calf, calf])[:, None]


def joint_residuals(
    config: LeapConfig, joints: JointMotion, gains: tuple[np.ndarray, np.ndarray]
) -> dict[str, np.ndarray]:
    """Return the residual blocks [..., *] about joints, torques and the controller."""
    angle, velocity, accel, torque, target = (
        x[..., :-1]
        for x in (joints.angle, joints.velocity, joints.accel, joints.torque, joints.target)
    )
    pose, half_range = ROBOT.default_pose[1:3], ROBOT.action_half_range[1:3]
    box = [_per_joint(*(pose + sign * half_range)) for sign in (-1, 1)]
    limits = ROBOT.joint_limits[1:3].T  # [low/high, thigh/calf]
    low = np.maximum(box[0], _per_joint(*limits[0]))
    high = np.minimum(box[1], _per_joint(*limits[1]))
    load = torque / ROBOT.torque_limit[0]
    spectrum = np.fft.rfft(target, axis=-1)
    unfiltered = np.fft.irfft(spectrum * gains[0], n=target.shape[-1], axis=-1)
    missed = target - np.fft.irfft(spectrum * gains[1], n=target.shape[-1], axis=-1)
    return {
        "angle": 20.0 * _outside(angle, low + 0.06, high - 0.06),
        "target": 10.0 * _outside(target, low, high),
        "torque": 0.7 * load,
        "torque limit": 5.0 * _above(np.abs(load), config.torque_share),
        "velocity": 0.03 * velocity,
        "velocity limit": 0.2 * _above(np.abs(velocity), 12.0),
        "acceleration": 0.0025 * accel,
        "action box": 3.0 * _outside(unfiltered, *box),
        "bandwidth": 3.0 * missed,
    }


def body_residuals(config: LeapConfig, mass: float, motion: LeapMotion) -> dict[str, np.ndarray]:
    """Return the residual blocks [..., *] about legs, feet, pitch and friction."""
    feet, knees = motion.feet[..., :-1, :, :], motion.states.knee[..., :-1, :, 1]
    bottom = feet[..., 1] - ROBOT.foot_radius
    weight = mass * GRAVITY
    # The middle of the leap is half-way between hind lift-off and hind landing.
    flight = 0.5 * config.flight_time * config.cycle_length / config.duration
    blocks = {
        "leg length": 300.0 * _outside(motion.leg_length[..., :-1, :], *LEG_LENGTHS),
        "knee height": 20.0 * _above(0.07, knees),
        "pitch": 5.0 * _above(np.abs(motion.pose.pitch[..., :-1]), config.max_pitch),
        "feet apart": 10.0 * _above(0.12, feet[..., 0, 0] - feet[..., 1, 0]),
        "friction": _above(
            np.abs(motion.force[..., :-1, :, 0]), config.friction * motion.force[..., :-1, :, 1]
        )
        / weight,
    }
    for cycle in (0, 1):
        away = np.abs(feet[..., 0] - flight - 0.17 - cycle * config.cycle_length)
        over = np.clip((0.5 * config.band_length + 0.06 - away) / 0.06, 0.0, 1.0)
        blocks[f"clearance {cycle}"] = 20.0 * over * _above(config.foot_clearance, bottom)
    return blocks


def residuals(
    config: LeapConfig,
    layout: Layout,
    model: PlanarModel,
    params: np.ndarray,
    weights: tuple[float, float, float],
    guess: LeapMotion | None = None,
) -> dict[str, np.ndarray]:
    """Return all residual blocks [..., *] of plans ``params`` [..., P].

    Args:
        config: Wishes.
        layout: Meaning of ``params``.
        model: Masses.
        params: [..., P].
        weights: Of closing the cycle, of the fictitious pitch torque and of friction.
        guess: Motion of a very near plan.
    """
    motion = plan_motion(config, layout, model, params, guess)
    gains = filter_gains(config.num_frames, config.duration)
    lead = params.shape[:-1]
    scale = 1.0 / np.sqrt(config.num_frames)
    blocks = joint_residuals(config, joint_motion(config, model, motion), gains)
    blocks |= body_residuals(config, model.mass, motion)
    blocks["friction"] = weights[2] * blocks["friction"]
    out = {name: scale * block.reshape(*lead, -1) for name, block in blocks.items()}
    # Ends count in the units of ``closure``, velocities a third.
    out["closure"] = weights[0] * closure(config, motion) * np.array([1, 1, 0.3, 0.3, 1, 0.3])
    out["slack"] = weights[1] * layout.get(params, "slack")
    for name in layout.stances:
        inner = layout.get(params, f"swing_z_{name}")[..., 1:-1]
        out[f"swing height {name}"] = 10.0 * _above(config.run_up_foot_height, inner)
        for axis in "xz":
            push = layout.get(params, f"push_{axis}_{name}")
            out[f"even push {axis} {name}"] = 0.03 * np.diff(push, axis=-1)
        out[f"small push {name}"] = 0.02 * layout.get(params, f"push_z_{name}")
    return out


def first_guess(config: LeapConfig, layout: Layout, model: PlanarModel) -> np.ndarray:
    """Return parameters [P] whose fictitious torque keeps the trunk level."""
    params = layout.start.copy()
    motion = plan_motion(config, layout, model, params)
    nodes = np.arange(SLACK_NODES) * config.duration / SLACK_NODES
    slack = -np.interp(nodes, motion.times, motion.moment)
    params[layout.index["slack"]] = np.clip(slack, -59.0, 59.0)
    return params


def solve_leap(
    config: LeapConfig,
    model: PlanarModel,
    progress: Callable[[str], None] | None = None,
    start: np.ndarray | None = None,
) -> tuple[LeapMotion, np.ndarray]:
    """Find a plan and return its motion (no leading axes) and its numbers [P].

    Args:
        config: Wishes.
        model: Masses.
        progress: Called with a line of text after every stage.
        start: [P] plan of a similar leap to go on from: the first stages are left out.

    Raises:
        RuntimeError: the solver's result does not close the cycle or leaves the legs' reach.
    """
    layout = make_layout(config)
    params = first_guess(config, layout, model) if start is None else start
    stages = STAGES if start is None else STAGES[WARM_STAGE:]
    for number, (close, slack, friction, steps) in enumerate(stages, 1):

        def stacked(
            values: np.ndarray,
            guess: LeapMotion | None = None,
            weights: tuple[float, float, float] = (close, slack, friction),
        ) -> np.ndarray:
            blocks = residuals(config, layout, model, values, weights, guess)
            return np.concatenate(list(blocks.values()), axis=-1)

        def jacobian(values: np.ndarray, of: Callable = stacked) -> np.ndarray:
            step = 1e-6
            guess = plan_motion(config, layout, model, values[None])
            probes = np.concatenate([values[None], values + step * np.eye(len(values))])
            rows = of(probes, guess)
            return ((rows[1:] - rows[:1]) / step).T

        result = optimize.least_squares(
            stacked,
            np.clip(params, layout.lower + 1e-9, layout.upper - 1e-9),
            jac=jacobian,  # pyright: ignore[reportArgumentType]
            bounds=(layout.lower, layout.upper),
            x_scale=layout.upper - layout.lower,
            max_nfev=steps,
        )
        params = result.x
        if progress is not None:
            progress(f"stage {number} of {len(stages)}: cost {result.cost:.4g}")
    motion = plan_motion(config, layout, model, params)
    gap = np.abs(closure(config, motion)).max()
    longest = float(motion.leg_length.max())
    if gap > CLOSURE_TOLERANCE or longest > 0.356 or motion.leg_length.min() < 0.1:
        raise RuntimeError(
            f"no leap found for {config}: cycle gap {gap:.2g} (allowed {CLOSURE_TOLERANCE}), leg "
            f"length {motion.leg_length.min():.3f} to {longest:.3f} m (allowed 0.1 to 0.356); "
            "try a shorter flight or another speed"
        )
    return motion, params
