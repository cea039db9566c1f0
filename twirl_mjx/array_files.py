"""Arrays in files: written whole or not at all, read without pickles and without surprises.

What an archive and the headers of its arrays declare is compared with what the file holds before
anything is allocated. HDF5 files are read the same way, and nothing beside them is opened.
Everything else about files: ``files``.
"""

from __future__ import annotations

import contextlib
import math
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from twirl_mjx import files, plugins

MAX_RATIO = 100
"""Arrays of more than 64 MB may be compressed to this share at best: zeros only are smaller."""


def write_npy(path: str | Path, array: np.ndarray) -> None:
    """Write one array of numbers as ``.npy``, whole or not at all."""
    array = np.asarray(array, order="C")
    with files.write_atomic(path) as file:
        header = np.lib.format.header_data_from_array_1_0(array)
        np.lib.format.write_array_header_1_0(file, header)
        file.write(array.data)  # numpy's own tofile hides why a disk refuses


def write_npz(
    path: str | Path, arrays: Mapping[str, np.ndarray], *, compressed: bool = False
) -> None:
    """Write arrays as ``.npz``, whole or not at all; equal arrays give equal bytes."""
    save = np.savez_compressed if compressed else np.savez
    with files.write_atomic(path) as file:
        save(file, allow_pickle=False, **arrays)  # pyright: ignore[reportArgumentType]


def read_npy(path: str | Path, what: str, limit: int = files.SIZE_LIMIT) -> np.ndarray:
    """Return the array of a ``.npy`` file, checked as those of :func:`read_npz`.

    Raises:
        FileError: As :func:`read_npz`.
    """
    size = files.check_readable(path, what, limit)
    with open(path, "rb") as file, _named(path, ".npy file", what):
        return _read_array(file, size)


def read_npz(
    path: str | Path, what: str, limit: int = files.SIZE_LIMIT, remedy: str = ""
) -> dict[str, np.ndarray]:
    """Return the arrays of a ``.npz`` archive by name; nothing is unpickled.

    The sizes that the archive and the headers of its arrays declare are compared with each other,
    with ``limit`` and with the size of the file before anything is allocated.

    Raises:
        FileError: As :func:`check_readable`, or no such archive; the message has the reason.
    """
    size = files.check_readable(path, what, limit, remedy)
    with open(path, "rb") as file, _named(path, ".npz archive", what, remedy):
        if file.read(6) == np.lib.format.MAGIC_PREFIX:
            raise ValueError("it holds one array, not an archive")
        with zipfile.ZipFile(file) as archive:
            members = {info.filename: info for info in archive.infolist()}
            total = sum(info.file_size for info in members.values())
            if total > min(limit, max(64 * files.MB, MAX_RATIO * size)):
                raise ValueError(f"{size:,} bytes that would become {total:,}")
            arrays = {}
            for name, info in members.items():
                with archive.open(info) as member:
                    arrays[name.removesuffix(".npy")] = _read_array(member, info.file_size)
            return arrays


def names_in_npz(path: str | Path, what: str) -> frozenset[str]:
    """Return the names of the arrays in a ``.npz`` archive without reading them.

    Raises:
        FileError: As :func:`read_npz`.
    """
    files.check_readable(path, what)
    with open(path, "rb") as file, _named(path, ".npz archive", what):
        if file.read(6) == np.lib.format.MAGIC_PREFIX:
            raise ValueError("it holds one array, not an archive")
        with zipfile.ZipFile(file) as archive:
            return frozenset(name.removesuffix(".npy") for name in archive.namelist())


def read_hdf5(path: str | Path, what: str, limit: int = files.SIZE_LIMIT) -> dict[str, np.ndarray]:
    """Return the arrays of numbers of an HDF5 file by their path within it, ``group/name``.

    Numbers and texts among the attributes of the file itself are arrays of no dimension. The sizes
    that are declared are compared as in :func:`read_npz`. Links are refused, and so are arrays
    whose bytes lie in other files. Texts and arrays of other types are left out.

    Raises:
        FileError: As :func:`check_readable`, no such file, or one that cannot be trusted.
        ValueError: The package h5py is not installed.
    """
    size = files.check_readable(path, what, limit)
    h5py = plugins.required("h5py", f"{path}: an HDF5 file", "hdf5")
    with _named(path, "HDF5 file", what), h5py.File(path, "r") as file:
        found = dict(_hdf5_arrays(h5py, file, "", set()))
        total = sum(math.prod(item.shape) * item.dtype.itemsize for item in found.values())
        if total > min(limit, max(64 * files.MB, MAX_RATIO * size)):
            raise ValueError(f"{size:,} bytes that would become {total:,}")
        said = {k: np.asarray(v) for k, v in file.attrs.items()}
        plain = {name: value for name, value in said.items() if value.dtype.kind in "biufU"}
        return plain | {name: item[()] for name, item in found.items()}


def _hdf5_arrays(h5py: Any, group: Any, above: str, seen: set[int]) -> Iterator[tuple[str, Any]]:
    """Yield path and array of all numbers under a group, each object once."""
    for name in group:
        where, link = f"{above}{name}", group.get(name, getlink=True)
        if not isinstance(link, h5py.HardLink):
            raise ValueError(f"{where} is a link to {link.path!r}, and links are not followed")
        item = group[name]
        address = h5py.h5o.get_info(item.id).addr
        if address in seen:
            raise ValueError(f"{where} is another name of an object that was there before")
        seen.add(address)
        if isinstance(item, h5py.Group):
            yield from _hdf5_arrays(h5py, item, f"{where}/", seen)
        elif (
            isinstance(item, h5py.Dataset) and item.dtype.kind in "biuf" and item.shape is not None
        ):
            if item.external or item.is_virtual:
                raise ValueError(f"the numbers of {where} lie in another file, which is not opened")
            yield where, item


def _read_array(file: Any, size: int) -> np.ndarray:
    """Return the array of a stream in numpy's format that has ``size`` bytes.

    Raises:
        ValueError: Its header does not describe ``size`` bytes, or it holds Python objects.
    """
    version = np.lib.format.read_magic(file)
    read = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }.get(version)
    if read is None:
        raise ValueError(f"an array of format {version}, need (1, 0) or (2, 0)")
    try:
        shape, fortran, dtype = read(file)
    except MemoryError as error:  # the parser's stack, not an array
        raise ValueError("a header that is no description of an array") from error
    if dtype.hasobject:
        raise ValueError("an array of Python objects, which are not loaded")
    if not dtype.itemsize or min(shape, default=0) < 0:
        raise ValueError(f"an array of shape {shape} and type {dtype!r}")
    expected = math.prod(shape) * dtype.itemsize
    found = size - file.tell()
    if expected != found:
        raise ValueError(
            f"an array of shape {shape} and type {dtype} has {expected:,} bytes, the file {found:,}"
        )
    content = bytearray(expected)
    view = memoryview(content)
    while len(view):
        count = file.readinto(view[: files.MB])
        if not count:
            raise EOFError("it ends within an array")
        view = view[count:]
    file.read(1)  # the end of a member of an archive, where its checksum is compared
    return np.frombuffer(content, dtype).reshape(shape, order="F" if fortran else "C")


@contextlib.contextmanager
def _named(path: str | Path, kind: str, what: str, remedy: str = "") -> Iterator[None]:
    """Turn what a damaged file makes its parser raise into one error that names the file."""
    try:
        yield
    except MemoryError:
        raise
    except Exception as error:  # parsers of zip, deflate and Python literals share no base class
        why = f"{path} is not a readable {kind}: {error}"
        raise files.FileError(f"{why}; expected {what}{files.then(remedy)}") from error
