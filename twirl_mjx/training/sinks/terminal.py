"""How a run looks while it runs: a live panel on a terminal, plain lines elsewhere."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Mapping, Sequence

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from twirl_mjx.training.metrics import METRICS
from twirl_mjx.training.sinks.base import RunInfo
from twirl_mjx.types import MetricInfo

TRAINING = {
    "env_steps_per_s": ("env steps/s", "{:.0f}"),
    "updates_per_s": ("updates/s", "{:.0f}"),
    "return": ("return", "{:.1f}"),
    "episode_length": ("length", "{:.0f}"),
    "phi": ("phi", "{:.2f}"),
}
"""Headlines before those of the task: label and format."""
RETURN = {"eval/return": ("eval return", "{:.1f}")}
DROPPED = {"dropped_transitions": ("dropped", "{:.0f}")}
FORMATS = {"1": "{:.3g}", "s": "{:.1f} s", "m": "{:.2f} m", "share": "{:.0%}"}
"""How a number is written, by its unit; any other unit stands behind three digits."""
SHOWN_MEASURES = 3
"""Measures of a task that are shown: the first it declares beside the common ones."""
SHOWN_LEARNING = 4
"""Metrics of a learner that are shown: the first it declares."""
RATE_WINDOW = 20
"""Epochs over which the remaining time is estimated."""


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


def written(form: str, values: Sequence[float]) -> str:
    """Return a number, or the mean and the range of several that look different."""
    low, high = form.format(min(values)), form.format(max(values))
    mean = form.format(math.fsum(values) / len(values))
    return mean if low == high else f"{mean} ({low} to {high})"


def headlines(run: RunInfo) -> dict[str, tuple[str, str]]:
    """Return label and format of the metrics shown while a run goes on, in their order."""

    def labelled(metrics: Mapping[str, MetricInfo], most: int) -> dict[str, tuple[str, str]]:
        own = [name for name in metrics if name not in METRICS][:most]
        return {
            name: (name.replace("_", " "), FORMATS.get(unit, f"{{:.3g}} {unit}"))
            for name, unit in ((name, metrics[name].unit) for name in own)
        }

    task = labelled(run.measures, SHOWN_MEASURES)
    evaluated = {f"eval/{name}": (f"eval {label}", form) for name, (label, form) in task.items()}
    learning = labelled(run.learning, SHOWN_LEARNING)
    return TRAINING | task | learning | RETURN | evaluated | DROPPED


class Terminal:
    """A live panel on a terminal, one plain line for each epoch elsewhere."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._live: Live | None = None
        self._busy: tuple[str, float] | None = None

    def open(self, run: RunInfo, name: str | None = None, num_runs: int = 1) -> None:
        """Begin to show a stage.

        Args:
            run: The run, or the first of several in step.
            name: What they are called together; the name of the run by default.
            num_runs: How many they are.
        """
        self._stage, self._run = run.stage, name or run.identity["run"]
        self._each = f" each of {num_runs} seeds" if num_runs > 1 else ""
        self._total = max(run.total_env_steps, 1)
        self._headlines = headlines(run)
        self._values: dict[str, list[float]] = {}
        self._env_steps, self._grad_steps = run.resume_env_steps or 0, 0
        self._opened = (time.monotonic(), self._env_steps)
        self._overall: float | None = None
        self._history = deque([(time.monotonic(), self._env_steps)], maxlen=RATE_WINDOW)
        if self._console.is_terminal:
            self._live = Live(
                console=self._console, get_renderable=self._render, refresh_per_second=2
            )
            self._live.start()
        else:
            begin = f" from {format_count(self._env_steps)}" if self._env_steps else ""
            total = format_count(self._total)
            self.announce(f"{self._stage} {self._run}: to {total}{self._each}{begin}")

    def close(self) -> None:
        """End the live display and leave its last state on the screen."""
        if self._live is not None:
            if "env_steps_per_s" not in self._values:
                self._overall = self._rate_since_open()
            self._live.stop()
            self._live = None

    def _rate_since_open(self) -> float | None:
        """Return transitions per second of the whole stage, None before there are any."""
        began, first = self._opened
        seconds = time.monotonic() - began
        return (self._env_steps - first) / seconds if self._env_steps > first else None

    def announce(self, text: str) -> None:
        """Print one line above the display."""
        self._console.print(Text(text), soft_wrap=True)

    def busy(self, text: str | None) -> None:
        """Show that something slow goes on, with its running time; ``None`` ends it."""
        self._busy = (text, time.monotonic()) if text else None
        if text and self._live is None:
            self.announce(text)

    def log(self, env_steps: int, grad_steps: int, runs: Sequence[Mapping[str, float]]) -> None:
        """Take over one epoch of every run; mean and range of what they report are shown."""
        self._env_steps, self._grad_steps = env_steps, grad_steps
        for name in dict.fromkeys(name for values in runs for name in values):
            self._values[name] = [values[name] for values in runs if name in values]
        if "compile_s" in runs[0]:  # says nothing about the epochs to come
            self._history.clear()
        self._history.append((time.monotonic(), env_steps))
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
            *(f"{label} {text}" for label, text in self._texts()),
        ]
        return " | ".join(parts)

    def _texts(self) -> list[tuple[str, str]]:
        """Return (label, text) of the headlines that are known."""
        known = [
            (label, written(form, self._values[name]))
            for name, (label, form) in self._headlines.items()
            if name in self._values
        ]
        if self._overall is None:
            return known
        label, form = TRAINING["env_steps_per_s"]
        return [(f"{label} with compilation", form.format(self._overall)), *known]

    def _render(self) -> RenderableType:
        """Build the live panel."""
        head = Table.grid(expand=True, padding=(0, 1))
        head.add_column(no_wrap=True)
        head.add_column(ratio=1)
        head.add_column(no_wrap=True, justify="right")
        count = (
            f"{format_count(self._env_steps)} / {format_count(self._total)} env steps{self._each}"
        )
        head.add_row(
            Text(self._stage, style="bold"),
            ProgressBar(total=self._total, completed=min(self._env_steps, self._total)),
            Text(
                f"{count}, {format_count(self._grad_steps)} updates, ETA "
                f"{format_seconds(self.eta())}"
            ),
        )
        body = Table.grid(expand=True, padding=(0, 2))
        cells = [Text.assemble((f"{label} ", "dim"), text) for label, text in self._texts()]
        for start in range(0, len(cells), 4):
            body.add_row(*cells[start : start + 4], *[Text()] * (4 - len(cells[start : start + 4])))
        parts: list[RenderableType] = [head, body]
        if self._busy is not None:
            text, since = self._busy
            parts.append(Text(f"{text} {time.monotonic() - since:.0f} s", style="yellow"))
        return Panel(Group(*parts), title=self._run, title_align="left")
