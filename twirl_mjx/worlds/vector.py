"""Vectorised worlds of one task: reset, step, auto-reset that keeps the true last observation."""

from __future__ import annotations

import functools
import pickle
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import flax.struct
import jax
import jax.core
import jax.numpy as jnp
import mujoco
import numpy as np

from twirl_mjx.checks import check_range
from twirl_mjx.sim import actuation, mjx
from twirl_mjx.sim.dynamics import Dynamics, broadcast, draw, leaf_value
from twirl_mjx.sim.engine import Engine, Trace, make_data, world_model
from twirl_mjx.sim.ranges import NO_RANGES, Ranges
from twirl_mjx.sim.scene import Scene
from twirl_mjx.tasks.base import Outcome, World, make_view
from twirl_mjx.tasks.observations import layout_noise, layout_size
from twirl_mjx.tasks.task import Task
from twirl_mjx.types import Metrics, Transition

if TYPE_CHECKING:
    import gymnasium

    from twirl_mjx.worlds.picture import Painter

MAX_DISTANCE = 1e4
"""m, a robot farther from the origin counts as diverged."""

OBSERVATION_LIMIT = 10 * MAX_DISTANCE
"""Bound of the observation space, in the units of the layout: beyond it a world has diverged."""

FAULTS = (
    "",
    "the physical state was not finite",
    "the physical state was beyond what the robot reaches (worlds.vector.state_bounds)",
    f"the observation was not finite or beyond {OBSERVATION_LIMIT:g}",
    "the reward was not finite",
    "the action was not finite",
    f"the observation before the step was not finite or beyond {OBSERVATION_LIMIT:g}",
)
"""Why a step was invalid; index 0: it was not."""
BAD_ACTION, BAD_VIEW = 5, 6
"""Faults of what was given to a step."""

DRAW, NOISE, PUSH = 1001, 1002, 1003
"""What is folded into a world's key for draws that only some worlds make: the others' numbers do
not depend on them. Beyond the numbers of the keys that a split gives."""

PHYSICS_STATE = ("time", "qpos", "qvel", "ctrl", "qacc_warmstart")
"""Fields of ``mjx.Data`` that the next step depends on; it computes the others anew."""

Recipe = Callable[[], tuple[Callable[..., Any], tuple[Any, ...]]]
"""Returns what makes worlds, and the arguments to make them with; both can be pickled."""

Live = tuple[dict[str, jax.Array], World, jax.Array]
"""What a restart changes: ``PHYSICS_STATE``, the rest of the worlds, what the policy sees."""


class EnvState(flax.struct.PyTreeNode):
    """State of N worlds between two control steps; reset and step return identical shapes."""

    data: mjx.Data
    """Simulation data of all worlds, after auto-reset; leaves [N, ...]. Only ``PHYSICS_STATE`` is
    of this instant; call ``mjx.forward`` for derived fields (``xpos``, ...)."""
    obs: jax.Array
    """[N, O] what the policy sees next, after auto-reset."""
    next_obs: jax.Array
    """[N, O] true successor observation, before auto-reset."""
    reward: jax.Array
    """[N] reward of the step."""
    terminated: jax.Array
    """[N] bool, the MDP ended: no bootstrap."""
    truncated: jax.Array
    """[N] bool, the time limit was reached: bootstrap from ``next_obs``."""
    invalid: jax.Array
    """[N] bool, the step was not finite and must not be learned from; the world was reset."""
    metrics: Metrics
    """Every reward term, unweighted, and the task's measures, each [N] float32."""
    world: World
    """Everything else, leaves [N, ...]."""

    @property
    def done(self) -> jax.Array:
        """[N] bool, the episode ended and the world was reset."""
        return self.terminated | self.truncated | self.invalid


def state_bounds(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and highest [nq + nv] that a robot reaches unless its physics diverge.

    Joints stay within half a turn of their limits. In one physics step nothing turns by more than
    an eighth of a turn, and the trunk moves by no more than the length of a leg.
    """
    robot, dt = scene.robot, scene.options.sim_dt
    turn = np.full(robot.num_joints + 3, np.pi / 4 / dt)  # rad/s
    speed = np.full(3, (robot.thigh_length + robot.calf_length) / dt)  # m/s
    far, unit = np.full(3, MAX_DISTANCE), np.full(4, 1.1)
    low, high = robot.joint_limits.T
    return (
        np.concatenate([-far, -unit, low - np.pi, -speed, -turn]).astype(np.float32),
        np.concatenate([far, unit, high + np.pi, speed, turn]).astype(np.float32),
    )


def in_full_precision[**P, T](function: Callable[P, T]) -> Callable[P, T]:
    """Let a function multiply in float32, whatever jax's default is.

    GPUs and TPUs round the operands of float32 products to 10 or 7 bits unless they are told not
    to: an error of the simulator that grows in contacts.
    """

    @functools.wraps(function)
    def run(*args: P.args, **kwargs: P.kwargs) -> T:
        with jax.default_matmul_precision("highest"):
            return function(*args, **kwargs)

    return run


class VectorEnv:
    """N worlds of one task in one scene; holds constants only, all methods are pure.

    ``reset`` and ``step`` are compiled when they are called with arrays, and become part of the
    caller's program under ``jax.jit``, ``vmap`` and ``scan``.
    """

    def __init__(
        self,
        task: Task,
        scene: Scene,
        engine: Engine,
        *,
        num_envs: int,
        episode_length: int,
        dynamics: Dynamics,
        metric_names: tuple[str, ...],
        ranges: Ranges = NO_RANGES,
    ) -> None:
        """Bind a task to a scene.

        Args:
            task: The MDP.
            scene: Compiled scene.
            engine: Physics engine of that scene.
            num_envs: N.
            episode_length: Control steps before truncation.
            dynamics: Default physical parameters of the worlds, leaves () or [N].
            metric_names: Names of the metrics that the task reports (``check.check_task``).
            ranges: Parameters that are drawn instead, for every world and episode.

        Raises:
            ValueError: A range does nothing in this scene, or a leaf has a wrong shape.
        """
        ranges.check_scene(scene.kind)
        self.task = task
        self.metric_names = metric_names
        self.scene = scene
        self.engine = engine
        self.num_envs = num_envs
        self.episode_length = episode_length
        self.dynamics = broadcast(dynamics, num_envs)
        self.ranges = ranges
        self._low, self._high = state_bounds(scene)
        self._recipe: Recipe | None = None

    def __repr__(self) -> str:
        name = type(self.engine).__name__.removesuffix("Engine").lower()
        drawn = f", drawn: {' '.join(self.ranges.texts())}" if self.ranges else ""
        return (
            f"<VectorEnv {self.task.name}: {self.num_envs} worlds on {self.scene.kind} ground,"
            f" robot {self.scene.robot.name}, engine {name}; observation"
            f" [{self.observation_size}], action [{self.action_size}] in [-1, 1],"
            f" {1 / self.control_dt:g} Hz, episodes of {self.episode_length} steps{drawn}>"
        )

    def made_by(self, recipe: Recipe) -> VectorEnv:
        """Keep how to make these worlds again, which is how they are pickled; return them."""
        self._recipe = recipe
        return self

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        if self._recipe is None:
            raise pickle.PicklingError(
                "only worlds of twirl_mjx.make and make_env can be pickled: these were put"
                " together by hand"
            )
        return self._recipe()

    @property
    def observation_size(self) -> int:
        """O."""
        return layout_size(self.task.observer.layout)

    @property
    def action_size(self) -> int:
        """A, one action per joint."""
        return self.scene.robot.num_joints

    @property
    def control_dt(self) -> float:
        """Control step in s."""
        return self.scene.robot.control_dt

    @functools.cached_property
    def observation_space(self) -> gymnasium.spaces.Box:
        """What one world shows, float32 [O], as gymnasium says it."""
        import gymnasium

        limit = float(OBSERVATION_LIMIT)
        return gymnasium.spaces.Box(-limit, limit, (self.observation_size,), np.float32)

    @functools.cached_property
    def action_space(self) -> gymnasium.spaces.Box:
        """What one world takes, float32 [A] in [-1, 1], as gymnasium says it."""
        import gymnasium

        return gymnasium.spaces.Box(-1.0, 1.0, (self.action_size,), np.float32)

    @functools.cached_property
    def painter(self) -> Painter:
        """Draws these worlds, under the default physical parameters of world 0."""
        from twirl_mjx.worlds.picture import Painter

        dynamics = jax.tree.map(lambda leaf: leaf[0], self.dynamics)
        return Painter(self.scene, dynamics, self.task.band_height)

    def render(self, state: EnvState, world: int = 0) -> np.ndarray:
        """Return an image [480, 640, 3] uint8 of one world.

        Args:
            state: A state of these worlds.
            world: Which one.

        Raises:
            ValueError: There is no such world.
            RenderError: No OpenGL backend works.
        """
        check_range("world", world, 0, self.num_envs - 1)
        one = jax.tree.map(lambda leaf: leaf[world], (state.world.task, state.world.goal))
        task, goal = one
        qpos = np.asarray(state.data.qpos[world], np.float64)
        shown = np.asarray(goal) if self.task.shows_goal else None
        return self.painter.draw(qpos, self.task.bands(task), shown)

    @functools.cached_property
    def mj_model(self) -> mujoco.MjModel:
        """The compiled model of the scene, with the default physical parameters of world 0."""
        return world_model(self.scene, jax.tree.map(lambda leaf: leaf[0], self.dynamics))

    def reset(
        self,
        key: jax.Array,
        dynamics: Dynamics | None = None,
        index: jax.Array | None = None,
    ) -> EnvState:
        """Start an episode in every world.

        Args:
            key: PRNG key; world ``i`` draws from ``fold_in(key, i)``, whatever N is.
            dynamics: Physical parameters of this batch, leaves () or [N]; the env's by default.
            index: [N] int, the number ``i`` of every world; 0 to N - 1 by default. Worlds of
                equal number draw alike.

        Returns:
            A state whose ``next_obs`` equals ``obs``, with reward 0 and all flags false.
        """
        run = self._reset if _is_traced(key, dynamics, index) else self._compiled_reset
        return run(key, dynamics, index)

    @functools.cached_property
    def _compiled_reset(self) -> Callable[..., EnvState]:
        return jax.jit(self._reset)

    @in_full_precision
    def _reset(
        self, key: jax.Array, dynamics: Dynamics | None, index: jax.Array | None
    ) -> EnvState:
        dynamics = self.dynamics if dynamics is None else broadcast(dynamics, self.num_envs)
        index = jnp.arange(self.num_envs) if index is None else index
        keys = jax.vmap(jax.random.fold_in, (None, 0))(key, index)
        qpos, qvel, world, obs = jax.vmap(self.start_world)(keys, dynamics)
        data = make_data(self.scene, self.num_envs)
        data = data.replace(qpos=qpos, qvel=qvel, ctrl=qpos[:, 7:])
        flags = jnp.zeros(self.num_envs, bool)
        return EnvState(
            data=data,
            obs=obs,
            next_obs=obs,
            reward=jnp.zeros(self.num_envs),
            terminated=flags,
            truncated=flags,
            invalid=flags,
            metrics={name: jnp.zeros(self.num_envs) for name in self.metric_names},
            world=world,
        )

    def step(self, state: EnvState, action: jax.Array) -> EnvState:
        """Advance every world by one control step, then restart those whose episode ended.

        Args:
            state: The present state.
            action: [N, A], clipped to [-1, 1].

        Raises:
            ValueError: ``action`` has another shape.
        """
        need = (self.num_envs, self.action_size)
        if jnp.shape(action) != need:
            raise ValueError(f"action has shape {jnp.shape(action)}, need {need}")
        run = self._step if _is_traced(state, action) else self._compiled_step
        return run(state, action)[0]

    def step_and_fault(self, state: EnvState, action: jax.Array) -> tuple[EnvState, jax.Array]:
        """Return what :meth:`step` does, and why steps were invalid; for traced callers.

        Returns:
            The state, and [N] int32 indices into ``FAULTS``.
        """
        return self._step(state, action)

    @functools.cached_property
    def _compiled_step(self) -> Callable[[EnvState, jax.Array], tuple[EnvState, jax.Array]]:
        return jax.jit(self._step)

    @in_full_precision
    def _step(self, state: EnvState, action: jax.Array) -> tuple[EnvState, jax.Array]:
        finite_action = jnp.all(jnp.isfinite(action), axis=-1)
        good_view = jnp.all(jnp.abs(state.obs) <= OBSERVATION_LIMIT, axis=-1)
        action = jnp.clip(jnp.nan_to_num(action.astype(jnp.float32)), -1.0, 1.0)
        world, command = jax.vmap(self.command)(state.world, state.data.ctrl, action)
        pushed = state.data.replace(qvel=jax.vmap(self._push)(world, state.data.qvel))
        data, trace = self.engine.step(pushed, command, world.dynamics)
        world, next_obs, outcome, fault = jax.vmap(self.judge_world)(world, command, trace)
        fault = jnp.where(finite_action, fault, BAD_ACTION)
        fault = jnp.where(good_view, fault, BAD_VIEW)
        invalid = fault > 0
        ended = EnvState(
            data=data,
            obs=next_obs,
            next_obs=jnp.where(invalid[:, None], jnp.nan_to_num(state.obs), next_obs),
            reward=jnp.where(invalid, 0.0, outcome.reward),
            terminated=outcome.terminated & ~invalid,
            truncated=(world.episode_step >= self.episode_length) & ~invalid,
            invalid=invalid,
            metrics={
                name: jnp.where(invalid, 0.0, outcome.metrics[name].astype(jnp.float32))
                for name in self.metric_names
            },
            world=world,
        )
        live = ({name: getattr(data, name) for name in PHYSICS_STATE}, world, next_obs)
        restart = functools.partial(self._restart, ended.done)
        # Only what a restart changes goes through: a conditional copies whatever it hands on.
        physics, world, obs = jax.lax.cond(jnp.any(ended.done), restart, lambda x: x, live)
        return ended.replace(data=data.replace(**physics), world=world, obs=obs), fault

    def start_world(
        self, key: jax.Array, dynamics: Dynamics
    ) -> tuple[jax.Array, jax.Array, World, jax.Array]:
        """Start an episode in one world: qpos, qvel, the rest of it, and what the policy sees."""
        key, start_key, motor_key = jax.random.split(key, 3)
        if self.ranges:
            dynamics = draw(jax.random.fold_in(key, DRAW), dynamics, self.ranges)
        start = self.task.start(start_key, self.scene, dynamics)
        world = World(
            key=key,
            episode_step=jnp.zeros((), jnp.int32),
            action=jnp.zeros(self.action_size),
            filter=actuation.filter_init(start.qpos[7:]),
            motors=actuation.motor_init(motor_key, dynamics),
            dynamics=dynamics,
            goal=start.goal,
            memory=start.memory,
            task=start.task,
        )
        obs = self.task.observer.observe(start.memory, start.goal, start.qpos, start.qvel)
        return start.qpos, start.qvel, world, self.sense(world, obs)

    def command(
        self, world: World, previous: jax.Array, action: jax.Array
    ) -> tuple[World, actuation.MotorCommand]:
        """Turn an action into the motors' command; ``previous`` [J] is the last target in rad."""
        robot = self.scene.robot
        desired = actuation.action_to_target(robot, action)
        target, filter_state = actuation.filter_step(robot, world.filter, desired)
        command = actuation.motor_command(robot, world.motors, target, world.dynamics)
        options = self.scene.options
        command = actuation.delay(
            command, previous, world.dynamics, options.sim_dt, options.n_substeps
        )
        return world.replace(filter=filter_state, action=action), command

    def _push(self, world: World, qvel: jax.Array) -> jax.Array:
        """Return ``qvel`` with the push that is due, every ``push_interval`` of the episode."""
        if world.dynamics.push is None:
            return qvel
        interval = leaf_value(world.dynamics, "push_interval") / self.control_dt
        steps = jnp.maximum(jnp.round(interval), 1.0).astype(jnp.int32)
        due = (world.episode_step > 0) & (world.episode_step % steps == 0)
        # direction = U(0, 2 pi)
        angle = jax.random.uniform(_key_now(world, PUSH), maxval=2 * jnp.pi)
        impulse = world.dynamics.push * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
        return qvel.at[:2].add(jnp.where(due, impulse, 0.0))

    def sense(self, world: World, obs: jax.Array) -> jax.Array:
        """Return the observation [O] with the sensors' noise of this instant."""
        if world.dynamics.obs_noise is None:
            return obs
        deviation = world.dynamics.obs_noise * layout_noise(self.task.observer.layout)
        return obs + deviation * jax.random.normal(_key_now(world, NOISE), obs.shape)

    def judge_world(
        self, world: World, command: actuation.MotorCommand, trace: Trace
    ) -> tuple[World, jax.Array, Outcome, jax.Array]:
        """Observe and judge a control step of one world; the last one is an index to ``FAULTS``."""
        view = make_view(self.scene, world.dynamics, trace.qpos, trace.qvel)
        torque = actuation.pd_torque(command, trace.qpos[:, 7:], trace.qvel[:, 6:])
        memory = self.task.observer.push(world.memory, view.qpos, view.qvel, world.action)
        world = world.replace(
            memory=memory,
            motors=actuation.motor_heat(world.motors, world.dynamics, torque, self.control_dt),
            episode_step=world.episode_step + 1,
        )
        outcome = self.task.judge(world, view, self.scene)
        world = world.replace(goal=outcome.goal, task=outcome.task)
        obs = self.task.observer.observe(memory, world.goal, view.qpos, view.qvel)
        state = jnp.concatenate([trace.qpos, trace.qvel], axis=-1)  # of every substep
        good = (  # in the order of FAULTS
            jnp.all(jnp.isfinite(state)),
            jnp.all((state >= self._low) & (state <= self._high)),
            jnp.all(jnp.abs(obs) <= OBSERVATION_LIMIT),
            jnp.isfinite(outcome.reward),
        )
        first = jnp.argmin(jnp.stack(good)).astype(jnp.int32) + 1
        fault = jnp.where(functools.reduce(jnp.logical_and, good), 0, first)
        return world, self.sense(world, obs), outcome, fault

    def _restart(self, done: jax.Array, live: Live) -> Live:
        """Start new episodes in the worlds whose episode ended; leave the others untouched."""
        physics, world, _ = live
        qpos, qvel, fresh_world, fresh_obs = jax.vmap(self.start_world)(world.key, world.dynamics)
        fresh = {name: jnp.zeros_like(leaf) for name, leaf in physics.items()}
        fresh |= {"qpos": qpos, "qvel": qvel, "ctrl": qpos[:, 7:]}
        return _select(done, (fresh, fresh_world, fresh_obs), live)


def _is_traced(*tree: Any) -> bool:
    """Return whether any leaf is being traced by jax."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree))


def _key_now(world: World, stream: int) -> jax.Array:
    """Return the key of a stream of draws in this control step of the episode."""
    return jax.random.fold_in(jax.random.fold_in(world.key, stream), world.episode_step)


def _select[T](mask: jax.Array, new: T, old: T) -> T:
    """Take leaves [N, ...] of ``new`` where ``mask`` [N], else of ``old``."""

    def pick(a: jax.Array, b: jax.Array) -> jax.Array:
        return jnp.where(mask.reshape(mask.shape + (1,) * (a.ndim - 1)), a, b)

    return jax.tree.map(pick, new, old)


def make_transition(state: EnvState, action: jax.Array, result: EnvState) -> Transition:
    """Return the experience [N] of a step: ``result = env.step(state, action)``."""
    return Transition(
        obs=state.obs,
        action=jnp.clip(action, -1.0, 1.0),
        reward=result.reward,
        terminated=result.terminated,
        next_obs=result.next_obs,
    )
