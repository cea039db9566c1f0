"""A small grid, synthetic runs, and an executor without Ray."""

from __future__ import annotations

import csv
import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from twirl_mjx.sweep.plan import Cell
from twirl_mjx.sweep.worker import Ending, Job, run_job
from twirl_mjx.training import config_json

GRID = '''
"""Two arms, two seeds, and a third arm with one."""
TASK = {"biped": {"task": "biped"}}
ZERO_SHOT = {"zs": {"variant": "zero-shot"}}
GRID = (
    {"preset": "debug", "seeds": (0, 1), "base": {"variant": "twirl"},
     "axes": {"task": TASK, "phi": {f"phi{p:g}": {"replay.phi": p} for p in (0.25, 0.5)}}},
    {"preset": "debug", "seeds": (0,), "axes": {"task": TASK, "variant": ZERO_SHOT}},
)
REDUCED = GRID
REDUCED_NOTE = "all of it"
'''


@pytest.fixture
def grid_file(tmp_path: Path) -> Path:
    path = tmp_path / "phi.py"
    path.write_text(GRID)
    return path


def write_csv(path: Path, columns: tuple[str, ...], rows: list[list[Any]]) -> None:
    with path.open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([columns, *rows])


def finish(cell: Cell, runs: Path, *, steps: int | None = None, epochs: int = 250) -> Path:
    """Write the files a finished run leaves; ``eval/return`` is ``seed + env_steps / 1000``."""
    run_dir = runs / cell.name
    run_dir.mkdir(parents=True, exist_ok=True)
    config = dataclasses.replace(cell.config, source=cell.source)
    (run_dir / "config.json").write_text(config_json.to_json(config))
    trained = config.variant != "zero-shot"
    steps = (config.total_env_steps if trained else 0) if steps is None else steps
    who = [cell.name, config.task, config.shift, config.variant, config.seed]
    if trained:
        rows = [
            [*who, metric, at, at // 2, at / 10, value]
            for at in range(1, epochs + 1)
            for metric, value in (
                ("eval/return", config.seed + at / 1000),
                ("critic_loss", 1.0),
                ("env_steps_per_s", 8.0),
                ("updates_per_s", 4.0),
            )
        ]
        columns = ("metric", "env_steps", "grad_steps", "wall_s", "value")
        write_csv(run_dir / "metrics.csv", (*WHO, *columns), rows)
    rows = [
        [*who, steps, episode, metric, episode + config.seed]
        for episode in range(config.eval.final_episodes)
        for metric in ("return", "episode_length", "unlisted")
    ]
    write_csv(run_dir / "eval.csv", (*WHO, "env_steps", "episode", "metric", "value"), rows)
    return run_dir


WHO = ("run", "task", "shift", "variant", "seed")


@pytest.fixture
def finish_run() -> Callable[..., Path]:
    return finish


@pytest.fixture(autouse=True)
def _plans_without_shipped_policies(no_shipped_policies: None) -> None:
    """The plan must not depend on which policies happen to be shipped."""


class HereExecutor:
    """Runs each job at once, in this process's child; a worker can be told to get lost."""

    def __init__(self, room: int = 2, lost: tuple[str, ...] = ()) -> None:
        self.room, self.lost = room, lost
        self.submitted: list[str] = []
        self.most_at_once = 0
        self._open: set[str] = set()

    def capacity(self) -> int:
        return self.room

    def submit(self, job: Job) -> tuple[int, Job]:
        self.submitted.append(job.name)
        self._open.add(job.name)
        self.most_at_once = max(self.most_at_once, len(self._open))
        return len(self.submitted), job

    def finished(self, handles: Any, timeout_s: float) -> list[Any]:
        return list(handles)[:1]

    def ending(self, handle: tuple[int, Job]) -> Ending:
        job = handle[1]
        self._open.discard(job.name)
        if job.name in self.lost:
            raise ConnectionError("the worker died")
        return run_job(job)

    def stop(self, handle: Any) -> None:
        pass

    def kill(self, handle: Any) -> None:
        pass


@pytest.fixture
def here_executor() -> type[HereExecutor]:
    return HereExecutor
