"""Arrays in files: they come back as they were, and what lies about its size is refused."""

from __future__ import annotations

import io
import random
import zipfile
from pathlib import Path

import numpy as np
import pytest

from twirl_mjx import array_files, files


def header_of(shape: tuple[int, ...], kind: str = "<f4") -> bytes:
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        file, {"descr": kind, "fortran_order": False, "shape": shape}
    )
    return file.getvalue()


@pytest.mark.parametrize(
    "array",
    [np.arange(6.0).reshape(2, 3), np.array(3, np.int32), np.zeros((0, 4)), np.array("ä {}"),
     np.array([True, False]), np.asfortranarray(np.arange(6, dtype=np.float32).reshape(2, 3))],
)  # fmt: skip
@pytest.mark.parametrize("compressed", [False, True])
def test_arrays_come_back(array: np.ndarray, compressed: bool, tmp_path: Path) -> None:
    array_files.write_npz(tmp_path / "a.npz", {"x/y": array, "z": array}, compressed=compressed)
    array_files.write_npy(tmp_path / "a.npy", array)
    for found in (
        array_files.read_npz(tmp_path / "a.npz", "arrays")["x/y"],
        array_files.read_npy(tmp_path / "a.npy", "an array"),
        np.load(tmp_path / "a.npy"),
    ):
        assert found.dtype == array.dtype
        assert found.shape == array.shape
        np.testing.assert_array_equal(found, array)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (header_of((10**12,)), "has 4,000,000,000,000 bytes, the file 0"),
        (header_of((2, 2)) + bytes(15), "has 16 bytes, the file 15"),
        (header_of((2, 2)) + bytes(17), "has 16 bytes, the file 17"),
        (header_of((-1, 4)), "shape"),
        (header_of((2,), "|O") + bytes(16), "Python objects"),
        (header_of((10**12,), "<U0"), "type"),
        (b"\x93NUMPY\x01\x00\x10\x27" + b"(" * 10_000, "parenthes|header"),
        (b"\x93NUMPY\x01\x00\x10\x27" + b"-" * 10_000, ""),
        (b"", "EOF"),
        (b"hello", "EOF"),
    ],
)
def test_lying_headers_are_refused(content: bytes, message: str, tmp_path: Path) -> None:
    (tmp_path / "a.npy").write_bytes(content)
    with pytest.raises(files.FileError, match=rf"a\.npy is not a readable \.npy.*(?:{message})"):
        array_files.read_npy(tmp_path / "a.npy", "rows")
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("x.npy", content)
    with pytest.raises(
        files.FileError, match=rf"a\.npz is not a readable \.npz.*(?:{message}|magic|EOF)"
    ):
        array_files.read_npz(tmp_path / "a.npz", "rows")


def test_zip_bombs_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("x.npy", "w", force_zip64=True) as member,
    ):
        member.write(header_of((25 << 20,)))
        for _ in range(100):
            member.write(bytes(1 << 20))
    assert path.stat().st_size < 200_000
    with pytest.raises(files.FileError, match=r"that would become 104,857,\d\d\d"):
        array_files.read_npz(path, "arrays")
    array_files.write_npz(path, {"x": np.zeros(1000)})
    with pytest.raises(files.FileError, match="has at most 4,000"):
        array_files.read_npz(path, "arrays", limit=4000)
    array_files.write_npz(path, {"x": np.zeros(1000)}, compressed=True)
    with pytest.raises(files.FileError, match="would become 8,128"):
        array_files.read_npz(path, "arrays", limit=4000)


def test_random_damage_never_escapes(tmp_path: Path) -> None:
    """300 flips and cuts: each is read as before or refused by name, and nothing else happens."""
    rng = random.Random(0)
    path = tmp_path / "a.npz"
    arrays = {"x": np.arange(50.0), "header": np.array('{"a": 1}')}
    refused = 0
    for compressed in (False, True):
        array_files.write_npz(path, arrays, compressed=compressed)
        whole = path.read_bytes()
        for _ in range(150):
            damaged = bytearray(whole)
            for _ in range(rng.randrange(1, 4)):
                damaged[rng.randrange(len(whole))] = rng.randrange(256)
            path.write_bytes(damaged[: rng.choice([len(whole), rng.randrange(len(whole))])])
            try:
                array_files.read_npz(path, "arrays")
            except files.FileError as error:
                assert str(path) in str(error)
                refused += 1
    assert refused > 200
