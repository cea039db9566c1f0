"""Any policy as one that acts in the worlds of a task: scripted, learned or ONNX."""

from __future__ import annotations

import dataclasses
import hashlib
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from twirl_mjx import records
from twirl_mjx.checks import check_choice
from twirl_mjx.droq.learner import LEARNER
from twirl_mjx.policies import scripted
from twirl_mjx.policies.clip import ClipPolicy
from twirl_mjx.policies.function import from_policy
from twirl_mjx.policies.learned import NumpyPolicy, PolicyFileError, PolicyHeader, load_policy
from twirl_mjx.policies.onnx_file import OnnxPolicy
from twirl_mjx.policies.source import ActOnObs, ObservingSource, OwnTaskSource, actor_act
from twirl_mjx.sim.robots import ROBOTS
from twirl_mjx.tasks.imitate import ImitateOptions, load_clip
from twirl_mjx.tasks.observations import layout_size
from twirl_mjx.tasks.registry import TASKS
from twirl_mjx.types import SourcePolicy
from twirl_mjx.worlds.config import WorldConfig, in_task

SCRIPTED_SOURCES = (*scripted.SCRIPTED, "clip")
"""Sources nobody trained, by name; ``clip`` plays the actions planned for a clip."""


@dataclasses.dataclass(frozen=True)
class Source:
    """A policy ready to act, and what is known of it."""

    policy: SourcePolicy
    origin: str
    """Where it came from: a path, or ``scripted NAME``."""
    digest: str
    """Changes with what decides its actions."""
    task: str | None = None
    """Task it was trained for; None for scripted and anonymous policies."""
    loaded: Any = None
    """The numpy policy behind it, if any."""
    run_dir: Path | None = None
    """Directory of the run that trained it, if that is how it was named."""

    @property
    def identity(self) -> dict[str, str]:
        """What a run directory remembers of its source."""
        return {"origin": self.origin, "digest": self.digest}


def resolve_policy(name: str, config: WorldConfig, *, noise: bool = False) -> Source:
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
        return _scripted(name, config)
    path = Path(name)
    loaded = load_policy(path)
    header = loaded.header
    own = config_of_source(config, header, name)
    observer = own.make_task().observer
    size = layout_size(observer.layout)
    if size != loaded.observation_size:
        raise ValueError(
            f"{name} takes observations of {loaded.observation_size} numbers, task {own.task}"
            f" shows {size} (nearest: a policy trained for {own.task} by this version)"
        )
    act = _act_of(loaded, noise)
    foreign = own.task != config.task
    return Source(
        policy=ObservingSource(act, observer) if foreign else OwnTaskSource(act),
        origin=name,
        digest=_digest(path, header),
        task=None if header is None else own.task,
        loaded=loaded,
        run_dir=path if path.is_dir() else None,
    )


def _digest(path: Path, header: PolicyHeader | None) -> str:
    if path.is_dir() and header is not None:
        return f"{header.config_digest}@{header.card.get('env_steps')}"
    return hashlib.sha256(path.read_bytes()).hexdigest()[:12]


def config_of_source(
    config: WorldConfig, header: PolicyHeader | None, origin: str = "the policy"
) -> WorldConfig:
    """Return the worlds as a policy observes them: its own task, with that task's options.

    Args:
        config: The worlds; kept as they are where these are of the policy's own task.
        header: What the policy says about itself; None if it says nothing.
        origin: What an error calls the policy, its file for example.

    Raises:
        PolicyFileError: A task, or an option on its card, that this version does not have.
    """
    if header is None or header.task == config.task:
        return config
    return in_task(config, header.task, options_of_card(header, origin))


def config_of_card(header: PolicyHeader, origin: str) -> WorldConfig:
    """Return the worlds of a policy's own task, with the task options on its card.

    Raises:
        PolicyFileError: As :func:`config_of_source`.
    """
    return WorldConfig(task=header.task, options=options_of_card(header, origin))


def options_of_card(header: PolicyHeader, origin: str) -> Any:
    """Return the options on a policy's card, for evaluation; the paper's where it has none.

    Raises:
        PolicyFileError: As :func:`config_of_source`.
    """
    try:
        check_choice("task", header.task, TASKS.names())
    except (TypeError, ValueError) as error:
        raise PolicyFileError(f"{origin}: {error}") from error
    given = header.card.get("options", {})
    paper = TASKS.get(header.task).paper_options()
    try:
        values = dataclasses.asdict(paper) | dict(given)
        own = records.from_dict(type(paper), values, f"the options of task {header.task}")
        return TASKS.get(header.task).evaluation_options(own)
    except (TypeError, ValueError) as error:
        raise PolicyFileError(
            f"{origin}: the options on its card are {given!r}, which this version does not"
            f" understand: {error}"
        ) from error


def _act_of(loaded: NumpyPolicy | OnnxPolicy, noise: bool) -> ActOnObs:
    if isinstance(loaded, NumpyPolicy):
        actor = jax.tree.map(jnp.asarray, dict(loaded.actor_params))
        return actor_act(LEARNER, actor, noise=noise)
    return from_policy(loaded).on_observation


def _scripted(name: str, config: WorldConfig) -> Source:
    if name != "clip":
        return Source(
            scripted.get_scripted(name, ROBOTS.get(config.robot)), f"scripted {name}", name
        )
    clip = load_clip(clip_name(config), ROBOTS.get(config.robot))
    content = hashlib.sha256(clip.qpos.tobytes()).hexdigest()[:12]
    return Source(ClipPolicy(clip), f"scripted {name}", f"clip {content}")


def clip_name(config: WorldConfig) -> str:
    """Return the clip a config names in its options or in those of its source's task."""
    for options in (config.options, getattr(config, "source_options", None)):
        if isinstance(options, ImitateOptions):
            return options.clip
    return ImitateOptions().clip
