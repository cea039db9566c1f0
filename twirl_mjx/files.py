"""The one way to write a file and the one way to read it.

*Writing*: whole or not at all. The content goes to a temporary file beside the target, is forced to
disk and takes the target's name; on any failure, an interrupt included, the temporary file is
removed and what was there before is untouched. Only regular files are replaced: a device, FIFO,
socket or folder is refused by name, and of a symbolic link the file that it leads to is replaced.
What a person names on the command line is replaced only if this project wrote it: such files carry
``MARK``, and ``check_ours`` looks for it before any work is done.

*Reading*: regular files of a bounded size, and errors that name the file, what was expected and
what helps. Arrays: ``array_files``.
"""

from __future__ import annotations

import contextlib
import csv
import errno
import hashlib
import io
import itertools
import json
import os
import secrets
import stat
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

MB = 1 << 20
TEXT_LIMIT = 256 * MB
"""Bytes, largest text that is read; a table of a million rows has a third of it."""
SIZE_LIMIT = 16 << 10 << 20
"""Bytes, largest file that is read: a million source rows have a tenth of it."""

MARK = "made by twirl_mjx"
"""What films, pictures, pages, exports and clips of ours say in their metadata."""
MARKED_WITHIN = 4 * MB
"""Bytes from the start within which a mark stands: in a film it follows the table of frames."""

_KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a FIFO"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)
_NO_SPACE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS)


class FileError(ValueError):
    """A file that cannot be what was asked for; the message names it and says why."""


# ---- writing


@contextlib.contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Hand out a temporary path, with the target's suffix, that takes the target's name at the end.

    For writers that need a path of their own; the others take :func:`write_atomic`. The folders
    above the target are made, and the permission bits of a file that is replaced are kept.

    Args:
        path: The target.

    Raises:
        FileError: The target exists and is no regular file.
        OSError: As the system says, with the name of the target.
    """
    target = check_target(path)
    mark = f".twirl-{zlib.crc32(target.name.encode(errors='surrogateescape')):08x}"
    temporary = target.with_name(f"{mark}-{os.getpid()}-{secrets.token_hex(3)}{Path(path).suffix}")
    try:
        make_folders(target.parent)
        _sweep(target.parent, mark)
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
        yield temporary
        sync(temporary)
        with contextlib.suppress(FileNotFoundError):
            os.chmod(temporary, stat.S_IMODE(target.stat().st_mode))
        os.replace(temporary, target)
        sync(target.parent)
    except BaseException as error:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        if isinstance(error, OSError) and (
            error.filename == str(temporary)
            or (error.filename is None and error.errno in _NO_SPACE)
        ):
            error.filename, error.filename2 = str(path), None
        raise


@contextlib.contextmanager
def write_atomic(path: str | Path) -> Iterator[BinaryIO]:
    """Open a target for bytes, written whole or not at all; see :func:`replacing` for errors."""
    with replacing(path) as temporary, temporary.open("wb") as file:
        yield file


def write_bytes(path: str | Path, content: bytes) -> None:
    """Write bytes, whole or not at all; see :func:`replacing`."""
    with write_atomic(path) as file:
        file.write(content)


def write_text(path: str | Path, text: str) -> None:
    """Write UTF-8 text as it is, whole or not at all; see :func:`replacing`."""
    write_bytes(path, text.encode())


def write_json(path: str | Path, record: Any) -> None:
    """Write a record as JSON with sorted keys, whole or not at all."""
    write_text(path, json.dumps(record, indent=2, sort_keys=True) + "\n")


def write_csv(path: str | Path, rows: Iterable[Sequence[object]], notes: str = "") -> None:
    """Write rows, the header first, after ``notes``; whole or not at all."""
    write_text(path, notes + csv_text(rows))


def csv_text(rows: Iterable[Sequence[object]]) -> str:
    """Return rows as the text of a CSV table."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()


def check_target(path: str | Path) -> Path:
    """Return the file to replace, links followed, after checking that it can be replaced.

    Nothing is written, so this is asked before any work is done, too.

    Raises:
        FileError: Something that is no regular file is there.
        OSError: A loop of links, a name that is too long, a file where a folder is meant, or a
            folder in which nothing can be written.
    """
    target = Path(os.path.realpath(path))
    with contextlib.suppress(FileNotFoundError):
        mode = target.stat().st_mode
        if not stat.S_ISREG(mode):
            raise FileError(f"{path} is {_kind(mode)} and would be replaced: name a file to write")
    folder = next(parent for parent in target.parents if parent.exists())
    if not folder.is_dir():
        raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), str(path))
    if not os.access(folder, os.W_OK | os.X_OK):
        frozen = os.name == "posix" and os.statvfs(folder).f_flag & os.ST_RDONLY
        number = errno.EROFS if frozen else errno.EACCES
        raise OSError(number, os.strerror(number), str(path))
    return target


def check_ours(path: str | Path, mark: str = MARK, *, overwrite: bool = False) -> Path:
    """Return the file to write after checking that nobody else's work would be replaced.

    Args:
        path: The target.
        mark: Text by which a file of ours is known: ``MARK``, or the header of a table.
        overwrite: Whether the person said that any file may be replaced.

    Raises:
        FileError: As :func:`check_target`, or a file is there without the mark.
        OSError: As the system says.
    """
    target = check_target(path)
    if overwrite or not target.exists() or target.stat().st_size == 0:
        return target
    with target.open("rb") as file:
        if mark.encode() in file.read(MARKED_WITHIN):
            return target
    free = next(p for i in itertools.count(2) if not (p := _numbered(Path(path), i)).exists())
    raise FileError(
        f"{path} is there and was not written by this command; nothing was touched (nearest:"
        f" {free}, or --overwrite to replace it)"
    )


def _numbered(path: Path, number: int) -> Path:
    return path.with_name(f"{path.stem}-{number}{path.suffix}")


def make_folders(folder: Path) -> None:
    """Make a folder and those above it, and force their entries to disk."""
    made = [f for f in (folder, *folder.parents) if not f.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    for new in made:
        sync(new.parent)


def sync(path: Path) -> None:
    """Force a file, or the entries of a folder, to disk; what a file system cannot is left out."""
    if path.is_dir() and os.name != "posix":
        return
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):
            raise
    finally:
        os.close(descriptor)


def _sweep(folder: Path, mark: str) -> None:
    """Remove what killed processes have left of earlier writes of the same target."""
    if os.name != "posix":
        return
    for path in folder.glob(f"{mark}-*"):
        with contextlib.suppress(OSError, ValueError):
            os_process = int(path.name.removeprefix(mark).split("-")[1])
            try:
                os.kill(os_process, 0)
            except ProcessLookupError:
                path.unlink()


# ---- reading


def check_readable(path: str | Path, what: str, limit: int = SIZE_LIMIT, remedy: str = "") -> int:
    """Check that a path leads to a regular file of at most ``limit`` bytes; return its size.

    Args:
        path: The file.
        what: What it should be, "a clip" for example.
        limit: Bytes.
        remedy: What helps when it is not, as a clause for the end of the message.

    Raises:
        FileNotFoundError: There is nothing.
        FileError: No regular file, or a larger one.
        OSError: As the system says.
    """
    try:
        status = os.stat(path)
    except FileNotFoundError:
        raise FileNotFoundError(f"{path}: no such file, expected {what}{then(remedy)}") from None
    except ValueError as error:  # a NUL in the name
        raise FileError(f"{str(path)!r} is no name of a file: {error}") from error
    if not stat.S_ISREG(status.st_mode):
        kind = _kind(status.st_mode)
        raise FileError(f"{path} is {kind}, expected {what} in a file{then(remedy)}")
    if status.st_size > limit:
        raise FileError(
            f"{path} has {status.st_size:,} bytes, {what} has at most {limit:,}{then(remedy)}"
        )
    return status.st_size


def read_bytes(path: str | Path, what: str, limit: int = SIZE_LIMIT, remedy: str = "") -> bytes:
    """Return the content of a regular file; arguments and errors of :func:`check_readable`."""
    check_readable(path, what, limit, remedy)
    with open(path, "rb") as file:
        content = file.read(limit + 1)  # a file of /proc says that it is empty
    if len(content) > limit:
        raise FileError(f"{path} is larger than {limit:,} bytes, expected {what}{then(remedy)}")
    return content


def checksum(path: str | Path) -> str:
    """Return the SHA-256 of a file's content, as 64 hexadecimal digits."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def read_tail(path: str | Path, what: str, size: int) -> bytes:
    """Return the last ``size`` bytes of a regular file; errors of :func:`check_readable`."""
    length = check_readable(path, what)
    with open(path, "rb") as file:
        file.seek(max(0, length - size))
        return file.read(size)


def read_text(path: str | Path, what: str, limit: int = TEXT_LIMIT, remedy: str = "") -> str:
    """Return UTF-8 text, with or without byte order mark, line ends as they are.

    Raises:
        FileError: As :func:`check_readable`, or the bytes are no UTF-8.
    """
    content = read_bytes(path, what, limit, remedy)
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise FileError(
            f"{path}: byte {error.start}: not UTF-8 text, expected {what}{then(remedy)}"
        ) from error


def read_json(path: str | Path, what: str, limit: int = TEXT_LIMIT, remedy: str = "") -> Any:
    """Return what a JSON file holds.

    Raises:
        FileError: As :func:`read_text`, or the text is no JSON; the message has the place.
    """
    text = read_text(path, what, limit, remedy)
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        why = f"line {error.lineno}, column {error.colno}: not JSON: {error.msg}"
    except (ValueError, RecursionError) as error:
        why = f"not JSON that can be read: {error}"
    raise FileError(f"{path}: {why}; expected {what}{then(remedy)}")


def read_rows(
    path: str | Path,
    what: str,
    columns: Mapping[str, Callable[[str], Any]],
    *,
    growing: bool = False,
    remedy: str = "",
) -> list[dict[str, Any]]:
    """Return the rows of a CSV table, which may open with comment lines, by column name.

    Args:
        path: The file.
        what: What it should be.
        columns: Columns it must have, and what turns the text of a cell into its value; further
            columns stay text.
        growing: Whether a process may be appending to it: a row without its end is left out then.
        remedy: What helps when it is damaged.

    Raises:
        FileError: As :func:`read_text`, no such column, a row of another length, or a cell that
            cannot be converted; the message has the line.
    """
    text = read_text(path, what, remedy=remedy)
    if growing:
        text = text[: text.rfind("\n") + 1]
    lines = io.StringIO(text, newline="").readlines()
    notes = next((i for i, line in enumerate(lines) if not line.startswith("#")), len(lines))
    reader = csv.reader(lines[notes:])
    found: list[dict[str, Any]] = []
    try:
        header = next(reader, [])
        for name in columns:
            if name not in header and not (growing and not header):
                raise ValueError(f"there is no column {name!r}")
        for cells in reader:
            if len(cells) != len(header):
                raise ValueError(f"{len(cells)} cells, the header has {len(header)}")
            row = dict(zip(header, cells, strict=True))
            found.append(row | {name: convert(row[name]) for name, convert in columns.items()})
    except (csv.Error, ValueError, OverflowError) as error:
        where = f"line {notes + reader.line_num}"
        raise FileError(f"{path}: {where}: {error}; expected {what}{then(remedy)}") from error
    return found


def number_text(cell: str) -> str:
    """Return the text of a number as it is, for ``columns`` of :func:`read_rows`.

    Raises:
        ValueError: It is none.
    """
    float(cell)
    return cell


def _kind(mode: int) -> str:
    return next((name for test, name in _KINDS if test(mode)), "no regular file")


def then(remedy: str) -> str:
    """Return a remedy as the last clause of a message."""
    return f"; {remedy}" if remedy else ""
