"""A policy under a contract, acting in the worlds of any task.

Terms are filled from the true physical state of the worlds, as the observers of this project's own
sources are. Its output gives joint targets; the action is what reaches the same targets in the
worlds' own terms, ``(target - default pose) / half range``. The worlds' low-pass on the targets and
their gains are part of the target world and stay as they are. The policy is asked once per control
step of the worlds, whatever its own rate; its clocks count its own steps.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from twirl_mjx.checks import check_range
from twirl_mjx.motion.clip import Clip, ClipArrays, sample
from twirl_mjx.policies.contract import Contract, ContractError, frame_runs
from twirl_mjx.policies.function import Brain, fresh_worlds, restart, spread
from twirl_mjx.sim import frames
from twirl_mjx.sim.robot import ROOT_SIZE, Robot
from twirl_mjx.tasks.imitate import to_heading

TOWARDS = "towards-goal"
MAX_YAW_RATE = 1.0
"""rad/s, fastest turn that is asked for on the way to a goal."""
ARRIVAL_TIME = 1.0
"""s, speed is taken back when the goal is this near at it."""


@dataclasses.dataclass(frozen=True)
class Command:
    """What a policy with commands is told to do."""

    values: tuple[float, ...]
    """Constants: m/s forward, m/s left, rad/s yaw, then the policy's own."""
    speed: float | None = None
    """m/s towards the goal of the task; it replaces the first three constants."""

    def at(self, qpos: jax.Array, goal: jax.Array) -> jax.Array:
        """Return the commands [N, C] at states ``qpos`` [N, 7 + J] and goals [N, 2]."""
        constants = jnp.broadcast_to(
            jnp.asarray(self.values, jnp.float32), (len(qpos), len(self.values))
        )
        if self.speed is None:
            return constants
        way = goal - qpos[:, :2]
        distance = jnp.linalg.norm(way, axis=-1)
        angle = jnp.arctan2(way[:, 1], way[:, 0]) - frames.yaw(qpos[:, 3:7])
        angle = jnp.where(distance > 1e-3, jnp.arctan2(jnp.sin(angle), jnp.cos(angle)), 0.0)
        speed = jnp.minimum(self.speed, distance / ARRIVAL_TIME)
        forward = speed * jnp.maximum(jnp.cos(angle), 0.0)
        turn = jnp.clip(angle, -MAX_YAW_RATE, MAX_YAW_RATE)
        rule = jnp.stack([forward, jnp.zeros_like(forward), turn], axis=-1)
        return jnp.concatenate([rule, constants[:, 3:]], axis=-1)


def parse_command(text: str, contract: Contract) -> Command:
    """Return the command of ``--source-command``.

    Args:
        text: Nothing (the contract's own constants), ``0.5,0,0``, or ``towards-goal:0.5``.
        contract: Whose commands.

    Raises:
        ContractError: Something else, or another number of constants than the contract has.
    """
    own = contract.commands
    if not text:
        return Command(own)
    if not any(term.name == "commands" for term in contract.observation):
        raise ContractError(
            f"contract {contract.name!r} shows no commands: --source-command {text} would do"
            " nothing"
        )
    rule, _, number = text.partition(":")
    try:
        if rule == TOWARDS:
            check_range(f"speed of {TOWARDS} (m/s)", float(number), 0.0, 5.0)
            if len(own) < 3:
                raise ValueError(f"contract {contract.name!r} has only {len(own)} commands, need 3")
            return Command(own, float(number))
        values = tuple(float(part) for part in text.split(","))
        if len(values) != len(own) or not np.isfinite(values).all():
            raise ValueError(f"{len(values)} numbers, contract {contract.name!r} has {len(own)}")
    except ValueError as error:
        nearest = ",".join(f"{value:g}" for value in own)
        raise ContractError(
            f"--source-command {text!r}: {error}; give {TOWARDS}:SPEED or {len(own)} numbers"
            f" (nearest: {nearest})"
        ) from error
    return Command(values)


@dataclasses.dataclass(frozen=True)
class Reference:
    """A contract's motion on the device."""

    clip: ClipArrays
    duration: float
    """s, of a cycle."""
    start: float
    """s, time within the motion at reset."""

    @classmethod
    def of(cls, contract: Contract, order: np.ndarray, robot: Robot) -> Reference | None:
        """Return the motion of a contract; None where it has none."""
        if (motion := contract.motion) is None:
            return None
        rows = np.array(motion.frames)
        joints = np.zeros_like(rows[:, ROOT_SIZE:])
        joints[:, order] = rows[:, ROOT_SIZE:]
        try:
            clip = Clip(rows[:, :3], rows[:, 3:7], joints, motion.frame_dt, "wrap", motion.travels,
                        motion.turns, contract.name, robot)  # fmt: skip
        except ValueError as error:
            raise ContractError(f"contract: motion: {error}") from error
        return cls(clip.to_arrays(), clip.cycle_duration, motion.start)

    def at(self, time: jax.Array) -> jax.Array:
        """Return [N, 7 + J] at times [N] in s since reset."""
        return jax.vmap(lambda t: sample(self.clip, t)[0])(self.start + time)

    def cycles(self, time: jax.Array) -> jax.Array:
        """Return how many cycles have begun [N]; the margin is that of the task."""
        return jnp.floor((self.start + time) / self.duration + 1e-4)


@dataclasses.dataclass(frozen=True)
class Seen:
    """What terms are made of, N worlds."""

    contract: Contract
    order: np.ndarray
    """[J] where the contract's joints are among the robot's."""
    qpos: jax.Array
    qvel: jax.Array
    goal: jax.Array
    start: jax.Array
    """[N, 3] m, base at reset."""
    time: jax.Array
    """[N] s since reset."""
    previous: jax.Array
    """[N, J] last output."""
    commands: jax.Array
    reference: Reference | None = None
    """The contract's motion."""
    offset: jax.Array | None = None
    """[N, 2] m, by which the motion was moved."""
    ahead: int = 0
    """Control steps from now, for what is shown of the motion."""

    @functools.cached_property
    def target(self) -> jax.Array:
        """[N, 7 + J] the motion, joints in the robot's order."""
        assert self.reference is not None, "a contract with such words has a motion"
        later = self.time + jnp.float32(self.ahead * self.contract.control_dt)
        return self.reference.at(later).at[:, :2].add(self.offset)

    @property
    def heading(self) -> jax.Array:
        """[N] rad, yaw of the base."""
        return frames.yaw(self.qpos[:, 3:7])

    @property
    def pose(self) -> jax.Array:
        """[N, J] joint angles in the contract's order."""
        return self.qpos[:, ROOT_SIZE:][:, self.order]

    @property
    def ticks(self) -> jax.Array:
        """[N] float32, the policy's own control steps since reset."""
        return jnp.floor(self.time / self.contract.control_dt + 1e-3)

    @property
    def phases(self) -> jax.Array:
        """[N, C] rad, gait clocks."""
        offsets = jnp.asarray(self.contract.gait_offsets, jnp.float32)
        turns = self.time[:, None] / self.contract.gait_period + offsets
        return 2.0 * jnp.pi * (turns % 1.0)

    def in_body(self, vector: jax.Array) -> jax.Array:
        """Return world vectors [N, 3] in the frame of the base."""
        return frames.rotate_inverse(self.qpos[:, 3:7], vector)


DOWN = (0.0, 0.0, -1.0)

FILL: dict[str, Callable[[Seen], jax.Array]] = {
    "base_lin_vel": lambda s: s.in_body(s.qvel[:, :3]),
    "base_ang_vel": lambda s: s.qvel[:, 3:6],
    "projected_gravity": lambda s: s.in_body(
        jnp.broadcast_to(jnp.asarray(DOWN, jnp.float32), (len(s.qpos), 3))
    ),
    "commands": lambda s: s.commands,
    "joint_pos_rel": lambda s: s.pose - jnp.asarray(s.contract.default_pose, jnp.float32),
    "joint_pos": lambda s: s.pose,
    "joint_vel": lambda s: s.qvel[:, 6:][:, s.order],
    "previous_action": lambda s: s.previous,
    "gait_sin": lambda s: jnp.sin(s.phases),
    "gait_cos": lambda s: jnp.cos(s.phases),
    "time_step": lambda s: s.ticks[:, None],
    "time": lambda s: s.time[:, None],
    "roll_pitch": lambda s: frames.roll_pitch(s.qpos[:, 3:7]),
    "roll_pitch_rate_b": lambda s: s.qvel[:, 3:5],
    "base_displacement_w": lambda s: s.qpos[:, :3] - s.start,
    "goal_displacement_w": lambda s: s.goal - s.qpos[:, :2],
    "base_x_axis_w": lambda s: frames.base_axes(s.qpos[:, 3:7])[0],
    "base_z_axis_w": lambda s: frames.base_axes(s.qpos[:, 3:7])[2],
    "base_quat_h": lambda s: to_heading(s.qpos[:, 3:7], s.heading),
    "target_base_displacement_h": lambda s: frames.rotate(
        frames.from_yaw(-s.heading), s.target[:, :3] - s.qpos[:, :3]
    ),
    "target_base_quat_h": lambda s: to_heading(s.target[:, 3:7], s.heading),
    "target_joint_pos": lambda s: s.target[:, ROOT_SIZE:][:, s.order],
}
"""How every word of the vocabulary but ``constant`` is filled, [N, size] each."""


class MeetingMemory(flax.struct.PyTreeNode):
    """What a policy under a contract remembers, leaves [N, ...]."""

    start: jax.Array
    """[N, 3] m, base at reset."""
    previous: jax.Array
    """[N, J] last output."""
    history: tuple[jax.Array, ...]
    """[N, H, size] of every term with a history, oldest first."""
    offset: jax.Array
    """[N, 2] m, by which the contract's motion was moved."""
    brain: Any
    """Memory of the policy itself."""


class ContractPolicy:
    """A source policy (``types.SourcePolicy``) that meets its robot by a contract."""

    def __init__(self, contract: Contract, brain: Brain, robot: Robot, command: Command) -> None:
        """Bind a policy to a robot.

        Raises:
            ContractError: Sizes or joints that do not fit.
        """
        if brain.observation_size not in (None, contract.observation_size):
            raise ContractError(
                f"the policy takes observations of {brain.observation_size} numbers, contract"
                f" {contract.name!r} shows {contract.observation_size}"
                f" ({', '.join(f'{t.name} {t.size * t.history}' for t in contract.observation)})"
            )
        if brain.action_size != contract.action_size:
            raise ContractError(
                f"the policy makes {brain.action_size} numbers, contract {contract.name!r} has"
                f" {contract.action_size} joints"
            )
        self.contract = contract
        self._brain = brain
        self._robot = robot
        self._command = command
        self._order = contract.joint_order(robot)
        self._dt = robot.control_dt
        self._reference = Reference.of(contract, self._order, robot)

    def init(self, state: Any) -> MeetingMemory:
        """Return the memory of freshly reset worlds."""
        worlds = state.world.episode_step.shape
        longer = [term for term in self.contract.observation if term.history > 1]
        return MeetingMemory(
            start=state.data.qpos[:, :3],
            previous=jnp.zeros((*worlds, self.contract.action_size)),
            history=tuple(jnp.zeros((*worlds, t.history, t.size)) for t in longer),
            offset=jnp.zeros((*worlds, 2)),
            brain=spread(self._brain.initial_memory, state),
        )

    def act(
        self, memory: MeetingMemory, state: Any, key: jax.Array
    ) -> tuple[jax.Array, MeetingMemory]:
        """Return actions [N, A] that reach the policy's joint targets, unclipped."""
        del key  # brains are deterministic
        fresh = fresh_worlds(state)
        memory = restart(fresh, self.init(state), memory)
        obs, seen, history = self.observe(memory, state)
        output, thought = self._brain.run(obs, seen.ticks, memory.brain)
        contract, action = self.contract, self.contract.action
        if action.clip is not None:
            output = jnp.clip(output, *action.clip)
        scale = jnp.asarray(action.scale, jnp.float32)
        around = jnp.asarray(contract.default_pose, jnp.float32)
        target = scale * output + (around if action.kind == "offset" else 0.0)
        target = jnp.zeros_like(target).at[:, self._order].set(target)
        rest, reach = (
            jnp.asarray(x, jnp.float32)
            for x in (self._robot.default_pose, self._robot.action_half_range)
        )
        following = memory.replace(
            previous=output, history=history, offset=self._offset(memory, state), brain=thought
        )
        return (target - rest) / reach, following

    def observe(
        self, memory: MeetingMemory, state: Any
    ) -> tuple[jax.Array, Seen, tuple[jax.Array, ...]]:
        """Return the observation [N, O], what it was made of, and the history with this step."""
        contract = self.contract
        qpos, step = state.data.qpos, state.world.episode_step
        seen = Seen(
            contract=contract,
            order=self._order,
            qpos=qpos,
            qvel=state.data.qvel,
            goal=state.world.goal,
            start=memory.start,
            time=step.astype(jnp.float32) * jnp.float32(self._dt),
            previous=memory.previous,
            commands=self._command.at(qpos, state.world.goal),
            reference=self._reference,
            offset=self._offset(memory, state),
        )
        times = {term.ahead for term in contract.observation}
        at = {ahead: dataclasses.replace(seen, ahead=ahead) for ahead in times}
        now, history = [], []
        for term in contract.observation:
            zeros = jnp.zeros((len(qpos), term.size))
            value = zeros
            if term.name != "constant":
                value = FILL[term.name](at[term.ahead])
            value = jnp.asarray(term.scale, jnp.float32) * (
                value - jnp.asarray(term.offset, jnp.float32)
            )
            value = value if term.clip is None else jnp.clip(value, *term.clip)
            if term.history > 1:
                past = memory.history[len(history)]
                moved = jnp.concatenate([past[:, 1:], value[:, None]], axis=1)
                first = jnp.broadcast_to(value[:, None], moved.shape)
                history.append(jnp.where((step == 0)[:, None, None], first, moved))
                value = history[-1]
            now.append(value)
        return _flat(contract, now), seen, tuple(history)

    def _offset(self, memory: MeetingMemory, state: Any) -> jax.Array:
        """Return where the motion stands [N, 2]: a new cycle begins where the base is."""
        if (reference := self._reference) is None:
            return memory.offset
        step, dt = state.world.episode_step, jnp.float32(self._dt)
        time = step.astype(jnp.float32) * dt
        begins = reference.cycles(time) > reference.cycles((step - 1).astype(jnp.float32) * dt)
        here = state.data.qpos[:, :2] - reference.at(time)[:, :2]
        return jnp.where(((step == 0) | begins)[:, None], here, memory.offset)


def _flat(contract: Contract, values: list[jax.Array]) -> jax.Array:
    """Return the observation [N, O] of terms [N, size], with a history [N, H, size]."""
    count = len(values[0])
    if contract.history_order == "newest":
        values = [value[:, ::-1] if value.ndim == 3 else value for value in values]
    runs = (
        {run[0]: run for run in frame_runs(contract)} if contract.history_layout == "frame" else {}
    )
    inside = {index for run in runs.values() for index in run[1:]}
    parts = []
    for index, value in enumerate(values):
        if index in runs:
            value = jnp.concatenate([values[i] for i in runs[index]], axis=-1)
        if index not in inside:
            parts.append(value.reshape(count, -1))
    return jnp.concatenate(parts, axis=-1)
