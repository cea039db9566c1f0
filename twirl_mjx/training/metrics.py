"""What a run reports: metric names, the tidy ``metrics.csv``, TensorBoard and live progress."""

from __future__ import annotations

import contextlib
import csv
import difflib
import math
import os
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console

from twirl_mjx.training.progress import ProgressView, Snapshot

COLUMNS = (
    "run",
    "task",
    "shift",
    "variant",
    "seed",
    "metric",
    "env_steps",
    "grad_steps",
    "wall_s",
    "value",
)
"""Columns of ``metrics.csv``, one row per metric and epoch."""

IDENTITY = COLUMNS[:5]
CSV_NAME = "metrics.csv"
TENSORBOARD_DIR = "tensorboard"


class MetricInfo(NamedTuple):
    """Meaning of a metric."""

    description: str
    """What is measured, over what."""
    unit: str
    """Unit, ``1`` for a plain number."""


METRICS: dict[str, MetricInfo] = {
    # Episodes that ended during the epoch, exploring policy.
    "return": MetricInfo("mean undiscounted return of the episodes that ended", "1"),
    "episode_length": MetricInfo("mean length of the episodes that ended", "control steps"),
    "episodes": MetricInfo("episodes that ended", "1"),
    "terminated_share": MetricInfo("share of ended episodes that failed (no time limit)", "1"),
    "reward": MetricInfo("mean reward of one transition", "1"),
    "standing_time": MetricInfo(
        "mean time per episode with upright cosine c >= 0.7 and both front feet off the ground", "s"
    ),
    "min_distance": MetricInfo("mean over episodes of the smallest distance to the goal", "m"),
    "hurdles_passed": MetricInfo("mean number of hurdles passed per episode", "1"),
    "clean_clearances": MetricInfo("mean number of hurdles cleared in one flight phase", "1"),
    "forward_speed": MetricInfo("mean speed of the base along world x", "m/s"),
    # Learner, mean over the critic updates (or actor updates) of the epoch.
    "critic_loss": MetricInfo("mean squared TD error over ensemble and rows", "1"),
    "actor_loss": MetricInfo("mean of temperature * log_prob - mean critic value", "1"),
    "temperature_loss": MetricInfo("mean of temperature * (entropy - target entropy)", "1"),
    "temperature": MetricInfo("SAC's alpha, the weight of the entropy", "1"),
    "entropy": MetricInfo("policy entropy estimated by -log_prob of sampled actions", "nat"),
    "q_mean": MetricInfo("mean critic value of the minibatch actions", "1"),
    "target_q_mean": MetricInfo("mean TD target", "1"),
    "q_max": MetricInfo("largest critic value in a minibatch", "1"),
    "critic_grad_norm": MetricInfo("Euclidean norm of the critic gradient", "1"),
    "actor_grad_norm": MetricInfo("Euclidean norm of the actor gradient", "1"),
    # Bookkeeping.
    "env_steps_per_s": MetricInfo("transitions per second, compilation excluded", "1/s"),
    "updates_per_s": MetricInfo("critic updates per second, compilation excluded", "1/s"),
    "replay_ratio": MetricInfo("rows the critic learned from per transition, utd * batch", "1"),
    "online_rows": MetricInfo("filled rows of the online ring", "1"),
    "source_rows": MetricInfo("filled rows of the source ring", "1"),
    "dropped_transitions": MetricInfo(
        "transitions dropped because a state, observation, reward or action was not finite", "1"
    ),
    "compile_s": MetricInfo("time spent compiling since the last row", "s"),
}
"""The one table of metric names; the documentation is generated from it."""

FAMILIES: dict[str, MetricInfo] = {
    "reward/": MetricInfo("mean per transition of one unweighted reward term", "1"),
    "eval/": MetricInfo(
        "the metric after the slash, over evaluation episodes on separate seeds with the "
        "deterministic policy",
        "as named",
    ),
    "termination/": MetricInfo("share of ended episodes that ended by this cause", "1"),
    "world/": MetricInfo("mean over transitions of a task's per-world metric", "as in the task"),
}
"""Prefixes under which a task or an evaluation may add names of its own."""


def describe(name: str) -> MetricInfo:
    """Return the meaning of a metric.

    Raises:
        ValueError: unknown name; the message gives the closest known one.
    """
    if name in METRICS:
        return METRICS[name]
    for prefix, info in FAMILIES.items():
        if name.startswith(prefix) and len(name) > len(prefix):
            return info
    closest = difflib.get_close_matches(name, [*METRICS, *FAMILIES], 1, 0.0)[0]
    raise ValueError(
        f"unknown metric {name!r}; the closest known name is {closest!r}. New names belong in "
        f"METRICS, or under one of {', '.join(FAMILIES)}"
    )


def metrics_markdown() -> str:
    """Return the metric table as Markdown, for the documentation."""
    rows = [
        f"| `{name}` | {info.description} | {info.unit} |"
        for name, info in [*METRICS.items(), *((f"{k}<name>", v) for k, v in FAMILIES.items())]
    ]
    return "\n".join(["| metric | meaning | unit |", "|---|---|---|", *rows]) + "\n"


def truncate_csv(path: Path, env_steps: int) -> float:
    """Drop the rows after ``env_steps``, and any row a crash left unfinished.

    Args:
        path: a ``metrics.csv``; the file is replaced whole.
        env_steps: transitions at the checkpoint the run resumes from.

    Returns:
        ``wall_s`` of the last row kept, 0 without rows.

    Raises:
        ValueError: the file has other columns.
    """
    text = path.read_text()
    text = text[: text.rfind("\n") + 1]  # a row without its line end was being written
    rows = list(csv.reader(text.splitlines()))
    if rows and tuple(rows[0]) != COLUMNS:
        raise ValueError(f"{path} has columns {rows[0]}, expected {list(COLUMNS)}")
    kept = [row for row in rows[1:] if len(row) == len(COLUMNS) and int(row[6]) <= env_steps]
    partial = path.with_name(path.name + ".partial")
    with partial.open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([COLUMNS, *kept])
    partial.replace(path)
    return float(kept[-1][8]) if kept else 0.0


class RunLogger:
    """Writes one run's metrics and shows its progress; a context manager.

    Every ``log`` call appends to ``metrics.csv`` and TensorBoard and forces both to disk, so a
    killed run loses nothing it has reported. On a terminal a live panel shows the run; elsewhere
    each epoch is one line.
    """

    def __init__(
        self,
        run_dir: str | Path,
        identity: Mapping[str, Any],
        total_env_steps: int,
        stage: str,
        resume_env_steps: int = 0,
        *,
        console: Console | None = None,
        tensorboard: bool = True,
    ) -> None:
        """Open the run's files.

        Args:
            run_dir: the run's directory; created when missing.
            identity: the values of ``run, task, shift, variant, seed``.
            total_env_steps: transitions at which the stage is finished.
            stage: what the run is doing, for the display (``source``, ``collect``, ``train``).
            resume_env_steps: transitions of the checkpoint this run resumes from; rows after it
                are dropped, 0 starts the files anew.
            console: where progress goes; standard output by default.
            tensorboard: also write TensorBoard events.

        Raises:
            ValueError: identity with missing or unknown keys, or a foreign ``metrics.csv``.
        """
        if set(identity) != set(IDENTITY):
            raise ValueError(f"identity needs exactly {IDENTITY}, got {sorted(identity)}")
        self._identity = [str(identity[name]) for name in IDENTITY]
        run_dir = Path(run_dir)
        run_dir.mkdir(parents=True, exist_ok=True)
        path = run_dir / CSV_NAME
        resumes = resume_env_steps > 0 and path.exists()
        earlier = truncate_csv(path, resume_env_steps) if resumes else 0.0
        self._file = path.open("a" if resumes else "w", newline="")
        self._csv = csv.writer(self._file, lineterminator="\n")
        if not resumes:
            self._csv.writerow(COLUMNS)
            self._sync()
        self._board = _open_board(run_dir, resume_env_steps) if tensorboard else None
        self._start = time.monotonic() - earlier
        self._compile_s = 0.0
        self._last = (resume_env_steps, 0, time.monotonic()) if not resume_env_steps else None
        self._view = ProgressView(console or Console(), stage, self._identity[0], total_env_steps)
        self._view.start(resume_env_steps)

    def __enter__(self) -> RunLogger:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def log(self, env_steps: int, grad_steps: int, metrics: Mapping[str, Any]) -> None:
        """Append one epoch; NaN means undefined (no episode ended) and writes no row.

        Args:
            env_steps: transitions gathered so far.
            grad_steps: critic updates so far.
            metrics: name to scalar; the rates are added unless given.

        Raises:
            ValueError: a name that is not in ``METRICS`` or under one of ``FAMILIES``.
        """
        values = {name: float(np.asarray(value)) for name, value in metrics.items()}
        for name in values:
            describe(name)
        env_steps, grad_steps = int(env_steps), int(grad_steps)
        values = {**self._rates(env_steps, grad_steps), **values}
        wall_s = time.monotonic() - self._start
        for name, value in values.items():
            if not math.isnan(value):
                tail = [name, env_steps, grad_steps, f"{wall_s:.3f}", f"{value:.9g}"]
                self._csv.writerow([*self._identity, *tail])
        self._sync()
        if self._board is not None:
            for name, value in values.items():
                if not math.isnan(value):
                    self._board.add_scalar(name, value, env_steps)
            self._board.flush()
        self._view.update(Snapshot(env_steps, grad_steps, wall_s, values))

    def announce(self, text: str) -> None:
        """Print one line above the progress."""
        self._view.announce(text)

    @contextlib.contextmanager
    def compiling(self, name: str) -> Iterator[None]:
        """Announce a compilation, show its running time and leave it out of the rates.

        Args:
            name: function being compiled, for example ``train_epoch``.
        """
        start = time.monotonic()
        self._view.busy(f"compiling {name} ...")
        try:
            yield
        finally:
            elapsed = time.monotonic() - start
            self._compile_s += elapsed
            self._view.busy(None)
            self._view.announce(f"compiling {name} ... {elapsed:.0f} s")

    def close(self) -> None:
        """Close files and display; harmless when repeated."""
        self._view.stop()
        if self._board is not None:
            self._board.close()
            self._board = None
        if not self._file.closed:
            self._sync()
            self._file.close()

    def _sync(self) -> None:
        self._file.flush()
        os.fsync(self._file.fileno())

    def _rates(self, env_steps: int, grad_steps: int) -> dict[str, float]:
        """Return the rates since the last call; none on the first call after a resume."""
        now, compile_s = time.monotonic(), self._compile_s
        last, self._last, self._compile_s = self._last, (env_steps, grad_steps, now), 0.0
        rates = {"compile_s": compile_s} if compile_s else {}
        if last is None:
            return rates
        seconds = max(now - last[2] - compile_s, 1e-9)
        rates["env_steps_per_s"] = (env_steps - last[0]) / seconds
        rates["updates_per_s"] = (grad_steps - last[1]) / seconds
        return rates


def _open_board(run_dir: Path, resume_env_steps: int) -> Any:
    """Open the TensorBoard writer; events after the checkpoint are marked as superseded."""
    from tensorboardX import SummaryWriter

    purge = resume_env_steps + 1 if resume_env_steps else None
    return SummaryWriter(str(run_dir / TENSORBOARD_DIR), purge_step=purge)
