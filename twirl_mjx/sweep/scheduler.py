"""Run jobs on Ray: dependencies, retries, and nothing that one crash could take with it."""

from __future__ import annotations

import dataclasses
import logging
import math
import signal
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, Protocol

from twirl_mjx import exits
from twirl_mjx.sweep.plan import Status
from twirl_mjx.sweep.together import Teams, alone
from twirl_mjx.sweep.worker import Ending, Job, join, run_job

State = Literal["waiting", "running", "busy", "done", "failed", "blocked", "stopped"]
"""``busy``: another process works on the run, which is waited for."""

OBJECT_STORE_BYTES = 80 * 2**20
"""Ray's smallest object store; jobs hand over a few words."""
START_ATTEMPTS = 4
"""Attempts to start Ray."""
BUSY_LOOK_S = 10.0
"""Time between two looks at a run that another process works on, s."""


@dataclasses.dataclass
class Progress:
    """How far a job is."""

    job: Job
    state: State = "waiting"
    attempts: int = 0
    began: float = math.nan
    """Monotonic time of the present attempt, s."""
    seconds: float = 0.0
    """Duration of the finished attempt, s."""
    reason: str = ""
    """Why it did not finish."""
    where: str = ""
    """Machine and core of the last attempt."""
    look_at: float = 0.0
    """Monotonic time of the next look at a busy run, s."""
    log: str = ""
    """File with the output of the last attempt."""
    is_alone: bool = False
    """Whether it goes on in a process of its own, as that of its team has failed."""

    def __post_init__(self) -> None:
        """Begin with the log of the job."""
        self.log = self.log or self.job.log


class Executor(Protocol):
    """Something that runs jobs elsewhere."""

    def capacity(self) -> int:
        """Return how many jobs can run at once."""
        ...

    def submit(self, job: Job) -> Any:
        """Start a job; return a handle."""
        ...

    def finished(self, handles: Sequence[Any], timeout_s: float) -> list[Any]:
        """Wait up to ``timeout_s`` for handles whose job has ended, and return those."""
        ...

    def ending(self, handle: Any) -> Ending:
        """Return how a job ended; raises when its worker was lost."""
        ...

    def stop(self, handle: Any) -> None:
        """Ask a running job to save and stop."""
        ...

    def kill(self, handle: Any) -> None:
        """End a running job at once."""
        ...


class RayExecutor:
    """Jobs as Ray tasks; a context manager that starts and ends Ray."""

    def __init__(self, *, address: str | None, workers: int | None, gpus: float | None) -> None:
        """Start Ray on this machine, or join a cluster.

        Args:
            address: Address of a running Ray cluster; None starts Ray here, without server and
                (by an environment variable that ``cli`` sets) for this machine alone.
            workers: Most jobs at once; None for one per core (or GPU fraction).
            gpus: GPUs per job, may be a fraction; None for one where there are any, else 0.

        Raises:
            ValueError: More GPUs are asked for than there are.
            RuntimeError: Ray does not start, or there is no cluster at the address.
        """
        import ray

        self._ray = ray
        options: dict[str, Any] = {"address": address}
        if address is None:
            options = {
                "num_cpus": workers,
                "include_dashboard": False,
                "object_store_memory": OBJECT_STORE_BYTES,
            }
        _start(ray, options)
        self._workers = workers
        there = float(ray.cluster_resources().get("GPU", 0))
        self._gpus = (1.0 if there else 0.0) if gpus is None else gpus
        if self._gpus > there:
            self.close()
            raise ValueError(f"{self._gpus:g} GPUs per run asked for, {there:g} available")
        self._task: Any = ray.remote(run_job)
        self._options: dict[str, Any] = {"num_cpus": 1, "num_gpus": self._gpus, "max_retries": 0}
        if 0.0 < self._gpus < 1.0:  # jobs that share a GPU may only claim their part of it
            part = {"XLA_PYTHON_CLIENT_MEM_FRACTION": f"{0.9 * self._gpus:.3f}"}
            self._options["runtime_env"] = {"env_vars": part}

    def __enter__(self) -> RayExecutor:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End Ray (leave the cluster)."""
        self._ray.shutdown()

    def capacity(self) -> int:
        """Return how many jobs the cluster has room for."""
        resources = self._ray.cluster_resources()
        room = int(resources.get("CPU", 0))
        if self._gpus:
            room = min(room, int(resources.get("GPU", 0) / self._gpus + 1e-9))
        return min(room, self._workers or room)

    def submit(self, job: Job) -> Any:
        """Start a job as a task of its own worker process."""
        return self._task.options(name=job.name, **self._options).remote(job, pin=not self._gpus)

    def finished(self, handles: Sequence[Any], timeout_s: float) -> list[Any]:
        """Wait for endings."""
        done, _ = self._ray.wait(
            list(handles), num_returns=len(handles), timeout=timeout_s, fetch_local=False
        )
        return done

    def ending(self, handle: Any) -> Ending:
        """Return how a task ended."""
        return self._ray.get(handle)

    def stop(self, handle: Any) -> None:
        """Interrupt the task, which asks its child to stop."""
        self._ray.cancel(handle, force=False)

    def kill(self, handle: Any) -> None:
        """End the worker of the task, and with it the child."""
        self._ray.cancel(handle, force=True)


def _start(ray: Any, options: dict[str, Any]) -> None:
    """Start or join Ray; a busy machine gets several attempts, as Ray itself gives it 30 s.

    Raises:
        RuntimeError: It did not work.
    """
    quiet = {"log_to_driver": False, "configure_logging": False, "logging_level": logging.ERROR}
    attempts = 1 if options.get("address") else START_ATTEMPTS
    for left in reversed(range(attempts)):
        try:
            ray.init(**quiet, **options)
        except Exception as error:  # Ray raises the bare class here
            ray.shutdown()
            if not left:
                raise RuntimeError(f"Ray did not start in {attempts} attempts: {error}") from error
        else:
            return


def run_all(
    jobs: Sequence[Job],
    executor: Executor,
    *,
    retries: int,
    stop: threading.Event,
    show: Callable[[Mapping[str, Progress]], None],
    look: Callable[[Job], Status] = lambda job: "missing",
    say: Callable[[str], None] = lambda text: None,
    poll_s: float = 1.0,
    teams: Teams = alone,
) -> dict[str, Progress]:
    """Run every job after those it needs; one that fails takes only its dependants along.

    When the process of a team fails, those of its jobs that are not finished go on each in a
    process of its own; for them that was no attempt.

    Args:
        jobs: What to run; a need that is not among them counts as done.
        executor: Where to run.
        retries: Further attempts after a crash.
        stop: When set, running jobs are asked to stop and nothing new is started.
        show: Called after every change and about once per ``poll_s``.
        look: Returns how far a job is before it is started, as other processes may work on it.
        say: Prints one line for a person.
        poll_s: Longest time between two looks, s.
        teams: Puts jobs together that one process runs.

    Returns:
        The progress of every job, by name.
    """
    table = {job.name: Progress(job) for job in jobs}
    handles: dict[Any, list[Progress]] = {}
    while not stop.is_set():
        _block(table)
        room = executor.capacity()
        for candidates in _teams(_ready(table), room - len(handles), teams):
            if len(handles) >= room:
                break
            if team := [each for each in candidates if _is_to_start(each, look)]:
                handles[executor.submit(_begin(team))] = team
        show(table)
        if not handles:
            if all(progress.state not in ("waiting", "busy") for progress in table.values()):
                break
            stop.wait(poll_s)  # no room at the moment, or others have to finish first
            continue
        for handle in executor.finished(list(handles), poll_s):
            _settle(handles.pop(handle), handle, executor, retries, look)
    if handles:
        _stop_all(handles, executor, show=lambda: show(table), look=look, say=say)
    show(table)
    return table


def _ready(table: Mapping[str, Progress]) -> list[Progress]:
    now = time.monotonic()
    return [
        p
        for p in table.values()
        if (p.state == "waiting" or (p.state == "busy" and now >= p.look_at))
        and all(table[n].state == "done" for n in p.job.needs if n in table)
    ]


def _teams(ready: Sequence[Progress], room: int, teams: Teams) -> list[list[Progress]]:
    """Return what may start by the process that is to run it."""
    if room < 1:
        return []
    by_name = {progress.job.name: progress for progress in ready}
    found = teams([progress.job for progress in ready if not progress.is_alone], room)
    return [
        *([by_name[job.name] for job in team] for team in found),
        *([progress] for progress in ready if progress.is_alone),
    ]


def _begin(team: Sequence[Progress]) -> Job:
    """Enter the members of a team as running; return their job."""
    job = join([progress.job for progress in team])
    for progress in team:
        progress.state, progress.began, progress.log = "running", time.monotonic(), job.log
        progress.attempts += 1
        if len(team) > 1:
            progress.reason = f"one of {len(team)} in a program"
    return job


def _is_to_start(progress: Progress, look: Callable[[Job], Status]) -> bool:
    """Look at the run of a job; enter it as done, busy or failed where it is not to be started."""
    try:
        status = look(progress.job)
    except (ValueError, OSError) as error:  # a run directory that cannot be read
        progress.state, progress.reason = "failed", str(error)
        return False
    if status == "in use":
        _set_busy(progress)
    elif status == "finished":
        progress.state, progress.began, progress.reason = "done", time.monotonic(), ""
        progress.where = progress.where or "another process"
    else:
        progress.reason = ""
    return status in ("missing", "cut off")


def _set_busy(progress: Progress) -> None:
    progress.state, progress.reason = "busy", "in use by another process"
    progress.look_at = time.monotonic() + BUSY_LOOK_S


def _block(table: Mapping[str, Progress]) -> None:
    """Mark the jobs whose needs can no longer be met; jobs stand after what they need."""
    for progress in table.values():
        lost = [n for n in progress.job.needs if n in table and table[n].state in _LOST]
        if progress.state == "waiting" and lost:
            progress.state, progress.reason = "blocked", f"needs {lost[0]}"


_LOST = ("failed", "blocked", "stopped")


def _settle(
    team: Sequence[Progress],
    handle: Any,
    executor: Executor,
    retries: int,
    look: Callable[[Job], Status],
) -> None:
    """Enter how an attempt ended: done, to be tried again, stopped or failed.

    An attempt that another process was ahead of does not count, nor does a failure in a team.
    """
    try:
        ending = executor.ending(handle)
    except Exception as error:  # the worker was lost: any of Ray's errors
        ending, reason = Ending(1, team[0].where), f"worker lost: {type(error).__name__}"
    else:
        reason = _reason(ending.code)
    for progress in team:
        progress.seconds = time.monotonic() - progress.began
        progress.where, progress.reason = ending.where, reason
        failed = ending.code not in (0, exits.BUSY, exits.STOPPED)
        if len(team) > 1 and failed and _is_to_start(progress, look):
            progress.state, progress.is_alone = "waiting", True
            progress.attempts -= 1
        elif len(team) == 1 or not failed:
            _settle_one(progress, ending.code, retries)


def _settle_one(progress: Progress, code: int, retries: int) -> None:
    """Enter the exit status of a process whose runs all ended with it."""
    if code == 0:
        progress.state = "done"
    elif code == exits.BUSY:
        progress.attempts -= 1
        _set_busy(progress)
    elif code == exits.STOPPED:
        progress.state = "stopped"
    elif code != exits.UNUSABLE and progress.attempts <= retries:
        progress.state = "waiting"
    else:
        progress.state = "failed"


def _reason(code: int) -> str:
    if code == 0:
        return ""
    return f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit status {code}"


def _stop_all(
    handles: dict[Any, list[Progress]],
    executor: Executor,
    show: Callable[[], None],
    look: Callable[[Job], Status],
    say: Callable[[str], None],
) -> None:
    """Ask what runs to stop and wait for it as long as it takes; a second signal kills it."""
    say(
        f"stopping: {sum(map(len, handles.values()))} runs end their epoch and save, which may"
        " take minutes"
        " (a second signal kills them: they go on from their last checkpoint)"
    )
    try:
        for handle in handles:
            executor.stop(handle)
        while handles:
            for handle in executor.finished(list(handles), 1.0):
                team = handles.pop(handle)
                _settle(team, handle, executor, 0, look)
                for progress in team:
                    if progress.state in ("failed", "waiting"):  # cancelled before it stopped
                        progress.state = "stopped"
            show()
    except KeyboardInterrupt:
        for handle, team in handles.items():
            executor.kill(handle)
            for progress in team:
                progress.state, progress.reason = "stopped", "killed at the second signal"
