"""How a run looks while it runs: a live panel on a terminal, plain lines elsewhere."""

from __future__ import annotations

import dataclasses
import math
import time
from collections import deque

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

HEADLINES = (
    ("env_steps_per_s", "env steps/s", "{:.0f}"),
    ("updates_per_s", "updates/s", "{:.0f}"),
    ("return", "return", "{:.1f}"),
    ("episode_length", "length", "{:.0f}"),
    ("standing_time", "standing", "{:.1f} s"),
    ("min_distance", "min distance", "{:.2f} m"),
    ("hurdles_passed", "hurdles", "{:.2f}"),
    ("temperature", "alpha", "{:.3g}"),
    ("q_mean", "Q", "{:.3g}"),
    ("critic_loss", "critic loss", "{:.3g}"),
    ("actor_loss", "actor loss", "{:.3g}"),
    ("eval/return", "eval return", "{:.1f}"),
    ("eval/standing_time", "eval standing", "{:.1f} s"),
    ("eval/min_distance", "eval distance", "{:.2f} m"),
    ("eval/hurdles_passed", "eval hurdles", "{:.2f}"),
    ("dropped_transitions", "dropped", "{:.0f}"),
)
"""Metrics shown while a run goes on: name, label and format."""

RATE_WINDOW = 20
"""Epochs over which the remaining time is estimated."""


@dataclasses.dataclass(frozen=True)
class Snapshot:
    """One reported epoch."""

    env_steps: int
    """Transitions gathered so far."""
    grad_steps: int
    """Critic updates so far."""
    wall_s: float
    """Time since the stage began, s."""
    values: dict[str, float]
    """Metric name to value."""


def format_count(number: float) -> str:
    """Write a count briefly: 950, 12.3k, 1.25M."""
    for limit, suffix in ((1e6, "M"), (1e3, "k")):
        if number >= limit:
            return f"{number / limit:.3g}{suffix}"
    return f"{number:.0f}"


def format_seconds(seconds: float | None) -> str:
    """Write a duration as h:mm:ss, ``-:--:--`` when unknown."""
    if seconds is None or not math.isfinite(seconds):
        return "-:--:--"
    whole = round(seconds)
    return f"{whole // 3600}:{whole // 60 % 60:02d}:{whole % 60:02d}"


def headline_texts(values: dict[str, float]) -> list[tuple[str, str]]:
    """Return (label, text) of the headline metrics that are known."""
    return [
        (label, form.format(values[name]))
        for name, label, form in HEADLINES
        if name in values and not math.isnan(values[name])
    ]


class ProgressView:
    """Shows one stage of a run."""

    def __init__(self, console: Console, stage: str, run: str, total_env_steps: int) -> None:
        self._console, self._stage, self._run = console, stage, run
        self._total = max(total_env_steps, 1)
        self._env_steps = self._grad_steps = 0
        self._values: dict[str, float] = {}
        self._history: deque[tuple[float, int]] = deque(maxlen=RATE_WINDOW)
        self._busy: tuple[str, float] | None = None
        self._live: Live | None = None

    def start(self, env_steps: int) -> None:
        """Begin at ``env_steps`` transitions."""
        self._env_steps = env_steps
        self._history.append((time.monotonic(), env_steps))
        if self._console.is_terminal:
            self._live = Live(
                console=self._console, get_renderable=self._render, refresh_per_second=2
            )
            self._live.start()
        else:
            begin = f" from {format_count(env_steps)}" if env_steps else ""
            self.announce(f"{self._stage} {self._run}: to {format_count(self._total)}{begin}")

    def stop(self) -> None:
        """End the live display and leave its last state on the screen."""
        if self._live is not None:
            self._live.stop()
            self._live = None

    def announce(self, text: str) -> None:
        """Print one line above the display."""
        self._console.print(Text(text), soft_wrap=True)

    def busy(self, text: str | None) -> None:
        """Show that something slow goes on, with its running time; ``None`` ends it."""
        self._busy = (text, time.monotonic()) if text else None
        if text and self._live is None:
            self.announce(text)

    def update(self, snapshot: Snapshot) -> None:
        """Take over one epoch."""
        self._env_steps, self._grad_steps = snapshot.env_steps, snapshot.grad_steps
        self._values |= {k: v for k, v in snapshot.values.items() if not math.isnan(v)}
        if "compile_s" in snapshot.values:  # says nothing about the epochs to come
            self._history.clear()
        self._history.append((time.monotonic(), snapshot.env_steps))
        if self._live is None:
            self.announce(self.line())

    def eta(self) -> float | None:
        """Return the remaining time in s, or ``None`` before there is a rate."""
        (begin, first), (end, last) = self._history[0], self._history[-1]
        if last <= first or end <= begin:
            return None
        return max(self._total - last, 0) * (end - begin) / (last - first)

    def line(self) -> str:
        """Return the state as one plain line."""
        share = 100.0 * self._env_steps / self._total
        parts = [
            f"{self._stage} {self._run} {share:5.1f} %",
            f"env {format_count(self._env_steps)}",
            f"updates {format_count(self._grad_steps)}",
            f"eta {format_seconds(self.eta())}",
            *(f"{label} {text}" for label, text in headline_texts(self._values)),
        ]
        return " | ".join(parts)

    def _render(self) -> RenderableType:
        """Build the live panel."""
        head = Table.grid(expand=True, padding=(0, 1))
        head.add_column(no_wrap=True)
        head.add_column(ratio=1)
        head.add_column(no_wrap=True, justify="right")
        count = f"{format_count(self._env_steps)} / {format_count(self._total)} env steps"
        head.add_row(
            Text(self._stage, style="bold"),
            ProgressBar(total=self._total, completed=min(self._env_steps, self._total)),
            Text(
                f"{count}, {format_count(self._grad_steps)} updates, ETA "
                f"{format_seconds(self.eta())}"
            ),
        )
        body = Table.grid(expand=True, padding=(0, 2))
        cells = [
            Text.assemble((f"{label} ", "dim"), text)
            for label, text in headline_texts(self._values)
        ]
        for start in range(0, len(cells), 4):
            body.add_row(*cells[start : start + 4], *[Text()] * (4 - len(cells[start : start + 4])))
        parts: list[RenderableType] = [head, body]
        if self._busy is not None:
            text, since = self._busy
            parts.append(Text(f"{text} {time.monotonic() - since:.0f} s", style="yellow"))
        return Panel(Group(*parts), title=self._run, title_align="left")
