"""Learners by the class of their settings: those of a config decide who trains the run."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

from twirl_mjx.droq.config import DroqConfig
from twirl_mjx.plugins import Registry

if TYPE_CHECKING:
    from twirl_mjx.types import Learner, LearnerConfig

DROQ = "droq"
"""Name of the built-in learner."""
READ = ("utd", "updates_per_block", "batch_size")
"""Settings of a learner that training reads."""


def accept(item: Any) -> Learner:
    """Return a learner after checking its settings.

    Raises:
        ValueError: It is no ``types.Learner``, or the class of its settings is that of another
            learner, or lacks what training reads (``types.LearnerConfig``).
    """
    from twirl_mjx.types import Learner  # needs jax, which options do not

    if not isinstance(item, Learner):
        raise ValueError(f"{item!r} is no learner: expected an object of twirl_mjx.types.Learner")
    kind = item.Config
    missing = [name for name in READ if not hasattr(kind, name)]
    if missing or not (dataclasses.is_dataclass(kind) and kind.__hash__):
        raise ValueError(
            f"learner {item.name}: {kind.__name__} should be a frozen dataclass with defaults"
            f" for {', '.join(READ)}" + (f"; it has no {', '.join(missing)}" if missing else "")
        )
    for other in map(LEARNERS.get, LEARNERS.names()):
        if other.Config is kind and other is not item:
            raise ValueError(
                f"learner {item.name}: {kind.__name__} holds the settings of learner"
                f" {other.name}; derive a class of its own"
            )
    return item


LEARNERS: Registry[Learner] = Registry(
    "learner",
    accept=accept,
    group="twirl_mjx.learners",
    shipped={DROQ: "twirl_mjx.droq.learner:LEARNER"},
)
"""The one list of learners."""

register = LEARNERS.register


def settings_of(name: str) -> type:
    """Return the class of a learner's settings; for DroQ's the learner itself is not loaded."""
    return DroqConfig if name == DROQ else LEARNERS.get(name).Config


def learner_of(config: LearnerConfig) -> Learner:
    """Return the learner whose settings these are.

    Raises:
        ValueError: Nobody registered a learner with such settings.
    """
    for learner in map(LEARNERS.get, LEARNERS.names()):
        if learner.Config is type(config):
            return learner
    raise ValueError(
        f"no learner has settings of class {type(config).__name__}: register it with"
        f" twirl_mjx.training.learners.register (known: {', '.join(LEARNERS.names())})"
    )
