"""One way to write, one way to read: whole or not at all, regular files, named errors."""

from __future__ import annotations

import ast
import errno
import json
import os
import re
import stat
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from twirl_mjx import array_files, files

PACKAGE = Path(files.__file__).parent
NODES = ["folder", "fifo", "socket", "device"]


# ---- writing


def test_what_is_written_is_there_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "new" / "deep" / "a.txt"
    files.write_text(path, "a\r\nä")
    assert path.read_bytes() == b"a\r\n\xc3\xa4"
    files.write_csv(path, [("a", "b"), (1, "x,y")], notes="# n\n")
    assert path.read_bytes() == b'# n\na,b\n1,"x,y"\n'
    files.write_json(path, {"b": 1, "a": [2]})
    assert path.read_text() == '{\n  "a": [\n    2\n  ],\n  "b": 1\n}\n'
    assert [p.name for p in path.parent.iterdir()] == ["a.txt"]


def test_permission_bits_are_kept_and_new_files_follow_the_umask(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    old = os.umask(0o027)
    try:
        files.write_text(path, "1")
        assert stat.S_IMODE(path.stat().st_mode) == 0o640
        path.chmod(0o604)
        files.write_text(path, "2")
    finally:
        os.umask(old)
    assert stat.S_IMODE(path.stat().st_mode) == 0o604
    assert path.read_text() == "2"


def test_links_stay_and_their_targets_are_replaced(tmp_path: Path) -> None:
    target, link = tmp_path / "target.txt", tmp_path / "link.txt"
    link.symlink_to("target.txt")
    files.write_text(link, "1")  # a link that leads to nothing yet
    files.write_text(link, "2")
    assert link.is_symlink()
    assert target.read_text() == "2"
    link.unlink()
    link.symlink_to("link.txt")
    with pytest.raises(OSError, match=r"link\.txt") as error:
        files.write_text(link, "3")
    assert error.value.errno == errno.ELOOP
    assert sorted(p.name for p in tmp_path.iterdir()) == ["link.txt", "target.txt"]


@pytest.mark.parametrize("kind", NODES)
def test_what_is_no_regular_file_is_not_replaced(
    kind: str, node: Callable[[str], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # names of sockets have to be short
    path = node(kind)
    before = os.lstat(path).st_ino
    with pytest.raises(files.FileError, match=rf"(?i)a-{kind} is a {kind} and would be replaced"):
        files.write_text(path, "x")
    assert os.lstat(path).st_ino == before
    assert [p.name for p in tmp_path.iterdir()] == [f"a-{kind}"]


def fail_within(path: Path, error: BaseException) -> None:
    with files.write_atomic(path) as file:
        file.write(b"half")
        raise error


@pytest.mark.parametrize("error", [KeyboardInterrupt(), ValueError("v"), SystemExit(3)])
def test_any_failure_leaves_what_was_there(error: BaseException, tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(type(error)):
        fail_within(path, error)
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


@pytest.mark.usefixtures("no_space")
def test_a_full_disk_is_said_with_the_name_of_the_target(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(OSError, match=re.escape(str(path))) as error:
        files.write_text(path, "new")
    assert error.value.errno == errno.ENOSPC
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_a_really_full_disk(small_disk: Path) -> None:
    """Every kind of content, too large for the disk; numpy's own writers hide the reason."""
    array = np.random.default_rng(0).random(100_000)
    for write in (
        lambda path: files.write_bytes(path, array.tobytes()),
        lambda path: files.write_text(path, "x" * 800_000),
        lambda path: array_files.write_npy(path, array),
        lambda path: array_files.write_npz(path, {"a": array}),
        lambda path: array_files.write_npz(path, {"a": array}, compressed=True),
    ):
        path = small_disk / "a.bin"
        path.write_text("old")
        with pytest.raises(OSError, match=re.escape(str(path))) as error:
            write(path)
        assert error.value.errno == errno.ENOSPC
        assert path.read_text() == "old"
        assert [p.name for p in small_disk.iterdir()] == ["a.bin"]


def test_a_read_only_disk(frozen_disk: Path) -> None:
    for name in ("old.txt", "new.txt"):
        with pytest.raises(OSError, match=re.escape(str(frozen_disk / name))) as error:
            files.write_text(frozen_disk / name, "new")
        assert error.value.errno == errno.EROFS
    assert (frozen_disk / "old.txt").read_text() == "old"
    assert [p.name for p in frozen_disk.iterdir()] == ["old.txt"]


def test_where_nothing_can_be_written_is_said_before_any_work(
    frozen_disk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Folders are made when the file is written, and judged by the nearest that is there."""
    assert files.check_target(tmp_path / "no" / "such" / "a.json") == tmp_path / "no/such/a.json"
    assert not (tmp_path / "no").exists()
    for name in ("old.txt", "no/such/a.json"):
        with pytest.raises(OSError, match=name) as error:
            files.check_target(frozen_disk / name)
        assert error.value.errno == errno.EROFS
    monkeypatch.setattr(os, "access", lambda path, mode: False)  # root may write anywhere
    with pytest.raises(PermissionError, match=r"no/such/a\.json"):
        files.check_target(tmp_path / "no" / "such" / "a.json")


def test_what_a_killed_process_left_is_swept_by_the_next_write(tmp_path: Path) -> None:
    """Of the same target only, and not what a living process is writing."""
    code = """
import os, sys
from twirl_mjx import files
with files.write_atomic(sys.argv[1]) as file:
    file.write(b"half")
    file.flush()
    os.kill(os.getpid(), 9)
"""
    for name in ("a.txt", "b.txt"):
        done = subprocess.run(
            [sys.executable, "-c", code, str(tmp_path / name)], timeout=60, check=False
        )
        assert done.returncode == -9
    assert len(list(tmp_path.glob(".twirl-*"))) == 2
    with files.replacing(tmp_path / "a.txt") as mine:
        files.write_text(tmp_path / "a.txt", "other")
        assert mine.exists()
        assert len(list(tmp_path.glob(".twirl-*"))) == 2  # mine, and what is left of b.txt
    files.write_text(tmp_path / "b.txt", "b")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.txt", "b.txt"]


def test_names_at_the_limits(tmp_path: Path) -> None:
    longest = tmp_path / ("n" * 251 + ".txt")
    files.write_text(longest, "x")
    assert longest.read_text() == "x"
    with pytest.raises(OSError, match="nnn") as error:
        files.write_text(tmp_path / ("n" * 300), "x")
    assert error.value.errno == errno.ENAMETOOLONG
    (tmp_path / "file").write_text("")
    with pytest.raises(NotADirectoryError):
        files.write_text(tmp_path / "file" / "a.txt", "x")


# ---- reading


@pytest.mark.parametrize("kind", NODES)
@pytest.mark.parametrize(
    "read",
    [files.read_bytes, files.read_text, files.read_json, files.read_tail, files.read_rows,
     array_files.read_npy, array_files.read_npz],
    ids=lambda f: f.__name__,
)  # fmt: skip
def test_only_regular_files_are_read(
    read: Callable, kind: str, node: Callable[[str], Path], tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    extra = {"read_tail": (10,), "read_rows": ({},)}.get(read.__name__, ())
    with pytest.raises(files.FileError, match=rf"(?i)a-{kind} is a {kind}, expected a thing"):
        read(node(kind), "a thing", *extra)
    with pytest.raises(FileNotFoundError, match="nowhere: no such file, expected a thing"):
        read(tmp_path / "nowhere", "a thing", *extra)


def test_texts(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_bytes(b"\xef\xbb\xbfa\r\n\xc3\xa4")
    assert files.read_text(path, "a text") == "a\r\nä"
    path.write_bytes(b"abc\xff")
    with pytest.raises(
        files.FileError, match=r"a\.txt: byte 3: not UTF-8 text, expected a te.*; r"
    ):
        files.read_text(path, "a text", remedy="remove it")
    with pytest.raises(files.FileError, match="has 4 bytes, a text has at most 3"):
        files.read_text(path, "a text", limit=3)
    assert files.read_text("/proc/self/status", "a status").startswith("Name:")
    with pytest.raises(files.FileError, match="is larger than 3 bytes"):
        files.read_text("/proc/self/status", "a status", limit=3)
    with pytest.raises(files.FileError, match="is no name of a file"):
        files.read_text("a\0b", "a text")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "line 1, column 1: not JSON: Expecting value"),
        ('{"a": 1', "line 1, column 8: not JSON"),
        ("[" * 100_000, "not JSON that can be read"),
        ("1" * 10_000, "not JSON that can be read"),
    ],
)
def test_damaged_json_is_named(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text(text)
    with pytest.raises(files.FileError, match=rf"a\.json: {message}.*; expected a record"):
        files.read_json(path, "a record")


def test_rows(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    cells = {"steps": int, "value": float}
    path.write_text('\ufeffname,steps,value\nx,1,2.5\n"y,\nz",2,nan\n')
    rows = files.read_rows(path, "a table", cells)
    assert rows[0] == {"name": "x", "steps": 1, "value": 2.5}
    assert rows[1]["name"] == "y,\nz"
    path.write_text("# note\nname,steps,value\nx,1,2.5\ny,2")
    assert len(files.read_rows(path, "a table", cells, growing=True)) == 1
    with pytest.raises(files.FileError, match=r"a\.csv: line 4: 2 cells, the header has 3;"):
        files.read_rows(path, "a table", cells)
    assert files.read_rows(path, "a table", {}, growing=True)[0]["steps"] == "1"
    for text, message in (
        ("name,value\n", "line 1: there is no column 'steps'; expected a table"),
        ("", "line 0: there is no column 'steps'"),
        ("steps,value\n1e3,1\n", "line 2: invalid literal for int"),
        ("steps,value\n1,inf\n1,x\n", "line 3: could not convert"),
        ("steps,value\n1," + "x" * 200_000, "line 2: field larger than"),
    ):
        path.write_text(text)
        with pytest.raises(files.FileError, match=rf"a\.csv: {message}"):
            files.read_rows(path, "a table", cells)


# ---- the package


APPENDS = {
    ("training/sinks/table.py", 1): "metrics.csv grows",
    ("training/rundir.py", 2): "the lock of a run directory",
    ("training/overview.py", 2): "the lock of a run directory",
    ("sweep/worker.py", 2): "locks of cores, and the log of a run",
    ("bench/startup.py", 1): "the output of a child process",
}
"""Files that are opened without ``files``: how many times, and why."""
OWN_WAYS = {"write_text", "write_bytes", "read_text", "read_bytes", "savefig", "rename", "savez"}


THINGS = ("os", "Image", "run_dir", "sink", "_terminal", "webbrowser")
"""Whose ``open`` opens no file of ours by name, or is looked at elsewhere."""


def own_ways(source: str) -> tuple[int, list[str]]:
    """Return how often a source opens a file itself, and what it reads or writes itself."""
    opened, others = 0, []
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.Call):
            continue
        called = ast.unparse(node.func)
        owner, _, name = called.rpartition(".")
        of_a_thing = owner.rpartition(".")[2] in THINGS
        opened += name == "open" and not of_a_thing
        if owner in ("files", "array_files"):
            continue
        in_memory = name == "savefig" and ast.unparse(node.args[0]) in ("file", "buffer")
        if (name in OWN_WAYS and not in_memory) or called in ("np.load", "np.save", "os.replace"):
            others.append(f"{called} in line {node.lineno}")
    return opened, others


def test_own_ways_are_found() -> None:
    source = "p.open('w')\nopen(p)\nos.open(p, 0)\np.write_text('')\nnp.load(p)\nf.savefig(p)\n"
    assert own_ways(source) == (2, ["p.write_text in line 4", "np.load in line 5",
                                    "f.savefig in line 6"])  # fmt: skip
    assert own_ways("files.write_text(p, '')\nfigure.savefig(file)\n") == (0, [])


def test_the_package_reads_and_writes_in_one_way() -> None:
    found = {}
    for path in PACKAGE.rglob("*.py"):
        name = path.relative_to(PACKAGE).as_posix()
        if name in ("files.py", "array_files.py"):
            continue
        text = path.read_text(encoding="utf-8")
        assert ".partial" not in text.replace("functools.partial", ""), name
        opened, others = own_ways(text)
        if opened or others:
            found[name, opened] = others
    assert found == {key: [] for key in APPENDS}


def test_only_one_code_finds_the_nearest_name() -> None:
    users = [p.name for p in PACKAGE.rglob("*.py") if "difflib" in p.read_text(encoding="utf-8")]
    assert sorted(users) == ["checks.py"]


def test_records_stay_readable_by_others(tmp_path: Path) -> None:
    files.write_json(tmp_path / "a.json", {"x": float("nan"), "y": "ä"})
    assert json.loads((tmp_path / "a.json").read_text())["y"] == "ä"
