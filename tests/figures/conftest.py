"""Synthetic result tables. They are written below `tmp_path` only, never next to real results."""

import csv
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pytest

CURVES = ["run", "task", "shift", "variant", "seed", "metric", "env_steps", "grad_steps"]
CURVES += ["wall_s", "value"]
EPISODES = ["run", "task", "shift", "variant", "seed", "env_steps", "episode", "metric", "value"]
LEVEL = {
    "twirl": 0.9,
    "twirl+weights": 1.0,
    "weights": 0.6,
    "zero-shot": 0.45,
    "scratch": 0.3,
    "source": 0.35,
}
SHIFTS = ("bumpy", "icy", "weakened", "sloped", "gravity")


def write_csv(path: Path, columns: Iterable[str], rows: Iterable, notes: Iterable[str] = ()):
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="", encoding="utf-8") as handle:
        handle.writelines(f"# {note}\n" for note in notes)
        writer = csv.writer(handle, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(rows)
    return path


def curve_rows(task, shift, variant, seed, *, steps=100_000, points=21, level=None, extra=()):
    """Rows of one run whose return rises to `level`; untrained variants have one row."""
    words = (task, shift, variant, *extra)
    rng = np.random.default_rng([seed, *map(ord, "".join(map(str, words)))])
    run = "-".join(map(str, (*words, seed)))
    level = LEVEL[variant] if level is None else level
    untrained = variant in ("zero-shot", "source")
    scale = 1500.0 if task == "biped" else 400.0
    for x in [0.0] if untrained else np.linspace(0, 1, points):
        growth = 1.0 if untrained else 0.1 + 0.9 * (1 - np.exp(-4 * x))
        value = scale * (level * growth + 0.06 * rng.normal())
        at = round(steps * x)
        row = [run, task, shift, variant, seed, "return", at, 20 * at, 0.01 * at, value]
        yield [*row, *extra]
        standing = max(0.0, 14 * level * growth + 0.5 * rng.normal())
        yield [*row[:5], "standing_time", *row[6:9], standing, *extra]


def episode_rows(task, shift, variant, seed, *, episodes=12):
    rng = np.random.default_rng([seed, *map(ord, task + shift + variant)])
    for episode in range(episodes):
        level = LEVEL[variant] * (1.0 if shift == "none" else 0.7)
        row = [f"{task}-{variant}-{seed}", task, shift, variant, seed, 100_000, episode]
        yield [*row, "return", 1000 * level + 80 * rng.normal()]
        yield [*row, "success", float(rng.random() < level)]


def fill_results(root: Path, *, seeds=(0, 1, 2), steps=100_000) -> Path:
    """Write a table for every grid of the paper, and an evaluation."""
    reduced = [f"reduced: {steps // 1000}k of 1M transitions, {len(seeds)} seeds"]
    for task in ("biped", "hurdles"):
        for variant in ("scratch", "twirl", "source"):
            rows = [r for s in seeds for r in curve_rows(task, "none", variant, s, steps=steps)]
            notes = [*reduced, f"command: make sweep GRID=tasks ARGS=--only={task}-{variant}"]
            write_csv(root / "tasks" / f"{task}-{variant}.csv", CURVES, rows, notes)
        for variant in ("twirl", "twirl+weights", "weights", "zero-shot"):
            for shift in SHIFTS:
                rows = [r for s in seeds for r in curve_rows(task, shift, variant, s, steps=steps)]
                write_csv(root / "shifts" / f"{task}-{shift}-{variant}.csv", CURVES, rows, reduced)
            rows = [
                r
                for shift in ("none", *SHIFTS)
                for s in seeds
                for r in episode_rows(task, shift, variant, s)
            ]
            write_csv(root / "evaluation" / f"{task}-{variant}.csv", EPISODES, rows)
        for grid, values in (("phi", (0, 0.25, 0.5, 0.75)), ("utd", (1, 5, 10, 20))):
            for i, value in enumerate(values):
                setting = {"level": 0.4 + 0.2 * i - 0.05 * i**2, "extra": (value,)}
                rows = [
                    r
                    for s in seeds
                    for r in curve_rows(task, "icy", "twirl", s, steps=steps, **setting)
                ]
                write_csv(root / grid / f"{task}-{value}.csv", [*CURVES, grid], rows, reduced)
    return root


@pytest.fixture
def write() -> Callable[..., Path]:
    """The writer: (path, columns, rows, notes)."""
    return write_csv


@pytest.fixture
def rows_of() -> Callable:
    return curve_rows


@pytest.fixture
def episodes_of() -> Callable:
    return episode_rows


@pytest.fixture(scope="session")
def results(tmp_path_factory) -> Path:
    """A results directory with every grid (read-only by agreement)."""
    return fill_results(tmp_path_factory.mktemp("results"))
