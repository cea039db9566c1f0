"""A run on a disk that fills up: one line, its own exit status, and the same command goes on."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from twirl_mjx import exits


def train(runs: Path) -> subprocess.CompletedProcess[str]:
    command = ["train", "--task", "stand", "--preset", "debug", "--runs", str(runs), "--name", "a"]
    return subprocess.run(
        [sys.executable, "-m", "twirl_mjx", *command, "--checkpoint-minutes", "0"],
        env={k: v for k, v in os.environ.items() if k != "TWIRL_DEBUG"},
        capture_output=True,
        text=True,
        timeout=500,
        check=False,
    )


@pytest.mark.slow
@pytest.mark.timeout(1100)
def test_a_run_stops_with_one_line_and_goes_on_when_there_is_space(small_disk: Path) -> None:
    """700 kB hold the first checkpoint of the debug preset, and not the second."""
    resize = ["mount", "-o", "remount,size={}", str(small_disk)]
    subprocess.run([word.format("700k") for word in resize], check=True)
    stopped = train(small_disk)
    assert stopped.returncode == exits.NO_SPACE, stopped.stderr
    lines = [line for line in stopped.stderr.splitlines() if line]
    assert lines[-1].startswith(f"twirl train: {small_disk}/a/checkpoints/")
    assert "No space left on device: free space, then run the same command again" in lines[-1]
    assert lines[-1].endswith("saved: the checkpoint at 32 transitions")
    assert all(line.startswith("twirl train: ") for line in lines)
    subprocess.run([word.format("8m") for word in resize], check=True)
    resumed = train(small_disk)
    assert resumed.returncode == 0, resumed.stderr
    assert "resuming a at 32 transitions" in resumed.stdout
    assert (small_disk / "a" / "eval.csv").is_file()
