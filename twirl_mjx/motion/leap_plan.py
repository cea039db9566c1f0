"""From the numbers of a leap plan to the whole-body motion, in the sagittal plane.

A plan holds the timing and place of every stance, the ground forces in it (Bernstein polynomials
that vanish at both ends) and the swing paths. The motion follows without approximation of the
dynamics: forces integrate to the centre of mass (ballistic where there are none) and to the angular
momentum about it; the trunk's place and pitch are then those for which the articulated body, with
its feet where the plan wants them, has that centre of mass and that angular momentum.

All functions take parameter vectors [..., P] and vectorise over the leading axes.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import comb

import numpy as np

from twirl_mjx.motion import planar
from twirl_mjx.motion.leap_config import ROBOT, LeapConfig
from twirl_mjx.motion.planar import GRAVITY, LinkStates, PlanarModel, Pose

FORCE_NODES = 4
"""Inner control points of a ground force component (degree 5)."""
SWING_NODES = 4
"""Inner control points of a swing path component (degree 7, zero velocity at both ends)."""
SLACK_NODES = 40
"""Nodes of the fictitious pitch torque that the solver starts with and drives to zero."""
INERTIA = 0.33
"""kg m^2, rough pitch inertia of the robot: a unit for angular momentum, and a first guess."""
EFFECTIVE_INERTIA = 0.26
"""kg m^2, gain of the fixed-point iteration of the pitch rate."""
SWEEPS = 10
"""Fixed-point iterations for the trunk's place and pitch."""
PAIRS = "FH"
"""Front and hind."""


@dataclass(frozen=True)
class Layout:
    """Names, places, first guess and bounds of the numbers of a plan."""

    index: dict[str, slice]
    """Where every variable lies in the parameter vector."""
    start: np.ndarray
    """[P] first guess."""
    lower: np.ndarray
    """[P]."""
    upper: np.ndarray
    """[P]."""
    bounds: int
    """Number of bounds in a cycle; each has one stance of both pairs."""

    def get(self, params: np.ndarray, name: str) -> np.ndarray:
        """Return a variable [..., n] of parameters [..., P]."""
        return params[..., self.index[name]]

    def scalar(self, params: np.ndarray, name: str) -> np.ndarray:
        """Return a scalar variable [...] of parameters [..., P]."""
        return self.get(params, name)[..., 0]

    @property
    def stances(self) -> list[str]:
        """Names of the stances in order: F1 H1 F2 H2 ..."""
        return [f"{pair}{i}" for i in range(1, self.bounds + 1) for pair in PAIRS]


def make_layout(config: LeapConfig) -> Layout:
    """Return the variables of a plan and their first guess: a pronk, front feet a little first."""
    bounds, duration, speed = (
        1 + config.run_up_strides,
        config.duration,
        config.cycle_length / config.duration,
    )
    rows: list[tuple[str, list[float], float, float]] = [
        ("height", [0.33], 0.25, 0.45),
        ("climb", [0.5 * GRAVITY * config.flight_time], 1.0, 2.7),
        ("speed", [speed], 0.6 * speed, 1.4 * speed),
        ("pitch", [0.0], -0.6, 0.3),
        ("pitch_rate", [0.0], -1.0, 4.0),
    ]
    period = (duration - config.flight_time) / bounds
    stay, lag = min(0.7 * period, 0.27), 0.04
    for i in range(1, bounds + 1):
        begin = config.flight_time + (i - 1) * period
        middle = speed * (begin + 0.5 * stay)
        if i > 1:
            rows.append((f"begin_F{i}", [begin], begin - 0.12, begin + 0.12))
        rows.append((f"stay_F{i}", [stay], 0.14, 0.36))
        if i < bounds:
            rows.append((f"begin_H{i}", [begin + lag], begin, begin + 0.2))
        last = duration - begin - lag
        rows.append((f"stay_H{i}", [stay if i < bounds else min(last, 0.3)], 0.14, 0.36))
        rows.append((f"place_F{i}", [middle + 0.2], middle - 0.2, middle + 0.5))
        rows.append((f"place_H{i}", [middle - 0.13], middle - 0.5, middle + 0.2))
    for name in (f"{pair}{i}" for i in range(1, bounds + 1) for pair in PAIRS):
        rows.append((f"push_z_{name}", [1.7] * FORCE_NODES, 0.0, 6.0))
        rows.append((f"push_x_{name}", [-0.5, -0.17, 0.17, 0.5], -3.0, 3.0))
        rows.append((f"swing_x_{name}", [0.25, 0.4, 0.6, 0.75], -0.3, 1.3))
        rows.append((f"swing_z_{name}", [0.08] * SWING_NODES, 0.0, 0.5))
    rows.append(("slack", [0.0] * SLACK_NODES, -60.0, 60.0))
    index, place = {}, 0
    for name, values, _, _ in rows:
        index[name] = slice(place, place + len(values))
        place += len(values)
    return Layout(
        index=index,
        start=np.concatenate([values for _, values, _, _ in rows]),
        lower=np.concatenate([[low] * len(values) for _, values, low, _ in rows]),
        upper=np.concatenate([[high] * len(values) for _, values, _, high in rows]),
        bounds=bounds,
    )


@dataclass(frozen=True)
class LeapMotion:
    """A planned cycle, frames 0..F at equal times; frame F is frame 0 of the next cycle."""

    times: np.ndarray
    """[F+1] s."""
    com: np.ndarray
    """[..., F+1, 2] m, centre of mass (x, z)."""
    com_vel: np.ndarray
    """[..., F+1, 2] m/s."""
    force: np.ndarray
    """[..., F+1, 2, 2] N, ground force (x, z) on the front and the hind pair."""
    feet: np.ndarray
    """[..., F+1, 2, 2] m, foot centres (x, z)."""
    contact: np.ndarray
    """[..., F+1, 2, 2] m, where the forces act: under the feet, on the ground."""
    pose: Pose
    """Trunk and joints."""
    states: LinkStates
    """Links."""
    leg_length: np.ndarray
    """[..., F+1, 2] m, hip to foot, before the IK's clip."""
    moment: np.ndarray
    """[..., F+1] N m, pitch moment of the forces about the centre of mass."""

    @property
    def dt(self) -> float:
        """Time between frames in s."""
        return float(self.times[1] - self.times[0])


def bernstein(share: np.ndarray, *controls: np.ndarray) -> np.ndarray:
    """Evaluate Bernstein polynomials with control points [..., n+1] at shares [..., F] in [0, 1].

    Returns:
        [..., F, k] values for k sets of control points.
    """
    degree = controls[0].shape[-1] - 1
    total = 0.0
    up, down = [np.ones_like(share)], [np.ones_like(share)]
    for _ in range(degree):
        up.append(up[-1] * share)
        down.append(down[-1] * (1.0 - share))
    for i in range(degree + 1):
        points = np.stack([control[..., i] for control in controls], axis=-1)[..., None, :]
        total = total + (comb(degree, i) * up[i] * down[degree - i])[..., None] * points
    return np.asarray(total)


def stance_times(
    config: LeapConfig, layout: Layout, params: np.ndarray
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return begin and duration [...] in s of every stance.

    The first front stance begins where the flight ends, the last hind stance ends at take-off.
    """
    times = {}
    for name in layout.stances:
        stay = layout.scalar(params, f"stay_{name}")
        if name == "F1":
            begin = np.full_like(stay, config.flight_time)
        elif name == f"H{layout.bounds}":
            begin = config.duration - stay
        else:
            begin = layout.scalar(params, f"begin_{name}")
        times[name] = (begin, stay)
    return times


def feet_and_forces(
    config: LeapConfig, layout: Layout, params: np.ndarray, weight: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return foot centres [..., F+1, 2, 2] m and ground forces, same shape, N.

    Args:
        config: Timing and length of the cycle.
        layout: Meaning of ``params``.
        params: [..., P].
        weight: N, the unit of the forces' control points.
    """
    grid = np.linspace(0.0, config.duration, config.num_frames + 1)
    shape = (*params.shape[:-1], len(grid), 2, 2)
    feet, force = np.zeros(shape), np.zeros(shape)
    zero = np.zeros((*params.shape[:-1], 1))
    times = stance_times(config, layout, params)
    for pair, letter in enumerate(PAIRS):
        names = [name for name in layout.stances if name[0] == letter]
        for name, after in zip(names, names[1:] + names[:1], strict=True):
            begin, stay = (value[..., None] for value in times[name])
            share = np.clip((grid - begin) / stay, 0.0, 1.0)
            pushes = [
                np.concatenate([zero, layout.get(params, f"push_{axis}_{name}"), zero], axis=-1)
                for axis in "xz"
            ]
            force[..., pair, :] += weight * bernstein(share, *pushes)
            wraps = after == names[0]
            lift = begin + stay
            land = times[after][0][..., None] + wraps * config.duration
            here = layout.get(params, f"place_{name}")
            there = layout.get(params, f"place_{after}") + wraps * config.cycle_length
            path = _swing_path(layout, params, name, here, there)
            for cycle in (0, 1) if wraps else (0,):  # a swing over the seam appears at both ends
                clock = grid + cycle * config.duration
                share = np.clip((clock - lift) / (land - lift), 0.0, 1.0)
                swinging = (clock > lift) & (clock < land)
                at = bernstein(share, *path)
                at[..., 0] -= cycle * config.cycle_length
                feet[..., pair, :] = np.where(swinging[..., None], at, feet[..., pair, :])
                standing = (clock >= begin - 1e-12) & (clock <= lift)
                stand = np.stack([here - cycle * config.cycle_length, zero + ROBOT.foot_radius], -1)
                feet[..., pair, :] = np.where(standing[..., None], stand, feet[..., pair, :])
    return feet, force


def _swing_path(
    layout: Layout, params: np.ndarray, name: str, here: np.ndarray, there: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the control points (x, z) [..., n+1] m of the swing that follows a stance."""
    forward = here + (there - here) * layout.get(params, f"swing_x_{name}")
    lift = ROBOT.foot_radius + layout.get(params, f"swing_z_{name}")
    ground = np.full_like(here, ROBOT.foot_radius)
    return (
        np.concatenate([here, here, forward, there, there], axis=-1),
        np.concatenate([ground, ground, lift, ground, ground], axis=-1),
    )


def _accumulate(start: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Return running sums [..., F+1, k] from ``start`` [..., k] over ``steps`` [..., F, k]."""
    return np.concatenate([start[..., None, :], start[..., None, :] + np.cumsum(steps, -2)], -2)


def plan_motion(
    config: LeapConfig,
    layout: Layout,
    model: PlanarModel,
    params: np.ndarray,
    guess: LeapMotion | None = None,
) -> LeapMotion:
    """Return the motion of plans ``params`` [..., P].

    Args:
        config: Timing and length of the cycle.
        layout: Meaning of ``params``.
        model: Masses.
        params: [..., P].
        guess: Motion of a very near plan, which saves half of the work.
    """
    times = np.linspace(0.0, config.duration, config.num_frames + 1)
    dt = times[1]
    feet, force = feet_and_forces(config, layout, params, model.mass * GRAVITY)
    accel = force.sum(axis=-2) / model.mass - np.array([0.0, GRAVITY])
    first = [layout.scalar(params, key) for key in ("speed", "climb")]
    velocity = _accumulate(np.stack(first, -1), 0.5 * dt * (accel[..., 1:, :] + accel[..., :-1, :]))
    height = layout.scalar(params, "height")
    moves = velocity[..., :-1, :] * dt + (2 * accel[..., :-1, :] + accel[..., 1:, :]) * dt**2 / 6
    com = _accumulate(np.stack([0 * height, height], axis=-1), moves)
    contact = feet * np.array([1.0, 0.0])
    moment = planar.cross(contact - com[..., None, :], force).sum(axis=-1)
    distance = np.abs(times[:, None] * SLACK_NODES / config.duration - np.arange(SLACK_NODES))
    hats = np.maximum(0.0, 1.0 - np.minimum(distance, SLACK_NODES - distance))
    moment = moment + layout.get(params, "slack") @ hats.T
    spin = INERTIA * layout.get(params, "pitch_rate") + dt * (
        np.cumsum(moment[..., :-1], axis=-1) - 0.5 * moment[..., :1]
    )
    pitch = layout.get(params, "pitch")
    if guess is None:
        root, rate, sweeps = com + np.array([0.0, 0.02]), spin / INERTIA, SWEEPS
    else:
        root, rate, sweeps = guess.pose.root, np.diff(guess.pose.pitch, axis=-1) / dt, SWEEPS // 2
    root, pitch = _trunk(model, feet, (com, spin), (root, pitch, rate), (dt, sweeps))
    thigh, calf, length = planar.leg_ik(root, pitch, feet)
    pose = Pose(root, pitch, thigh, calf)
    states = planar.link_states(model, pose)
    return LeapMotion(times, com, velocity, force, feet, contact, pose, states, length, moment)


def _trunk(
    model: PlanarModel,
    feet: np.ndarray,
    wanted: tuple[np.ndarray, np.ndarray],
    guess: tuple[np.ndarray, np.ndarray, np.ndarray],
    numbers: tuple[float, int],
) -> tuple[np.ndarray, np.ndarray]:
    """Find the trunk motion with a given centre of mass and angular momentum by fixed point.

    Args:
        model: Masses.
        feet: [..., F+1, 2, 2] m.
        wanted: Centre of mass [..., F+1, 2] m and angular momentum between the frames [..., F].
        guess: Trunk origin [..., F+1, 2] m; pitch of frame 0 [..., 1] rad, which is exact; pitch
            rates between the frames [..., F] rad/s.
        numbers: Frame duration in s and number of iterations.

    Returns:
        Trunk origin [..., F+1, 2] m and pitch [..., F+1] rad.
    """
    (com, spin), (root, pitch_start, rate), (dt, sweeps) = wanted, guess, numbers

    def integrate(rate: np.ndarray) -> np.ndarray:
        return np.concatenate([pitch_start, pitch_start + np.cumsum(rate * dt, axis=-1)], axis=-1)

    pitch = integrate(rate)
    for sweep in range(sweeps):
        thigh, calf, _ = planar.leg_ik(root, pitch, feet)
        states = planar.link_states(model, Pose(root, pitch, thigh, calf))
        root = root + 1.3 * (com - planar.centre_of_mass(model, states))
        if sweep >= 2 or sweeps < SWEEPS:  # from a rough guess let the place settle first
            momentum = planar.angular_momentum(model, states, dt)
            rate = rate + (spin - momentum) / EFFECTIVE_INERTIA
            pitch = integrate(rate)
    return root, pitch
