"""How a sweep stops: it waits while runs save, however long, and kills at the second signal."""

from __future__ import annotations

import _thread
import itertools
import os
import signal
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from twirl_mjx import exits
from twirl_mjx.sweep import scheduler
from twirl_mjx.sweep.scheduler import Progress, run_all
from twirl_mjx.sweep.worker import Ending, Job, run_job


def make(folder: Path, name: str, code: str = "pass") -> Job:
    return Job(name, ("-S", "-c", code, str(folder / f"{name}.out")), str(folder / f"{name}.log"))


class SlowExecutor:
    """One job that ends after a number of looks; a look can be cut short by a signal."""

    def __init__(self, looks: int, interrupted_at: int = -1) -> None:
        self.looks, self.interrupted_at = looks, interrupted_at
        self.said: list[str] = []

    def capacity(self) -> int:
        return 1

    def submit(self, job: Job) -> Job:
        return job

    def finished(self, handles: Any, timeout_s: float) -> list[Any]:
        self.looks -= 1
        if self.looks == self.interrupted_at:
            raise KeyboardInterrupt
        return list(handles) if self.looks <= 0 else []

    def ending(self, handle: Job) -> Ending:
        return Ending(exits.STOPPED, "here")

    def stop(self, handle: Job) -> None:
        self.said.append("stop")

    def kill(self, handle: Job) -> None:
        self.said.append("kill")


def stopped(executor: SlowExecutor, folder: Path) -> Progress:
    stop = threading.Event()
    table = run_all(
        [make(folder, "a")], executor, retries=1, stop=stop, show=lambda t: stop.set(),
        say=executor.said.append,
    )  # fmt: skip
    return table["a"]


def test_a_stop_waits_as_long_as_runs_need_to_save(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = itertools.count(0.0, 600.0)  # every look at the clock is ten minutes later
    monkeypatch.setattr(scheduler.time, "monotonic", lambda: next(clock))
    executor = SlowExecutor(looks=50)
    progress = stopped(executor, tmp_path)
    assert (progress.state, progress.reason, progress.where) == (
        "stopped",
        "exit status 130",
        "here",
    )
    assert "1 runs end their epoch and save" in executor.said[0]
    assert executor.said[1:] == ["stop"]


def test_a_second_signal_kills(tmp_path: Path) -> None:
    executor = SlowExecutor(looks=50, interrupted_at=45)
    progress = stopped(executor, tmp_path)
    assert (progress.state, progress.reason) == ("stopped", "killed at the second signal")
    assert executor.said[1:] == ["stop", "kill"]


SAVE = (
    "import pathlib, signal, sys, time; p = pathlib.Path(sys.argv[1])\n"
    "def save(*_):\n"
    "    if {slow}: time.sleep(60)\n"
    "    p.write_text('saved'); sys.exit(130)\n"
    "signal.signal(signal.SIGTERM, save); p.write_text('up'); time.sleep(60)"
)


def interrupt_when(path: Path, text: str, times: int) -> threading.Thread:
    """Interrupt this process's main thread as Ray does, once a file has a text."""

    def watch() -> None:
        while not (path.exists() and path.read_text() == text):
            time.sleep(0.02)
        for _ in range(times):
            _thread.interrupt_main()
            time.sleep(1.5)  # longer than a look at the child

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    return thread


def test_an_interrupted_worker_lets_its_child_save(tmp_path: Path) -> None:
    watcher = interrupt_when(tmp_path / "a.out", "up", 1)
    ending = run_job(make(tmp_path, "a", SAVE.format(slow=False)), pin=False)
    watcher.join()
    assert ending.code == 130
    assert (tmp_path / "a.out").read_text() == "saved"


def test_a_worker_of_a_background_sweep_can_be_interrupted(tmp_path: Path) -> None:
    old = signal.signal(signal.SIGINT, signal.SIG_IGN)  # as after `nohup make sweep &`
    try:
        watcher = interrupt_when(tmp_path / "a.out", "up", 1)
        ending = run_job(make(tmp_path, "a", SAVE.format(slow=False)), pin=False)
        watcher.join()
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, old)
    assert ending.code == 130


def test_a_second_interrupt_kills_the_child(tmp_path: Path) -> None:
    watcher = interrupt_when(tmp_path / "a.out", "up", 2)
    began = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        run_job(make(tmp_path, "a", SAVE.format(slow=True)), pin=False)
    watcher.join()
    assert time.monotonic() - began < 30
    assert (tmp_path / "a.out").read_text() == "up"


@pytest.mark.skipif(not hasattr(os, "getpgid"), reason="no process groups")
def test_a_signal_of_the_terminal_is_not_the_childs(tmp_path: Path) -> None:
    code = "import os, pathlib, sys; pathlib.Path(sys.argv[1]).write_text(str(os.getpgid(0)))"
    run_job(make(tmp_path, "a", code))
    assert int((tmp_path / "a.out").read_text()) != os.getpgid(0)
