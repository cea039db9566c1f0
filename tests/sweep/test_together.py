"""Cells that are one program: who is started with whom, and how a team ends."""

from __future__ import annotations

import csv
import shutil
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from twirl_mjx import exits
from twirl_mjx.commands import sweep as sweep_command
from twirl_mjx.commands import sweep_run
from twirl_mjx.commands.train import split
from twirl_mjx.sweep import scheduler, together
from twirl_mjx.sweep.grid import load
from twirl_mjx.sweep.plan import make_plan
from twirl_mjx.sweep.scheduler import Progress, run_all
from twirl_mjx.sweep.worker import Job, join

WRITE = (
    "import pathlib, sys\n"
    "for word in sys.argv[1:]: word == '--and' or pathlib.Path(word).write_text('done')"
)


def jobs_of(names: str, folder: Path = Path(), code: str = WRITE) -> list[Job]:
    return [
        Job(name, ("-S", "-c", code, str(folder / f"{name}.out")), str(folder / f"{name}.log"))
        for name in names
    ]


def divide(
    names: str, room: int, most: int | None = None, far: dict[str, set[int]] | None = None
) -> list[str]:
    """Teams of jobs whose program is their capital letter."""
    programs = {name: name.upper().translate({66: 65, 67: 65, 68: 65, 69: 65}) for name in names}
    steps = far or {}
    teams = together.divide(
        jobs_of(names), programs, lambda job: steps.get(job.name, set()), room, most
    )
    return ["".join(job.name for job in team) for team in teams]


def test_a_program_is_divided_evenly_on_the_free_places() -> None:
    assert divide("abcde", room=1) == ["abcde"]
    assert divide("abcde", room=2) == ["ab", "cde"]
    assert divide("abcd", room=3) == ["a", "b", "cd"]
    assert divide("abc", room=16) == ["a", "b", "c"]
    assert divide("abcde", room=1, most=2) == ["a", "bc", "de"]
    assert divide("abcde", room=1, most=1) == ["a", "b", "c", "d", "e"]
    assert divide("axbxcx".replace("x", ""), room=1) == ["abc"]
    assert divide("axb", room=1) == ["ab", "x"]
    assert divide("axby", room=2) == ["ab", "x", "y"]
    assert divide("abx", room=3) == ["a", "b", "x"]


def test_only_runs_that_are_equally_far_are_one_program() -> None:
    far = {"a": {32, 64}, "b": {64, 96}, "d": {96}}
    assert divide("abcde", room=1, far=far) == ["ab", "ce", "d"]


def test_what_a_program_of_a_grid_is(grid_file: Path, tmp_path: Path) -> None:
    cells = make_plan(load(str(grid_file)), tmp_path)
    programs: dict[str, list[str]] = {}
    for cell in cells:
        programs.setdefault(together.program_of(cell), []).append(cell.label)
    assert list(programs.values()) == [
        ["first: stand s0", "first: stand s1"],
        ["biped-phi0.25 s0", "biped-phi0.25 s1", "biped-phi0.5 s0", "biped-phi0.5 s1"],
        ["biped-zs s0"],
    ]
    jobs = [sweep_run.job_of(cell, tmp_path) for cell in cells if "phi" in cell.label]
    (team,) = together.make_teams(cells, tmp_path)(jobs, 1)
    joined = join(team)
    assert joined.argv[:3] == ("-m", "twirl_mjx", "train")
    assert joined.log == jobs[0].log
    assert [tuple(words) for words in split(joined.argv[3:])] == [job.argv[3:] for job in jobs]


def run(
    jobs: list[Job], executor: Any, look: Callable[[Job], Any], retries: int = 0
) -> dict[str, Progress]:
    return run_all(
        jobs, executor, retries=retries, stop=threading.Event(), show=lambda t: None, look=look,
        poll_s=0.01, teams=lambda found, room: [list(found)],
    )  # fmt: skip


def test_a_team_is_one_process(tmp_path: Path, here_executor: Any) -> None:
    executor = here_executor()
    looks = {"a": "missing", "b": "finished", "c": "cut off"}
    table = run(jobs_of("abc", tmp_path), executor, lambda job: looks[job.name])
    assert executor.submitted == ["a"]
    assert {name: (p.state, p.attempts) for name, p in table.items()} == {
        "a": ("done", 1), "b": ("done", 0), "c": ("done", 1),
    }  # fmt: skip
    assert sorted(path.name for path in tmp_path.glob("*.out")) == ["a.out", "c.out"]
    assert table["c"].log == table["a"].log == str(tmp_path / "a.log")


@pytest.mark.parametrize("code", [1, exits.UNUSABLE, -9])
def test_one_that_fails_does_not_lose_the_others(
    code: int, tmp_path: Path, here_executor: Any
) -> None:
    """The team fails; a is finished by then, c alone fails again, the others succeed."""
    end = f"import os; os.kill(os.getpid(), {-code})" if code < 0 else f"sys.exit({code})"
    words = f"import sys\nif '--and' in sys.argv or sys.argv[1].endswith('c.out'): {end}\n{WRITE}"
    executor = here_executor()

    def look(job: Job) -> str:
        return "finished" if job.name == "a" and executor.submitted else "missing"

    table = run(jobs_of("abcd", tmp_path, words), executor, look)
    assert executor.submitted == ["a", "b", "c", "d"]
    assert {name: (p.state, p.attempts) for name, p in table.items()} == {
        "a": ("done", 1), "b": ("done", 1), "c": ("failed", 1), "d": ("done", 1),
    }  # fmt: skip
    assert table["d"].log == str(tmp_path / "d.log")


def test_a_team_that_finds_a_run_in_use_waits_for_that_one(
    tmp_path: Path, here_executor: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scheduler, "BUSY_LOOK_S", 0.0)
    words = f"import sys\nif '--and' in sys.argv: sys.exit({exits.BUSY})\n{WRITE}"
    seen = {"a": iter(["missing", "in use", "missing"]), "b": iter(["missing"] * 2)}
    executor = here_executor()
    table = run(jobs_of("ab", tmp_path, words), executor, lambda job: next(seen[job.name]))
    assert executor.submitted == ["a", "b", "a"]
    assert {(p.state, p.attempts) for p in table.values()} == {("done", 1)}


def test_a_team_that_was_stopped_is_no_failure(tmp_path: Path, here_executor: Any) -> None:
    words = f"import sys; sys.exit({exits.STOPPED})"
    table = run(jobs_of("ab", tmp_path, words), here_executor(), lambda job: "missing")
    assert {(p.state, p.attempts) for p in table.values()} == {("stopped", 1)}


TWO_BY_TWO = """
GRID = (
    {"preset": "debug", "seeds": (0, 1), "base": {"task": "biped", "source": "trot"},
     "axes": {"phi": {f"phi{p}": {"replay.phi": p} for p in (0.25, "auto")}}},
)
"""


def values_of(run_dir: Path, name: str) -> dict[tuple[str, ...], float]:
    """Rows of a table of a run by what they are of, without what depends on the time."""
    with (run_dir / name).open(newline="") as file:
        rows = list(csv.DictReader(file))
    timed = ("env_steps_per_s", "updates_per_s", "compile_s")
    return {
        tuple(row[k] for k in row if k not in ("value", "wall_s")): float(row["value"])
        for row in rows
        if row["metric"] not in timed
    }


@pytest.mark.slow
@pytest.mark.timeout(1900)
def test_a_grid_as_one_program_against_single_runs(
    tmp_path: Path, here_executor: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    grid = tmp_path / "mine.py"
    grid.write_text(TWO_BY_TWO)
    submitted: list[list[str]] = []

    class Executor(here_executor):
        def __init__(self, **_: object) -> None:
            super().__init__(room=1)
            submitted.append(self.submitted)

        def __enter__(self) -> Executor:
            return self

        def __exit__(self, *_: object) -> None:
            pass

    monkeypatch.setattr(sweep_run, "RayExecutor", Executor)

    def sweep(folder: str, *more: str) -> list[Path]:
        runs, results = str(tmp_path / folder), str(tmp_path / "results" / folder)
        argv = [str(grid), "--runs", runs, "--results", results, *more]
        assert sweep_command.main(argv) == 0
        return sorted((tmp_path / folder).glob("biped-*"))

    whole, single = sweep("together"), sweep("single", "--together", "1")
    assert [len(each) for each in submitted] == [1, 4]
    assert [path.name for path in whole] == [path.name for path in single]
    assert len(whole) == 4
    tables = [(path, name) for path in whole for name in ("metrics.csv", "eval.csv")]
    before = {table: values_of(*table) for table in tables}
    for (path, name), found in before.items():
        assert found == pytest.approx(
            values_of(tmp_path / "single" / path.name, name), rel=1e-3, abs=1e-3
        )
    for path in whole:  # as after a kill while the second cell was saved
        (path / "eval.csv").unlink()
    shutil.rmtree(whole[1] / "checkpoints" / "orbax" / "96")
    assert sweep("together") == whole
    assert len(submitted[-1]) == 1
    assert {table: values_of(*table) for table in tables} == before
