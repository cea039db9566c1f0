"""Reference motions: frames of a robot's configuration, and sampling them at any time.

A clip lasts ``(F - 1) * frame_duration``: its last frame is the first frame of the next cycle. A
wrapping clip goes on from where the cycle before it ended, as in Peng et al. 2020 ("Learning Agile
Robotic Locomotion Skills by Imitating Animals"): every cycle is the first one moved by a planar
rigid motion. Joints are in the order of the robot, quaternions are wxyz, body to world.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from twirl_mjx.sim import frames
from twirl_mjx.sim.robot import Robot
from twirl_mjx.sim.robots import A1

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

LoopMode = Literal["wrap", "clamp"]
QUAT_TOLERANCE = 0.01
"""Largest deviation of a frame's quaternion norm from 1; smaller ones are normalised away."""


def rotation_of(quat: np.ndarray) -> Rotation:
    """Return the rotations of quaternions w x y z, [F, 4] or [4]."""
    from scipy.spatial.transform import Rotation  # takes long to import

    return Rotation.from_quat(quat, scalar_first=True)


class ClipArrays(flax.struct.PyTreeNode):
    """A clip on the device, with the velocities of its frames (float32)."""

    root_pos: jax.Array
    """[F, 3] m, world frame."""
    root_quat: jax.Array
    """[F, 4] wxyz; neighbouring frames lie in the same hemisphere."""
    joint_pos: jax.Array
    """[F, J] rad."""
    root_vel: jax.Array
    """[F, 3] m/s, world frame."""
    root_ang_vel: jax.Array
    """[F, 3] rad/s, body frame."""
    joint_vel: jax.Array
    """[F, J] rad/s."""
    frame_duration: jax.Array
    """Scalar, s."""
    cycle_shift: jax.Array
    """[3] (x, y in m, yaw in rad): the next cycle is turned by yaw about world z, then moved."""
    loop: LoopMode = flax.struct.field(pytree_node=False)
    """What happens beyond the ends: ``wrap`` to the next cycle, or ``clamp`` to the end frame."""

    @property
    def cycle_duration(self) -> jax.Array:
        """Scalar, s, from the first to the last frame."""
        return (self.root_pos.shape[0] - 1) * self.frame_duration


@dataclass(frozen=True, eq=False)
class Clip:
    """A reference motion of a robot (numpy, float64)."""

    root_pos: np.ndarray
    """[F, 3] m, trunk origin in the world frame."""
    root_quat: np.ndarray
    """[F, 4] unit quaternions wxyz, trunk to world."""
    joint_pos: np.ndarray
    """[F, J] rad, in the order of the robot."""
    frame_duration: float
    """s between frames."""
    loop: LoopMode = "wrap"
    """``wrap``: cycle after cycle; ``clamp``: hold the end frames."""
    cycle_offset_position: bool = True
    """Whether a new cycle starts at the (x, y) where the last one ended."""
    cycle_offset_rotation: bool = False
    """Whether a new cycle starts with the heading with which the last one ended."""
    name: str = "clip"
    """For messages and figures."""
    robot: Robot = A1
    """Whose motion it is."""

    def __post_init__(self) -> None:
        """Check shapes and values, and normalise the quaternions.

        Raises:
            ValueError: the message names the clip, the frame and the value at fault.
        """
        joints = self.robot.num_joints
        for field, width in (("root_pos", 3), ("root_quat", 4), ("joint_pos", joints)):
            array = np.array(getattr(self, field), np.float64)
            if array.ndim != 2 or array.shape[1] != width:
                raise ValueError(f"{self.name}: {field} has shape {array.shape}, need [F, {width}]")
            bad = np.flatnonzero(~np.isfinite(array).all(axis=1))
            if bad.size:
                raise ValueError(f"{self.name}: frame {bad[0]}: {field} is not finite")
            object.__setattr__(self, field, array)
        lengths = {len(self.root_pos), len(self.root_quat), len(self.joint_pos)}
        if len(lengths) != 1 or min(lengths) < 2:
            raise ValueError(
                f"{self.name}: root_pos, root_quat and joint_pos have {len(self.root_pos)}, "
                f"{len(self.root_quat)} and {len(self.joint_pos)} frames; need equal, at least 2"
            )
        if not (np.isfinite(self.frame_duration) and self.frame_duration > 0):
            raise ValueError(f"{self.name}: frame_duration {self.frame_duration} s must be above 0")
        if self.loop not in ("wrap", "clamp"):
            raise ValueError(f"{self.name}: loop {self.loop!r} must be 'wrap' or 'clamp'")
        norm = np.linalg.norm(self.root_quat, axis=1)
        worst = int(np.argmax(np.abs(norm - 1.0)))
        if abs(norm[worst] - 1.0) > QUAT_TOLERANCE:
            raise ValueError(
                f"{self.name}: frame {worst}: quaternion norm {norm[worst]:.4f}, need 1 within "
                f"{QUAT_TOLERANCE}"
            )
        object.__setattr__(self, "root_quat", _one_hemisphere(self.root_quat / norm[:, None]))

    @property
    def num_frames(self) -> int:
        """Number of frames F."""
        return len(self.root_pos)

    @property
    def cycle_duration(self) -> float:
        """Time in s from the first to the last frame."""
        return (self.num_frames - 1) * self.frame_duration

    @property
    def cycle_displacement(self) -> np.ndarray:
        """[3] (x, y in m, yaw in rad) from the first to the last frame, as far as the flags ask.

        The height is not part of it: every cycle starts at the height of the first frame.
        """
        move = self.root_pos[-1, :2] - self.root_pos[0, :2]
        turn = headings(self.root_quat[[0, -1]])
        yaw = (turn[1] - turn[0] + np.pi) % (2 * np.pi) - np.pi
        return np.array(
            [*(move * self.cycle_offset_position), yaw if self.cycle_offset_rotation else 0.0]
        )

    @property
    def qpos(self) -> np.ndarray:
        """[F, 7 + J] MuJoCo configurations of the frames."""
        return np.concatenate([self.root_pos, self.root_quat, self.joint_pos], axis=1)

    def to_arrays(self) -> ClipArrays:
        """Return the clip with its velocities as device arrays."""
        root_vel, root_ang_vel, joint_vel = frame_velocities(self)
        x, y, yaw = self.cycle_displacement
        c, s = np.cos(yaw), np.sin(yaw)
        start = self.root_pos[0, :2]
        shift = start + np.array([x, y]) - np.array([[c, -s], [s, c]]) @ start
        values = {
            "root_pos": self.root_pos,
            "root_quat": self.root_quat,
            "joint_pos": self.joint_pos,
            "root_vel": root_vel,
            "root_ang_vel": root_ang_vel,
            "joint_vel": joint_vel,
            "frame_duration": self.frame_duration,
            "cycle_shift": np.array([*shift, yaw]),
        }
        return ClipArrays(
            **{key: jnp.asarray(value, jnp.float32) for key, value in values.items()},
            loop=self.loop,
        )


def _one_hemisphere(quat: np.ndarray) -> np.ndarray:
    """Flip signs of quaternions [F, 4] so that neighbours have a non-negative dot product."""
    dots = (quat[1:] * quat[:-1]).sum(axis=1)
    signs = np.cumprod(np.where(dots < 0, -1.0, 1.0))
    return np.concatenate([quat[:1], quat[1:] * signs[:, None]])


def headings(quat: np.ndarray) -> np.ndarray:
    """Return the yaw [F] in rad of quaternions [F, 4] wxyz (numpy)."""
    w, x, y, z = np.moveaxis(quat, -1, 0)
    return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def frame_velocities(clip: Clip) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the velocities at the frames: means of the interpolation slopes on both sides.

    Beyond the ends a wrapping clip has the slope of the neighbouring cycle, a clamped one its
    own end slope.

    Returns:
        Linear velocity [F, 3] m/s (world), angular velocity [F, 3] rad/s (body) and joint
        velocity [F, J] rad/s.
    """
    from scipy.spatial.transform import Rotation  # takes long to import

    dt = clip.frame_duration
    rotation = rotation_of(clip.root_quat)
    slopes = [
        np.diff(clip.root_pos, axis=0) / dt,
        (rotation[:-1].inv() * rotation[1:]).as_rotvec() / dt,
        np.diff(clip.joint_pos, axis=0) / dt,
    ]
    turn = Rotation.from_euler("z", clip.cycle_displacement[2])
    velocities = []
    for index, slope in enumerate(slopes):
        before, after = slope[:1], slope[-1:]
        if clip.loop == "wrap":
            before, after = slope[-1:], slope[:1]
            if index == 0:  # the world frame turns with the cycle, body and joints do not
                before, after = turn.inv().apply(before), turn.apply(after)
        both = np.concatenate([before, slope, after])
        velocities.append(0.5 * (both[1:] + both[:-1]))
    return velocities[0], velocities[1], velocities[2]


MARGIN = 1e-4
"""Frames and cycles by which a time counts as the next one's.

Control steps fall on frames. A compiler may compute a time twice, rounded in two ways, and find two
frames for it: the orientation was a whole frame late then (seen with AVX-512)."""


def slerp(a: jax.Array, b: jax.Array, fraction: jax.Array) -> jax.Array:
    """Interpolate on the shorter great circle from quaternions ``a`` to ``b`` [..., 4].

    Args:
        a: [..., 4] at fraction 0.
        b: [..., 4] at fraction 1.
        fraction: [...] in [0, 1].

    Returns:
        [..., 4] unit quaternions.
    """
    dot = jnp.sum(a * b, axis=-1, keepdims=True)
    b = jnp.where(dot < 0, -b, b)
    # Half the angle between them from chord lengths: exact where arccos loses all its digits.
    half = jnp.arctan2(
        jnp.linalg.norm(b - a, axis=-1, keepdims=True),
        jnp.linalg.norm(b + a, axis=-1, keepdims=True),
    )
    angle, u = 2.0 * half, fraction[..., None]
    small = angle < 1e-4
    sine = jnp.where(small, 1.0, jnp.sin(angle))
    weight_a = jnp.where(small, 1.0 - u, jnp.sin((1.0 - u) * angle) / sine)
    weight_b = jnp.where(small, u, jnp.sin(u * angle) / sine)
    out = weight_a * a + weight_b * b
    return out / jnp.linalg.norm(out, axis=-1, keepdims=True)


def _cycle_motion(shift: jax.Array, cycle: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return displacement [2] m and yaw in rad of cycle number ``cycle`` (may be negative).

    The displacements of the cycles form a geometric series of rotations, summed in closed form.
    """
    yaw = shift[2]
    turning = jnp.abs(yaw) > 1e-6
    half = jnp.where(turning, 0.5 * yaw, 1.0)
    count = jnp.where(turning, jnp.sin(cycle * half) / jnp.sin(half), cycle)
    middle = 0.5 * (cycle - 1.0) * yaw
    c, s = jnp.cos(middle), jnp.sin(middle)
    move = count * jnp.stack([c * shift[0] - s * shift[1], s * shift[0] + c * shift[1]])
    return move, cycle * yaw


def sample(clip: ClipArrays, time: jax.Array | float) -> tuple[jax.Array, jax.Array]:
    """Interpolate a clip: positions and joints linearly, orientations on great circles.

    Velocities are interpolated linearly between those of the frames (``frame_velocities``); a
    clamped clip stands still beyond its ends. Traceable; ``vmap`` over ``time`` for many times.

    Args:
        clip: The motion.
        time: Scalar, s; 0 is the first frame. Any sign.

    Returns:
        qpos [7 + J] and qvel [6 + J] in MuJoCo's layout (linear velocity in the world frame,
        angular velocity in the body frame).
    """
    time = jnp.asarray(time, clip.root_pos.dtype)
    duration = clip.cycle_duration
    cycle = jnp.floor(time / duration + MARGIN) if clip.loop == "wrap" else jnp.zeros_like(time)
    inside = jnp.clip(time - cycle * duration, 0.0, duration)
    place = inside / clip.frame_duration
    first = jnp.floor(place + MARGIN).astype(jnp.int32)
    first = jnp.clip(first, 0, clip.root_pos.shape[0] - 2)
    u = jnp.clip(place - first, 0.0, 1.0)

    def lerp(values: jax.Array) -> jax.Array:
        return (1.0 - u) * values[first] + u * values[first + 1]

    pos, vel = lerp(clip.root_pos), lerp(clip.root_vel)
    quat = slerp(clip.root_quat[first], clip.root_quat[first + 1], u)
    velocity = [vel, lerp(clip.root_ang_vel), lerp(clip.joint_vel)]
    if clip.loop == "wrap":
        move, yaw = _cycle_motion(clip.cycle_shift, cycle)
        turn = frames.from_yaw(yaw)
        pos = frames.rotate(turn, pos) + jnp.concatenate([move, jnp.zeros(1, move.dtype)])
        quat = frames.multiply(turn, quat)
        velocity[0] = frames.rotate(turn, vel)
    qpos = jnp.concatenate([pos, quat, lerp(clip.joint_pos)])
    qvel = jnp.concatenate(velocity)
    if clip.loop == "clamp":
        qvel = jnp.where((time < 0.0) | (time > duration), 0.0, qvel)
    return qpos, qvel


def configurations(clip: Clip, times: np.ndarray) -> np.ndarray:
    """Return qpos [T, 7 + J] at ``times`` [T] s: the positions of ``sample``, as float64."""
    from scipy.spatial.transform import Rotation, Slerp  # takes long to import

    wraps = clip.loop == "wrap"
    cycle = np.floor(times / clip.cycle_duration) if wraps else np.zeros(len(times))
    inside = np.clip(times - cycle * clip.cycle_duration, 0.0, clip.cycle_duration)
    grid = np.linspace(0.0, clip.cycle_duration, clip.num_frames)
    columns = np.concatenate([clip.root_pos, clip.joint_pos], axis=1).T
    values = np.stack([np.interp(inside, grid, column) for column in columns], axis=1)
    rotation = Slerp(grid, rotation_of(clip.root_quat))(inside)
    x, y, yaw = clip.cycle_displacement
    # In the complex plane a cycle turns by `turn` about the start and then moves by x + iy.
    start, turn = complex(*clip.root_pos[0, :2]), np.exp(1j * yaw)
    powers = turn**cycle
    moves = cycle if abs(turn - 1) < 1e-9 else (1 - powers) / (1 - turn)
    place = start + powers * (values[:, 0] + 1j * values[:, 1] - start) + moves * complex(x, y)
    root = np.stack([place.real, place.imag, values[:, 2]], axis=1)
    rotation = Rotation.from_rotvec(np.outer(cycle * yaw, [0, 0, 1])) * rotation
    return np.concatenate([root, rotation.as_quat(scalar_first=True), values[:, 3:]], axis=1)
