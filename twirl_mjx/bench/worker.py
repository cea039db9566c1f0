"""A learner in a process of its own, pinned to one CPU: ``python -m twirl_mjx.bench.worker``.

The parent sends lines on stdin, each a length in s, and gets a line with a JSON list of critic
updates per second for each; end of input ends the process.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import threading
from typing import Any

READY = "ready"


def pinning_missing(workers: int) -> str | None:
    """Return why no learners can be pinned to CPUs, or None."""
    if workers == 0:
        return "switched off (--workers 0)"
    if not hasattr(os, "sched_setaffinity"):
        return f"{sys.platform} cannot pin a process to a CPU"
    import jax

    if jax.default_backend() != "cpu":
        return "learners on an accelerator share it by the batch axis, not by pinned processes"
    return None


class Worker:
    """The parent's end of one pinned learner; a context manager that ends the process."""

    def __init__(self, cpu: int, options: dict[str, Any]) -> None:
        """Start the process; it compiles until ``wait_until_ready`` returns.

        Args:
            cpu: Number of the CPU it may use.
            options: Fields of a ``LearnerBench``.
        """
        command = [sys.executable, "-m", "twirl_mjx.bench.worker", str(cpu), json.dumps(options)]
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def __enter__(self) -> Worker:
        return self

    def __exit__(self, *_: object) -> None:
        # Closing its input ends a waiting worker; a busy one is ended.
        assert self._process.stdin is not None
        self._process.stdin.close()
        try:
            self._process.wait(timeout=10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        assert self._process.stdout is not None
        self._process.stdout.close()

    def wait_until_ready(self) -> None:
        """Wait for the end of its compilation.

        Raises:
            RuntimeError: The process ended or is not ready after ten minutes.
        """
        if self._line() != READY:
            raise RuntimeError("a pinned learner broke its protocol")

    def start(self, seconds: float) -> None:
        """Let it measure; several workers may be started before the first is read."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{seconds}\n")
        self._process.stdin.flush()

    def samples(self) -> list[float]:
        """Wait for the measurement and return its samples."""
        return json.loads(self._line())

    def _line(self) -> str:
        assert self._process.stdout is not None
        watchdog = threading.Timer(600.0, self._process.kill)
        watchdog.start()
        try:
            line = self._process.stdout.readline()
        finally:
            watchdog.cancel()
        if not line:
            raise RuntimeError(f"a pinned learner ended with status {self._process.wait()}")
        return line.strip()


def main(argv: list[str]) -> None:
    """Serve measurements; arguments are the CPU and the options as JSON."""
    if int(argv[0]) >= 0:
        os.sched_setaffinity(0, {int(argv[0])})
    with contextlib.redirect_stdout(sys.stderr):  # mujoco-mjx prints while it is imported
        from twirl_mjx.bench.learner import LearnerBench, make_learner
        from twirl_mjx.bench.measure import only_json_on_stdout, sample_rates

    with only_json_on_stdout() as out:
        chain, updates = make_learner(LearnerBench(**json.loads(argv[1])), 1)
        print(READY, file=out, flush=True)
        for line in sys.stdin:
            print(json.dumps(sample_rates(chain, updates, float(line))), file=out, flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
