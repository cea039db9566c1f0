"""A measurement in a process of its own: ``python -m twirl_mjx.bench.worker KIND CPU OPTIONS``.

It compiles, says so, and then waits. The parent sends lines on stdin, each a length in s, and gets
a line with a JSON list of rates for each; end of input ends the process. So several compile at
once and each is timed alone, or several pinned ones are timed together.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import threading
from collections.abc import Mapping
from typing import Any

READY = "ready"
ANYWHERE = -1
"""The CPU of a process that is not pinned."""


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
    """The parent's end of one process; a context manager that ends it."""

    def __init__(
        self,
        kind: str,
        options: dict[str, Any],
        *,
        cpu: int = ANYWHERE,
        environment: Mapping[str, str] | None = None,
    ) -> None:
        """Start the process; it compiles until ``wait_until_ready`` returns.

        Args:
            kind: ``learner`` (critic updates per second) or ``worlds`` (control steps per second).
            options: Fields of a ``LearnerBench``, or arguments of ``worlds.make_chain``.
            cpu: Number of the CPU it may use.
            environment: Variables that it sees beside ours.
        """
        words = [kind, str(cpu), json.dumps(options)]
        self._process = subprocess.Popen(
            [sys.executable, "-m", "twirl_mjx.bench.worker", *words],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, **(environment or {})},
        )

    def __enter__(self) -> Worker:
        return self

    def __exit__(self, *_: object) -> None:
        # Closing its input ends a waiting worker; a busy one is ended.
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # it ended before it read what it was sent
            self._process.stdin.close()
        try:
            self._process.wait(timeout=10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        assert self._process.stdout is not None
        self._process.stdout.close()

    def wait_until_ready(self, limit: float = 600.0) -> None:
        """Wait for the end of its compilation.

        Args:
            limit: s, after which the process is ended.

        Raises:
            RuntimeError: The process ended or was not ready in time.
        """
        if self._line(limit) != READY:
            raise RuntimeError("a measuring process broke its protocol")

    def start(self, seconds: float) -> None:
        """Let it measure; several workers may be started before the first is read."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{seconds}\n")
        self._process.stdin.flush()

    def samples(self, limit: float = 600.0) -> list[float]:
        """Wait for the measurement, at most ``limit`` s, and return its samples.

        Raises:
            RuntimeError: The process ended or took longer.
        """
        return json.loads(self._line(limit))

    def _line(self, limit: float) -> str:
        assert self._process.stdout is not None
        watchdog = threading.Timer(limit, self._process.kill)
        watchdog.start()
        try:
            line = self._process.stdout.readline()
        finally:
            watchdog.cancel()
        if not line:
            raise RuntimeError(f"a measuring process ended with status {self._process.wait()}")
        return line.strip()


def main(argv: list[str]) -> None:
    """Serve measurements; arguments are the kind, the CPU and the options as JSON."""
    kind, cpu, options = argv[0], int(argv[1]), json.loads(argv[2])
    if cpu != ANYWHERE:
        os.sched_setaffinity(0, {cpu})
    with contextlib.redirect_stdout(sys.stderr):  # mujoco-mjx prints while it is imported
        from twirl_mjx.bench import learner, worlds
        from twirl_mjx.bench.measure import only_json_on_stdout, sample_rates

    with only_json_on_stdout() as out:
        if kind == "learner":
            given = learner.LearnerBench(**options)
            chain, work = learner.make_learner(given, 1 if cpu != ANYWHERE else given.num_seeds)
        else:
            chain, work = worlds.make_chain(**options)
        chain()
        print(READY, file=out, flush=True)
        for line in sys.stdin:
            print(json.dumps(sample_rates(chain, work, float(line))), file=out, flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
