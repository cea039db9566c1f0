"""A run's config as JSON and as flat names: the same names as on the command line and in grids.

The options of the task stand under its name (``biped.distance_weight``), those of its source's task
under that one's; the fields of parts under the part's (``droq.utd``); all others by themselves.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from typing import Any

from twirl_mjx import records
from twirl_mjx.checks import check_choice
from twirl_mjx.tasks.registry import TASKS
from twirl_mjx.training.config import TrainConfig
from twirl_mjx.training.learners import LEARNERS, settings_of


def flatten(config: TrainConfig) -> dict[str, Any]:
    """Return a config as a flat dict of public names."""
    out: dict[str, Any] = {}
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        prefix = _sections(config.task, config.learner).get(field.name, field.name)
        if dataclasses.is_dataclass(value):
            out |= {f"{prefix}.{key}": inner for key, inner in records.flatten(value).items()}
        elif field.name not in ("options", "source_options"):
            out[field.name] = value
    return out


def _sections(task: str, learner: str) -> dict[str, str | None]:
    """Return under which name the options of a task, of its source's, of a learner stand."""
    return {"options": task, "source_options": TASKS.get(task).source, "droq": learner}


def nest(flat: Mapping[str, Any]) -> dict[str, Any]:
    """Return flat names as a dict of dicts, one level for the dot."""
    out: dict[str, Any] = {}
    for name, value in flat.items():
        part, _, leaf = name.partition(".")
        if leaf:
            out.setdefault(part, {})[leaf] = value
        else:
            out[part] = value
    return out


def to_json(config: TrainConfig) -> str:
    """Return the config as indented JSON with every field."""
    return json.dumps(nest(flatten(config)), indent=2, sort_keys=True) + "\n"


def from_json(text: str) -> TrainConfig:
    """Read a config written by :func:`to_json`, or by version 0.1.

    Raises:
        ValueError: The text is not JSON, or holds an unknown key or a bad value.
    """
    return from_record(json.loads(text))


def from_record(record: Any) -> TrainConfig:
    """Return the config in a parsed JSON document of this version or of 0.1.

    Raises:
        ValueError: As :func:`from_json`.
    """
    is_old = isinstance(record, dict) and "env" in record
    return from_dict(_from_version_0_1(record) if is_old else record)


def from_dict(record: Any) -> TrainConfig:
    """Return the config of nested plain values.

    Raises:
        ValueError: An unknown key, with the nearest valid one, or a value of another type than
            its field's or out of range.
    """
    if not isinstance(record, dict):
        raise ValueError(f"config is {record!r}, expected names and values")
    values = dict(record)
    task = values.get("task", TrainConfig.task)
    records.check_type("task", task, str)
    learner = values.get("learner", TrainConfig.learner)
    records.check_type("learner", learner, str)
    for reference in values.get("uses", ()):
        TASKS.admit_if_fits(reference)
        LEARNERS.admit_if_fits(reference)
    task = values["task"] = TASKS.admit(task)
    learner = values["learner"] = LEARNERS.admit(learner)
    sections = _sections(task, learner)
    kinds = {name: TASKS.get(name).Options for f, name in sections.items() if f != "droq" and name}
    kinds[learner] = settings_of(learner)
    names = [field.name for field in dataclasses.fields(TrainConfig) if field.name not in sections]
    for key in values:
        check_choice("key in config", key, (*names, *kinds))
    parts = {
        field: records.from_dict(kinds[name], values.pop(name, {}), f"config.{name}")
        for field, name in sections.items()
        if name is not None
    }
    return records.from_dict(TrainConfig, values | parts)


def settle(config: TrainConfig, settings: Mapping[str, Any]) -> TrainConfig:
    """Return a config with fields changed, all at once, by their public names.

    Raises:
        ValueError: An unknown field (with the nearest), or a value of another type or out of range.
    """
    flat = flatten(config)
    for name in settings:
        check_choice("config field", name, tuple(flat))
    return from_dict(nest(flat | dict(settings)))


def diff(a: TrainConfig, b: TrainConfig) -> list[str]:
    """Return one line ``key: a -> b`` for every field in which two configs differ."""
    flat_a, flat_b = flatten(a), flatten(b)
    names = dict.fromkeys([*flat_a, *flat_b])
    absent = "not there"
    return [
        f"{name}: {flat_a.get(name, absent)!r} -> {flat_b.get(name, absent)!r}"
        for name in names
        if flat_a.get(name, absent) != flat_b.get(name, absent)
    ]


def departures(config: TrainConfig) -> dict[str, Any]:
    """Return the fields of a config that are not the default, flat.

    What identifies a run: a field that a later version adds, at its default, changes nothing, nor
    does the place of a user's file.
    """
    default = flatten(TrainConfig(task=config.task, learner=config.learner, uses=config.uses))
    default |= {"task": TrainConfig.task, "learner": TrainConfig.learner}
    return {key: value for key, value in flatten(config).items() if value != default[key]}


def _from_version_0_1(record: dict[str, Any]) -> dict[str, Any]:
    """Return a config of version 0.1, which held the options of four tasks, in today's form."""
    env = record["env"]
    task = record["task"]
    sections = {name for name in _sections(task, "droq").values() if name}
    others = {"stand", "biped", "imitate", "hurdles"} - sections
    new = {key: value for key, value in record.items() if key not in {"env", *others}}
    if "stand" in sections:  # its goals were those of the other upright task
        goals = ("goal_mean_radius", "goal_min_radius", "goal_max_radius", "fixed_goal")
        new["stand"] = record["stand"] | {key: record["biped"][key] for key in goals}
    new |= {key: env[key] for key in ("num_envs", "engine", "course")}
    new["episode_length"] = env.get("train_episode_length") or env["episode_length"]
    new["eval"] = record["eval"] | {"episode_length": env["episode_length"]}
    return new
