"""How far a clip can be followed without feedback: the control pipeline in C MuJoCo.

The feed-forward actions of ``leap_checks.feed_forward`` go through the very pipeline a policy has:
20 Hz, Butterworth low-pass, joint limits, PD motors with their torque limit, contacts. A bounding
robot is unstable, so without feedback it leaves the motion within a cycle or so; but a clip whose
first take-off and flight already fail here asks for something the motors do not give.
"""

from __future__ import annotations

import mujoco
import numpy as np
from scipy import signal

from twirl_mjx.motion.clip import Clip, frame_velocities
from twirl_mjx.motion.leap_checks import CONTROL_RATE, feed_forward, inverse_dynamics
from twirl_mjx.sim.mjcf import robot_spec
from twirl_mjx.sim.robot import CALF, FOOT, Robot


def robot_on_floor(robot: Robot) -> mujoco.MjModel:
    """Return the robot on a plane with friction 1, stepped at 5 ms."""
    spec = robot_spec(robot, (FOOT, CALF))
    spec.option.timestep = 0.005
    spec.worldbody.add_geom(
        name="floor",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[0, 0, 0.05],
        contype=1,
        conaffinity=0,
        priority=1,
        friction=[1.0, 0.005, 0.0001],
    )
    return spec.compile()


def clip_state(clip: Clip, time: float) -> tuple[np.ndarray, np.ndarray]:
    """Return qpos and qvel at the frame nearest to ``time`` s of a wrapping clip."""
    frame = round(time / clip.frame_duration)
    cycle, frame = divmod(frame, clip.num_frames - 1)
    qpos = clip.qpos[frame].copy()
    qpos[:2] += cycle * clip.cycle_displacement[:2]
    return qpos, np.concatenate(frame_velocities(clip), axis=1)[frame]


def open_loop(clip: Clip, start: float, duration: float) -> tuple[np.ndarray, np.ndarray]:
    """Play the feed-forward actions from a state of the clip.

    Args:
        clip: A wrapping clip that does not turn.
        start: s, time in the clip; rounded to a control step.
        duration: s.

    Returns:
        Simulated and reference configurations at the ends of the control steps, [K, 7 + J] each.
    """
    actions, _, _ = feed_forward(clip, inverse_dynamics(clip))
    robot = clip.robot
    cycle, targets = len(actions), robot.default_pose + actions * robot.action_half_range
    repeated = np.tile(targets, (8, 1))
    settled = np.asarray(signal.lfilter(*robot.lowpass, repeated, axis=0))[-cycle:]
    model = robot_on_floor(robot)
    data = mujoco.MjData(model)
    first = round(start * CONTROL_RATE)
    step = clip.cycle_duration / cycle
    data.qpos[:], data.qvel[:] = clip_state(clip, first * step)
    simulated, reference = [], []
    for now in range(first, first + round(duration * CONTROL_RATE)):
        data.ctrl[:] = np.clip(settled[now % cycle], *robot.joint_limits.T)
        mujoco.mj_step(model, data, nstep=round(step / model.opt.timestep))
        simulated.append(data.qpos.copy())
        reference.append(clip_state(clip, (now + 1) * step)[0])
    return np.array(simulated), np.array(reference)
