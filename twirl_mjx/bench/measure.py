"""Timing shared by all measurements: samples, their median and spread, what machine it was."""

from __future__ import annotations

import contextlib
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TextIO

import jax
import psutil

from twirl_mjx import files
from twirl_mjx.machine import usable_cores
from twirl_mjx.training.rundir import versions

MIN_SAMPLES = 3
MAX_SAMPLE_S = 1.0
"""s, length of one sample unless a single call takes longer."""

Record = dict[str, Any]
"""A result as JSON knows it."""


def sample_rates(call: Callable[[], object], work: float, seconds: float) -> list[float]:
    """Measure how much work a second a function does, in at least three samples.

    Args:
        call: Does ``work`` units and returns when they are done; already compiled.
        work: Units of one call.
        seconds: Length of the measurement in s; one sample takes a fifth of it, at most 1 s.

    Returns:
        Units per second of every sample.
    """
    return sample_in_turn([call], work, seconds)[0]


def sample_in_turn(
    calls: Sequence[Callable[[], object]], work: float, seconds: float
) -> list[list[float]]:
    """Measure several functions in turn, so that a disturbance of the machine meets them all.

    Args:
        calls: Functions that do ``work`` units each, as in :func:`sample_rates`.
        work: Units of one call.
        seconds: Length of all measurements together in s.

    Returns:
        Units per second of every sample, per function; equally many.
    """
    length = min(seconds / len(calls) / 5, MAX_SAMPLE_S)
    repeats = []
    for call in calls:
        began = time.perf_counter()
        call()
        repeats.append(max(1, round(length / max(time.perf_counter() - began, 1e-9))))
    deadline = time.perf_counter() + seconds
    samples: list[list[float]] = [[] for _ in calls]
    while len(samples[0]) < MIN_SAMPLES or time.perf_counter() < deadline:
        for call, repeat, taken in zip(calls, repeats, samples, strict=True):
            began = time.perf_counter()
            for _ in range(repeat):
                call()
            taken.append(repeat * work / (time.perf_counter() - began))
    return samples


def summary(samples: Sequence[float]) -> Record:
    """Return median, relative spread (largest - smallest) / median, and the samples."""
    median = statistics.median(samples)
    return {
        "median": median,
        "spread": (max(samples) - min(samples)) / median,
        "samples": list(samples),
    }


class Chain:
    """A compiled function of its own last result, called again and again."""

    def __init__(
        self, function: Callable[..., Any], state: Any, *constants: Any, donate: bool = True
    ) -> None:
        """Compile.

        Args:
            function: ``(state, *constants) -> state``.
            state: First state.
            *constants: Further arguments.
            donate: Let the function overwrite its state.
        """
        began = time.perf_counter()
        jitted = jax.jit(function, donate_argnums=0 if donate else ())
        self._compiled = jitted.lower(state, *constants).compile()
        self.compile_s = time.perf_counter() - began
        self.state = state
        self._constants = constants

    def __call__(self) -> Any:
        """Take one step and wait for it; return the new state."""
        self.state = jax.block_until_ready(self._compiled(self.state, *self._constants))
        return self.state


@contextlib.contextmanager
def only_json_on_stdout() -> Iterator[TextIO]:
    """Send everything that anything prints to stderr; yield the real stdout.

    File descriptors are exchanged, so that libraries written in C are silent too.
    """
    sys.stdout.flush()
    kept = os.dup(1)
    os.dup2(2, 1)
    try:
        with os.fdopen(os.dup(kept), "w", encoding="utf-8") as real:
            yield real
    finally:
        sys.stdout.flush()
        os.dup2(kept, 1)
        os.close(kept)


def progress(text: str) -> None:
    """Say on stderr what is being measured."""
    print(text, file=sys.stderr, flush=True)


def machine() -> Record:
    """Return what the numbers depend on: processor, devices, load, versions."""
    return {
        "processor": _processor(),
        "cpus": len(usable_cores()),
        "memory_gb": round(psutil.virtual_memory().total / 1e9, 1),
        "devices": [f"{d.platform} {d.device_kind}" for d in jax.devices()],
        "load_before": round(os.getloadavg()[0], 2),
        "versions": versions(),
    }


def _processor() -> str:
    path = Path("/proc/cpuinfo")
    if path.is_file():
        for line in files.read_text(path, "a list of processors").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()
