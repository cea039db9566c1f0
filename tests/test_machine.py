"""What differs between operating systems."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from twirl_mjx import cli, machine


def test_windows_is_sent_to_wsl_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setattr(sys, "platform", "win32")
    assert cli.main(["train", "--help"]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "WSL" in said
    with (tmp_path / "lock").open("a+") as file, pytest.raises(OSError, match="WSL"):
        machine.try_lock(file)


def test_cores_without_affinity(monkeypatch: pytest.MonkeyPatch) -> None:
    assert set(machine.usable_cores()) == os.sched_getaffinity(0)
    monkeypatch.delattr(os, "sched_getaffinity")  # macOS
    assert machine.usable_cores() == list(range(os.cpu_count() or 1))


def test_locks_exclude_and_are_released_with_the_file(tmp_path: Path) -> None:
    path = tmp_path / "lock"
    with path.open("a+") as first, path.open("a+") as second:
        assert machine.try_lock(first)
        assert not machine.try_lock(second)
        assert not machine.try_lock(second, shared=True)
    with path.open("a+") as first, path.open("a+") as second:
        assert machine.try_lock(first, shared=True)
        assert machine.try_lock(second, shared=True)
        assert not machine.try_lock(first)
