"""What differs between operating systems."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
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


def test_the_folder_for_locks_is_the_user_s_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever somebody has put in its predictable place is refused, by name."""
    monkeypatch.setattr(machine.tempfile, "gettempdir", lambda: str(tmp_path))
    monkeypatch.setattr(os, "getuid", lambda: 54321)  # has no folder in /run/user
    place = tmp_path / "twirl_mjx-54321"
    with pytest.raises(PermissionError, match="only you can write") as error:  # we are another user
        machine.runtime_folder()
    assert error.value.filename == str(place)
    place.rmdir()
    monkeypatch.undo()
    monkeypatch.setattr(machine.tempfile, "gettempdir", lambda: str(tmp_path))
    monkeypatch.setattr(machine, "_is_own", refuse_session(machine._is_own))
    place = tmp_path / f"twirl_mjx-{os.getuid()}"
    assert machine.runtime_folder() == machine.runtime_folder() == place
    assert place.stat().st_mode & 0o777 == 0o700
    place.chmod(0o777)
    with pytest.raises(PermissionError, match="only you can write"):
        machine.runtime_folder()
    place.rmdir()
    (tmp_path / "elsewhere").mkdir(mode=0o700)
    place.symlink_to("elsewhere")
    with pytest.raises(PermissionError, match="only you can write"):
        machine.runtime_folder()


def refuse_session(is_own: Callable[[Path], bool]) -> Callable[[Path], bool]:
    """Let there be no ``/run/user/UID``."""
    return lambda folder: not folder.is_relative_to("/run/user") and is_own(folder)
