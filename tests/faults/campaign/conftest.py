"""The break campaign (`make test-faults`): what its parts share, and the table it ends with.

A small run is trained once, in this process, and with it everything is compiled. Every fault then
costs a second: the same programs go on from what it has left.
"""

from __future__ import annotations

import contextlib
import csv
import functools
import os
import shutil
import sys
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from twirl_mjx import array_files, faults
from twirl_mjx.training import loop, pipeline, program
from twirl_mjx.training.checkpoint import load_learner, load_replay
from twirl_mjx.training.config_json import settle
from twirl_mjx.training.presets import make_config

CONFIG = settle(make_config("biped", "debug"), {"source": "zero"})
"""A run of three epochs with recorded source experience, a checkpoint after each."""
NAME = "a"
TIMED = ("wall_s", "env_steps_per_s", "updates_per_s", "compile_s")
"""What of a table depends on the clock."""
COLUMNS = ("survived equal", "refused clearly", "fell short")


MOST = int(os.environ.get("TWIRL_FAULTS", "20"))
"""Points that are tried of each kind of fault."""


def spread_evenly(points: Iterable[Any], share: float = 1.0) -> list[Any]:
    """Return at most ``share`` of ``MOST`` points, evenly from the first to the last."""
    every = list(points)
    count = min(max(1, round(share * MOST)), len(every))
    return [every[i * len(every) // count] for i in range(count)]


@pytest.fixture(scope="session")
def spread() -> Callable[..., list[Any]]:
    return spread_evenly


class Tally:
    """Counts what became of faults, by kind."""

    def __init__(self) -> None:
        self.counts: dict[str, Counter[str]] = {}
        self.short: list[str] = []

    def add(self, kind: str, outcome: str, what: str = "") -> None:
        assert outcome in COLUMNS
        self.counts.setdefault(kind, Counter())[outcome] += 1
        if outcome == "fell short":
            self.short.append(f"{kind}: {what}")

    def judge(self, kind: str, what: str, run: Callable[[], bool]) -> None:
        """Run what follows a fault: it returns whether the end is equal, or refuses."""
        try:
            equal = run()
        except Exception as error:
            fault = faults.explain(error)
            clear = "a fault of this program" not in fault.text
            self.add(kind, COLUMNS[1] if clear else COLUMNS[2], f"{what}: {fault.text}")
        else:
            self.add(kind, COLUMNS[0] if equal else COLUMNS[2], f"{what}: another end")

    def check(self) -> None:
        """Fail with what fell short since the last check."""
        short, self.short = self.short, []
        assert not short, "\n".join(short)

    def table(self) -> str:
        lines = ["| kind of fault | tried | " + " | ".join(COLUMNS) + " |", "|---|" + "---:|" * 4]
        total: Counter[str] = Counter()
        for kind, counts in self.counts.items():
            total += counts
            numbers = [counts.total(), *(counts[c] for c in COLUMNS)]
            lines.append(f"| {kind} | " + " | ".join(f"{n:,}" for n in numbers) + " |")
        numbers = [total.total(), *(total[c] for c in COLUMNS)]
        lines.append("| **together** | " + " | ".join(f"**{n:,}**" for n in numbers) + " |")
        return "\n".join(lines)


TALLY = Tally()


@pytest.fixture(scope="session")
def tally() -> Tally:
    return TALLY


def pytest_terminal_summary(terminalreporter: Any) -> None:
    if TALLY.counts:
        terminalreporter.section("break campaign")
        terminalreporter.write_line(TALLY.table())


class Watch:
    """Calls a function at every file operation below a folder; audit hooks stay for ever."""

    def __init__(self) -> None:
        self.root: str | None = None
        self.act: Callable[[str, str], None] = lambda event, path: None
        self._here = threading.local()
        self._force = os.fsync
        sys.addaudithook(self._hear)

    @contextlib.contextmanager
    def over(self, root: Path, act: Callable[[str, str], None]) -> Iterator[None]:
        self.root, self.act, os.fsync = str(root), act, self._sync
        try:
            yield
        finally:
            self.root, os.fsync = None, self._force

    def _sync(self, descriptor: int) -> None:
        path = os.readlink(f"/proc/self/fd/{descriptor}")
        self._force(descriptor)
        self._tell("os.fsync", path)

    def _hear(self, event: str, args: tuple[Any, ...]) -> None:
        if self.root is None or event not in EVENTS or getattr(self._here, "acts", False):
            return
        if event == "open" and not (isinstance(args[2], int) and args[2] & WRITING):
            return
        with contextlib.suppress(TypeError):  # a number instead of a path
            self._tell(event, os.fsdecode(args[0]))

    def _tell(self, event: str, path: str) -> None:
        if self.root is None or not path.startswith(self.root):
            return
        self._here.acts = True
        try:
            self.act(event, path)
        finally:
            self._here.acts = False


EVENTS = {"open", "os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.truncate", "os.chmod"}
WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT


@pytest.fixture(scope="session")
def watch() -> Watch:
    return Watch()


class Small:
    """The small run: trained anywhere by the same compiled programs, and compared."""

    def __init__(self, reference: Path) -> None:
        self.train(reference)
        self.runs = reference
        self.expected = result(reference / NAME)

    def train(self, runs: Path) -> Path:
        return pipeline.run(CONFIG, "debug", runs, NAME, print).path

    def ends_equal(self, runs: Path, but: str = "") -> bool:
        """Train, or go on, to the end; return whether it is the reference's to the last bit.

        Args:
            runs: Folder of the run.
            but: Name of a part of :func:`result` that is not compared.
        """
        found = result(self.train(runs))
        return found | {but: b""} == self.expected | {but: b""}


def result(run_dir: Path) -> dict[str, bytes]:
    """Return all that a finished run has to show, without what depends on the clock."""
    found: dict[str, Any] = {}
    for name in ("policy.npz", "policy_last.npz", "source.npz"):
        arrays = array_files.read_npz(run_dir / name, name)
        found |= {f"{name}/{key}": value for key, value in arrays.items() if key != "header"}
    with (run_dir / "metrics.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["metric"] not in TIMED]
    found["metrics"] = [[row[k] for k in row if k not in TIMED] for row in rows]
    found["eval"] = (run_dir / "eval.csv").read_text()
    found["rows"] = load_replay(run_dir, CONFIG.replay.capacity)
    leaves = flat(load_learner(run_dir))
    return {name: np.asarray(value).tobytes() for name, value in (found | leaves).items()}


def flat(tree: Any, before: str = "learner") -> dict[str, Any]:
    if not isinstance(tree, dict):
        return {before: tree}
    return {k: v for name in tree for k, v in flat(tree[name], f"{before}/{name}").items()}


@pytest.fixture(scope="session")
def small(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Small]:
    """The reference, while the compiled programs of a config are shared."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop, "Program", functools.cache(loop.Program))
        patch.setattr(loop, "check_learner", functools.cache(loop.check_learner))
        patch.setattr(program, "compile_evaluation", functools.cache(program.compile_evaluation))
        patch.setattr(pipeline.memory, "check_run", lambda *args: None)  # its own tests
        patch.setattr(pipeline, "make_env", functools.cache(pipeline.make_env))
        yield Small(tmp_path_factory.mktemp("reference"))


def copy(source: Path, target: Path) -> Path:
    """Copy a folder as it is at this moment; what vanishes meanwhile is left out."""
    target.mkdir(parents=True)
    for entry in os.scandir(source):
        with contextlib.suppress(FileNotFoundError):
            if entry.is_dir(follow_symlinks=False):
                copy(Path(entry.path), target / entry.name)
            else:
                shutil.copyfile(entry.path, target / entry.name)
    return target


@pytest.fixture(scope="session")
def copy_now() -> Callable[[Path, Path], Path]:
    return copy
