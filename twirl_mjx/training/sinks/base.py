"""What a sink is, and what it is told of the run."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

from twirl_mjx.types import MetricInfo

IDENTITY = ("run", "task", "shift", "variant", "seed")
"""What tells a run from others, in every table."""


@dataclasses.dataclass(frozen=True)
class RunInfo:
    """One stage of one run, as sinks see it."""

    directory: Path
    """The run's directory."""
    identity: Mapping[str, str]
    """The values of ``IDENTITY``."""
    total_env_steps: int
    """Transitions at which the stage is finished."""
    stage: str = "train"
    """What the run is doing, for the display."""
    resume_env_steps: int | None = None
    """Transitions of the checkpoint this start resumes from: whatever was logged after it is
    void, it will be logged again. None: the run begins anew, and all of it is void."""
    measures: Mapping[str, MetricInfo] = dataclasses.field(default_factory=dict)
    """Meaning of what the task measures of an episode."""
    learning: Mapping[str, MetricInfo] = dataclasses.field(default_factory=dict)
    """Meaning of what the learner reports."""
    config: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Every setting of the run by its dotted name."""

    def __post_init__(self) -> None:
        """Check the identity.

        Raises:
            ValueError: Missing or unknown keys.
        """
        if set(self.identity) != set(IDENTITY):
            raise ValueError(f"identity needs exactly {IDENTITY}, got {sorted(self.identity)}")


class Sink(Protocol):
    """Takes the metrics of a run somewhere.

    One object may serve several stages one after the other: ``open``, ``log`` any number of times,
    ``close``, and again. What it raises is announced once and ends its part in the run, not the
    run: only the built-in three (table, TensorBoard, terminal) are sure to have every number.
    """

    def open(self, run: RunInfo) -> None:
        """Begin a stage, before anything is compiled; ``run.resume_env_steps`` voids the rest."""
        ...

    def log(
        self, env_steps: int, grad_steps: int, wall_s: float, values: Mapping[str, float]
    ) -> None:
        """Take one epoch; what is durable when this returns outlives a kill.

        Args:
            env_steps: Transitions gathered so far.
            grad_steps: Critic updates so far.
            wall_s: Time since the run began, s, pauses between its starts apart.
            values: Metric name to value, read-only; undefined ones (NaN) are left out.
        """
        ...

    def close(self) -> None:
        """End the stage, also after an error or a signal."""
        ...
