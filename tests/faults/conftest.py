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


class Disk:
    """Knows what of a folder would outlive a power cut: what was forced to disk, nothing else.

    A file has the content of its last ``fsync``, and a name is there if its folder was forced to
    disk since. Folders that were never forced are empty, and files without ``fsync`` too.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self.contents: dict[int, bytes] = {}
        self.entries: dict[int, dict[str, tuple[int, bool]]] = {}
        self.at_sync: Callable[[], None] = lambda: None
        self._force = os.fsync

    def fsync(self, descriptor: int) -> None:
        self._force(descriptor)
        path = Path(os.readlink(f"/proc/self/fd/{descriptor}"))
        inode = os.fstat(descriptor).st_ino
        if path.is_dir():
            self.entries[inode] = {
                entry.name: (entry.inode(), entry.is_dir()) for entry in os.scandir(path)
            }
        elif path.exists():
            self.contents[inode] = path.read_bytes()
        self.at_sync()

    def after_the_cut(self, target: Path) -> None:
        """Write what is left to another folder."""
        self._write(self.root.stat().st_ino, target)

    def _write(self, folder: int, target: Path) -> None:
        target.mkdir()
        for name, (inode, is_folder) in self.entries.get(folder, {}).items():
            if is_folder:
                self._write(inode, target / name)
            else:
                (target / name).write_bytes(self.contents.get(inode, b""))


@pytest.fixture
def disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Disk]:
    root = tmp_path / "run"
    root.mkdir()
    made = Disk(root)
    monkeypatch.setattr(os, "fsync", made.fsync)
    yield made
