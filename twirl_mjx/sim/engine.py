"""Physics engines behind one contract: MJX on the device, or C MuJoCo in host threads.

An engine advances all worlds by one control step and returns the joint-level trajectory of every
physics substep; observations, rewards, contacts and torques are computed from it by shared code.
"""

from __future__ import annotations

import functools
import os
import threading
from typing import Literal, Protocol

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import mujoco.rollout
import numpy as np
from mujoco import mjx

from twirl_mjx.sim.actuation import MotorCommand
from twirl_mjx.sim.dynamics import Dynamics
from twirl_mjx.sim.scene import Scene

EngineName = Literal["auto", "mjx", "native"]


class Trace(flax.struct.PyTreeNode):
    """State after every physics substep of one control step of all worlds."""

    qpos: jax.Array
    """[N, S, 19] m, quaternion wxyz, rad."""
    qvel: jax.Array
    """[N, S, 18] m/s (world), rad/s (base frame), rad/s."""


class Engine(Protocol):
    """Advance all worlds by one control step; a pure function of its arguments."""

    def step(
        self, data: mjx.Data, command: MotorCommand, dynamics: Dynamics
    ) -> tuple[mjx.Data, Trace]:
        """Return the data of all worlds after the step and the substep trace."""
        ...


def resolve_engine(name: EngineName) -> Literal["mjx", "native"]:
    """Return the engine for ``auto``: MJX on an accelerator, C MuJoCo on a CPU."""
    if name != "auto":
        return name
    return "native" if jax.default_backend() == "cpu" else "mjx"


def make_engine(name: EngineName, scene: Scene, threads: int | None = None) -> Engine:
    """Return the engine called ``name`` for a scene.

    Args:
        name: ``auto``, ``mjx`` or ``native``.
        scene: The compiled scene.
        threads: Host threads of the native engine; the CPUs this process may use by default.

    Raises:
        ValueError: Unknown name.
    """
    if name not in ("auto", "mjx", "native"):
        raise ValueError(f"unknown engine {name!r}: choose auto, mjx or native")
    if resolve_engine(name) == "mjx":
        return MjxEngine(scene)
    return NativeEngine(scene, threads or len(os.sched_getaffinity(0)))


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

    def substep(d: mjx.Data, _: None) -> tuple[mjx.Data, tuple[jax.Array, jax.Array]]:
        d = mjx.step(model, d)
        return d, (d.qpos, d.qvel)

    data = data.replace(ctrl=command.target)
    data, (qpos, qvel) = jax.lax.scan(substep, data, length=scene.options.n_substeps)
    return data, Trace(qpos=qpos, qvel=qvel)


def apply_dynamics(scene: Scene, command: MotorCommand, dynamics: Dynamics) -> mjx.Model:
    """Return the MJX model of one world with its physical parameters written in."""
    model = scene.mjx_model
    ground = jnp.asarray(scene.ground_geoms)
    limit = jnp.stack([-command.torque_limit, command.torque_limit], axis=-1)
    changes = {
        "opt": model.opt.replace(gravity=dynamics.gravity * jnp.array([0.0, 0.0, -1.0])),
        "geom_friction": model.geom_friction.at[ground, 0].set(dynamics.friction),
        "actuator_gainprm": model.actuator_gainprm.at[:, 0].set(command.kp),
        "actuator_biasprm": model.actuator_biasprm.at[:, 1]
        .set(-command.kp)
        .at[:, 2]
        .set(-command.kd),
        "actuator_forcerange": limit,
    }
    if scene.kind == "sloped":
        half = -dynamics.incline / 2
        quat = jnp.stack([jnp.cos(half), 0.0 * half, jnp.sin(half), 0.0 * half])
        changes["geom_quat"] = model.geom_quat.at[scene.ground_geoms[1]].set(quat)
    if scene.kind == "bumpy":
        scale = dynamics.bump_height / scene.mj_model.hfield_size[0, 2]
        changes["hfield_data"] = jnp.asarray(scene.bumps.ravel()) * scale
    return model.replace(**changes)


class NativeEngine:
    """C MuJoCo in host threads (``mujoco.rollout``), called from inside jitted code.

    Each call starts the constraint solver cold, so that a step depends on nothing but its
    arguments; the cached per-world models only save writing parameters that did not change.
    """

    def __init__(self, scene: Scene, threads: int) -> None:
        """Keep the scene; threads and per-world models are created on the first step."""
        self._scene = scene
        self._threads = threads
        self._lock = threading.Lock()
        self._rollout: mujoco.rollout.Rollout | None = None
        self._models: list[mujoco.MjModel] = []
        self._written = np.zeros((0, 0))

    def step(
        self, data: mjx.Data, command: MotorCommand, dynamics: Dynamics
    ) -> tuple[mjx.Data, Trace]:
        """Advance all worlds; see :class:`Engine`."""
        num_envs, n_substeps = data.qpos.shape[0], self._scene.options.n_substeps
        ground = (dynamics.gravity, dynamics.friction, dynamics.incline, dynamics.bump_height)
        motors = (command.kp, command.kd, command.torque_limit)
        start = (data.qpos, data.qvel)
        packed = jnp.concatenate([jnp.stack(ground, -1), *motors, command.target, *start], axis=-1)
        states = jax.pure_callback(
            self._host_step,
            jax.ShapeDtypeStruct((num_envs, n_substeps, 37), jnp.float32),
            packed,  # in one piece: every argument of a callback costs a copy and a dispatch
            vmap_method="broadcast_all",
        )
        trace = Trace(qpos=states[..., :19], qvel=states[..., 19:])
        data = data.replace(
            qpos=states[:, -1, :19],
            qvel=states[:, -1, 19:],
            ctrl=command.target,
            time=data.time + n_substeps * self._scene.options.sim_dt,
        )
        return data, trace

    def _host_step(self, packed: np.ndarray) -> np.ndarray:
        # Leading axes are worlds, and seeds when the caller is vmapped over them.
        lead = np.shape(packed)[:-1]
        columns = np.asarray(packed, np.float64).reshape(-1, 89)
        physics, target, state = np.split(columns, [40, 52], axis=1)
        with self._lock:
            models = self._prepare(physics)
            start = np.concatenate([np.zeros((len(state), 1)), state], axis=1)
            assert self._rollout is not None
            n_substeps = self._scene.options.n_substeps
            out = np.empty((len(state), n_substeps, 38))
            self._rollout.rollout(
                models,
                self._data,
                start,
                np.repeat(target[:, None], n_substeps, axis=1),
                skip_checks=True,  # they cost a tenth of a step of 16 worlds
                nstep=n_substeps,
                state=out,
            )
        return np.asarray(out[..., 1:], np.float32).reshape(*lead, out.shape[1], 37)

    def _prepare(self, physics: np.ndarray) -> list[mujoco.MjModel]:
        """Return one model per world holding its parameters ``physics`` [N, 40]."""
        if self._rollout is None:
            self._rollout = mujoco.rollout.Rollout(nthread=self._threads)
            self._data = [mujoco.MjData(self._scene.mj_model) for _ in range(self._threads)]
        if len(self._models) != len(physics):
            self._models = [_copy_model(self._scene.mj_model) for _ in physics]
            self._written = np.full(physics.shape, np.nan)
        for i in np.flatnonzero((self._written != physics).any(axis=1)):
            write_physics(self._scene, self._models[i], physics[i])
        self._written = physics
        return self._models


def _copy_model(model: mujoco.MjModel) -> mujoco.MjModel:
    copy = model.__copy__()
    # A diverging world must show its NaN to the guards instead of silently restarting.
    copy.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    return copy


def world_model(scene: Scene, dynamics: Dynamics) -> mujoco.MjModel:
    """Return a copy of the scene's model with one world's parameters (scalars), motors whole."""
    ground = (dynamics.gravity, dynamics.friction, dynamics.incline, dynamics.bump_height)
    motors = np.concatenate([scene.robot.kp, scene.robot.kd, scene.robot.torque_limit])
    model = scene.mj_model.__copy__()
    write_physics(scene, model, np.concatenate([np.array([float(x) for x in ground]), motors]))
    return model


def write_physics(scene: Scene, model: mujoco.MjModel, values: np.ndarray) -> None:
    """Write the physical parameters of one world into a copy of the scene's model.

    Args:
        scene: The scene ``model`` is a copy of.
        model: Changed in place.
        values: [40] gravity (m/s^2), friction, incline (rad), bump height (m), then kp, kd and
            torque limit [12] each, as in ``MotorCommand``.
    """
    gravity, friction, incline, bump_height = values[:4]
    kp, kd, limit = values[4:].reshape(3, 12)
    model.opt.gravity[2] = -gravity
    model.geom_friction[list(scene.ground_geoms), 0] = friction
    model.actuator_gainprm[:, 0] = kp
    model.actuator_biasprm[:, 1] = -kp
    model.actuator_biasprm[:, 2] = -kd
    model.actuator_forcerange[:] = np.stack([-limit, limit], axis=-1)
    if scene.kind == "sloped":
        half = -incline / 2
        model.geom_quat[scene.ground_geoms[1]] = [np.cos(half), 0.0, np.sin(half), 0.0]
    if scene.kind == "bumpy":
        model.hfield_data[:] = scene.bumps.ravel() * (bump_height / model.hfield_size[0, 2])
