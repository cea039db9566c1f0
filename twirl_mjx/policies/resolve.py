"""Any policy as one that acts in the worlds of a task: scripted, learned or ONNX."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from twirl_mjx import config_json
from twirl_mjx.checks import check_choice
from twirl_mjx.config import SCRIPTED_SOURCES, TASKS, TrainConfig
from twirl_mjx.droq.learner import LEARNER
from twirl_mjx.policies import scripted
from twirl_mjx.policies.clip import ClipPolicy
from twirl_mjx.policies.function import from_policy
from twirl_mjx.policies.learned import NumpyPolicy, PolicyFileError, PolicyHeader, load_policy
from twirl_mjx.policies.onnx_file import OnnxPolicy
from twirl_mjx.policies.source import ActOnObs, ObservingSource, OwnTaskSource, actor_act
from twirl_mjx.presets import make_config
from twirl_mjx.tasks.imitate import load_clip
from twirl_mjx.tasks.observations import layout_size
from twirl_mjx.tasks.registry import make_task
from twirl_mjx.types import SourcePolicy


@dataclasses.dataclass(frozen=True)
class ResolvedPolicy:
    """A policy ready to act, and what is known of it."""

    policy: SourcePolicy
    origin: str
    task: str | None
    """Task it was trained for; None for scripted and anonymous policies."""
    loaded: Any = None
    """The numpy policy behind it, if any."""


def resolve_policy(name: str, config: TrainConfig, *, noise: bool = False) -> ResolvedPolicy:
    """Return a policy by scripted name or by path (policy file, ONNX file, run directory).

    A policy that says its task sees the worlds as that task shows them, with the options (the
    clip, say) it was trained with; an ONNX file of other origin sees the observations of the task
    it acts in. Learned policies act deterministically unless ``noise`` is asked for.

    Raises:
        FileNotFoundError: Nothing to load there.
        PolicyFileError: The file is no policy, or of a task or with options unknown here.
        ValueError: The policy takes observations of another size than its task shows.
    """
    if name in SCRIPTED_SOURCES:
        return ResolvedPolicy(_scripted(name, config), f"scripted {name}", None)
    loaded = load_policy(Path(name))
    task = config.task if loaded.header is None else loaded.header.task
    own = config_of_source(config, loaded.header, name)
    observer = make_task(own).observer
    size = layout_size(observer.layout)
    if size != loaded.observation_size:
        raise ValueError(
            f"{name} takes observations of {loaded.observation_size} numbers, task {task} shows"
            f" {size} (nearest: a policy trained for {task} by this version)"
        )
    act = _act_of(loaded, noise)
    foreign = own.task != config.task
    policy = ObservingSource(act, observer) if foreign else OwnTaskSource(act)
    return ResolvedPolicy(policy, name, None if loaded.header is None else task, loaded)


def config_of_source(
    config: TrainConfig, header: PolicyHeader | None, origin: str = "the policy"
) -> TrainConfig:
    """Return the config under which a policy observes: its own task and that task's options.

    Args:
        config: Config of the worlds; kept as it is where these are of the policy's own task.
        header: What the policy says about itself; None if it says nothing.
        origin: What an error calls the policy, its file for example.

    Raises:
        PolicyFileError: A task, or an option on its card, that this version does not have.
    """
    if header is None or header.task == config.task:
        return config
    return with_card_options(config, header, origin)


def config_of_card(header: PolicyHeader, origin: str) -> TrainConfig:
    """Return the paper's config of a policy's own task, with the task options on its card.

    Raises:
        PolicyFileError: As :func:`config_of_source`.
    """
    _check_task(header, origin)
    return with_card_options(make_config(header.task), header, origin)


def with_card_options(config: TrainConfig, header: PolicyHeader, origin: str) -> TrainConfig:
    """Return the config in a policy's own task, with the task options on its card.

    Options that the card does not have stay those of the config.

    Raises:
        PolicyFileError: As :func:`config_of_source`.
    """
    _check_task(header, origin)
    base = getattr(config, header.task)
    given = header.card.get("options", {})
    try:
        values = dataclasses.asdict(base) | dict(given)
        own = config_json.from_dict(type(base), values, f"the options of task {header.task}")
    except (TypeError, ValueError) as error:
        raise PolicyFileError(
            f"{origin}: the options on its card are {given!r}, which this version does not"
            f" understand: {error}"
        ) from error
    return dataclasses.replace(config, task=header.task, **{header.task: own})


def _check_task(header: PolicyHeader, origin: str) -> None:
    try:
        check_choice("task", header.task, TASKS)
    except (TypeError, ValueError) as error:
        raise PolicyFileError(f"{origin}: {error}") from error


def _act_of(loaded: NumpyPolicy | OnnxPolicy, noise: bool) -> ActOnObs:
    if isinstance(loaded, NumpyPolicy):
        actor = jax.tree.map(jnp.asarray, dict(loaded.actor_params))
        return actor_act(LEARNER, actor, noise=noise)
    return from_policy(loaded).on_observation


def _scripted(name: str, config: TrainConfig) -> SourcePolicy:
    if name == "clip":
        return ClipPolicy(load_clip(config.imitate.clip))
    return scripted.get_scripted(name)
