"""Sweeps on Ray itself: crashes, lost workers, and a sweep killed half-way."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import psutil
import pytest

from twirl_mjx.figures.tables import read_directory
from twirl_mjx.sweep.scheduler import RayExecutor, run_all
from twirl_mjx.sweep.worker import Job

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]

GRID = """
GRID = (
    {"preset": "debug", "seeds": (0, 1, 2),
     "base": {"variant": "scratch", "total_env_steps": 640, "checkpoint_minutes": 0.0},
     "axes": {"task": {"biped": {"task": "biped"}}, "utd": {"utd1": {"droq.utd": 1.0}}}},
)
"""


def make(folder: Path, name: str, code: str, needs: tuple[str, ...] = ()) -> Job:
    out = str(folder / f"{name}.out")
    return Job(name, ("-S", "-c", code, out), str(folder / f"{name}.log"), needs)


@pytest.mark.filterwarnings("default")  # Ray's own
def test_crashes_and_lost_workers(tmp_path: Path) -> None:
    lose_worker_once = (
        "import os, pathlib, sys, time; p = pathlib.Path(sys.argv[1])\n"
        "if p.exists(): sys.exit(0)\n"
        "p.write_text('tried'); os.kill(os.getppid(), 9); time.sleep(60)"
    )
    jobs = [
        make(tmp_path, "lost", lose_worker_once),
        make(tmp_path, "bad", "import sys; sys.exit(1)"),
        make(tmp_path, "child", "pass", needs=("bad",)),
        make(tmp_path, "good", "pass", needs=("lost",)),
    ]
    before = {p.pid for p in psutil.Process().children(recursive=True)}
    with RayExecutor(address=None, workers=2, gpus=0.0) as executor:
        assert executor.capacity() == 2
        table = run_all(
            jobs, executor, retries=1, stop=threading.Event(), show=lambda t: None, poll_s=0.2
        )
    states = {name: (p.state, p.attempts) for name, p in table.items()}
    assert states == {
        "lost": ("done", 2), "bad": ("failed", 2), "child": ("blocked", 0), "good": ("done", 1),
    }  # fmt: skip
    deadline = time.monotonic() + 30
    while {p.pid for p in psutil.Process().children(recursive=True)} - before:
        assert time.monotonic() < deadline, "Ray left processes behind"
        time.sleep(0.2)


@pytest.mark.filterwarnings("default")  # Ray's own
def test_ray_waits_for_a_run_that_saves_slowly(tmp_path: Path) -> None:
    save_slowly = (
        "import pathlib, signal, sys, time; p = pathlib.Path(sys.argv[1])\n"
        "def save(*_): time.sleep(5); p.write_text('saved'); sys.exit(130)\n"
        "signal.signal(signal.SIGTERM, save); p.write_text('up'); time.sleep(300)"
    )
    out, stop = tmp_path / "a.out", threading.Event()
    with RayExecutor(address=None, workers=1, gpus=0.0) as executor:
        table = run_all(
            [make(tmp_path, "a", save_slowly)], executor, retries=1, stop=stop, poll_s=0.2,
            show=lambda t: stop.set() if out.exists() else None,
        )  # fmt: skip
    assert (table["a"].state, table["a"].reason) == ("stopped", "exit status 130")
    assert out.read_text() == "saved"


def sweep(folder: Path, *, background: bool = False) -> subprocess.Popen[str]:
    """Start a sweep; in the background, as by ``nohup ... &``, it ignores SIGINT."""
    argv = [sys.executable, "-m", "twirl_mjx", "sweep", "utd.py", "--workers", "2"]
    argv += ["--runs", "runs", "--results", "results"]
    if background:
        argv = ["sh", "-c", 'trap "" INT; exec "$@"', "sh", *argv]
    return subprocess.Popen(
        argv, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )


def listening(pid: int) -> set[str]:
    """Return the addresses at which a process and all it has started listen."""
    first = psutil.Process(pid)
    return {
        connection.laddr.ip
        for process in (first, *first.children(recursive=True))
        for connection in process.net_connections("inet")
        if connection.status == psutil.CONN_LISTEN
    }


def runs_below(folder: Path) -> list[psutil.Process]:
    """Return the living training processes of a folder."""
    found = []
    for process in psutil.process_iter(["cmdline", "status"]):
        line = process.info["cmdline"] or []
        alive = process.info["status"] != psutil.STATUS_ZOMBIE
        if alive and "train" in line and str(folder) in " ".join(line):
            found.append(process)
    return found


def wait_for(condition: object, what: str, seconds: float = 1500.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():  # type: ignore[operator]
        assert time.monotonic() < deadline, what
        time.sleep(0.1)


def test_a_sweep_killed_half_way_goes_on(tmp_path: Path) -> None:
    (tmp_path / "utd.py").write_text(GRID)
    first = sweep(tmp_path)
    # killed when a cell is finished and another one is at work
    wait_for(lambda: list(tmp_path.glob("runs/*/eval.csv")), "no cell finished")
    wait_for(lambda: runs_below(tmp_path), "no cell is running")
    assert listening(first.pid) <= {"127.0.0.1", "::1", "::ffff:127.0.0.1"}
    first.send_signal(signal.SIGKILL)
    first.communicate()
    wait_for(lambda: not runs_below(tmp_path), "runs outlived the sweep", 30)
    finished = {p: p.stat().st_mtime_ns for p in tmp_path.glob("runs/*/eval.csv")}
    assert 1 <= len(finished) < 3

    second = sweep(tmp_path)
    said, _ = second.communicate()
    assert second.returncode == 0, said
    assert f"{3 - len(finished)} runs to do" in said
    assert "3 of 3 cells finished" in said
    for path, written in finished.items():
        assert path.stat().st_mtime_ns == written, f"{path} was repeated"
        assert (path.parent / "sweep.log").read_text().count(": -m twirl_mjx train ") == 1
    curves, episodes = read_directory(tmp_path / "results" / "utd")
    assert curves is not None and sorted(set(curves["seed"])) == [0, 1, 2]
    assert episodes is not None and len(set(episodes["run"])) == 3

    third = sweep(tmp_path)
    said, _ = third.communicate()
    assert third.returncode == 0, said
    assert "runs to do" not in said


@pytest.mark.parametrize("background", [False, True])
def test_a_stopped_sweep_saves_its_runs(background: bool, tmp_path: Path) -> None:
    (tmp_path / "utd.py").write_text(GRID.replace("640", "64000"))
    first = sweep(tmp_path, background=background)
    wait_for(lambda: list(tmp_path.glob("runs/*/metrics.csv")), "no run started")
    wait_for(
        lambda: any(p.read_text().count("\n") > 5 for p in tmp_path.glob("runs/*/metrics.csv")),
        "no epoch ended",
    )
    os.kill(first.pid, signal.SIGTERM)
    said, _ = first.communicate(timeout=300)
    assert first.returncode == 130, said
    assert "the same command goes on" in said
    logs = [p.read_text() for p in tmp_path.glob("runs/*/sweep.log")]
    assert any("the same command resumes" in log and "== ended with 130" in log for log in logs)
    assert not runs_below(tmp_path)
