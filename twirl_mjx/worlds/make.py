"""Worlds from a config, or from a few words."""

from __future__ import annotations

import dataclasses
import pickle
from collections.abc import Mapping
from typing import Any

from twirl_mjx import records
from twirl_mjx.cache import use_cache
from twirl_mjx.sim.engine import make_engine
from twirl_mjx.sim.leaves import SceneKind, get_shift
from twirl_mjx.sim.scene import SimOptions, build_scene
from twirl_mjx.tasks.registry import TASKS
from twirl_mjx.tasks.task import Task
from twirl_mjx.worlds.check import check_task
from twirl_mjx.worlds.config import REGISTRIES, DynamicsOverrides, WorldConfig, world_fields
from twirl_mjx.worlds.vector import VectorEnv


def make_env(
    config: WorldConfig,
    *,
    num_envs: int | None = None,
    scene_kind: SceneKind | None = None,
    threads: int | None = None,
) -> VectorEnv:
    """Return the worlds a config describes.

    Args:
        config: Task, options, shift, course, episodes and engine.
        num_envs: Worlds, ``config.num_envs`` by default.
        scene_kind: Ground, that of the config's shift by default.
        threads: Host threads of the native engine, all by default.

    Raises:
        ValueError: Options that do not fit, or a task whose methods return something of another
            form than tasks must.
    """
    return _bind(config.make_task(), config, num_envs, scene_kind, threads)


def _bind(
    task: Task,
    config: WorldConfig,
    num_envs: int | None = None,
    scene_kind: SceneKind | None = None,
    threads: int | None = None,
) -> VectorEnv:
    kind = scene_kind or get_shift(config.shift).scene
    scene = build_scene(kind, robot=task.robot, collision=task.collision, options=SimOptions())
    how = (num_envs, scene_kind, threads)
    worlds = num_envs or config.num_envs
    return VectorEnv(
        task,
        scene,
        make_engine(config.engine, scene, worlds, threads),
        num_envs=worlds,
        episode_length=config.episode_length,
        dynamics=config.make_dynamics(),
        metric_names=check_task(task, scene),
        ranges=config.ranges,
    ).made_by(lambda: (_again, (config.uses, pickle.dumps(config), how)))


def _again(uses: tuple[str, ...], pickled: bytes, how: tuple[Any, Any, Any]) -> VectorEnv:
    """Return worlds of a pickled config, whose classes may come from a user's files."""
    for reference in uses:
        for registry in REGISTRIES:
            registry.admit_if_fits(reference)
    num_envs, scene_kind, threads = how
    config = pickle.loads(pickled)
    return make_env(config, num_envs=num_envs, scene_kind=scene_kind, threads=threads)


def make(
    task: str | type[Task] | Task,
    shift: str | None = None,
    num_envs: int | None = None,
    *,
    options: Any = None,
    config: WorldConfig | None = None,
    **settings: Any,
) -> VectorEnv:
    """Return vectorised worlds of a task.

    Args:
        task: Name, ``file.py:Name``, or a task of your own: the class, or an object of it, whose
            options are taken.
        shift: Name of a dynamics shift, or ``file.py:NAME``.
        num_envs: Worlds stepped together.
        options: Options of the task: an object of its ``Options``, or names and values.
        config: Everything that is not given here; without it the defaults, no shift and 256 worlds.
        **settings: Any other field of ``WorldConfig`` (``course``, ``episode_length``, ``engine``,
            ``shift_strength``, ``dynamics={"friction": 0.3}``, ``randomize=["payload=0:2"]``).

    Raises:
        ValueError: An unknown name or a value out of range, with the nearest valid choice.
    """
    use_cache()
    if isinstance(task, Task):
        options = task.options if options is None else options
    kind = task if isinstance(task, type) else type(task)
    name = task if isinstance(task, str) else TASKS.register(kind).name
    name = TASKS.admit(name)
    base = WorldConfig(task=name, num_envs=256)
    if config is not None:
        base = WorldConfig(**world_fields(config))
    if options is None and name == base.task:
        options = base.options
    elif isinstance(options, Mapping):
        options = records.from_dict(TASKS.get(name).Options, dict(options), f"options of {name}")
    for key, value in (("shift", shift), ("num_envs", num_envs)):
        if value is not None:
            settings[key] = value
    if isinstance(given := settings.get("dynamics"), Mapping):
        settings["dynamics"] = records.from_dict(DynamicsOverrides, dict(given), "dynamics")
    if "randomize" in settings:
        settings["randomize"] = tuple(settings["randomize"])
    known = tuple(field.name for field in dataclasses.fields(WorldConfig))
    for key in settings:
        records.check_choice("option of make", key, known)
    return make_env(dataclasses.replace(base, task=name, options=options, **settings))
