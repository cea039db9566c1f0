"""Physics engines behind one contract: MJX on the device, or C MuJoCo in host threads.

An engine advances all worlds by one control step and returns the joint-level trajectory of every
physics substep; observations, rewards, contacts and torques are computed from it by shared code.
"""

from __future__ import annotations

import functools
import itertools
import math
import threading
from collections.abc import Mapping, Sequence
from typing import Any, Literal, Protocol

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import mujoco.rollout
import numpy as np

from twirl_mjx.machine import usable_cores
from twirl_mjx.sim import actuation, mjx
from twirl_mjx.sim.actuation import MOTOR_PLACES, MotorCommand
from twirl_mjx.sim.dynamics import Dynamics, Target, targets
from twirl_mjx.sim.leaves import LEAVES, trunk
from twirl_mjx.sim.scene import Scene

EngineName = Literal["auto", "mjx", "native"]
PLACES = {leaf.name: leaf.places for leaf in LEAVES} | MOTOR_PLACES
"""Where leaves of ``Dynamics`` and fields of ``MotorCommand`` go in a MuJoCo model."""
Layout = tuple[tuple[str, tuple[int, ...]], ...]
"""(name, shape in one world) of arrays packed side by side."""


class Trace(flax.struct.PyTreeNode):
    """State after every physics substep of one control step of all worlds."""

    qpos: jax.Array
    """[N, S, nq] m, quaternion wxyz, rad."""
    qvel: jax.Array
    """[N, S, nv] m/s (world), rad/s (base frame), rad/s."""


class Engine(Protocol):
    """Advance all worlds by one control step; a pure function of its arguments."""

    def step(
        self, data: mjx.Data, command: MotorCommand, dynamics: Dynamics
    ) -> tuple[mjx.Data, Trace]:
        """Return the data of all worlds after the step and the substep trace."""
        ...


MJX_FROM = 1024
"""Worlds from which ``auto`` is MJX on an accelerator: an H200 steps as many as the 16 cores beside
it in the same 20 ms, and more in hardly more time (docs/accelerators.md)."""


def resolve_engine(name: EngineName, num_envs: int) -> Literal["mjx", "native"]:
    """Return the engine for ``auto``: C MuJoCo on a CPU and for few worlds, else MJX."""
    if name != "auto":
        return name
    few = num_envs < MJX_FROM
    return "native" if few or jax.default_backend() == "cpu" else "mjx"


def make_engine(
    name: EngineName, scene: Scene, num_envs: int, threads: int | None = None
) -> Engine:
    """Return the engine called ``name`` for a scene.

    Args:
        name: ``auto``, ``mjx`` or ``native``.
        scene: The compiled scene.
        num_envs: Worlds that it will step, which decide what ``auto`` is.
        threads: Host threads of the native engine; the CPUs this process may use by default.

    Raises:
        ValueError: Unknown name, or the native engine where jax may not use the host.
    """
    if name not in ("auto", "mjx", "native"):
        raise ValueError(f"unknown engine {name!r}: choose auto, mjx or native")
    if resolve_engine(name, num_envs) == "mjx":
        return MjxEngine(scene)
    check_host()
    return NativeEngine(scene, threads or len(usable_cores()))


def check_host() -> None:
    """Refuse the native engine where jax has no CPU device: its callbacks run there.

    Raises:
        ValueError: ``JAX_PLATFORMS`` names accelerators alone.
    """
    platforms = jax.config.jax_platforms or ""
    if platforms and "cpu" not in platforms.split(","):
        raise ValueError(
            f"JAX_PLATFORMS={platforms} hides the CPU, where engine native steps its worlds"
            f" (nearest: JAX_PLATFORMS={platforms},cpu; or --engine mjx)"
        )


def make_data(scene: Scene, num_envs: int) -> mjx.Data:
    """Return default simulation data of ``num_envs`` worlds, leaves [N, ...]."""
    data = mjx.make_data(scene.mj_model)
    return jax.tree.map(lambda x: jnp.broadcast_to(x, (num_envs, *jnp.shape(x))), data)


class MjxEngine:
    """MJX: substeps in ``lax.scan``, worlds in ``vmap``."""

    def __init__(self, scene: Scene) -> None:
        """Keep the scene; the model goes to the device on the first step."""
        self._scene = scene

    def step(
        self, data: mjx.Data, command: MotorCommand, dynamics: Dynamics
    ) -> tuple[mjx.Data, Trace]:
        """Advance all worlds; see :class:`Engine`."""
        return jax.vmap(functools.partial(_mjx_world_step, self._scene))(data, command, dynamics)


def _mjx_world_step(
    scene: Scene, data: mjx.Data, command: MotorCommand, dynamics: Dynamics
) -> tuple[mjx.Data, Trace]:
    model = apply_dynamics(scene, command, dynamics)

    def substep(d: mjx.Data, late: jax.Array | None) -> tuple[mjx.Data, tuple[Any, Any]]:
        d = mjx.step(model, d if late is None else d.replace(ctrl=late))
        return d, (d.qpos, d.qvel)

    data, (qpos, qvel) = jax.lax.scan(
        substep,
        data.replace(ctrl=command.target),
        command.late_targets,
        length=scene.options.n_substeps,
    )
    return data.replace(ctrl=command.target), Trace(qpos=qpos, qvel=qvel)


def model_values(scene: Scene, command: MotorCommand, dynamics: Dynamics) -> dict[str, jax.Array]:
    """Return the values that stand in the model of a scene, by their names in ``PLACES``."""
    leaves = {
        leaf.name: getattr(dynamics, leaf.name)
        for leaf in LEAVES
        if leaf.places and leaf.scene in (None, scene.kind)
    }
    values = leaves | {name: getattr(command, name) for name in MOTOR_PLACES}
    return {name: value for name, value in values.items() if value is not None}


def apply_dynamics(scene: Scene, command: MotorCommand, dynamics: Dynamics) -> mjx.Model:
    """Return the MJX model of one world with its physical parameters written in."""
    values = model_values(scene, command, dynamics)
    changes: dict[str, Any] = {}
    for name, place, field, index, base in targets(scene, PLACES, values):
        entry = place.entry(base, values[name], scene, jnp)
        if index is not ...:
            whole = changes.get(place.field, field(scene.mjx_model))
            entry = whole.at[index].set(entry)
        changes[place.field] = entry
    model: Any = scene.mjx_model.tree_replace(changes)
    return model


def write_physics(
    scene: Scene,
    model: mujoco.MjModel,
    values: Mapping[str, Any],
    places: Sequence[Target] | None = None,
) -> None:
    """Write the physical parameters of one world into a copy of the scene's model.

    Args:
        scene: The scene ``model`` is a copy of.
        model: Changed in place.
        values: As ``model_values`` returns them, by numpy in float64.
        places: Where they go, looked up when it is not given.
    """
    for name, place, field, index, base in places or targets(scene, PLACES, values):
        field(model)[index] = place.entry(base, values[name], scene, np)


def copy_model(scene: Scene) -> mujoco.MjModel:
    """Return a copy of the scene's model that takes any physical parameters."""
    model, body = scene.mj_model.__copy__(), trunk(scene)
    # Where the frames of the trunk, its inertia and its shapes coincide, C MuJoCo copies one for
    # the other; they part when the centre of mass moves.
    kinds = mujoco.mjtSameFrame
    if model.body_sameframe[body] == kinds.mjSAMEFRAME_BODY:
        model.body_sameframe[body] = kinds.mjSAMEFRAME_BODYROT
    for frames, owners in (
        (model.geom_sameframe, model.geom_bodyid),
        (model.site_sameframe, model.site_bodyid),
    ):
        inertial = np.isin(frames, (kinds.mjSAMEFRAME_INERTIA, kinds.mjSAMEFRAME_INERTIAROT))
        frames[inertial & (owners == body)] = kinds.mjSAMEFRAME_NONE
    return model


def world_model(scene: Scene, dynamics: Dynamics) -> mujoco.MjModel:
    """Return a copy of the scene's model with one world's parameters (scalars), motors whole."""
    whole = actuation.whole_motors(scene.robot)
    command = actuation.motor_command(scene.robot, whole, jnp.zeros_like(whole.strength), dynamics)
    model = copy_model(scene)
    values = jax.device_get(model_values(scene, command, dynamics))
    write_physics(scene, model, {k: np.asarray(v, np.float64)[()] for k, v in values.items()})
    return model


def silence() -> None:
    """Keep MuJoCo's own warnings off the terminal and out of ``MUJOCO_LOG.TXT``.

    A world that diverges is found and counted by who steps it, in words of this project.
    """
    mujoco.set_mju_user_warning(lambda text: None)


class NativeEngine:
    """C MuJoCo in host threads (``mujoco.rollout``), called from inside jitted code.

    Calls that overlap, of seeds on devices of their own, do not wait for each other: each takes an
    idle stepper, or makes one.
    """

    def __init__(self, scene: Scene, threads: int) -> None:
        """Keep the scene; threads and per-world models are created on the first step.

        Args:
            scene: The compiled scene.
            threads: Of one call.
        """
        self._scene = scene
        self._threads = threads
        self._idle: list[_Stepper] = []
        self._lock = threading.Lock()

    def step(
        self, data: mjx.Data, command: MotorCommand, dynamics: Dynamics
    ) -> tuple[mjx.Data, Trace]:
        """Advance all worlds; see :class:`Engine`."""
        model, options = self._scene.mj_model, self._scene.options
        num_envs, n_substeps = data.qpos.shape[0], options.n_substeps
        physics = model_values(self._scene, command, dynamics)
        late = command.late_targets
        target = command.target if late is None else late.reshape(num_envs, -1)
        parts = [*physics.values(), target, data.qpos, data.qvel]
        packed = jnp.concatenate([part.reshape(num_envs, -1) for part in parts], axis=-1)
        states = jax.pure_callback(
            functools.partial(
                self._host_step,
                tuple((name, value.shape[1:]) for name, value in physics.items()),
                target.shape[-1],
            ),
            jax.ShapeDtypeStruct((num_envs, n_substeps, model.nq + model.nv), jnp.float32),
            packed,  # in one piece: every argument of a callback costs a copy and a dispatch
            vmap_method="broadcast_all",
        )
        trace = Trace(qpos=states[..., : model.nq], qvel=states[..., model.nq :])
        data = data.replace(
            qpos=trace.qpos[:, -1],
            qvel=trace.qvel[:, -1],
            ctrl=command.target,
            time=data.time + n_substeps * options.sim_dt,
        )
        return data, trace

    def _host_step(self, layout: Layout, target_size: int, packed: np.ndarray) -> np.ndarray:
        # Leading axes are worlds, and seeds when the caller is vmapped over them.
        lead, size = np.shape(packed)[:-1], np.shape(packed)[-1]
        columns = np.asarray(packed, np.float64).reshape(-1, size)
        model = self._scene.mj_model
        state_at = size - model.nq - model.nv
        physics, target, state = np.split(columns, [state_at - target_size, state_at], axis=1)
        stepper = self._take(physics)
        try:
            states = stepper.step(layout, physics, target, state)
        finally:
            self._idle.append(stepper)
        return np.asarray(states, np.float32).reshape(*lead, *states.shape[1:])

    def _take(self, physics: np.ndarray) -> _Stepper:
        """Return a stepper that nobody uses, if there is one then that of these very worlds."""
        with self._lock:
            if not self._idle:
                return _Stepper(self._scene, self._threads)
            fits = (i for i, one in enumerate(self._idle) if one.has_written(physics))
            return self._idle.pop(next(fits, -1))


class _Stepper:
    """One call at a time of ``mujoco.rollout``, with a model for each world.

    Each call starts the constraint solver cold, so that a step depends on nothing but its
    arguments; the models that are kept only save writing parameters that did not change.
    """

    def __init__(self, scene: Scene, threads: int) -> None:
        silence()
        self._scene = scene
        self._rollout = mujoco.rollout.Rollout(nthread=threads)
        self._data = [mujoco.MjData(scene.mj_model) for _ in range(threads)]
        self._models: list[mujoco.MjModel] = []
        self._layout: Layout = ()
        self._slots: dict[str, int | slice] = {}
        self._places: list[Target] = []
        self._written = np.zeros((0, 0))

    def has_written(self, physics: np.ndarray) -> bool:
        """Return whether its models hold these parameters [N, P]."""
        return np.array_equal(self._written, physics)

    def step(
        self, layout: Layout, physics: np.ndarray, target: np.ndarray, state: np.ndarray
    ) -> np.ndarray:
        """Return positions and velocities [N, S, nq + nv] after every physics step.

        Args:
            layout: What stands in a row of ``physics``.
            physics: [N, P] parameters of the models.
            target: [N, any] joint targets, of equal parts of the control step one after another.
            state: [N, nq + nv].
        """
        n_substeps, nu = self._scene.options.n_substeps, self._scene.mj_model.nu
        start = np.concatenate([np.zeros((len(state), 1)), state], axis=1)
        control = target.reshape(len(state), -1, nu)
        out = np.empty((len(state), n_substeps, start.shape[1]))
        self._rollout.rollout(
            self._prepare(layout, physics),
            self._data,
            start,
            np.repeat(control, n_substeps // control.shape[1], axis=1),
            skip_checks=True,  # they cost a tenth of a step of 16 worlds
            nstep=n_substeps,
            state=out,
        )
        return out[..., 1:]

    def _prepare(self, layout: Layout, physics: np.ndarray) -> list[mujoco.MjModel]:
        """Return one model per world holding its parameters ``physics`` [N, P]."""
        if len(self._models) != len(physics) or self._layout != layout:
            self._models = [self._copy() for _ in physics]
            self._written = np.full(physics.shape, np.nan)
            self._layout = layout
            self._slots = _slots(layout)
            self._places = targets(self._scene, PLACES, self._slots)
        for i in np.flatnonzero((self._written != physics).any(axis=1)):
            values = {name: physics[i, slot] for name, slot in self._slots.items()}
            write_physics(self._scene, self._models[i], values, self._places)
        self._written = physics
        return self._models

    def _copy(self) -> mujoco.MjModel:
        model = copy_model(self._scene)
        # A diverging world must show its NaN to the guards instead of silently restarting.
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        return model


def _slots(layout: Layout) -> dict[str, int | slice]:
    """Return where every array lies in a row, scalars as such."""
    ends = itertools.accumulate(math.prod(shape) for _, shape in layout)
    return {
        name: slice(end - math.prod(shape), end) if shape else end - 1
        for (name, shape), end in zip(layout, ends, strict=True)
    }
