"""Commands are killed, terminated and interrupted at three moments; the same command goes on."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import psutil
import pytest

from twirl_mjx.assets import asset_path
from twirl_mjx.figures.tables import CURVE_COLUMNS

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]

ROOT = Path(__file__).parents[3]
SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
MOMENTS = (0.8, 0.5, 0.25)
"""When they come, as shares of the time that the command takes."""
SMALL = ["--preset", "debug", "--runs", "runs"]
GRID = """
GRID = (
    {"preset": "debug", "seeds": (0, 1), "base": {"source": "zero"},
     "axes": {"task": {"biped": {"task": "biped"}}}},
)
"""
COMMANDS: dict[str, tuple[list[str], list[str]]] = {
    "train": (["--task", "biped", "--source", "zero", "--name", "a", *SMALL], ["runs/a/eval.csv"]),
    "collect": (["--task", "biped", "--source", "zero", "--name", "a", *SMALL],
                ["runs/a/source.npz"]),
    "curriculum": (["--task", "biped", "--source", "zero", "--shifts", "icy", *SMALL],
                   ["runs/biped-icy-chain-debug-s0/eval.csv"]),
    "evaluate": (["zero", "--task", "stand", "--episodes", "2", "--shifts", "none", "--out",
                  "out.csv"], ["out.csv"]),
    "export": (["stand.npz", "--out", "out.onnx"], ["out.onnx", "contract.json"]),
    "report": (["--results", "tables", "--out", "out.html"], ["out.html"]),
    "sweep": (["grid.py", "--workers", "1", "--runs", "runs", "--results", "results"],
              ["results/grid/biped.csv"]),
}  # fmt: skip
"""Command, its words, and what it writes in the end."""
CLOCK = ("wall_s", "command", "took")
WALL = CURVE_COLUMNS.index("wall_s")


def prepare(folder: Path) -> None:
    """Put there what the commands read."""
    folder.mkdir()
    (folder / "grid.py").write_text(GRID)
    shutil.copy(asset_path("policies", "stand.npz"), folder)
    shutil.copytree(ROOT / "experiments" / "results" / "trot", folder / "tables" / "trot")


def start(name: str, folder: Path) -> subprocess.Popen[str]:
    argv = [sys.executable, "-m", "twirl_mjx", name, *COMMANDS[name][0]]
    return subprocess.Popen(
        argv, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )  # fmt: skip


def whole(name: str, folder: Path) -> float:
    """Run a command to its end; return how long it took, s."""
    began, process = time.monotonic(), start(name, folder)
    _, err = process.communicate(timeout=900)
    assert process.returncode == 0, err
    return time.monotonic() - began


def content(name: str, folder: Path) -> list[bytes]:
    """Return what a command has written, without what depends on the clock."""
    found = []
    for path in (folder / written for written in COMMANDS[name][1]):
        lines = path.read_bytes().split(b"\n")
        lines = [line for line in lines if not any(word.encode() in line for word in CLOCK)]
        if path.suffix == ".csv" and b"wall_s" in path.read_bytes():
            lines = [
                b",".join(c for i, c in enumerate(line.split(b",")) if i != WALL) for line in lines
            ]
        found.append(b"\n".join(lines))
    return found


def partial(folder: Path) -> set[Path]:
    """Return the files that were being written; those of a killed process go with the next."""
    return set(folder.rglob(".twirl-*"))


def faults_of(number: int, process: Any, err: str, folder: Path, before: set[Path]) -> list[str]:
    """Return what is wrong with how a command ended after a signal, and with what it left."""
    wrong = []
    if "Traceback" in err:
        wrong.append(f"a traceback: {err[-300:]}")
    allowed = {0, -number} if number == signal.SIGKILL else {0, 130, -number}
    if process.returncode not in allowed:
        wrong.append(f"status {process.returncode}: {err[-300:]}")
    halves = [p for p in folder.rglob("*") if p.is_file() and not p.stat().st_size]
    if number != signal.SIGKILL:
        halves += partial(folder) - before
    known = {".lock", "core", "metrics.csv"}
    wrong += [f"left {p.name}" for p in halves if not {p.name, p.suffix} & known]
    return wrong


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_outlives_signals(name: str, tally: Any, tmp_path: Path) -> None:
    """Whole runs before and after are equal; between, no traceback, no hang, nothing half."""
    folder = tmp_path / "part"
    for place in (tmp_path / "whole", folder):
        prepare(place)
    seconds = whole(name, tmp_path / "whole")
    expected = content(name, tmp_path / "whole")
    kind = f"SIGKILL, SIGTERM, SIGINT of `twirl {name}`"
    for number, moment in zip(SIGNALS, MOMENTS, strict=True):
        before, process = partial(folder), start(name, folder)
        time.sleep(moment * seconds)
        process.send_signal(number)
        try:
            _, err = process.communicate(timeout=180)
        except subprocess.TimeoutExpired:
            process.kill()
            tally.add(kind, "fell short", f"{number.name}: hangs")
            continue
        if wrong := faults_of(number, process, err, folder, before):
            tally.add(kind, "fell short", f"{number.name} at {moment}: {'; '.join(wrong)}")
        else:
            tally.add(kind, "survived equal")
        wait_for_children(folder)
    whole(name, folder)
    equal = content(name, folder) == expected
    tally.add(kind, "survived equal" if equal else "fell short", "another end")
    tally.check()


def wait_for_children(folder: Path) -> None:
    """Wait until no run works in the folder any more."""
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline:
        lines = [" ".join(p.info["cmdline"] or ()) for p in psutil.process_iter(["cmdline"])]
        if not any("twirl_mjx" in line and str(folder) in line for line in lines):
            return
        time.sleep(0.2)
