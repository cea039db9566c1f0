"""What an error means to a person: one line and an exit status."""

from __future__ import annotations

import errno
import re
import traceback
from typing import NamedTuple

from twirl_mjx import exits

NO_SPACE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
UNUSABLE = (
    errno.ENOENT, errno.EISDIR, errno.ENOTDIR, errno.EACCES, errno.EPERM, errno.EEXIST,
    errno.EROFS, errno.ELOOP, errno.ENAMETOOLONG, errno.EINVAL, errno.ENXIO, errno.ENOTEMPTY,
)  # fmt: skip
"""What paths given by a person may lead to."""
NO_SPACE_TEXT = re.compile(
    r'(?:"(?P<file>/[^"]+)"[^"]*)?(?P<why>No space left on device|Disk quota exceeded)'
)
"""How libraries that hide the number of an error say it, after a file in quotes or without one."""
SAVED = "saved: "
"""Begin of a note (``add_note``) on an error that says what is safe on disk."""
NO_MEMORY_TEXT = re.compile("RESOURCE_EXHAUSTED|[Oo]ut of memory|bad_alloc")
CALLED_BACK = re.compile(
    r"^(?:\w+\.)*(\w+)(?:: ?((?:(?!^\s+File ).)*))?\Z", re.DOTALL | re.MULTILINE
)
"""Name and message of the error at the end of a traceback that jax has put into a text."""


class Fault(NamedTuple):
    """How a command ends."""

    text: str
    """The line, without the command's name."""
    status: int
    """One of ``exits``."""


def explain(error: BaseException) -> Fault:
    """Return what to say of an error and how to end.

    Refusals of ours (``ValueError``, and ``RuntimeError`` with or without ``exit_status``) are
    shown as they are; what is neither a refusal nor a fault of the machine is one of this program.
    """
    text = str(error).strip()
    if isinstance(error, KeyboardInterrupt):
        return Fault("interrupted", exits.STOPPED)
    if full := _without_space(error):
        saved = "".join(f"; {n}" for n in getattr(error, "__notes__", ()) if n.startswith(SAVED))
        advice = "free space, then run the same command again"
        return Fault(f"{full}: {advice}{saved}", exits.NO_SPACE)
    if isinstance(error, OSError) and error.errno is not None:
        status = exits.UNUSABLE if error.errno in UNUSABLE else exits.FAILED
        return Fault(_system_text(error), status)
    if isinstance(error, MemoryError) or (
        isinstance(error, RuntimeError) and NO_MEMORY_TEXT.search(text)
    ):
        return Fault(f"not enough memory: {_first_line(text) or 'none is left'}", exits.FAILED)
    if isinstance(error, ValueError | FileNotFoundError):
        return Fault(text, exits.UNUSABLE)
    if isinstance(error, RuntimeError):
        if called := _from_callback(text):
            return called
        ours = type(error) is RuntimeError or type(error).__module__.startswith("twirl_mjx")
        if ours or hasattr(error, "exit_status"):
            return Fault(text, getattr(error, "exit_status", exits.FAILED))
    name = type(error).__name__
    return Fault(
        f"a fault of this program: {name}: {_first_line(text) or 'no message'}"
        f" ({_place(error)}; TWIRL_DEBUG=1 shows the traceback)",
        exits.FAILED,
    )


def _without_space(error: BaseException) -> str | None:
    """Return what a full disk says, wherever in the chain of causes it stands."""
    link: BaseException | None = error
    seen: set[int] = set()  # an error may be its own cause: `raise error from error`
    while link is not None and id(link) not in seen:
        seen.add(id(link))
        if isinstance(link, OSError) and link.errno in NO_SPACE:
            return _system_text(link)
        if found := NO_SPACE_TEXT.search(str(link)):
            file = found["file"]
            return f"{file}: {found['why']}" if file else _first_line(str(link))
        link = link.__cause__ or link.__context__
    return None


def _system_text(error: OSError) -> str:
    names = [str(name) for name in (error.filename, error.filename2) if name is not None]
    return ": ".join([*names, error.strerror or str(error)])


def _from_callback(text: str) -> Fault | None:
    """Return the fault of an error that was raised in host code that jax had called."""
    found = CALLED_BACK.search(text) if "Traceback (most recent call last)" in text else None
    if found is None:
        return None
    if found[1] == "KeyboardInterrupt":
        return Fault("interrupted", exits.STOPPED)
    refused = found[1] == "ValueError" or found[1].endswith("FileError")
    told = (found[2] or "").strip()
    return Fault(told if refused else f"{found[1]}: {told}", exits.UNUSABLE if refused else 1)


def _place(error: BaseException) -> str:
    frames = traceback.extract_tb(error.__traceback__)
    return f"{frames[-1].filename.rsplit('/', 1)[-1]}:{frames[-1].lineno}" if frames else "no place"


def _first_line(text: str) -> str:
    return text.strip().partition("\n")[0][:500]
