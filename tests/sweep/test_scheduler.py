"""The loop that starts jobs, with an executor that is not Ray; and one job as a process."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from twirl_mjx import exits
from twirl_mjx.sweep import scheduler
from twirl_mjx.sweep.scheduler import Progress, run_all
from twirl_mjx.sweep.worker import Job, claim_core, run_job
from twirl_mjx.training import rundir

WRITE = "import pathlib, sys; pathlib.Path(sys.argv[1]).write_text('done')"
FAIL = "import sys; print('why it failed'); sys.exit(1)"
FAIL_ONCE = (
    "import pathlib, sys; p = pathlib.Path(sys.argv[1])\n"
    "if p.exists(): sys.exit(0)\np.write_text('tried'); sys.exit(7)"
)


def make(folder: Path, name: str, code: str = WRITE, needs: tuple[str, ...] = ()) -> Job:
    out = str(folder / f"{name}.out")
    return Job(name, ("-S", "-c", code, out), str(folder / f"{name}.log"), needs)


def run(jobs: list[Job], executor: Any, retries: int = 1) -> dict[str, Progress]:
    seen: list[int] = []
    table = run_all(
        jobs, executor, retries=retries, stop=threading.Event(),
        show=lambda t: seen.append(sum(p.state == "running" for p in t.values())),
    )  # fmt: skip
    assert max(seen) <= executor.room
    return table


def test_jobs_run_after_what_they_need(tmp_path: Path, here_executor: Any) -> None:
    executor = here_executor(room=2)
    jobs = [
        make(tmp_path, "c", needs=("a", "b")), make(tmp_path, "a"), make(tmp_path, "b"),
        make(tmp_path, "d", needs=("not a job, so done",)),
    ]  # fmt: skip
    table = run(jobs, executor)
    assert {p.state for p in table.values()} == {"done"}
    assert executor.submitted.index("c") > max(map(executor.submitted.index, "ab"))
    assert executor.most_at_once == 2
    assert (tmp_path / "c.out").read_text() == "done"


def test_a_crash_takes_only_its_dependants(tmp_path: Path, here_executor: Any) -> None:
    jobs = [
        make(tmp_path, "bad", FAIL), make(tmp_path, "child", needs=("bad",)),
        make(tmp_path, "grandchild", needs=("child",)), make(tmp_path, "good"),
    ]  # fmt: skip
    executor = here_executor()
    table = run(jobs, executor, retries=2)
    states = {name: p.state for name, p in table.items()}
    assert states == {"bad": "failed", "child": "blocked", "grandchild": "blocked", "good": "done"}
    assert executor.submitted.count("bad") == 3
    assert table["bad"].reason == "exit status 1"
    assert table["grandchild"].reason == "needs child"
    assert (tmp_path / "bad.log").read_text().splitlines().count("why it failed") == 3


def test_a_second_attempt_can_succeed(tmp_path: Path, here_executor: Any) -> None:
    table = run([make(tmp_path, "flaky", FAIL_ONCE)], here_executor())
    assert (table["flaky"].state, table["flaky"].attempts) == ("done", 2)


def test_unusable_arguments_are_not_tried_again(tmp_path: Path, here_executor: Any) -> None:
    executor = here_executor()
    table = run([make(tmp_path, "wrong", "import sys; sys.exit(2)")], executor, retries=5)
    assert table["wrong"].state == "failed"
    assert executor.submitted == ["wrong"]


def test_a_run_that_was_stopped_is_not_a_failure(tmp_path: Path, here_executor: Any) -> None:
    table = run([make(tmp_path, "asked", "import sys; sys.exit(130)")], here_executor())
    assert table["asked"].state == "stopped"


def test_a_lost_worker_is_survived(tmp_path: Path, here_executor: Any) -> None:
    table = run([make(tmp_path, "a"), make(tmp_path, "b")], here_executor(lost=("a",)))
    assert (table["a"].state, table["b"].state) == ("failed", "done")
    assert table["a"].reason == "worker lost: ConnectionError"


class BusyRay:
    """Starts at the n-th attempt."""

    def __init__(self, needed: int) -> None:
        self.needed, self.calls = needed, 0

    def init(self, **options: Any) -> None:
        self.calls += 1
        if self.calls < self.needed:
            raise Exception("timed out during startup")

    def shutdown(self) -> None:
        pass


def test_a_busy_machine_gets_several_attempts_to_start_ray() -> None:
    ray = BusyRay(needed=3)
    scheduler._start(ray, {"num_cpus": 1})
    assert ray.calls == 3
    with pytest.raises(RuntimeError, match="did not start in 4 attempts: timed out"):
        scheduler._start(BusyRay(needed=9), {"num_cpus": 1})
    joined = BusyRay(needed=2)
    with pytest.raises(RuntimeError, match="in 1 attempts"):
        scheduler._start(joined, {"address": "10.0.0.1:6379"})
    assert joined.calls == 1


def test_nothing_starts_after_a_stop(tmp_path: Path, here_executor: Any) -> None:
    stop, executor = threading.Event(), here_executor(room=1)

    def stop_at_first(table: Any) -> None:
        stop.set()

    jobs = [make(tmp_path, "a"), make(tmp_path, "b")]
    table = run_all(jobs, executor, retries=1, stop=stop, show=stop_at_first)
    assert executor.submitted == ["a"]
    assert [table[n].state for n in "ab"] == ["done", "waiting"]


BUSY_TRAIN = (
    "import sys; from pathlib import Path; from twirl_mjx import cli\n"
    "from twirl_mjx.training import rundir\n"
    "class Train:\n"
    "    def main(self, argv):\n"
    "        with rundir.RunDir(argv[0]).exclusive(wait_s=0.0):\n"
    "            return 0\n"
    "cli._import_command = lambda name: Train()\n"
    "sys.exit(cli.main(['train', sys.argv[1]]))"
)


def test_a_run_that_another_process_holds_is_told_from_a_crash(tmp_path: Path) -> None:
    job = Job("a", ("-c", BUSY_TRAIN, str(tmp_path / "run")), str(tmp_path / "a.log"))
    with rundir.RunDir(tmp_path / "run").exclusive():
        assert run_job(job, pin=False).code == exits.BUSY
    assert run_job(job, pin=False).code == 0
    crash = Job("a", ("-S", "-c", FAIL), job.log)
    assert run_job(crash, pin=False).code == 1


@pytest.mark.parametrize("others_end", ["finished", "cut off"])
def test_a_run_of_another_process_is_waited_for(
    others_end: Any, tmp_path: Path, here_executor: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scheduler, "BUSY_LOOK_S", 0.0)
    looks = {"a": iter(["in use", "in use", others_end]), "b": iter(["missing"])}
    jobs = [make(tmp_path, "a"), make(tmp_path, "b"), make(tmp_path, "c", needs=("a",))]
    looks["c"] = iter(["missing"])
    seen: list[str] = []
    executor = here_executor(room=1)
    table = run_all(
        jobs, executor, retries=0, stop=threading.Event(), poll_s=0.01,
        show=lambda t: seen.append(t["a"].state), look=lambda job: next(looks[job.name]),
    )  # fmt: skip
    assert {p.state for p in table.values()} == {"done"}
    assert executor.submitted == ["b", "a", "c"] if others_end == "cut off" else ["b", "c"]
    assert "busy" in seen
    assert table["a"].attempts == (others_end == "cut off")


def test_losing_the_race_for_a_run_is_no_attempt(
    tmp_path: Path, here_executor: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scheduler, "BUSY_LOOK_S", 0.0)
    refused_twice = (
        "import pathlib, sys; p = pathlib.Path(sys.argv[1])\n"
        "tries = p.read_text() if p.exists() else ''; p.write_text(tries + 'x')\n"
        f"len(tries) < 2 and sys.exit({exits.BUSY})"
    )
    executor = here_executor()
    jobs = [make(tmp_path, "a", refused_twice), make(tmp_path, "child", needs=("a",))]
    table = run(jobs, executor, retries=0)
    assert {name: (p.state, p.attempts) for name, p in table.items()} == {
        "a": ("done", 1), "child": ("done", 1),
    }  # fmt: skip
    assert executor.submitted == ["a", "a", "a", "child"]


def test_a_run_that_cannot_be_looked_at_is_one_failure(tmp_path: Path, here_executor: Any) -> None:
    def look(job: Job) -> Any:
        if job.name == "a":
            raise ValueError("changed by hand")
        return "missing"

    table = run_all(
        [make(tmp_path, "a"), make(tmp_path, "b")], here_executor(), retries=1,
        stop=threading.Event(), show=lambda t: None, look=look,
    )  # fmt: skip
    assert (table["a"].state, table["a"].reason) == ("failed", "changed by hand")
    assert table["b"].state == "done"


def test_a_job_that_kills_itself_says_by_what(tmp_path: Path, here_executor: Any) -> None:
    kill = "import os, signal; os.kill(os.getpid(), signal.SIGKILL)"
    table = run([make(tmp_path, "a", kill)], here_executor(), retries=0)
    assert table["a"].reason == "killed by SIGKILL"


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux pins")
def test_a_job_is_pinned_to_its_core(tmp_path: Path) -> None:
    code = "import os; print('cores', sorted(os.sched_getaffinity(0)))"
    ending = run_job(make(tmp_path, "a", code))
    place = ending.where.rpartition(", core ")
    cores = [int(place[2])] if place[1] else sorted(os.sched_getaffinity(0))  # none was free
    assert f"cores {cores}" in (tmp_path / "a.log").read_text().splitlines()


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux pins")
def test_no_core_is_claimed_twice() -> None:
    with contextlib.ExitStack() as stack:
        claims = [stack.enter_context(claim_core()) for _ in range(3)]
        held = [core for core in claims if core is not None]
        assert len(set(held)) == len(held) <= len(os.sched_getaffinity(0))
        assert set(held) <= os.sched_getaffinity(0)


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux ends children with their parent")
def test_a_child_dies_with_its_parent(tmp_path: Path) -> None:
    sleeper = tmp_path / "a.out"
    code = (
        "import os, pathlib, sys, time; pathlib.Path(sys.argv[1]).write_text(str(os.getpid()))\n"
        "time.sleep(120)"
    )
    job = make(tmp_path, "a", code)
    parent = subprocess.Popen(
        [sys.executable, "-c", "from twirl_mjx.sweep.worker import *; run_job(" + repr(job) + ")"]
    )
    deadline = time.monotonic() + 60
    while not (sleeper.exists() and sleeper.read_text()) and time.monotonic() < deadline:
        time.sleep(0.05)
    child = Path("/proc") / sleeper.read_text()
    assert child.exists()
    parent.kill()
    parent.wait()
    while child.exists() and "State:\tZ" not in (child / "status").read_text():
        assert time.monotonic() < deadline, "the child outlived its parent"
        time.sleep(0.05)
