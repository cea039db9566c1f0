"""Hands the metrics of runs in step to their sinks, with the rates of the epoch added."""

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


class _Books:
    """The sinks of one run, but for the terminal, which all runs share."""

    def __init__(self, run: RunInfo, chosen: Sequence[Sink]) -> None:
        run.directory.mkdir(parents=True, exist_ok=True)
        self.run = run
        self.declared = {**run.measures, **run.learning}
        self.chosen = list(chosen)
        table = Table()
        self.open: list[Sink] = []
        for sink in (table, TensorBoard()):
            sink.open(run)
            self.open.append(sink)
        self.lacks = table.lacks
        """What the table says is missing of it, if anything."""
        self.start = time.monotonic() - table.earlier_s
        """When the run would have begun, had it run without a pause."""


class RunLogger:
    """Writes the metrics of runs in step and shows their progress; a context manager.

    Every ``log`` appends to every ``metrics.csv`` and TensorBoard and forces both to disk, so a
    killed run loses nothing it has reported; then come the terminal, which shows mean and range
    over the runs, and the sinks that were chosen.
    """

    def __init__(
        self,
        runs: Sequence[RunInfo],
        sinks: Sequence[Sequence[Sink]] = (),
        *,
        name: str | None = None,
        console: Console | None = None,
    ) -> None:
        """Open every sink.

        Args:
            runs: The stage of S runs that are equally far.
            sinks: What each of them logs to beside the built-in three; none by default.
            name: What the runs are called together; the name of the first by default.
            console: where progress goes; standard output by default.

        Raises:
            ValueError: A foreign ``metrics.csv`` lies in a directory.
        """
        self._terminal = Terminal(console or Console())
        self._books: list[_Books] = []
        self._left: set[int] = set()
        try:
            for run, chosen in zip(runs, sinks or [()] * len(runs), strict=True):
                self._books.append(_Books(run, chosen))
        except BaseException:
            self.close()
            raise
        self._terminal.open(runs[0], name, len(runs))
        for books in self._books:
            if books.lacks:
                self.announce(books.lacks)
            self._each_chosen(books, lambda sink, run=books.run: sink.open(run))
        self._compile_s = self._aside_s = 0.0
        self._last = (0, 0, time.monotonic()) if not runs[0].resume_env_steps else None

    def __enter__(self) -> RunLogger:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def log(self, env_steps: int, grad_steps: int, metrics: Mapping[str, Any]) -> None:
        """Report one epoch; NaN means undefined (no episode ended) and is left out.

        Args:
            env_steps: transitions of each run so far.
            grad_steps: critic updates of each run so far.
            metrics: name to scalar, or to one value of each run [S]; the rates are added unless
                given.

        Raises:
            ValueError: a name that neither training nor the task or learner declares.
        """
        shape = (len(self._books),)
        given = {name: np.broadcast_to(np.asarray(v), shape) for name, v in metrics.items()}
        env_steps, grad_steps = int(env_steps), int(grad_steps)
        rates = self._rates(env_steps, grad_steps)
        shown: list[Mapping[str, float]] = []
        for index, books in enumerate(self._books):
            if index in self._left:
                continue
            values = rates | {name: float(value[index]) for name, value in given.items()}
            for name in given:
                describe(name, books.declared)
            defined = MappingProxyType({k: v for k, v in values.items() if not math.isnan(v)})
            wall_s = time.monotonic() - books.start
            for sink in books.open:
                sink.log(env_steps, grad_steps, wall_s, defined)
            shown.append(defined)
            self._each_chosen(
                books, lambda sink, w=wall_s, d=defined: sink.log(env_steps, grad_steps, w, d)
            )
        self._terminal.log(env_steps, grad_steps, shown)

    def leave(self, index: int) -> None:
        """Close the sinks of a run that goes on no more, although others do."""
        self._left.add(index)
        self._close(self._books[index])

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
        for books in self._books:
            self._close(books)
        self._terminal.close()

    def _close(self, books: _Books) -> None:
        self._each_chosen(books, lambda sink: sink.close())
        books.chosen.clear()
        while books.open:
            books.open.pop().close()

    def _each_chosen(self, books: _Books, call: Callable[[Sink], None]) -> None:
        """Call every sink that was chosen; one that fails is announced and dropped."""
        for sink in tuple(books.chosen):
            try:
                call(sink)
            except Exception as error:
                books.chosen.remove(sink)
                why = f"{type(error).__name__}: {' '.join(str(error).split())}"
                self.announce(f"sink {type(sink).__name__} failed and is dropped: {why}")

    def _rates(self, env_steps: int, grad_steps: int) -> dict[str, float]:
        """Return the rates since the last call, if any step was made, or the compilation time."""
        now, compile_s, aside_s = time.monotonic(), self._compile_s, self._aside_s
        last, self._last = self._last, (env_steps, grad_steps, now)
        self._compile_s = self._aside_s = 0.0
        if compile_s:
            return {"compile_s": compile_s}
        seconds = 0.0 if last is None else now - last[2] - aside_s
        if last is None or seconds <= 0.0 or env_steps == last[0]:  # the last evaluation, say
            return {}
        return {
            "env_steps_per_s": (env_steps - last[0]) / seconds,
            "updates_per_s": (grad_steps - last[1]) / seconds,
        }
