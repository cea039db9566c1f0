"""Experiment trackers as sinks: optional packages, each an extra of this one."""

from __future__ import annotations

from collections.abc import Mapping

from twirl_mjx.plugins import required
from twirl_mjx.training.sinks.base import RunInfo

PROJECT = "twirl_mjx"


class Wandb:
    """Weights & Biases; ``WANDB_MODE=offline`` keeps all of it in the run's directory.

    Every start of a run is a run of its own there, in a group with the name of ours: what a crash
    voids cannot be taken back from the service, and lies in the earlier one.
    """

    def __init__(self) -> None:
        self._wandb = required("wandb", "--log wandb")

    def open(self, run: RunInfo) -> None:
        """Start a run."""
        name = run.identity["run"]
        self._run = self._wandb.init(
            project=PROJECT,
            group=name,
            name=name if run.resume_env_steps is None else f"{name} from {run.resume_env_steps}",
            job_type=run.stage,
            config={**run.identity, **run.config},
            dir=str(run.directory),
        )

    def log(
        self, env_steps: int, grad_steps: int, wall_s: float, values: Mapping[str, float]
    ) -> None:
        """Log one epoch at its transitions."""
        self._run.log({**values, "grad_steps": grad_steps, "wall_s": wall_s}, step=env_steps)

    def close(self) -> None:
        """End the run."""
        self._run.finish()


class Trackio:
    """Trackio, which keeps its tables on this machine; starts and groups are those of `Wandb`."""

    def __init__(self) -> None:
        self._trackio = required("trackio", "--log trackio")

    def open(self, run: RunInfo) -> None:
        """Start a run."""
        name = run.identity["run"]
        self._trackio.init(
            project=PROJECT,
            group=name,
            name=name if run.resume_env_steps is None else f"{name} from {run.resume_env_steps}",
            config={**run.identity, **run.config},
        )

    def log(
        self, env_steps: int, grad_steps: int, wall_s: float, values: Mapping[str, float]
    ) -> None:
        """Log one epoch at its transitions."""
        self._trackio.log({**values, "grad_steps": grad_steps, "wall_s": wall_s}, step=env_steps)

    def close(self) -> None:
        """End the run."""
        self._trackio.finish()
