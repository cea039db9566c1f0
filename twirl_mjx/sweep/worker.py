"""What a worker does with one run: claim a core, run it as a child process, report how it ended."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import platform
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from twirl_mjx.machine import CAN_PIN, runtime_folder, try_lock, usable_cores
from twirl_mjx.sweep import launch

POLL_S = 0.5
"""Time between two looks at a child, s; Ray interrupts a worker between two instructions only."""


@dataclasses.dataclass(frozen=True)
class Job:
    """One run to start."""

    name: str
    """Its name, unique in the sweep."""
    argv: tuple[str, ...]
    """Arguments for this interpreter, for example ``-m twirl_mjx train ...``."""
    log: str
    """File that its output is appended to."""
    needs: tuple[str, ...] = ()
    """Names of the jobs that have to be done before."""


PROGRAM_WORDS = 3
"""Arguments of a job before the options of its run: ``-m twirl_mjx train``."""


def join(jobs: Sequence[Job]) -> Job:
    """Return the one job of a team: its runs as one program, with the log of the first."""
    first, *others = jobs
    more = [word for job in others for word in ("--and", *job.argv[PROGRAM_WORDS:])]
    return dataclasses.replace(first, argv=(*first.argv, *more))


@dataclasses.dataclass(frozen=True)
class Ending:
    """How one attempt ended."""

    code: int
    """Exit status of the process, see ``exits``; negative: killed by that signal."""
    where: str
    """Machine and core."""


@contextlib.contextmanager
def claim_core() -> Iterator[int | None]:
    """Hold one core of those this process may use, by a lock that ends with the process.

    The locks are shared by all sweeps of a user on a machine, so two never pin to one core.

    Yields:
        The core; None when the machine cannot pin or every core is held.

    Raises:
        PermissionError: See ``machine.runtime_folder``.
    """
    cores = usable_cores() if CAN_PIN else []
    folder = runtime_folder()
    for core in cores:
        with (folder / f"core-{core}.lock").open("a") as file:
            if not try_lock(file):
                continue
            yield core
            return
    yield None


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """Let ``KeyboardInterrupt`` be raised here, by which Ray asks a worker to stop.

    A sweep that was started in the background (``nohup make sweep &``) ignores SIGINT, and so do
    its workers.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    old = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, old)


@interruptible()
def run_job(job: Job, *, pin: bool = True) -> Ending:
    """Run a job as a child process and wait for it.

    The child dies with this process. ``KeyboardInterrupt`` asks it to save and stop, which may
    take an epoch; a second one kills it.

    Args:
        job: What to run.
        pin: Give it a core of its own; not useful where the work is on an accelerator.

    Raises:
        KeyboardInterrupt: At the second interrupt.
    """
    log = Path(job.log)
    log.parent.mkdir(parents=True, exist_ok=True)
    with claim_core() if pin else contextlib.nullcontext() as core, log.open("a") as file:
        place = f"{platform.node()}{'' if core is None else f', core {core}'}"
        stamp = time.strftime("%Y-%m-%d %H:%M:%S")
        file.write(f"== {stamp} on {place}: {' '.join(job.argv)}\n")
        file.flush()
        target = "-" if core is None else str(core)
        command = [sys.executable, "-S", launch.__file__, str(os.getpid()), target]
        child = subprocess.Popen(
            [*command, sys.executable, *job.argv],
            stdin=subprocess.DEVNULL,
            stdout=file,
            stderr=subprocess.STDOUT,
            process_group=0,  # Ctrl-C is the sweep's: a run asked twice would end without saving
        )
        try:
            code = _wait(child)
        finally:
            if child.poll() is None:
                child.kill()
                child.wait()
        file.write(f"== ended with {code}\n")
    return Ending(code, place)


def _wait(child: subprocess.Popen[bytes]) -> int:
    try:
        return _exit_status(child)
    except KeyboardInterrupt:
        child.send_signal(signal.SIGTERM)
        return _exit_status(child)


def _exit_status(child: subprocess.Popen[bytes]) -> int:
    while (code := child.poll()) is None:
        time.sleep(POLL_S)
    return code
