"""Disks, nodes and links that faults are made of."""

from __future__ import annotations

import errno
import os
import socket
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest


@pytest.fixture
def no_space(monkeypatch: pytest.MonkeyPatch) -> None:
    """Forcing a file to disk says that there is no space, as delayed allocation does."""

    def refuse(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", refuse)


def _mount(folder: Path, options: str) -> None:
    command = ["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(folder)]
    if os.geteuid() != 0 or subprocess.run(command, capture_output=True, check=False).returncode:
        pytest.skip("needs the right to mount a file system")


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 64 kB; skipped where none may be mounted."""
    folder = tmp_path / "disk"
    folder.mkdir()
    _mount(folder, "size=64k")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


@pytest.fixture
def frozen_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system that is read-only and holds ``old.txt``; skipped where none may be mounted."""
    folder = tmp_path / "frozen"
    folder.mkdir()
    _mount(folder, "size=64k")
    try:
        (folder / "old.txt").write_text("old")
        subprocess.run(["mount", "-o", "remount,ro", str(folder)], check=True)
        yield folder
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


NODES = ("folder", "fifo", "socket", "device")


@pytest.fixture
def node(tmp_path: Path) -> Iterator[Callable[[str], Path]]:
    """Make something that is no regular file, by kind; its word in a message is the same."""
    sockets = []

    def make(kind: str) -> Path:
        path = tmp_path / f"a-{kind}"
        if kind == "folder":
            path.mkdir()
        elif kind == "fifo":
            os.mkfifo(path)
        elif kind == "socket":
            made = socket.socket(socket.AF_UNIX)
            sockets.append(made)
            made.bind(os.path.relpath(path))
        else:
            path.symlink_to("/dev/zero")
        return path

    yield make
    for made in sockets:
        made.close()
