"""Task ``imitate``: track a leap clip (Peng et al. 2020). Source of ``hurdles``.

Observation: ``make_layout`` (A1: [160]). Action [A] in [-1, 1]. Reward: the terms of ``WEIGHTS``
(paper Table 2), 1 for a perfect tracker. Episodes start on the reference at a random phase, at its
speed; a share of them starts at rest on four feet instead, as episodes of other tasks do.
Whenever the clip loops, the reference moves to where the robot is (root xy only).
Terminates when the root is ``max_root_error`` or ``max_root_angle`` away from the reference, or
trunk, hips, thighs or knees touch the ground. The lower ends of the calves do not count: in the
clip's own crouch they are 6 mm above the ground, and feet sink in when they land.
The reference lives on flat ground. On other ground the reward takes its height as one over the
ground under the robot; the observation goes on showing heights over the world's zero.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple, cast

import numpy as np
from etils import epy

from twirl_mjx.assets import asset_path
from twirl_mjx.checks import check_range
from twirl_mjx.motion.conversion import AS_IS, ClipOptions, Conversion
from twirl_mjx.sim.robot import HIP, ROOT_SIZE, THIGH, TRUNK, Robot
from twirl_mjx.sim.robots import A1, ROBOTS
from twirl_mjx.tasks.task import Measure, Task

with epy.lazy_imports():  # needed by worlds, not by options
    import jax
    import jax.numpy as jnp

    from twirl_mjx.motion import clip as clips
    from twirl_mjx.motion import formats, retarget
    from twirl_mjx.sim import frames, kinematics
    from twirl_mjx.tasks import base, observations, rewards

if TYPE_CHECKING:
    from twirl_mjx.motion.clip import Clip
    from twirl_mjx.sim.dynamics import Dynamics
    from twirl_mjx.sim.scene import Scene
    from twirl_mjx.tasks.observations import Entry

WEIGHTS = {
    "pose": 0.5,
    "velocity": 0.05,
    "root_pose": 0.15,
    "root_velocity": 0.1,
    "end_effector": 0.2,
}
"""Weights of the reward terms (paper Table 2); they sum to 1."""

TARGET_STEPS = (1, 2, 7, 20)
"""Control steps ahead of the target poses in the observation (Peng et al. 2020)."""

FLIGHT_STEPS = 4
"""Control steps in a row with all feet off the ground (at least 0.15 s) that make a flight."""

STANDING_TOLERANCE = 0.005
"""m, poses whose highest foot is this little above the lowest such pose are as good to start in."""


def make_layout(robot: Robot) -> tuple[Entry, ...]:
    """Return the layout of the observation (A1: 160 numbers).

    ``_h``: in the heading frame (world axes turned by the robot's yaw at that time); w >= 0.
    """
    entry = observations.Entry
    tilt = entry("base_quat_h", 4, "1", 0.005)  # half an angle of 0.01 rad
    joints = entry("joint_pos", robot.num_joints, "rad", 0.005)
    reference = joints._replace(noise=0.0)  # known without sensors
    target = (entry("base_displacement_h", 3, "m", 0.01), tilt, reference)
    frame = (tilt, joints, entry("previous_action", robot.num_joints, "1"))
    return (
        *observations.in_history(frame),
        *(e._replace(name=f"target_{e.name}[+{i}]") for i in TARGET_STEPS for e in target),
    )


def load_clip(
    name: str,
    robot: Robot = A1,
    legs: tuple[str, ...] = (),
    conversion: Conversion = AS_IS,
    recorded_on: Robot | None = None,
) -> Clip:
    """Return the clip of a config, turned to face +x on average.

    Args:
        name: ``leap`` for the shipped clip, else the path of a clip file.
        robot: Whose motion it is.
        legs: Order of the legs in the file, by default what it says.
        conversion: Units and frames of the file.
        recorded_on: Robot whose motion the file holds, if that is another one: its feet are
            followed.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file is no clip, it cannot be a motion of this robot
            (``plausible``), its motion ends, or the shipped clip is another robot's.
    """
    if name == "leap" and A1 not in (robot, recorded_on):
        raise ValueError(
            f"imitate.clip 'leap' is a motion of robot {A1.name!r}, not of {robot.name!r}"
            f" (nearest: --imitate.clip-robot {A1.name}, which follows its feet)"
        )
    path = asset_path(A1.name, "leap.json") if name == "leap" else name
    clip = retarget.read_motion(path, robot, legs, conversion, recorded_on)
    if clip.loop != "wrap":
        raise ValueError(
            f"imitate.clip {name!r} has loop mode {clip.loop!r}, which ends after one cycle;"
            " need 'wrap'"
        )
    return facing_x(clip)


def clip_of(options: ImitateOptions, robot: Robot) -> Clip:
    """Return the clip that options name; errors of :func:`load_clip`."""
    other = ROBOTS.get(ROBOTS.admit(options.clip_robot)) if options.clip_robot else None
    return load_clip(options.clip, robot, options.clip_legs, options.conversion, other)


def facing_x(clip: Clip) -> Clip:
    """Return the clip turned about the world z-axis so that its mean heading is +x."""
    from scipy.spatial.transform import Rotation  # takes long to import

    yaw = clips.headings(clip.root_quat)
    mean = np.arctan2(np.sin(yaw).mean(), np.cos(yaw).mean())
    turn = Rotation.from_euler("z", -mean)
    quat = turn * Rotation.from_quat(clip.root_quat, scalar_first=True)
    return dataclasses.replace(
        clip, root_pos=turn.apply(clip.root_pos), root_quat=quat.as_quat(scalar_first=True)
    )


def standing_time(clip: Clip) -> float:
    """Return the time in s at which a robot at rest best joins the clip.

    That is the frame with all feet lowest; of several such frames, the one the root leaves slowest.
    """
    highest_foot = formats.foot_paths(clip)[:-1, :, 2].max(axis=1)
    speed = np.linalg.norm(np.diff(clip.root_pos[:, :2], axis=0), axis=1)
    standing = highest_foot <= highest_foot.min() + STANDING_TOLERANCE
    return float(np.where(standing, speed, np.inf).argmin() * clip.frame_duration)


def to_heading(quat: jax.Array, yaw: jax.Array) -> jax.Array:
    """Return orientations [..., 4] as seen from the heading ``yaw`` in rad, with w >= 0."""
    turned = frames.multiply(frames.from_yaw(-yaw), quat)
    return jnp.where(turned[..., :1] < 0.0, -turned, turned)


def feet_from_root(robot: Robot, qpos: jax.Array) -> jax.Array:
    """Return the feet [4, 3] in m relative to the root, in the robot's heading frame."""
    tilt = to_heading(qpos[3:7], frames.yaw(qpos[3:7]))
    return frames.rotate(tilt, kinematics.foot_positions(robot, qpos[7:]))


class ImitateMemory(NamedTuple):
    """Memory of :class:`ImitateObserver`: the reference's clock and place, and a history."""

    start_time: jax.Array
    """s, clip time at the start of the episode."""
    step: jax.Array
    """int32, control steps since then."""
    offset: jax.Array
    """[2] m, added to the clip's root xy."""
    history: jax.Array
    """[HISTORY, F] the last frames (quaternion without yaw, joints, action), oldest first."""


class ImitateObserver:
    """A 3-step history, and where the reference is going, seen from the robot.

    In a foreign task, where the robot begins at rest, the reference starts at ``standing_time``.
    """

    def __init__(self, clip: Clip) -> None:
        """Keep a wrapping clip."""
        self.layout = make_layout(clip.robot)
        self.control_dt = clip.robot.control_dt
        """s, control step."""
        self.motion = clip
        """The clip itself."""
        self.clip = clip.to_arrays()
        self.duration = clip.cycle_duration
        """s, length of a cycle."""
        self.standing_time = standing_time(clip)
        """s, clip time at which a robot at rest starts."""

    def init(self, qpos: jax.Array, qvel: jax.Array) -> ImitateMemory:
        """Start the clip at ``standing_time``, at the robot's place."""
        return self.init_at(jnp.asarray(self.standing_time, jnp.float32), qpos, qvel)

    def init_at(self, time: jax.Array, qpos: jax.Array, qvel: jax.Array) -> ImitateMemory:
        """Start the clip at ``time`` in s, at the robot's place."""
        del qvel
        first = _frame(qpos, jnp.zeros_like(qpos[ROOT_SIZE:]))
        return ImitateMemory(
            start_time=time,
            step=jnp.zeros((), jnp.int32),
            offset=self._offset(time, qpos),
            history=jnp.tile(first, (observations.HISTORY, 1)),
        )

    def push(
        self, memory: ImitateMemory, qpos: jax.Array, qvel: jax.Array, action: jax.Array
    ) -> ImitateMemory:
        """Advance clock and history; a new cycle starts at the robot's place."""
        del qvel
        history = jnp.concatenate([memory.history[1:], _frame(qpos, action)[None]])
        new = memory._replace(step=memory.step + 1, history=history)
        time = self.time(new)
        looped = self.cycles(time) > self.cycles(self.time(memory))
        offset = jnp.where(looped, self._offset(time, qpos), new.offset)
        return new._replace(offset=offset)

    def observe(
        self, memory: ImitateMemory, goal: jax.Array, qpos: jax.Array, qvel: jax.Array
    ) -> jax.Array:
        """Return the numbers [O] in the order of ``layout``; the goal is not looked at."""
        del goal, qvel
        times = self.time(memory) + self.control_dt * jnp.array(TARGET_STEPS, jnp.float32)
        target = jax.vmap(lambda time: clips.sample(self.clip, time)[0])(times)
        target = target.at[:, :2].add(memory.offset)
        yaw = frames.yaw(qpos[3:7])
        displacement = frames.rotate(frames.from_yaw(-yaw), target[:, :3] - qpos[:3])
        poses = [displacement, to_heading(target[:, 3:7], yaw), target[:, 7:]]
        return jnp.concatenate([memory.history.ravel(), jnp.concatenate(poses, axis=1).ravel()])

    def elapsed(self, memory: ImitateMemory) -> jax.Array:
        """Return the time in s since the start of the episode."""
        return memory.step * jnp.float32(self.control_dt)

    def time(self, memory: ImitateMemory) -> jax.Array:
        """Return the clip time in s, over all cycles."""
        return memory.start_time + self.elapsed(memory)

    def reference(self, memory: ImitateMemory) -> tuple[jax.Array, jax.Array]:
        """Return qpos [7 + J] and qvel [6 + J] of the reference at present."""
        qpos, qvel = clips.sample(self.clip, self.time(memory))
        return qpos.at[:2].add(memory.offset), qvel

    def cycles(self, elapsed: jax.Array) -> jax.Array:
        """Return how many whole cycles ``elapsed`` s hold (int32)."""
        # The margin keeps a cycle of whole control steps from losing one to rounding.
        return jnp.floor(elapsed / self.duration + 1e-4).astype(jnp.int32)

    def _offset(self, time: jax.Array, qpos: jax.Array) -> jax.Array:
        """Return the offset [2] in m that puts the reference at the robot's xy at ``time``."""
        return qpos[:2] - clips.sample(self.clip, time)[0][:2]


def _frame(qpos: jax.Array, action: jax.Array) -> jax.Array:
    """Return one step of the history [F]."""
    tilt = to_heading(qpos[3:7], frames.yaw(qpos[3:7]))
    return jnp.concatenate([tilt, qpos[7:], action])


class ImitateState(NamedTuple):
    """State of the task in one world."""

    airborne_steps: jax.Array
    """int32, control steps in a row with all feet off the ground."""
    flew: jax.Array
    """bool, a flight of ``FLIGHT_STEPS`` was reached in the present cycle."""
    flights: jax.Array
    """int32, completed cycles with such a flight."""


LEAPS_SUCCESS = 3
"""Leaps in a row that make an episode a success."""


@dataclasses.dataclass(frozen=True)
class ImitateOptions(ClipOptions):
    """Task ``imitate``: track a leap clip."""

    clip: str = "leap"
    """``leap`` (ours) or the path of a clip file (.json, .txt, .npy, .csv)."""
    standing_fraction: float = 0.0
    """Share of episodes started at rest on four feet, as the episodes of ``hurdles`` are."""
    max_root_error: float = 1.0
    """m, an episode ends beyond this distance from the reference root."""
    max_root_angle: float = 1.5707963
    """rad, an episode ends beyond this rotation from the reference root."""

    def __post_init__(self) -> None:
        """Check every number, or raise ValueError."""
        super().__post_init__()
        check_range("imitate.standing_fraction", self.standing_fraction, 0.0, 1.0)
        check_range("imitate.max_root_error", self.max_root_error, 1e-3, 1e3)
        check_range("imitate.max_root_angle", self.max_root_angle, 1e-3, 3.1416)


class Imitate(Task[ImitateOptions]):
    """See the module docstring."""

    name = "imitate"
    Options = ImitateOptions
    collision = "feet"
    measures = {
        "tracking": Measure("tracking", "mean", 1.0, "1", "mean reward over its maximum"),
        "leaps": Measure("leaps", "max", 1.0, "1", "cycles of the clip survived"),
        "flights": Measure("flights", "max", 1.0, "1", "cycles with a flight of 4 steps or more"),
    }
    presets = {
        "paper": {"imitate.standing_fraction": 0.2},
        # Random actions hardly ever track the clip: it starts from planned ones.
        "cpu": {"variant": "twirl", "source": "clip", "total_env_steps": 1_600_000,
                "droq.discount": 0.95},
    }  # fmt: skip
    course_options = ("standing_fraction",)
    training_options = ("standing_fraction",)
    caption = ("tracking",)

    def make_observer(self) -> ImitateObserver:
        """Load the clip.

        Raises:
            FileNotFoundError: The clip of the options does not exist.
            ValueError: It is not a clip, or does not wrap.
        """
        return ImitateObserver(clip_of(self.options, self.robot))

    @property
    def follower(self) -> ImitateObserver:
        """The observer, by its own kind."""
        return cast(ImitateObserver, self.observer)

    def start(self, key: jax.Array, scene: Scene, dynamics: Dynamics) -> base.Start:
        """Start on the reference, or at rest in a share ``standing_fraction`` of the episodes.

        phase = U(0, cycle); standing_time from rest.
        """
        place_key, phase_key, pose_key, standing_key = jax.random.split(key, 4)
        phase = jax.random.uniform(phase_key, maxval=self.follower.duration)
        xy = base.start_xy(place_key, scene)
        qpos, qvel = clips.sample(self.follower.clip, phase)
        qpos = qpos.at[:2].set(xy).at[2].add(base.ground_at(scene, dynamics, xy))
        endpoints = kinematics.forward(scene.robot, qpos).endpoints
        lowest = jnp.min(base.clearances(scene, dynamics, endpoints))
        qpos = qpos.at[2].add(jnp.maximum(-lowest, 0.0))
        if self.options.standing_fraction > 0.0:
            rest, still = base.start_on_feet(pose_key, scene, dynamics)
            take = jax.random.uniform(standing_key) < self.options.standing_fraction
            qpos, qvel = jnp.where(take, rest, qpos), jnp.where(take, still, qvel)
            phase = jnp.where(take, jnp.float32(self.follower.standing_time), phase)
        return base.Start(
            qpos=qpos,
            qvel=qvel,
            goal=qpos[:2],
            memory=self.follower.init_at(phase, qpos, qvel),
            task=ImitateState(
                airborne_steps=jnp.zeros((), jnp.int32),
                flew=jnp.zeros((), bool),
                flights=jnp.zeros((), jnp.int32),
            ),
        )

    def judge(self, world: base.World, view: base.View, scene: Scene) -> base.Outcome:
        """Score one control step against the reference at its end."""
        options, qpos, qvel = self.options, view.qpos, view.qvel
        ref_qpos, ref_qvel = self.follower.reference(world.memory)
        root_error = jnp.append(qpos[:2], view.height) - ref_qpos[:3]
        turn = frames.multiply(frames.conjugate(ref_qpos[3:7]), qpos[3:7])
        angle = frames.rotation_angle(turn)
        spin = frames.rotate(qpos[3:7], qvel[3:6]) - frames.rotate(ref_qpos[3:7], ref_qvel[3:6])
        terms = {
            "pose": rewards.joint_tracking(qpos[7:] - ref_qpos[7:]),
            "velocity": rewards.joint_vel_tracking(qvel[6:] - ref_qvel[6:]),
            "root_pose": rewards.root_tracking(root_error, angle),
            "root_velocity": rewards.root_vel_tracking(qvel[:3] - ref_qvel[:3], spin),
            "end_effector": rewards.foot_tracking(
                feet_from_root(scene.robot, qpos) - feet_from_root(scene.robot, ref_qpos)
            ),
        }
        reward = sum((WEIGHTS[name] * term for name, term in terms.items()), jnp.zeros(()))
        distance = jnp.linalg.norm(root_error)
        fall = base.touches(view, TRUNK, HIP, THIGH) | base.knees_touch(view)
        lost = (distance > options.max_root_error) | (angle > options.max_root_angle)
        airborne = jnp.all(base.foot_clearance(view) > base.LIFTED)
        elapsed = self.follower.elapsed(world.memory)
        leaps = self.follower.cycles(elapsed)
        completed = leaps > self.follower.cycles(elapsed - self.robot.control_dt)
        task = count_flights(world.task, airborne, completed)
        return base.Outcome(
            reward=reward,
            terminated=fall | lost,
            goal=world.goal,
            task=task,
            metrics=terms
            | {
                "tracking": reward / sum(WEIGHTS.values()),
                "leaps": leaps,
                "flights": task.flights,
                "airborne": airborne,
                "root_error": distance,
                "root_angle": angle,
                "fall": fall,
                "lost": lost,
            },
        )

    def success(self, measures: Mapping[str, jax.Array]) -> jax.Array:
        """Complete three cycles with a flight."""
        return measures["flights"] >= LEAPS_SUCCESS


def count_flights(state: ImitateState, airborne: jax.Array, completed: jax.Array) -> ImitateState:
    """Return the flight count after a control step.

    Args:
        state: Before the step.
        airborne: Whether all feet are off the ground at its end.
        completed: Whether a cycle ended with it.
    """
    steps = jnp.where(airborne, state.airborne_steps + 1, 0)
    flew = state.flew | (steps == FLIGHT_STEPS)
    return ImitateState(
        airborne_steps=steps,
        flew=flew & ~completed,
        flights=state.flights + (flew & completed),
    )
