"""How a sweep looks: one live table on a terminal, plain lines elsewhere."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from twirl_mjx.sweep.estimate import Estimate
from twirl_mjx.sweep.plan import Cell, Status, reached_steps
from twirl_mjx.sweep.scheduler import Progress
from twirl_mjx.training.sinks.terminal import format_count, format_seconds

HEARTBEAT_S = 60.0
"""Time between two plain lines about running cells, s."""
SHOWN = 8
"""Waiting and ended cells shown in the live table; running and failed ones always are."""
COLOURS = {
    "running": "cyan",
    "busy": "yellow",
    "failed": "red",
    "blocked": "red",
    "stopped": "yellow",
}


class SweepView:
    """Shows the progress of a sweep; a context manager."""

    def __init__(
        self, console: Console, title: str, cells: Sequence[Cell], runs: Path,
        estimates: Mapping[str, Estimate],
    ) -> None:  # fmt: skip
        """Take what is going to be run.

        Args:
            console: Where to show it.
            title: Name of the sweep.
            cells: The cells to run.
            runs: Folder of all runs.
            estimates: Expected time of each cell by name.
        """
        self._console, self._title, self._runs = console, title, runs
        self._cells = {cell.name: cell for cell in cells}
        self._estimates = estimates
        self._table: Mapping[str, Progress] = {}
        self._seen: dict[str, tuple[str, int]] = {}
        self._beat = time.monotonic()
        self._live: Live | None = None

    def __enter__(self) -> SweepView:
        if self._console.is_terminal:
            self._live = Live(
                console=self._console, get_renderable=self._render, refresh_per_second=1
            )
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live is not None:
            self._live.stop()
            self._live = None

    def update(self, table: Mapping[str, Progress]) -> None:
        """Take over the present state; without a terminal, print what changed."""
        self._table = table
        if self._live is not None:
            return
        for name, progress in table.items():
            state = (progress.state, progress.attempts)
            if self._seen.get(name, ("waiting", 0)) != state:
                self.say(self._line(progress))
            self._seen[name] = state
        if time.monotonic() - self._beat > HEARTBEAT_S:
            self._beat = time.monotonic()
            for progress in table.values():
                if progress.state == "running":
                    self.say(self._line(progress))
            self.say(self._summary())

    def say(self, text: str) -> None:
        """Print one line, above the live table where there is one."""
        self._console.print(Text(text), soft_wrap=True)

    def _line(self, progress: Progress) -> str:
        cell = self._cells[progress.job.name]
        parts = [f"{progress.state:<8} {cell.label}", self._share(progress), self._spent(progress)]
        if progress.attempts > 1:
            parts.append(f"attempt {progress.attempts}")
        return " | ".join(part for part in [*parts, progress.reason, cell.name] if part)

    def _share(self, progress: Progress) -> str:
        cell = self._cells[progress.job.name]
        if progress.state != "running" or cell.config.variant == "zero-shot":
            return ""
        total = cell.config.total_env_steps
        done = min(reached_steps(self._runs / cell.name), total)
        return f"{format_count(done)} / {format_count(total)} ({100.0 * done / total:.0f} %)"

    def _spent(self, progress: Progress) -> str:
        if progress.state == "running":
            return format_seconds(time.monotonic() - progress.began)
        if progress.state == "waiting":
            return f"~{format_seconds(self._estimates[progress.job.name].seconds)}"
        return format_seconds(progress.seconds) if progress.seconds else ""

    def _summary(self) -> str:
        counts = Counter(p.state for p in self._table.values())
        total = sum(counts.values())
        return f"{self._title}: " + ", ".join(
            [f"{counts.pop('done', 0)} of {total} done", *(f"{n} {s}" for s, n in counts.items())]
        )

    def _chosen(self) -> list[Progress]:
        """Return what fits: all that runs or failed, the last that ended, the next to start."""
        by = {state: [p for p in self._table.values() if p.state == state] for state in _ORDER}
        ended = sorted(by["done"], key=lambda p: p.began)[-SHOWN:]
        return [
            *ended, *by["failed"], *by["stopped"], *by["running"], *by["busy"][:SHOWN],
            *by["waiting"][:SHOWN], *by["blocked"][:SHOWN],
        ]  # fmt: skip

    def _render(self) -> Table:
        frame = Table(title=self._summary(), title_justify="left", expand=False)
        for column in ("cell", "state", "transitions", "time", "where or why"):
            frame.add_column(column, no_wrap=True)
        for progress in self._chosen():
            cell = self._cells[progress.job.name]
            again = f" (attempt {progress.attempts})" if progress.attempts > 1 else ""
            frame.add_row(
                cell.label,
                Text(progress.state + again, style=COLOURS.get(progress.state, "")),
                self._share(progress),
                self._spent(progress),
                progress.reason or progress.where,
            )
        return frame


_ORDER = ("done", "failed", "stopped", "running", "busy", "waiting", "blocked")


def plan_table(
    title: str,
    cells: Sequence[Cell],
    status: Mapping[str, Status],
    estimates: Mapping[str, Estimate],
) -> Table:
    """Return the table of a dry run: every cell with its status and the time it still needs."""
    frame = Table(title=title, title_justify="left")
    for column in ("cell", "status", "transitions", "updates", "estimate", "basis", "run"):
        frame.add_column(column, no_wrap=True)
    for cell in cells:
        config, state = cell.config, status[cell.name]
        trained = config.variant != "zero-shot"
        steps = config.total_env_steps if trained else 0
        needed = state != "finished" and cell.name in estimates
        frame.add_row(
            cell.label,
            state,
            format_count(steps),
            format_count(steps * config.droq.utd),
            format_seconds(estimates[cell.name].seconds) if needed else "",
            estimates[cell.name].basis if needed else "",
            cell.name,
        )
    return frame
