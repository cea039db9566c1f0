"""Tasks by name, and worlds from a config."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

from twirl_mjx.checks import check_choice
from twirl_mjx.config import TASKS as TASK_NAMES
from twirl_mjx.config import TrainConfig
from twirl_mjx.sim.dynamics import SceneKind, get_shift, make_dynamics
from twirl_mjx.sim.engine import make_engine
from twirl_mjx.sim.scene import SimOptions, build_scene
from twirl_mjx.tasks.base import Task
from twirl_mjx.tasks.biped import Biped
from twirl_mjx.tasks.hurdles import Hurdles
from twirl_mjx.tasks.imitate import Imitate
from twirl_mjx.tasks.stand import Stand
from twirl_mjx.tasks.vector import VectorEnv

TASKS: dict[str, Callable[[TrainConfig], Task]] = {
    "stand": Stand,
    "biped": Biped,
    "imitate": Imitate,
    "hurdles": Hurdles,
}


def make_task(config: TrainConfig) -> Task:
    """Return the task a config names.

    Raises:
        ValueError: Unknown name, with the nearest valid one.
    """
    check_choice("task", config.task, TASK_NAMES)
    return TASKS[config.task](config)


def make_env(
    config: TrainConfig,
    *,
    training: bool = False,
    num_envs: int | None = None,
    scene_kind: SceneKind | None = None,
    threads: int | None = None,
) -> VectorEnv:
    """Return the worlds a config describes.

    Args:
        config: Task, shift and options.
        training: Start and cut episodes as configured for training (``stand.risen_fraction``,
            ``imitate.standing_fraction``, ``env.train_episode_length``), else as the task says.
        num_envs: Worlds, ``config.env.num_envs`` by default.
        scene_kind: Ground, that of the config's shift by default.
        threads: Host threads of the native engine, all by default.
    """
    if not training:
        config = dataclasses.replace(
            config,
            stand=dataclasses.replace(config.stand, risen_fraction=0.0),
            imitate=dataclasses.replace(config.imitate, standing_fraction=0.0),
            env=dataclasses.replace(config.env, train_episode_length=None),
        )
    task = make_task(config)
    scene = build_scene(
        scene_kind or get_shift(config.shift).scene,
        robot=task.robot,
        collision=task.collision,
        options=SimOptions(),
    )
    return VectorEnv(
        task,
        scene,
        make_engine(config.env.engine, scene, threads),
        num_envs=num_envs or config.env.num_envs,
        episode_length=config.env.train_episode_length or config.env.episode_length,
        dynamics=make_dynamics(config.shift, config.shift_strength),
    )


def make(
    task: str,
    shift: str | None = None,
    num_envs: int | None = None,
    *,
    shift_strength: float | None = None,
    engine: str | None = None,
    config: TrainConfig | None = None,
) -> VectorEnv:
    """Return vectorised worlds of a task.

    Args:
        task: stand, biped, imitate or hurdles.
        shift: none, bumpy, icy, weakened, sloped or gravity.
        num_envs: Worlds stepped together.
        shift_strength: 0 is nominal, 1 the paper's value.
        engine: auto, mjx or native.
        config: Everything that is not given here; without it the paper's defaults, no shift and
            256 worlds.

    Raises:
        ValueError: An unknown name or a value out of range, with the nearest valid choice.
    """
    check_choice("task", task, TASK_NAMES)
    if num_envs is None:
        num_envs = config.env.num_envs if config else 256
    base = config or TrainConfig()
    env = dataclasses.replace(base.env, num_envs=num_envs, **_given(engine=engine))
    droq = dataclasses.replace(base.droq, utd=base.droq.updates_per_block / num_envs)
    conditions = _given(shift=shift, shift_strength=shift_strength)
    return make_env(
        dataclasses.replace(base, task=task, env=env, droq=droq, **conditions), training=True
    )


def _given(**options: Any) -> dict[str, Any]:
    """Return the options that are not None."""
    return {name: value for name, value in options.items() if value is not None}
