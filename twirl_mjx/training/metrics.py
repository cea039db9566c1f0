"""What a run reports: metric names, the tidy ``metrics.csv``, TensorBoard and live progress."""

from __future__ import annotations

import contextlib
import csv
import math
import os
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console

from twirl_mjx import files
from twirl_mjx.checks import nearest
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
    # Means over the episodes that ended during the epoch, exploring policy.
    "return": MetricInfo("undiscounted return of an episode", "1"),
    "episode_length": MetricInfo("control steps of an episode", "control steps"),
    "episodes": MetricInfo("number of episodes that ended in the epoch", "1"),
    "terminated": MetricInfo("share of episodes the task ended, not the time limit", "share"),
    "success": MetricInfo("share of episodes that met the task's success criterion", "share"),
    "standing_time": MetricInfo(
        "time per episode with upright cosine c >= 0.7 and both front feet off the ground", "s"
    ),
    "cosine": MetricInfo("upright cosine c, vertical part of the base x-axis", "1"),
    "min_distance": MetricInfo("closest approach to the goal in an episode", "m"),
    "tracking": MetricInfo("imitation reward over its maximum", "1"),
    "leaps": MetricInfo("leap cycles completed in an episode", "1"),
    "flights": MetricInfo("leap cycles with all feet airborne for 4 control steps or more", "1"),
    "hurdles_passed": MetricInfo("hurdles passed in an episode", "1"),
    "clean_clearances": MetricInfo("hurdles passed in a single flight phase", "1"),
    "hit_hurdle": MetricInfo("share of episodes ended by touching a hurdle", "share"),
    "fall": MetricInfo("share of episodes ended by a fall", "share"),
    "distance_x": MetricInfo("way made along x in an episode", "m"),
    # Means over the transitions of the epoch.
    "reward": MetricInfo("reward of one transition", "1"),
    "dropped_transitions": MetricInfo(
        "transitions dropped because a state, observation, reward or action was not finite", "1"
    ),
    # Means over the critic updates (or actor updates) of the epoch.
    "critic_loss": MetricInfo("squared TD error, mean over ensemble and rows", "1"),
    "actor_loss": MetricInfo("temperature * log_prob - mean critic value", "1"),
    "temperature_loss": MetricInfo("temperature * (entropy - target entropy)", "1"),
    "temperature": MetricInfo("SAC's alpha, the weight of the entropy", "1"),
    "entropy": MetricInfo("policy entropy, -log_prob of sampled actions", "nat"),
    "q_mean": MetricInfo("critic value of the minibatch actions", "1"),
    "target_q_mean": MetricInfo("TD target", "1"),
    "critic_grad_norm": MetricInfo("Euclidean norm of the critic gradient", "1"),
    # Bookkeeping.
    "env_steps_per_s": MetricInfo(
        "transitions per second; undefined for an epoch with a compilation", "1/s"
    ),
    "updates_per_s": MetricInfo(
        "critic updates per second; undefined for an epoch with a compilation", "1/s"
    ),
    "replay_ratio": MetricInfo("replayed rows per transition, utd * batch size", "1"),
    "source_rows": MetricInfo("filled rows of the source ring", "1"),
    "online_rows": MetricInfo("filled rows of the online ring", "1"),
    "compile_s": MetricInfo("time spent compiling (and running once) in the epoch", "s"),
}
"""The one table of metric names; the documentation is generated from it."""

FAMILIES: dict[str, MetricInfo] = {
    "eval/": MetricInfo(
        "the metric after the slash, over evaluation episodes on separate seeds with the "
        "deterministic policy",
        "as named",
    ),
    "world/": MetricInfo(
        "mean per transition of what the task reports: unweighted reward terms and measures",
        "as in the task",
    ),
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
    closest = nearest(name, [*METRICS, *FAMILIES])
    raise ValueError(
        f"unknown metric {name!r} (nearest: {closest!r}). New names belong in METRICS, or under"
        f" one of {', '.join(FAMILIES)}"
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
        ValueError: the file has other columns, or a damaged row before its last.
    """
    what = f"a metrics table with columns {','.join(COLUMNS)}"
    rows = files.read_rows(
        path, what, {"env_steps": int, "wall_s": files.number_text}, growing=True
    )
    if rows and tuple(rows[0]) != COLUMNS:
        raise ValueError(f"{path} has columns {list(rows[0])}, expected {list(COLUMNS)}")
    kept = [row for row in rows if row["env_steps"] <= env_steps]
    files.write_csv(path, [COLUMNS, *(list(row.values()) for row in kept)])
    return float(kept[-1]["wall_s"]) if kept else 0.0


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
        resume_env_steps: int | None = None,
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
                are dropped; None starts the files anew.
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
        begin = resume_env_steps or 0
        resumes = resume_env_steps is not None and path.exists()
        earlier = truncate_csv(path, begin) if resumes else 0.0
        self._file = path.open("a" if resumes else "w", newline="")
        self._csv = csv.writer(self._file, lineterminator="\n")
        if not resumes:
            self._csv.writerow(COLUMNS)
            self._sync()
        self._board = _open_board(run_dir, begin) if tensorboard else None
        self._start = time.monotonic() - earlier
        self._compile_s = self._aside_s = 0.0
        self._last = (0, 0, time.monotonic()) if not begin else None
        self._view = ProgressView(console or Console(), stage, self._identity[0], total_env_steps)
        self._view.start(begin)

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
        """Announce a compilation and show its running time; its epoch gets no rates.

        Args:
            name: function being compiled, for example ``train_epoch``.
        """
        start = time.monotonic()
        with self.aside(f"compiling {name} ..."):
            yield
        elapsed = time.monotonic() - start
        self._compile_s += elapsed
        self._view.announce(f"compiling {name} ... {elapsed:.0f} s")

    @contextlib.contextmanager
    def aside(self, text: str) -> Iterator[None]:
        """Show that something other than training goes on and leave its time out of the rates.

        Args:
            text: what goes on, for example ``evaluating ...``.
        """
        start = time.monotonic()
        self._view.busy(text)
        try:
            yield
        finally:
            self._aside_s += time.monotonic() - start
            self._view.busy(None)

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
        """Return the rates since the last call, or the compilation time if there was one."""
        now, compile_s, aside_s = time.monotonic(), self._compile_s, self._aside_s
        last, self._last = self._last, (env_steps, grad_steps, now)
        self._compile_s = self._aside_s = 0.0
        if compile_s:
            return {"compile_s": compile_s}
        seconds = 0.0 if last is None else now - last[2] - aside_s
        if last is None or seconds <= 0.0:
            return {}
        return {
            "env_steps_per_s": (env_steps - last[0]) / seconds,
            "updates_per_s": (grad_steps - last[1]) / seconds,
        }


def _open_board(run_dir: Path, resume_env_steps: int) -> Any:
    """Open the TensorBoard writer; events after the checkpoint are marked as superseded."""
    from tensorboardX import SummaryWriter

    purge = resume_env_steps + 1 if resume_env_steps else None
    return SummaryWriter(str(run_dir / TENSORBOARD_DIR), purge_step=purge)
