"""``twirl sweep``: the dry run, the estimates, the plain display and the exit status."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import os
import signal
import threading
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console

from twirl_mjx.commands import figures, report, sweep, sweep_run
from twirl_mjx.figures.tables import read_table
from twirl_mjx.sweep import estimate, scheduler
from twirl_mjx.sweep.grid import load
from twirl_mjx.sweep.plan import make_plan
from twirl_mjx.sweep.scheduler import Progress
from twirl_mjx.sweep.table import SweepView
from twirl_mjx.sweep.worker import Ending
from twirl_mjx.training import rundir

Finish = Callable[..., Path]


def dry_run(capsys: pytest.CaptureFixture[str], grid_file: Path, *more: str) -> str:
    runs = str(grid_file.parent / "runs")
    assert sweep.main([str(grid_file), "--dry-run", "--runs", runs, *more]) == 0
    return capsys.readouterr().out


def test_dry_run_lists_cells_with_status_and_time(
    grid_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], finish_run: Finish
) -> None:
    out = dry_run(capsys, grid_file)
    for cell in (
        "first: stand s0",
        "first: stand s1",
        "biped-phi0.25 s0",
        "biped-phi0.5 s1",
        "biped-zs s0",
    ):
        assert cell in out
    assert out.count("missing") == 7
    assert "7 runs to do" in out
    assert "7 default" in out
    cells = make_plan(load(str(grid_file)), tmp_path / "runs")
    for cell in cells[:4]:
        finish_run(cell, tmp_path / "runs")
    out = dry_run(capsys, grid_file, "--workers", "2")
    assert "first: stand" not in out  # finished, and no cell of the grid
    assert out.count("finished") == 2
    assert "3 runs to do" in out
    assert "with 2 workers" in out
    assert not list((tmp_path / "runs").glob("*/sweep.log"))


def test_dry_run_of_chosen_arms_and_seeds(
    grid_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = dry_run(capsys, grid_file, "--arms", "*phi0.5", "--seeds", "4")
    assert "biped-phi0.5 s4" in out
    assert "phi0.25" not in out
    with pytest.raises(ValueError, match=r"no arm matches 'x'; arms: biped-phi0.25, biped-phi0.5"):
        sweep.main([str(grid_file), "--arms", "x"])


def test_tables_hold_more_than_what_was_asked_for(
    grid_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], finish_run: Finish
) -> None:
    runs, results = tmp_path / "runs", tmp_path / "results"
    for cell in make_plan(load(str(grid_file), seeds=(0, 1, 4)), runs):
        finish_run(cell, runs)

    def gathered(*more: str) -> dict[str, int]:
        argv = [str(grid_file), "--gather-only", "--runs", str(runs), "--results", str(results)]
        assert sweep.main([*argv, *more]) == 0
        paths = [p for p in (results / "phi").glob("*.csv") if "episodes" not in p.name]
        tables = {p.stem: read_table(p) for p in paths}
        return {arm: len(set(table["seed"])) for arm, table in tables.items()}

    all_arms = {"biped-phi0.25": 2, "biped-phi0.5": 2, "biped-zs": 1}
    assert gathered() == all_arms
    assert gathered("--arms", "*phi0.5", "--seeds", "0") == all_arms
    assert gathered("--arms", "*phi0.5", "--seeds", "4") == all_arms | {"biped-phi0.5": 3}
    assert "phi: 6 of 6 cells finished; 6 tables" in capsys.readouterr().out


def test_tables_and_figures_lie_where_the_user_is(
    grid_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, finish_run: Finish
) -> None:
    """A grid of one's own, anywhere: nothing is written into the checkout this code is in."""
    here = tmp_path / "mine"
    here.mkdir()
    monkeypatch.chdir(here)
    for cell in make_plan(load(str(grid_file)), here / "runs"):
        finish_run(cell, here / "runs")
    assert sweep.main([str(grid_file), "--gather-only"]) == 0
    assert (here / "results" / "phi" / "biped-phi0.5.csv").is_file()
    assert {path.name for path in here.iterdir()} == {"results", "runs"}
    shown = (figures.FiguresOptions, report.ReportOptions)
    assert [options().results for options in shown] == [Path("results")] * 2
    (here / "experiments").mkdir()  # a checkout
    assert [options().results for options in shown] == [Path("experiments/results")] * 2


def test_estimates_use_what_was_measured(
    grid_file: Path, tmp_path: Path, finish_run: Finish
) -> None:
    runs = tmp_path / "runs"
    _, cell, _, other, *_, zero_shot = make_plan(load(str(grid_file)), runs)
    base = estimate.START_S + cell.config.replay.source_size / estimate.ENV_STEPS_PER_S
    steps, utd = cell.config.total_env_steps, cell.config.droq.utd
    default = estimate.estimate(cell, runs, estimate.measure(runs))
    rate = estimate.default_rate(cell.config)
    assert default.basis == "default"
    assert default.seconds == pytest.approx(base + steps / 5000 + steps * utd / rate)
    finish_run(cell, runs)  # 8 transitions and 4 updates per second
    measured = estimate.estimate(other, runs, estimate.measure(runs))
    assert measured == (pytest.approx(base + steps / 8), "measured")
    droq = dataclasses.replace(other.config.droq, utd=2.0)
    scaled = dataclasses.replace(other, config=dataclasses.replace(other.config, droq=droq))
    expected = base + steps / 5000 + steps * 2 / 4
    assert estimate.estimate(scaled, runs, estimate.measure(runs)) == (
        pytest.approx(expected), "scaled",
    )  # fmt: skip
    assert estimate.estimate(zero_shot, runs, []).seconds == estimate.START_S


@pytest.mark.parametrize(
    "cut",
    [
        "r,biped,none,twirl,0,updates_per_s,320,160",  # killed while writing
        "r,biped,none,twirl,0,updates_per_s,320,160\n",
        "r,biped,none,twirl,0,updates_per_s,320,160,1.0,9",  # perhaps of 9000
        "r,biped,none,twirl,0,updates_per_s,320,160,1.0,9e\n",
        "r,biped,none,twirl,0,updates_per_s,320,160r,biped,none,twirl,0,updates_per_s,320,160,1.0,9\n",
    ],
)
def test_estimates_skip_rows_cut_off(
    cut: str, grid_file: Path, tmp_path: Path, finish_run: Finish
) -> None:
    cell = make_plan(load(str(grid_file)), tmp_path)[1]
    path = finish_run(cell, tmp_path) / "metrics.csv"
    whole = estimate.measure(tmp_path)
    with path.open("a") as file:
        file.write(cut)
    assert estimate.measure(tmp_path) == whole
    path.write_text("\n".join(path.read_text().splitlines()[:1]) + "\n" + cut)
    assert estimate.measure(tmp_path) == []


def test_a_cell_of_another_sweep_is_left_to_it(
    grid_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], finish_run: Finish,
    here_executor: Any, monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    runs = tmp_path / "runs"
    first, *others = make_plan(load(str(grid_file)), runs)
    cells = {cell.name: cell for cell in (first, *others)}
    other_sweep = contextlib.ExitStack()
    other_sweep.enter_context(rundir.RunDir(runs / first.name).exclusive())
    started: list[str] = []

    class Executor(here_executor):
        def __init__(self, **_: object) -> None:
            super().__init__(room=1)

        def __enter__(self) -> Executor:
            return self

        def __exit__(self, *_: object) -> None:
            pass

        def ending(self, handle: Any) -> Ending:
            started.append(handle[1].name)
            finish_run(cells[handle[1].name], runs)
            if len(started) == 2:  # the other sweep finishes its cell
                finish_run(first, runs)
                other_sweep.close()
            return Ending(0, "here")

    monkeypatch.setattr(sweep_run, "RayExecutor", Executor)
    monkeypatch.setattr(scheduler, "BUSY_LOOK_S", 0.0)
    argv = [str(grid_file), "--runs", str(runs), "--results", str(tmp_path / "results")]
    assert sweep.main([*argv, "--together", "1"]) == 0
    assert sorted(started) == sorted(cell.name for cell in others)
    said = capsys.readouterr().out
    assert "busy     first: stand s0 | in use by another process" in said
    assert "done     first: stand s0" in said
    assert "5 of 5 cells finished" in said


def test_default_rates_by_width(grid_file: Path, tmp_path: Path) -> None:
    config = make_plan(load(str(grid_file)), tmp_path)[0].config

    def rate(width: int) -> float:
        droq = dataclasses.replace(config.droq, hidden_sizes=(width, width))
        return estimate.default_rate(dataclasses.replace(config, droq=droq))

    assert [rate(w) for w in (32, 128, 256, 512)] == [400, 400, 250, 62.5]


def test_plain_lines_and_report(
    grid_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cells = make_plan(load(str(grid_file)), tmp_path)
    jobs = [sweep_run.job_of(cell, tmp_path) for cell in cells]
    table = {job.name: Progress(job) for job in jobs}
    times = {cell.name: estimate.Estimate(60.0, "default") for cell in cells}
    out = io.StringIO()
    with SweepView(Console(file=out, width=200), "phi", cells, tmp_path, times) as view:
        view.update(table)
        assert out.getvalue() == ""
        first, second, third, *_ = table.values()
        first.state, first.attempts, first.seconds = "done", 1, 61.0
        second.state, second.attempts, second.reason = "failed", 2, "exit status 1"
        third.state, third.reason = "blocked", "needs x"
        view.update(table)
        view.update(table)
    lines = out.getvalue().splitlines()
    assert len(lines) == 3
    assert lines[0].startswith("done     first: stand s0 | 0:01:01 | ")
    assert "failed   biped-phi0.25 s0 | attempt 2 | exit status 1" in lines[1]
    for progress in list(table.values())[3:]:
        progress.state = "done"
    assert sweep_run.report(table) == 1
    said = capsys.readouterr().out
    assert f"failed: {jobs[1].name}: exit status 1; log: {jobs[1].log}" in said
    assert "blocked" in said
    third.state = "busy"  # a sweep that was stopped while it waited
    assert sweep_run.report(table) == 130
    second.state = third.state = "stopped"
    assert sweep_run.report(table) == 130
    second.state = third.state = "done"
    assert sweep_run.report(table) == 0


def test_the_live_table_shows_running_cells(grid_file: Path, tmp_path: Path) -> None:
    cells = make_plan(load(str(grid_file)), tmp_path)
    table = {cell.name: Progress(sweep_run.job_of(cell, tmp_path)) for cell in cells}
    times = {cell.name: estimate.Estimate(60.0, "default") for cell in cells}
    running = list(table.values())[1]
    running.state, running.attempts, running.began = "running", 2, 0.0
    busy = list(table.values())[2]
    busy.state, busy.reason = "busy", "in use by another process"
    out = io.StringIO()
    console = Console(file=out, width=200, force_terminal=True, legacy_windows=False)
    with SweepView(console, "phi", cells, tmp_path, times) as view:
        view.update(table)
    text = out.getvalue()
    assert "running (attempt 2)" in text
    assert "0 / 96 (0 %)" in text
    assert "phi: 0 of 7 done" in text
    assert "in use by another process" in text


def test_a_job_is_the_command_a_user_could_type(grid_file: Path, tmp_path: Path) -> None:
    cell = make_plan(load(str(grid_file)), tmp_path)[1]
    job = sweep_run.job_of(cell, tmp_path)
    assert job.argv[:5] == ("-m", "twirl_mjx", "train", "--preset", "debug")
    assert job.log == str(tmp_path / cell.name / "sweep.log")
    assert job.needs == cell.needs != ()


def test_a_signal_reaches_the_sweep_although_ray_takes_it(monkeypatch: pytest.MonkeyPatch) -> None:
    class Taking(contextlib.nullcontext):  # as Ray does when it starts
        def __init__(self, **_: object) -> None:
            super().__init__()
            signal.signal(signal.SIGTERM, lambda *_: pytest.fail("Ray ends the sweep"))

    def run_all(*_: object, stop: threading.Event, **__: object) -> bool:
        os.kill(os.getpid(), signal.SIGTERM)
        return stop.wait(10.0)

    old = signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr(sweep_run, "RayExecutor", Taking)
    monkeypatch.setattr(sweep_run, "run_all", run_all)
    try:
        view: Any = SimpleNamespace(update=None, say=None)
        assert sweep_run._run([], Path("runs"), sweep.SweepOptions("utd"), view)
    finally:
        signal.signal(signal.SIGTERM, old)
