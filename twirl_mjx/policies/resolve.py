"""Any policy as one that acts in the worlds of a task: scripted, learned or ONNX."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from twirl_mjx.config import SCRIPTED_SOURCES, TrainConfig
from twirl_mjx.policies import scripted
from twirl_mjx.policies.clip import ClipPolicy
from twirl_mjx.policies.function import from_policy
from twirl_mjx.policies.learned import NumpyPolicy, load_policy
from twirl_mjx.policies.source import LearnedSource
from twirl_mjx.tasks.imitate import load_clip
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

    A learned policy observes as the task it was trained on, with that task's options in
    ``config``, and acts deterministically unless ``noise`` is asked for; an ONNX file sees the
    observations of the task it acts in.

    Raises:
        FileNotFoundError: Nothing to load there.
        PolicyFileError: The file is no policy.
    """
    if name in SCRIPTED_SOURCES:
        return ResolvedPolicy(_scripted(name, config), f"scripted {name}", None)
    loaded = load_policy(Path(name))
    header = getattr(loaded, "header", None)
    task = header.task if header is not None else None
    if not isinstance(loaded, NumpyPolicy):
        return ResolvedPolicy(from_policy(loaded), name, task, loaded)
    actor = jax.tree.map(jnp.asarray, dict(loaded.actor_params))
    observer = make_task(dataclasses.replace(config, task=loaded.header.task)).observer
    return ResolvedPolicy(LearnedSource(actor, observer, noise=noise), name, task, loaded)


def _scripted(name: str, config: TrainConfig) -> SourcePolicy:
    if name == "clip":
        return ClipPolicy(load_clip(config.imitate.clip))
    return scripted.get_scripted(name)
