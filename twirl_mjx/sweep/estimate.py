"""How long cells take: from finished runs of this machine, else from stated defaults."""

from __future__ import annotations

import contextlib
import csv
import dataclasses
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from twirl_mjx import files
from twirl_mjx.sweep.plan import Cell, reached_steps
from twirl_mjx.training.config import TrainConfig
from twirl_mjx.training.rundir import RunDir

START_S = 45.0
"""Start of a run: imports, cached programs, evaluations (measured on one busy core)."""
ENV_STEPS_PER_S = 5000.0
"""Transitions per second of the native engine on one core, without learning."""
UPDATES_PER_S = {128: 400.0, 256: 250.0}
"""Critic updates per second on one core by layer width; wider layers scale with the square."""


class Estimate(NamedTuple):
    """Expected time of a cell on one worker."""

    seconds: float
    """s."""
    basis: str
    """``measured`` (the same settings), ``scaled`` (the same learner) or ``default``."""


@dataclasses.dataclass(frozen=True)
class Speed:
    """What a run has measured."""

    learner: tuple[object, ...]
    """Settings that decide the cost of an update."""
    setting: tuple[object, ...]
    """Settings that decide the cost of a transition."""
    env_steps_per_s: float
    """Transitions per second, learning included."""
    updates_per_s: float
    """Critic updates per second, the worlds included."""


def measure(runs: Path) -> list[Speed]:
    """Return the median speeds of all runs below a folder that have measured any."""
    speeds = []
    for path in sorted(runs.glob("*/metrics.csv")):
        try:
            config, rates = RunDir(path.parent).read_config(), _rates(path)
        except (FileNotFoundError, ValueError, KeyError, csv.Error):
            continue  # not a run of this version: it tells nothing about these
        if rates is not None:
            speeds.append(Speed(_learner(config), _setting(config), *rates))
    return speeds


def _rates(path: Path) -> tuple[float, float] | None:
    """Return the median transitions and updates per second of the whole rows of a run."""
    values: dict[str, list[float]] = {"env_steps_per_s": [], "updates_per_s": []}
    lines = files.read_text(path, "the metrics of a run").splitlines(keepends=True)
    rows = csv.reader(line for line in lines if line.endswith("\n"))
    header = next(rows, [])
    for cells in rows:
        if len(cells) != len(header):
            continue  # cut off by a kill, or being written
        row = dict(zip(header, cells, strict=True))
        if row.get("metric") in values and row["grad_steps"] not in ("", "0"):
            with contextlib.suppress(ValueError):
                values[row["metric"]].append(float(row["value"]))
    medians = [statistics.median(v) if v else 0.0 for v in values.values()]
    return (medians[0], medians[1]) if min(medians) > 0.0 else None


def _learner(config: TrainConfig) -> tuple[object, ...]:
    names = ("hidden_sizes", "num_critics", "batch_size", "matmul_dtype", "fast", "form")
    return (config.learner, *(getattr(config.droq, name, None) for name in names))


def _setting(config: TrainConfig) -> tuple[object, ...]:
    droq = config.droq
    return (config.task, config.num_envs, config.engine, droq.utd, droq.updates_per_block)


def estimate(cell: Cell, runs: Path, speeds: Sequence[Speed]) -> Estimate:
    """Return the time a cell still needs on one worker."""
    config = cell.config
    if config.variant == "zero-shot":
        return Estimate(START_S, "default")
    steps = max(0, config.total_env_steps - reached_steps(runs / cell.name))
    alike = [s for s in speeds if s.learner == _learner(config)]
    same = [s.env_steps_per_s for s in alike if s.setting == _setting(config)]
    collecting = config.replay.source_size if config.uses_source_data and not cell.is_shifted else 0
    fixed = START_S + collecting / ENV_STEPS_PER_S
    if same:
        return Estimate(fixed + steps / statistics.median(same), "measured")
    rate = statistics.median(s.updates_per_s for s in alike) if alike else default_rate(config)
    seconds = fixed + steps / ENV_STEPS_PER_S + steps * config.droq.utd / rate
    return Estimate(seconds, "scaled" if alike else "default")


def default_rate(config: TrainConfig) -> float:
    """Return critic updates per second of one core where nothing was measured."""
    width = max(getattr(config.droq, "hidden_sizes", (min(UPDATES_PER_S),)))
    nearest = min((w for w in UPDATES_PER_S if w >= width), default=max(UPDATES_PER_S))
    return UPDATES_PER_S[nearest] * min(1.0, (nearest / width) ** 2)
