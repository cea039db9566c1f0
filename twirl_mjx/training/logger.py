"""Hands the metrics of a run to its sinks, with the rates of the epoch added."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np
from rich.console import Console

from twirl_mjx.training.metrics import describe
from twirl_mjx.training.sinks.base import RunInfo, Sink
from twirl_mjx.training.sinks.table import Table
from twirl_mjx.training.sinks.tensorboard import TensorBoard
from twirl_mjx.training.sinks.terminal import Terminal


class RunLogger:
    """Writes one run's metrics and shows its progress; a context manager.

    Every ``log`` appends to ``metrics.csv`` and TensorBoard and forces both to disk, so a killed
    run loses nothing it has reported; then come the terminal and the sinks that were chosen.
    """

    def __init__(
        self, run: RunInfo, sinks: Sequence[Sink] = (), *, console: Console | None = None
    ) -> None:
        """Open every sink.

        Args:
            run: The stage of the run.
            sinks: What to log to beside the built-in three.
            console: where progress goes; standard output by default.

        Raises:
            ValueError: A foreign ``metrics.csv`` lies in the directory.
        """
        run.directory.mkdir(parents=True, exist_ok=True)
        self._declared = {**run.measures, **run.learning}
        self._terminal = Terminal(console or Console())
        self._chosen = list(sinks)
        table = Table()
        self._open: list[Sink] = []
        for sink in (table, TensorBoard(), self._terminal):
            sink.open(run)
            self._open.append(sink)
        if table.lacks:
            self.announce(table.lacks)
        self._each_chosen(lambda sink: sink.open(run))
        self._start = time.monotonic() - table.earlier_s
        self._compile_s = self._aside_s = 0.0
        self._last = (0, 0, time.monotonic()) if not run.resume_env_steps else None

    def __enter__(self) -> RunLogger:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def log(self, env_steps: int, grad_steps: int, metrics: Mapping[str, Any]) -> None:
        """Report one epoch; NaN means undefined (no episode ended) and is left out.

        Args:
            env_steps: transitions gathered so far.
            grad_steps: critic updates so far.
            metrics: name to scalar; the rates are added unless given.

        Raises:
            ValueError: a name that neither training nor the task or learner declares.
        """
        values = {name: float(np.asarray(value)) for name, value in metrics.items()}
        for name in values:
            describe(name, self._declared)
        env_steps, grad_steps = int(env_steps), int(grad_steps)
        values = {**self._rates(env_steps, grad_steps), **values}
        defined = MappingProxyType({k: v for k, v in values.items() if not math.isnan(v)})
        wall_s = time.monotonic() - self._start
        for sink in self._open:
            sink.log(env_steps, grad_steps, wall_s, defined)
        self._each_chosen(lambda sink: sink.log(env_steps, grad_steps, wall_s, defined))

    def announce(self, text: str) -> None:
        """Print one line above the progress."""
        self._terminal.announce(text)

    @contextlib.contextmanager
    def compiling(self, name: str) -> Iterator[None]:
        """Announce a compilation and show its running time; its epoch gets no rates.

        Args:
            name: function being compiled, for example ``train_epoch``.
        """
        start = time.monotonic()
        with self.aside(f"compiling {name} ..."):
            yield
        elapsed = time.monotonic() - start
        self._compile_s += elapsed
        self.announce(f"compiling {name} ... {elapsed:.0f} s")

    @contextlib.contextmanager
    def aside(self, text: str) -> Iterator[None]:
        """Show that something other than training goes on and leave its time out of the rates.

        Args:
            text: what goes on, for example ``evaluating ...``.
        """
        start = time.monotonic()
        self._terminal.busy(text)
        try:
            yield
        finally:
            self._aside_s += time.monotonic() - start
            self._terminal.busy(None)

    def close(self) -> None:
        """Close every sink; harmless when repeated."""
        self._each_chosen(lambda sink: sink.close())
        self._chosen.clear()
        while self._open:
            self._open.pop().close()

    def _each_chosen(self, call: Callable[[Sink], None]) -> None:
        """Call every sink that was chosen; one that fails is announced and dropped."""
        for sink in tuple(self._chosen):
            try:
                call(sink)
            except Exception as error:
                self._chosen.remove(sink)
                why = f"{type(error).__name__}: {' '.join(str(error).split())}"
                self.announce(f"sink {type(sink).__name__} failed and is dropped: {why}")

    def _rates(self, env_steps: int, grad_steps: int) -> dict[str, float]:
        """Return the rates since the last call, or the compilation time if there was one."""
        now, compile_s, aside_s = time.monotonic(), self._compile_s, self._aside_s
        last, self._last = self._last, (env_steps, grad_steps, now)
        self._compile_s = self._aside_s = 0.0
        if compile_s:
            return {"compile_s": compile_s}
        seconds = 0.0 if last is None else now - last[2] - aside_s
        if last is None or seconds <= 0.0:
            return {}
        return {
            "env_steps_per_s": (env_steps - last[0]) / seconds,
            "updates_per_s": (grad_steps - last[1]) / seconds,
        }
