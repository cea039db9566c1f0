"""What differs between machines: cores, locks and a place for them, accelerators."""

from __future__ import annotations

import errno
import importlib.util
import os
import stat
import sys
import tempfile
from pathlib import Path
from typing import TextIO

UNSUPPORTED = (
    "Windows has not what this needs (process locks and signals): run it in WSL, the Linux that"
    " Windows brings (`wsl --install`)"
)
CAN_PIN = hasattr(os, "sched_setaffinity")
"""Whether a process can be bound to cores here."""


def is_supported() -> bool:
    """Return whether this operating system is one of those that are supported."""
    return sys.platform != "win32"


def usable_cores() -> list[int]:
    """Return the numbers of the cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


def runtime_folder() -> Path:
    """Return this user's own folder for locks and the like on this machine, made if missing.

    In ``/run/user/UID`` where there is one, else in the folder of temporary files, where anybody
    may have made it: what is there is trusted only if nobody else can have written it.

    Raises:
        PermissionError: It belongs to somebody else, is a link, or others may write into it.
    """
    uid = os.getuid()
    session = Path(f"/run/user/{uid}")
    parent = session if _is_own(session) else Path(tempfile.gettempdir())
    folder = parent / f"twirl_mjx-{uid}"
    folder.mkdir(mode=0o700, exist_ok=True)
    if not _is_own(folder):
        why = "not a folder that only you can write into: remove it, or set TMPDIR to one of yours"
        raise PermissionError(errno.EACCES, why, str(folder))
    return folder


def _is_own(folder: Path) -> bool:
    try:
        status = os.lstat(folder)
    except OSError:
        return False
    others = stat.S_IWGRP | stat.S_IWOTH
    return (
        stat.S_ISDIR(status.st_mode)
        and status.st_uid == os.getuid()
        and not status.st_mode & others
        and os.access(folder, os.W_OK | os.X_OK)
    )


def may_have_accelerator() -> bool:
    """Return whether anything is installed that could give jax another device than the CPU.

    Asked without jax, which takes seconds to import: its plug-ins are modules or entry points.
    """
    if any(importlib.util.find_spec(name) for name in ("jax_plugins", "libtpu")):
        return True
    from importlib.metadata import entry_points  # takes a while to import

    return bool(entry_points(group="jax_plugins"))


def try_lock(file: TextIO, *, shared: bool = False) -> bool:
    """Try to take a lock that the kernel releases when the file is closed or the process ends.

    Args:
        file: An open file; it stays as it is.
        shared: A lock that others may share, which finds out whether somebody holds it alone.

    Raises:
        OSError: There are no such locks on this operating system.
    """
    if not is_supported():
        raise OSError(UNSUPPORTED)
    import fcntl

    try:
        fcntl.flock(file.fileno(), (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
