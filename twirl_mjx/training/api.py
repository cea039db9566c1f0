"""Training from Python: one call, and what came out of it."""

from __future__ import annotations

import dataclasses
import functools
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from twirl_mjx import files
from twirl_mjx.cache import use_cache
from twirl_mjx.policies.identity import digest_of
from twirl_mjx.policies.learned import load_policy
from twirl_mjx.policies.resolve import Source
from twirl_mjx.tasks.registry import TASKS
from twirl_mjx.tasks.task import Task
from twirl_mjx.training import pipeline
from twirl_mjx.training.config import TrainConfig
from twirl_mjx.training.config_json import settle
from twirl_mjx.training.presets import default_preset, make_config
from twirl_mjx.training.rundir import RunDir
from twirl_mjx.training.sinks.base import Sink
from twirl_mjx.types import Policy, SourcePolicy


@dataclasses.dataclass(frozen=True)
class RunResult:
    """A finished run."""

    directory: Path
    """Where everything of it lies."""
    config: TrainConfig
    """Every setting."""
    measures: dict[str, float]
    """Means over the closing episodes on fresh seeds."""

    @property
    def policy(self) -> Policy:
        """The best policy by evaluation return: ``act(obs [..., O]) -> action [..., A]``, numpy."""
        return load_policy(RunDir(self.directory).policy)

    @functools.cached_property
    def curves(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Metric -> (transitions [n], values [n]) over the run."""
        found: dict[str, list[tuple[float, float]]] = {}
        columns = {"metric": str, "env_steps": float, "value": float}
        for row in files.read_rows(RunDir(self.directory).metrics, "a metrics table", columns):
            found.setdefault(row["metric"], []).append((row["env_steps"], row["value"]))
        curves = {name: np.array(points).T for name, points in found.items()}
        return {name: (steps, values) for name, (steps, values) in curves.items()}


@typing.overload
def train(task: str | type[Task], *, seeds: Iterable[int], **settings: Any) -> list[RunResult]: ...


@typing.overload
def train(task: str | type[Task], *, seeds: None = None, **settings: Any) -> RunResult: ...


def train(
    task: str | type[Task],
    *,
    seeds: Iterable[int] | None = None,
    preset: str | None = None,
    source: str | SourcePolicy | None = None,
    name: str | None = None,
    runs: Path | str = "runs",
    sinks: Sequence[str | Sink] = (),
    say: Callable[[str], None] = print,
    minutes: float | None = None,
    **settings: Any,
) -> RunResult | list[RunResult]:
    """Train a task to its budget, with every stage before it that is missing; resumes.

    Args:
        task: Name, ``file.py:Name``, or a task class of your own.
        seeds: Several seeds, trained in one program: a list of results, in their order.
        preset: ``paper``, ``cpu``, ``massive`` or ``debug``; ``cpu`` without an accelerator, else
            ``paper``.
        source: A policy object (``types.SourcePolicy``), or what ``--source`` takes. Runs of other
            objects need other names (``policies.identity`` says how objects are told apart).
        name: Name of the run; derived from task, variant, preset and seed by default.
        runs: Folder of all runs.
        sinks: Where metrics go beside ``metrics.csv``, TensorBoard and the terminal: names
            (``wandb``), ``file.py:Name``, or objects (``training.sinks.base.Sink``).
        say: Prints one line for a person.
        minutes: Save and stop after this wall time, when the epoch under way is done.
        **settings: Settings of the run by name (``seed=1``, ``shift="icy"``,
            ``total_env_steps=50_000``); those of a part as a mapping (``droq={"utd": 1.0}``,
            ``biped={"distance_weight": 4.0}``).

    Raises:
        ValueError: An unknown name or a value out of range, with the nearest valid choice.
        StoppedError: A signal, or the end of its time, stopped it after saving; the same call
            resumes.
    """
    use_cache()
    registered = task if isinstance(task, str) else TASKS.register(task).name
    preset = preset or default_preset()
    flat = _flat(settings)
    given = None
    if isinstance(source, str):
        flat["source"] = source
    elif source is not None:
        given = Source(source, f"object {type(source).__qualname__}", digest_of(source))
    learner = flat.pop("learner", TrainConfig.learner)
    config = settle(make_config(registered, preset, learner), flat)
    several = None if seeds is None else list(seeds)
    if several is not None and "seed" in settings:
        raise ValueError(f"seed {settings['seed']} beside seeds {several}: give one of them")
    deadline = pipeline.deadline_after(minutes)
    run_dirs = pipeline.run_seeds(
        config, several, preset, Path(runs), name, say, given, sinks, deadline
    )
    configs = (
        [config] if several is None else [dataclasses.replace(config, seed=s) for s in several]
    )
    results = [_result(*each) for each in zip(run_dirs, configs, strict=True)]
    return results[0] if several is None else results


def _flat(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings by their public names, ``droq.utd`` for ``droq={"utd": ...}``."""
    flat: dict[str, Any] = {}
    for key, value in settings.items():
        if isinstance(value, Mapping):
            flat |= {f"{key}.{inner}": v for inner, v in value.items()}
        else:
            flat[key] = value
    return flat


def _result(run_dir: RunDir, config: TrainConfig) -> RunResult:
    done = run_dir.finished()
    assert done is not None, "the pipeline returns finished runs"
    return RunResult(run_dir.path, config, done.measures)
