"""A run is finished only when it is complete; everything else is said in one line."""

from __future__ import annotations

import csv
import dataclasses
import errno
import json
import os
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from twirl_mjx.training import pipeline, rundir
from twirl_mjx.training.presets import make_config
from twirl_mjx.training.rundir import Foreign, New, RunDir
from twirl_mjx.training.sinks.base import RunInfo
from twirl_mjx.training.sinks.table import COLUMNS, Table, truncate_csv

CONFIG = make_config("stand", "debug")
EPISODES = CONFIG.eval.final_episodes


def values() -> dict[str, np.ndarray]:
    """Return measures of which one is defined in half of the episodes."""
    half = np.where(np.arange(EPISODES) % 2, np.nan, 1.0)
    numbers = np.arange(EPISODES, dtype=float)
    return {"return": numbers, "episode_length": numbers + 5, "reached": half}


@pytest.fixture
def done(tmp_path: Path) -> RunDir:
    """A finished run as far as its description and its closing episodes go."""
    run_dir = RunDir(tmp_path / "a")
    run_dir.open(CONFIG)
    run_dir.write_episodes(CONFIG, 96, values())
    return run_dir


def change(run_dir: RunDir, edit: Callable[[list[list[str]]], object]) -> None:
    """Edit the rows of ``eval.csv`` in place, the header first."""
    with run_dir.episodes.open(newline="") as file:
        rows = list(csv.reader(file))
    edit(rows)
    with run_dir.episodes.open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(rows)


def halve(rows: list[list[str]]) -> None:
    del rows[len(rows) // 2 :]


def column(index: int, text: str) -> Callable[[list[list[str]]], None]:
    def edit(rows: list[list[str]]) -> None:
        for row in rows[1:]:
            row[index] = text

    return edit


def without(metric: str) -> Callable[[list[list[str]]], None]:
    def edit(rows: list[list[str]]) -> None:
        rows[:] = [row for row in rows if row[7] != metric]

    return edit


DAMAGE: dict[str, tuple[Callable[[list[list[str]]], object], str]] = {
    "halved": (halve, "rows of episode_length, expected one for each of 4 episodes"),
    "the last row is gone": (lambda rows: rows.pop(), "its checksum is not that of"),
    "header only": (lambda rows: rows.__delitem__(slice(1, None)), "0 different env_steps"),
    "empty": (lambda rows: rows.clear(), "there is no column 'env_steps'"),
    "no returns": (without("return"), "0 rows of return, expected one for each of 4"),
    "an episode twice": (lambda rows: rows.append(rows[1]), "5 rows of return"),
    "too far": (column(5, str(10**9)), "env_steps 1,000,000,000, and the run went to 128 at most"),
    "far too far": (column(5, "1e30"), "1e30"),
    "before the start": (column(5, "-96"), "env_steps -96"),
    "another value": (column(8, "7"), "its checksum is not that of"),
}


def test_a_whole_run_is_finished(done: RunDir) -> None:
    found = done.finished()
    assert found == rundir.Finished(96, {"return": 1.5, "episode_length": 6.5, "reached": 1.0})
    assert done.status(CONFIG) == found


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_evaluation_does_not_finish_a_run(damage: str, done: RunDir) -> None:
    edit, message = DAMAGE[damage]
    change(done, edit)
    for judge in (done.finished, lambda: done.status(CONFIG)):
        with pytest.raises(ValueError, match=re.escape(message)) as error:
            judge()
        assert str(error.value).startswith(str(done.episodes))
        assert "evaluates again" in str(error.value)
        assert "\n" not in str(error.value)


def test_the_remedy_helps(done: RunDir) -> None:
    change(done, halve)
    done.episodes.unlink()
    assert done.finished() is None
    done.write_episodes(CONFIG, 96, values())
    assert isinstance(done.status(CONFIG), rundir.Finished)


def test_a_pruned_run_is_not_trained_anew(done: RunDir) -> None:
    """Its policy would be lost; so the message does not say that deleting helps."""
    done.policy.write_bytes(b"p")
    change(done, halve)
    with pytest.raises(ValueError, match=r"checkpoints are gone; `twirl evaluate` judges its poli"):
        done.finished()
    done.episodes.unlink()
    status = done.status(CONFIG)
    assert isinstance(status, Foreign)
    assert "would be trained anew; nothing was touched" in str(status.error)
    with pytest.raises(rundir.RunMismatchError, match="trained anew"):
        pipeline.run(CONFIG, "debug", done.path.parent, "a", print)
    assert done.policy.read_bytes() == b"p"


def test_a_run_closed_beyond_its_budget_stays_finished_when_pruned(done: RunDir) -> None:
    """It was stopped at 640 and its budget lowered to 96; or it was closed with more episodes."""
    done.write_episodes(CONFIG, 640, values())
    assert done.status(CONFIG) == done.finished()
    more = dataclasses.replace(CONFIG.eval, final_episodes=EPISODES + 1)
    assert isinstance(done.status(dataclasses.replace(CONFIG, eval=more)), rundir.Finished)


def test_runs_of_older_versions_stay_finished(done: RunDir) -> None:
    """They have no checksums."""
    done.sums.unlink()
    assert isinstance(done.status(CONFIG), rundir.Finished)


def test_a_run_that_goes_on_keeps_the_checksum_of_where_it_was(done: RunDir) -> None:
    """Killed between the checksum and the table of its second end, it is still at its first."""
    first = done.episodes.read_bytes()
    longer = dataclasses.replace(CONFIG, total_env_steps=128)
    done.open(longer)
    done.write_episodes(longer, 128, values())
    assert json.loads(done.sums.read_text()).keys() == {"96", "128"}
    done.episodes.write_bytes(first)
    found = done.finished()
    assert found is not None
    assert found.env_steps == 96


def test_a_run_without_its_config_is_not_overwritten(done: RunDir) -> None:
    done.config.unlink()
    status = done.status(CONFIG)
    assert isinstance(status, Foreign)
    assert "holds eval.csv of a run and no config.json" in str(status.error)
    with pytest.raises(FileNotFoundError, match=r"no config\.json"):
        done.finished()
    with pytest.raises(rundir.RunMismatchError, match=r"no config\.json"):
        pipeline.run(CONFIG, "debug", done.path.parent, "a", print)


def test_a_failed_start_leaves_its_name_free(tmp_path: Path) -> None:
    run_dir = RunDir(tmp_path / "a")
    run_dir.open(CONFIG)
    for folder in ("replay", "orbax", "manifests"):
        (run_dir.checkpoints / folder).mkdir(parents=True)
    run_dir.metrics.write_text(",".join(COLUMNS) + "\n")
    assert run_dir.status(dataclasses.replace(CONFIG, seed=5)) == New()


@pytest.mark.parametrize("whole_writes", [0, 1])
def test_a_full_disk_does_not_finish_a_run(
    whole_writes: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The checksum comes first, the table last: without the table it is not finished."""
    run_dir = RunDir(tmp_path / "a")
    run_dir.open(CONFIG)
    synced = 0

    def refuse(descriptor: int) -> None:
        nonlocal synced
        synced += 1
        if synced > 2 * whole_writes:  # the file, and its folder
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", refuse)
        failed = (run_dir.sums, run_dir.episodes)[whole_writes]
        with pytest.raises(OSError, match=re.escape(str(failed))):
            run_dir.write_episodes(CONFIG, 96, values())
    names = {path.name for path in run_dir.path.iterdir()}
    assert names == {"config.json", "versions.json", *[run_dir.sums.name] * whole_writes}
    assert run_dir.status(CONFIG) == New()
    run_dir.write_episodes(CONFIG, 96, values())
    assert isinstance(run_dir.status(CONFIG), rundir.Finished)


# ---- metrics.csv


def rows_of(run: str, *cells: tuple[str, int]) -> str:
    lines = [f"{run},stand,none,scratch,0,{name},{at},0,1.0,2" for name, at in cells]
    return "\n".join([",".join(COLUMNS), *lines]) + "\n"


def info(folder: Path, resume: int, total: int = 96) -> RunInfo:
    identity = {"run": "a", "task": "stand", "shift": "none", "variant": "scratch", "seed": "0"}
    return RunInfo(
        directory=folder, identity=identity, total_env_steps=total, stage="stand",
        resume_env_steps=resume, measures={}, learning={}, config={},
    )  # fmt: skip


@pytest.mark.parametrize(
    ("text", "reached"),
    [(None, 0), ("", 0), (rows_of("a", ("return", 32)), 32), (rows_of("a", ("return", 64)), 64)],
)
def test_what_metrics_lack_is_said(text: str | None, reached: int, tmp_path: Path) -> None:
    if text is not None:
        (tmp_path / "metrics.csv").write_text(text)
    table = Table()
    table.open(info(tmp_path, 64))
    table.close()
    if reached == 64:
        assert table.lacks is None
    else:
        expected = f"{tmp_path / 'metrics.csv'} ends at {reached} transitions and the run goes on"
        assert str(table.lacks).startswith(expected)


def test_last_rows_are_not_doubled_when_a_run_closes_again(tmp_path: Path) -> None:
    """Killed between the last rows and the finishing mark, a run evaluates again."""
    path = tmp_path / "metrics.csv"
    cells = (("eval/final_return", 64), ("return", 96), ("eval/final_return", 96))
    path.write_text(rows_of("a", *cells))
    table = Table()
    table.open(info(tmp_path, 96, total=128))
    table.close()
    assert path.read_text() == rows_of("a", *cells)
    table = Table()
    table.open(info(tmp_path, 96))
    table.close()
    assert path.read_text() == rows_of("a", *cells[:2])
    assert truncate_csv(path, 64) == (1.0, 64)
