"""Synthetic result tables. They are written below ``tmp_path`` only, never next to real results."""

import csv
import json
from collections.abc import Callable, Iterable
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import pytest

from twirl_mjx.deploy.video import write_video
from twirl_mjx.figures.report import Media, write_report

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


def curve_rows(
    task, shift, variant, seed, *, steps=100_000, points=21, level=None, extra=(), standing=False
):
    """Rows of one run whose return rises to ``level``; untrained variants have one row."""
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
        identity, at_step = [run, task, shift, variant, seed], [at, 20 * at, 0.01 * at]
        yield [*identity, "return", *at_step, value, *extra]
        if standing:
            yield [*identity, "standing_time", *at_step, 14 * level * growth, *extra]


def episode_rows(task, shift, variant, seed, *, episodes=12):
    rng = np.random.default_rng([seed, *map(ord, task + shift + variant)])
    for episode in range(episodes):
        level = LEVEL[variant] * (1.0 if shift == "none" else 0.7)
        row = [f"{task}-{variant}-{seed}", task, shift, variant, seed, 100_000, episode]
        yield [*row, "return", 1000 * level + 80 * rng.normal()]
        yield [*row, "success", float(rng.random() < level)]


BASE = {"variant": "scratch"}
FACTS = {
    "axes": {
        "task": {"order": ["biped", "hurdles"]},
        "variant": {"order": [*LEVEL]},
        "shift": {"order": ["none", *SHIFTS]},
    },
    "measures": {
        "success": {"unit": "share"},
        "standing_time": {"unit": "s"},
        "min_distance": {"unit": "m", "smaller_is_better": True},
    },
}


def write_facts(folder: Path, **more) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "grid.json").write_text(json.dumps(FACTS | more))


def fill_results(
    root: Path, *, tasks=("biped", "hurdles"), shifts=SHIFTS, seeds=(0, 1, 2), points=21
) -> Path:
    """Write a table for every grid of the paper, and an evaluation."""
    notes = [f"reduced: 100k of 1M transitions, {len(seeds)} seeds"]

    def arm(grid, name, cells, columns=CURVES, **options):
        rows = [
            r for t, shift, v in cells for s in seeds for r in curve_rows(t, shift, v, s, **options)
        ]
        command = f"command: make sweep GRID={grid} ARGS=--only={name}"
        write_csv(root / grid / f"{name}.csv", columns, rows, [*notes, command])

    for task in tasks:
        for variant in ("scratch", "twirl", "source"):
            cells, standing = [(task, "none", variant)], task == "biped"
            arm("tasks", f"{task}-{variant}", cells, points=points, standing=standing)
        for variant in ("twirl", "twirl+weights", "weights", "zero-shot"):
            cells = [(task, shift, variant) for shift in shifts]
            arm("shifts", f"{task}-{variant}", cells, points=points)
            cells = [(task, shift, variant, seed) for shift in ("none", *shifts) for seed in seeds]
            rows = [r for cell in cells for r in episode_rows(*cell)]
            write_csv(root / "evaluation" / f"{task}-{variant}.csv", EPISODES, rows)
    for grid, values in (("phi", (0, 0.25, 0.5, 0.75)), ("utd", (1, 5, 10, 20))):
        for i, value in enumerate(values):
            level = 0.4 + 0.2 * i - 0.05 * i**2
            options = {"level": level, "extra": (value,), "points": points}
            cells = [(tasks[0], "icy", "twirl")]
            arm(grid, f"{tasks[0]}-{value}", cells, [*CURVES, grid], **options)
    baselines = {"tasks": {"variant": "scratch"}, "shifts": {"variant": "weights"}}
    for place, grid in enumerate(("tasks", "shifts", "phi", "utd", "evaluation")):
        write_facts(root / grid, place=place, baseline=baselines.get(grid, {}))
    return root


@pytest.fixture
def write() -> Callable[..., Path]:
    """The writer: (path, columns, rows, notes)."""
    return write_csv


@pytest.fixture
def facts_of() -> Callable:
    """The writer of ``grid.json``: (folder, **keys)."""
    return write_facts


@pytest.fixture
def rows_of() -> Callable:
    return curve_rows


@pytest.fixture
def episodes_of() -> Callable:
    return episode_rows


@pytest.fixture(scope="session")
def results(tmp_path_factory) -> Path:
    """A results directory with every grid (read-only by agreement)."""
    root = tmp_path_factory.mktemp("results")
    return fill_results(root, shifts=("icy", "gravity"), seeds=(0, 1), points=6)


@pytest.fixture(scope="session")
def report_file(results, tmp_path_factory) -> Path:
    """A report of one task and its evaluation, with a clip and a picture."""
    root = tmp_path_factory.mktemp("report")
    for name in ("scratch", "twirl", "source"):
        source = results / "tasks" / f"biped-{name}.csv"
        lines = [line for line in source.read_text().splitlines() if "standing_time" not in line]
        (root / "results" / "tasks").mkdir(parents=True, exist_ok=True)
        (root / "results" / "tasks" / source.name).write_text("\n".join(lines) + "\n")
    for grid in ("tasks", "evaluation"):
        write_facts(root / "results" / grid, place=int(grid == "evaluation"), baseline=BASE)
    for name in ("twirl", "zero-shot"):
        rows = episode_rows("biped", "icy", name, 0)
        write_csv(root / "results" / "evaluation" / f"biped-{name}.csv", EPISODES, rows)
    write_video(root / "walk.mp4", [np.full((48, 64, 3), 40 * i, np.uint8) for i in range(5)])
    imageio.imwrite(root / "scene.png", np.full((40, 60, 3), 128, np.uint8))
    clip = Media(
        root / "walk.mp4", "Biped walks", "A robot on its hind legs", "make render TASK=biped"
    )
    media = [clip, root / "scene.png"]
    return write_report(root / "results", root / "report.html", media, say=lambda line: None)
