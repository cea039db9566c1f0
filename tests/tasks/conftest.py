"""Compiled worlds shared by all tests of tasks: every (task, options, N) compiles once."""

from __future__ import annotations

import functools
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from twirl_mjx.sim.dynamics import Dynamics, make_dynamics
from twirl_mjx.sim.robots import A1
from twirl_mjx.sim.scene import build_scene
from twirl_mjx.tasks import base
from twirl_mjx.tasks.base import Outcome
from twirl_mjx.tasks.biped import BipedState
from twirl_mjx.tasks.task import Task
from twirl_mjx.worlds.config import WorldConfig
from twirl_mjx.worlds.make import make
from twirl_mjx.worlds.vector import EnvState


class Worlds:
    """Native worlds with compiled reset and step; ``traces`` counts how often each was traced."""

    def __init__(self, task: str, num_envs: int, **options: Any) -> None:
        config = WorldConfig(task=task, **options)
        self.env = make(task, num_envs=num_envs, engine="native", config=config)
        self.traces = {"reset": 0, "step": 0}
        self._reset = jax.jit(functools.partial(self._counted, "reset", self.env.reset))
        self.step: Callable[[EnvState, jax.Array], EnvState] = jax.jit(
            functools.partial(self._counted, "step", self.env.step)
        )

    def _counted(self, name: str, function: Callable[..., EnvState], *args: Any) -> EnvState:
        self.traces[name] += 1
        return function(*args)

    def reset(self, seed: int = 0, dynamics: Dynamics | None = None) -> EnvState:
        return self._reset(jax.random.key(seed), dynamics or self.env.dynamics)

    def run(self, state: EnvState, actions: np.ndarray) -> list[EnvState]:
        """Return the states after every one of ``actions`` [T, N, 12]."""
        states = []
        for action in actions:
            state = self.step(state, jnp.asarray(action, jnp.float32))
            states.append(state)
        return states


def read_state(state: EnvState) -> SimpleNamespace:
    """Return the parts of a state that tests recompute, as numpy arrays."""
    parts = {name: getattr(state, name) for name in ("obs", "next_obs", "reward", "done")}
    parts |= {"qpos": state.data.qpos, "qvel": state.data.qvel, "goal": state.world.goal}
    read = jax.device_get(parts | {"metrics": state.metrics})
    for name in ("qpos", "qvel", "goal"):
        read[name] = read[name].astype(np.float64)
    return SimpleNamespace(**read)


@pytest.fixture(scope="session")
def read() -> Callable[[EnvState], SimpleNamespace]:
    return read_state


@pytest.fixture(scope="session")
def worlds() -> Callable[..., Worlds]:
    """``worlds("stand", num_envs=3, **fields of WorldConfig)``, compiled at first use."""
    made: dict[str, Worlds] = {}

    def get(task: str, num_envs: int = 3, **options: Any) -> Worlds:
        name = f"{task}, {num_envs}, {options}"
        if name not in made:
            made[name] = Worlds(task, num_envs, **options)
        return made[name]

    return get


def random_actions(steps: int, num_envs: int, *, scale: float = 0.3, seed: int = 0) -> np.ndarray:
    """Return actions [T, N, 12], uniform within ``scale``."""
    rng = np.random.default_rng(seed)
    return rng.uniform(-scale, scale, (steps, num_envs, 12)).astype(np.float32)


@pytest.fixture(scope="session")
def actions() -> Callable[..., np.ndarray]:
    return random_actions


def place(state: EnvState, world: int, qpos: np.ndarray) -> EnvState:
    """Return ``state`` with one world at rest in the pose ``qpos`` [19], its targets there too."""
    pose = jnp.asarray(qpos, jnp.float32)
    data = state.data.replace(
        qpos=state.data.qpos.at[world].set(pose), qvel=state.data.qvel.at[world].set(0.0)
    )
    both = jnp.stack([pose[7:], pose[7:]])
    filters = state.world.filter
    filters = filters.replace(
        inputs=filters.inputs.at[world].set(both), outputs=filters.outputs.at[world].set(both)
    )
    return state.replace(data=data, world=state.world.replace(filter=filters))


@pytest.fixture(scope="session")
def put() -> Callable[[EnvState, int, np.ndarray], EnvState]:
    return place


def upside_down() -> np.ndarray:
    """Return qpos [19] of a robot on its back: trunk, hips and thighs will touch the ground."""
    qpos = np.zeros(19)
    qpos[2:5] = [0.05, 0.0, 1.0]  # a half turn about x
    qpos[7:] = np.tile([0.0, 0.9, -1.8], 4)
    return qpos


@pytest.fixture(scope="session")
def fallen() -> np.ndarray:
    return upside_down()


FOUR = np.tile([0.0, 0.9, -1.8], 4)
FOLDED = np.array([0.8, 0.9, -1.8])
POSES: dict[str, tuple[tuple[float, float, float], np.ndarray, float, set[str]]] = {
    "on four feet": ((0, 0, 0), FOUR, 0.0005, {"foot"}),
    "on the hind feet": ((0, -80, 0), np.r_[FOUR[:6], [0, 1.9, -1.2] * 2], 0.0005, {"foot"}),
    "kneeling": ((0, 0, 0), np.tile([0, 0.6, -2.4], 4), 0.0005, {"calf"}),
    "on its side": ((0, 0, 90), FOUR, 0.0035, {"foot", "thigh"}),
    "on the hips": ((0, 0, 90), np.r_[FOLDED, FOUR[:3], FOLDED, FOUR[:3]], 0.0005, {"hip"}),
    "on its back": ((0, 0, 180), FOUR, 0.0005, {"trunk"}),
    "on its head": ((0, 55, 0), np.r_[[0, 2.6, -1] * 2, FOUR[6:]], 0.0005, {"trunk"}),
}
"""Name -> yaw, pitch, roll in deg, joint angles in rad, depth in m, parts that touch the ground."""


def ground_distances(model: mujoco.MjModel, qpos: np.ndarray) -> dict[str, float]:
    """Return the distance in m of every contact shape from the floor, by C MuJoCo."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    floor = model.geom("floor").id
    return {
        shape.name: mujoco.mj_geomDistance(model, data, floor, model.geom(shape.name).id, 3.0, None)
        for shape in A1.contact_geoms
    }


@pytest.fixture(scope="session")
def poses() -> dict[str, np.ndarray]:
    """Poses by name, put onto the ground by C MuJoCo, which also confirms what touches it."""
    model = build_scene("flat").mj_model
    made = {}
    for name, (euler, joints, depth, parts) in POSES.items():
        quat = Rotation.from_euler("ZYX", euler, degrees=True).as_quat(scalar_first=True)
        qpos = np.concatenate([[0.0, 0.0, 1.0], quat, joints])
        qpos[2] -= min(ground_distances(model, qpos).values()) + depth
        distances = ground_distances(model, qpos)
        assert parts == {s.body for s in A1.contact_geoms if distances[s.name] <= 0.0}, name
        made[name] = qpos
    return made


BATCH = 16
"""Poses judged in one compiled call; shorter lists are filled up with their last pose."""


@pytest.fixture(scope="session")
def judge() -> Callable[..., Outcome]:
    """``judge(task, qpos [K, 19], goal [2], previous_distance)`` -> outcomes of K single steps."""
    scene, dynamics = build_scene("flat"), make_dynamics()
    compiled: dict[Any, Callable[..., Outcome]] = {}

    def one(task: Task, pose: jax.Array, goal: jax.Array, previous: jax.Array) -> Outcome:
        view = base.make_view(scene, dynamics, pose[None], jnp.zeros((1, 18)))
        before = BipedState(previous_distance=previous)
        world: Any = SimpleNamespace(goal=goal, task=before)
        return task.judge(world, view, scene)

    def run(task: Any, qpos: Any, goal: Any = (1.0, 0.0), previous: float = 0.0) -> Outcome:
        key = (task.name, task.options, task.fixed_course)
        if key not in compiled:
            compiled[key] = jax.jit(jax.vmap(functools.partial(one, task), (0, None, None)))
        poses = np.array(qpos, np.float32)
        filled = np.concatenate([poses, np.repeat(poses[-1:], BATCH - len(poses), axis=0)])
        outcome = compiled[key](filled, np.array(goal, np.float32), np.float32(previous))
        return jax.tree.map(lambda leaf: np.asarray(leaf)[: len(poses)], outcome)

    return run
