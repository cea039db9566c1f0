"""Experiment trackers as sinks: optional packages, each an extra of this one."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from types import ModuleType

from twirl_mjx.training.sinks.base import RunInfo

PROJECT = "twirl_mjx"


def required(package: str) -> ModuleType:
    """Import an optional package.

    Raises:
        ValueError: It is not installed; the message says what to install.
    """
    try:
        return importlib.import_module(package)
    except ImportError as error:
        raise ValueError(
            f"--log {package} needs a package that is not installed: pip install"
            f" 'twirl-mjx[{package}]' ({error})"
        ) from error


class Wandb:
    """Weights & Biases; ``WANDB_MODE=offline`` keeps all of it in the run's directory.

    Every start of a run is a run of its own there, in a group with the name of ours: what a crash
    voids cannot be taken back from the service, and lies in the earlier one.
    """

    def __init__(self) -> None:
        self._wandb = required("wandb")

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
        self._trackio = required("trackio")

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
