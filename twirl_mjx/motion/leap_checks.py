"""Proof that a clip is a leap its robot can do: kinematics, hurdle clearance, dynamics, motors.

Torques come from inverse dynamics in C MuJoCo (``mj_inverse`` without contacts): the wrench that
the trunk lacks is distributed over the standing feet by non-negative least squares on the edges of
their friction pyramids (with a small preference for small forces), and the joint torques are what
remains after these forces. What cannot be distributed is reported as the unexplained wrench: a
motion that floats, slips or spins in the air against physics shows up there.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from scipy import optimize

from twirl_mjx.motion.clip import Clip, configurations, frame_velocities
from twirl_mjx.motion.formats import foot_paths
from twirl_mjx.motion.leap_solver import CONTROL_RATE
from twirl_mjx.sim.mjcf import robot_model
from twirl_mjx.sim.robot import Robot

BAND_LENGTH, BAND_HEIGHT = 0.2, 0.01
"""m, hurdle band (paper appendix)."""
CONTACT_HEIGHT = 2e-5
"""m, a foot lower than this stands."""
MARGIN_CAP = 0.15
"""m, largest hurdle clearance that is measured."""
GRAVITY = 9.81
"""m/s^2."""


@dataclass(frozen=True)
class Finding:
    """One property of a clip."""

    name: str
    """What was measured."""
    value: float
    """Measured value."""
    low: float
    """Smallest value allowed."""
    high: float
    """Largest value allowed."""
    unit: str
    """Unit of the three."""

    @property
    def passed(self) -> bool:
        """Whether the value is in the allowed range (NaN is not)."""
        return self.low <= self.value <= self.high

    def __str__(self) -> str:
        """Return one line: verdict, name, value, range, unit."""
        verdict = "ok  " if self.passed else "FAIL"
        return (
            f"{verdict} {self.name}: {self.value:.4g} {self.unit} "
            f"(allowed {self.low:.4g} to {self.high:.4g})"
        )


class LeapError(ValueError):
    """A clip lacks a property of a leap."""


@dataclass(frozen=True)
class Dynamics:
    """Inverse dynamics of a clip at its frames (the last one left out: it repeats the first)."""

    torque: np.ndarray
    """[F-1, 12] N m, motor torques."""
    contact_force: np.ndarray
    """[F-1, 4, 3] N, ground forces on the feet, world frame."""
    unexplained_force: np.ndarray
    """[F-1] N, share of the trunk's wrench that no ground force can give."""
    unexplained_moment: np.ndarray
    """[F-1] N m."""
    com: np.ndarray
    """[F-1, 3] m, centre of mass."""
    angular_momentum: np.ndarray
    """[F-1, 3] kg m^2/s about the centre of mass."""


def standing_feet(clip: Clip) -> np.ndarray:
    """Return which feet stand in every frame, bool [F, 4]."""
    return foot_paths(clip)[..., 2] - clip.robot.foot_radius < CONTACT_HEIGHT


def longest_flight(clip: Clip) -> tuple[int, int]:
    """Return first frame and number of frames of the longest flight, possibly over the seam."""
    airborne = ~standing_feet(clip)[:-1].any(axis=1)
    if airborne.all():
        return 0, len(airborne)
    best, run = (0, 0), 0
    for place in range(2 * len(airborne)):
        run = run + 1 if airborne[place % len(airborne)] else 0
        if run > best[1]:
            best = (place - run + 1, run)
    return best[0] % len(airborne), best[1]


def inverse_dynamics(clip: Clip, friction: float = 0.6) -> Dynamics:
    """Return torques and ground forces of a wrapping clip (see the module's description).

    Args:
        clip: The motion; accelerations are central differences of its frames.
        friction: Friction coefficient of the pyramids the forces must lie in.
    """
    model, off = robot_model(clip.robot), mujoco.mjtDisableBit
    model.opt.disableflags |= off.mjDSBL_CONTACT | off.mjDSBL_LIMIT
    data = mujoco.MjData(model)
    qvel = np.concatenate(frame_velocities(clip), axis=1)[:-1]
    qacc = _accelerations(clip, model)
    standing = standing_feet(clip)[:-1]
    # A central difference smears a force over the neighbouring frames.
    standing = standing | np.roll(standing, 1, axis=0) | np.roll(standing, -1, axis=0)
    feet = [model.geom(name).id for name in clip.robot.feet]
    edges = np.array([[friction, 0, 1], [-friction, 0, 1], [0, friction, 1], [0, -friction, 1]])
    rows = []
    for frame in range(clip.num_frames - 1):
        data.qpos[:], data.qvel[:], data.qacc[:] = clip.qpos[frame], qvel[frame], qacc[frame]
        mujoco.mj_inverse(model, data)
        needed = data.qfrc_inverse.copy()
        mujoco.mj_subtreeVel(model, data)
        jacobians = np.zeros((4, 3, model.nv))
        for leg, geom in enumerate(feet):
            point = data.geom_xpos[geom] - np.array([0.0, 0.0, clip.robot.foot_radius])
            mujoco.mj_jac(model, data, jacobians[leg], None, point, int(model.geom_bodyid[geom]))
        legs = np.flatnonzero(standing[frame])
        force = np.zeros((4, 3))
        if legs.size:
            force[legs] = _distribute(needed[:6], jacobians[legs, :, :6], edges)
        rest = needed - np.einsum("lij,li->j", jacobians, force)
        rows.append((rest, force, data.subtree_com[1].copy(), data.subtree_angmom[1].copy()))
    rest, force, com, momentum = (np.array(column) for column in zip(*rows, strict=True))
    return Dynamics(
        torque=rest[:, 6:],
        contact_force=force,
        unexplained_force=np.linalg.norm(rest[:, :3], axis=1),
        unexplained_moment=np.linalg.norm(rest[:, 3:6], axis=1),
        com=com,
        angular_momentum=momentum,
    )


def _accelerations(clip: Clip, model: mujoco.MjModel) -> np.ndarray:
    """Return the frames' accelerations [F-1, 18] as changes of the slopes on both sides."""
    slope = np.zeros((clip.num_frames - 1, model.nv))
    for frame in range(clip.num_frames - 1):
        dt = clip.frame_duration
        mujoco.mj_differentiatePos(model, slope[frame], dt, clip.qpos[frame], clip.qpos[frame + 1])
    return (slope - np.roll(slope, 1, axis=0)) / clip.frame_duration


def _distribute(wrench: np.ndarray, jacobians: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return forces [n, 3] in the friction pyramids that best give the wrench [6].

    Args:
        wrench: N and N m, generalised force on the trunk (moments in the body frame).
        jacobians: [n, 3, 6] of the contact points with respect to the trunk's velocity.
        edges: [4, 3] edges of a friction pyramid.
    """
    scale = np.array([1.0, 1.0, 1.0, 5.0, 5.0, 5.0])  # moments: a lever of 0.2 m
    columns = np.einsum("nij,ei->jne", jacobians, edges).reshape(6, -1)
    small = 1e-3 * np.eye(columns.shape[1])
    system = np.vstack([scale[:, None] * columns, small])
    target = np.concatenate([scale * wrench, np.zeros(len(small))])
    share, _ = optimize.nnls(system, target)
    return share.reshape(-1, 4) @ edges


def contact_ends(robot: Robot, qpos: np.ndarray) -> np.ndarray:
    """Return the ends of all contact shapes' axes [T, G, 2, 3] m at configurations [T, 7 + J]."""
    model = robot_model(robot)
    data = mujoco.MjData(model)
    bodies = [model.body(robot.body_of(geom)).id for geom in robot.contact_geoms]
    local = np.array([geom.endpoints for geom in robot.contact_geoms])
    ends = np.zeros((len(qpos), *local.shape))
    for row, values in enumerate(qpos):
        data.qpos[:] = values
        mujoco.mj_kinematics(model, data)
        frames = data.xmat[bodies].reshape(-1, 3, 3)
        ends[row] = data.xpos[bodies][:, None] + np.einsum("gij,gej->gei", frames, local)
    return ends


def band_margins(clip: Clip, places: np.ndarray, step: float = 0.01) -> np.ndarray:
    """Return how far the robot stays from hurdle bands centred at ``places`` [n] m: [n] m.

    Every contact shape is taken as spheres along its axis, at times ``step`` s apart over two
    cycles. Negative: it touches; distances above ``MARGIN_CAP`` are not told apart.
    """
    times = np.arange(-clip.cycle_duration, 2 * clip.cycle_duration, step)
    ends = contact_ends(clip.robot, configurations(clip, times))
    share = np.linspace(0.0, 1.0, 15)[:, None]
    points = ends[..., None, 0, :] * (1 - share) + ends[..., None, 1, :] * share
    radius = np.broadcast_to(clip.robot.contact_radii[None, :, None], points.shape[:-1])
    low = points[..., 2] - radius < BAND_HEIGHT + MARGIN_CAP
    (x, _, z), radius = points[low].T, radius[low]
    margins = []
    for place in places:
        beside = np.maximum(np.abs(x - place) - 0.5 * BAND_LENGTH, 0.0)
        above = np.maximum(z - BAND_HEIGHT, 0.0)
        margin = (np.hypot(beside, above) - radius).min(initial=MARGIN_CAP)
        margins.append(float(margin))
    return np.array(margins)


def _kinematic_findings(clip: Clip) -> list[Finding]:
    """Return findings about speed, joints, feet and smoothness."""
    distance = float(clip.cycle_displacement[0])
    robot = clip.robot
    box = robot.default_pose[:, None] + np.outer(robot.action_half_range, [-1.0, 1.0])
    low, high = np.clip(box.T, *robot.joint_limits.T)
    inside = float(np.minimum(clip.joint_pos - low, high - clip.joint_pos).min())
    feet, standing = foot_paths(clip), standing_feet(clip)
    both = standing[1:] & standing[:-1]
    moves = np.linalg.norm(np.diff(feet[..., :2], axis=0), axis=-1) * both
    ends = contact_ends(clip.robot, clip.qpos)
    lowest = float((ends[..., 2].min(axis=-1) - robot.contact_radii).min())
    seam = clip.qpos[-1] - clip.qpos[0]
    seam[:2] -= clip.cycle_displacement[:2]
    velocity = np.concatenate(frame_velocities(clip), axis=1)
    jump = np.abs(velocity[-1] - velocity[0])[6:].max()
    slopes = np.diff(clip.joint_pos, axis=0)
    slopes = np.concatenate([slopes, slopes[:1]]) / clip.frame_duration
    accel = float(np.abs(np.diff(slopes, axis=0)).max() / clip.frame_duration)
    return [
        Finding("cycle length", distance, 1.9, 2.3, "m"),
        Finding("speed", distance / clip.cycle_duration, 1.5, 2.2, "m/s"),
        Finding("joint angles inside action box and limits by", inside, 0.0, np.inf, "rad"),
        Finding("joint speed", float(np.abs(slopes).max()), 0.0, 20.0, "rad/s"),
        Finding("slip of a standing foot in a cycle", float(moves.sum(0).max()), 0.0, 3e-3, "m"),
        Finding("lowest point of the robot", lowest, -1e-3, 1e-3, "m"),
        Finding("gap at the loop's seam", float(np.abs(seam).max()), 0.0, 1e-3, "m or rad"),
        Finding("velocity jump at the loop's seam", float(jump), 0.0, 1e-6, "rad/s"),
        Finding("joint acceleration, seam included", accel, 0.0, 1200.0, "rad/s^2"),
    ]


def _flight_findings(clip: Clip, dynamics: Dynamics) -> list[Finding]:
    """Return findings about the flight: ballistic, free of moments, over a hurdle band."""
    first, count = longest_flight(clip)
    frames = np.arange(first, first + count)
    cycle = len(dynamics.com)
    shift = np.array([*clip.cycle_displacement[:2], 0.0])
    com = dynamics.com[frames % cycle] + (frames // cycle)[:, None] * shift
    fall, drift, spin = (np.nan,) * 3
    if count >= 4:
        accel = np.diff(com, 2, axis=0) / clip.frame_duration**2
        fall = float(np.abs(accel[:, 2] + GRAVITY).max())
        drift = float(np.abs(accel[:, :2]).max())
        momentum = dynamics.angular_momentum[frames % cycle]
        spin = float(np.ptp(momentum[1:-1], axis=0).max())
    start = clip.root_pos[first % cycle, 0]
    places = start + np.arange(0.0, max(clip.cycle_displacement[0], 0.1), 0.02)
    margins = band_margins(clip, places)
    room = float(0.02 * (margins > 0.02).sum())
    return [
        Finding("flight time (from frames)", count * clip.frame_duration, 0.28, 0.5, "s"),
        Finding("centre of mass off gravity's fall in flight", fall, 0.0, 0.1, "m/s^2"),
        Finding("horizontal acceleration in flight", drift, 0.0, 0.1, "m/s^2"),
        Finding("change of angular momentum in flight", spin, 0.0, 0.05, "kg m^2/s"),
        Finding("clearance of the best placed band", float(margins.max()), 0.03, np.inf, "m"),
        Finding("places of a band cleared by 0.02 m", room, 0.2, np.inf, "m"),
    ]


def ideal_targets(clip: Clip, dynamics: Dynamics) -> np.ndarray:
    """Return the PD targets [F-1, J] in rad that make the motors give the clip's torques."""
    rate = np.concatenate(frame_velocities(clip), axis=1)[:-1, 6:]
    return clip.joint_pos[:-1] + (dynamics.torque + clip.robot.kd * rate) / clip.robot.kp


def feed_forward(clip: Clip, dynamics: Dynamics) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the periodic 20 Hz actions whose filtered PD targets come closest to the ideal ones.

    The cycle is taken as the nearest whole number K of control steps.

    Returns:
        Actions [K, J] in [-1, 1], the PD targets [K, J] in rad that they give, and the ideal ones
        averaged over the control steps [K, J].
    """
    robot = clip.robot
    ideal = ideal_targets(clip, dynamics)
    steps, fine = max(round(clip.cycle_duration * CONTROL_RATE), 3), 20
    place = (np.arange(steps * fine) + 0.5) / (steps * fine) * len(ideal)
    grid = np.arange(len(ideal) + 1)
    closed = np.concatenate([ideal, ideal[:1]])
    wanted = np.stack([np.interp(place, grid, column) for column in closed.T], axis=1)
    wanted = wanted.reshape(steps, fine, robot.num_joints).mean(axis=1)
    delay = np.roll(np.eye(steps), 1, axis=0)
    powers = np.stack([np.eye(steps), delay, delay @ delay])
    b, a = robot.lowpass
    lowpass = np.linalg.solve(np.tensordot(a, powers, axes=1), np.tensordot(b, powers, axes=1))
    actions = np.zeros((steps, robot.num_joints))
    for joint in range(robot.num_joints):
        scale = robot.action_half_range[joint]
        system = np.vstack([scale * lowpass, 0.03 * np.eye(steps)])
        goal = np.append(wanted[:, joint] - robot.default_pose[joint], np.zeros(steps))
        actions[:, joint] = optimize.lsq_linear(system, goal, bounds=(-1.0, 1.0)).x
    given = robot.default_pose + robot.action_half_range * (lowpass @ actions)
    given = np.clip(given, *robot.joint_limits.T)
    return actions, given, wanted


def _motor_findings(clip: Clip, dynamics: Dynamics) -> list[Finding]:
    """Return findings about torques and about what the 20 Hz controller must be told."""
    target, (low, high) = ideal_targets(clip, dynamics), clip.robot.joint_limits.T
    beyond = np.maximum(target - high, low - target).max()
    _, given, wanted = feed_forward(clip, dynamics)
    missed = float(np.sqrt(((given - wanted) ** 2).mean(axis=0)).max())
    inf, most = np.inf, float(clip.robot.torque_limit.min())
    return [
        Finding("torque", float(np.abs(dynamics.torque).max()), 0.0, most, "N m"),
        Finding("unexplained force", float(dynamics.unexplained_force.max()), 0.0, 6.0, "N"),
        Finding("unexplained moment", float(dynamics.unexplained_moment.max()), 0.0, 2.0, "N m"),
        Finding("PD target beyond the joint limits by", float(beyond), -inf, 0.1, "rad"),
        Finding("PD target missed by actions in the box", missed, 0.0, 0.06, "rad rms"),
    ]


def check_leap(clip: Clip) -> list[Finding]:
    """Return every finding about a wrapping clip, passed or not.

    Raises:
        LeapError: the clip does not wrap, or turns, so that it cannot be a leap along x.
    """
    if clip.loop != "wrap" or not clip.cycle_offset_position or clip.cycle_displacement[2] != 0:
        raise LeapError(f"{clip.name}: a leap must wrap, go on from where it ended, and not turn")
    dynamics = inverse_dynamics(clip)
    return [
        *_kinematic_findings(clip),
        *_flight_findings(clip, dynamics),
        *_motor_findings(clip, dynamics),
    ]


def require_leap(clip: Clip) -> list[Finding]:
    """Return the findings of ``check_leap`` if all passed.

    Raises:
        LeapError: naming every failed property with its value and the range allowed.
    """
    findings = check_leap(clip)
    failed = [str(finding) for finding in findings if not finding.passed]
    if failed:
        raise LeapError(f"{clip.name} is no leap its robot can do:\n" + "\n".join(failed))
    return findings
