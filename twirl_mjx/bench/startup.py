"""Seconds from the shell to the first critic updates, with an empty and with a filled cache.

A child process runs ``twirl train`` with the layer sizes, worlds and updates of a preset, but with
a short warm-up and short epochs; neither changes what is compiled. It counts as started when its
``metrics.csv`` has a row of an epoch with critic updates.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from twirl_mjx import files
from twirl_mjx.bench.measure import Record, machine, progress
from twirl_mjx.bench.options import StartupBench
from twirl_mjx.training.presets import make_config

POLL_S = 0.05


def command(options: StartupBench, runs: Path) -> list[str]:
    """Return the command line of the child: updates follow its second vector step."""
    worlds = make_config(options.task, options.preset).num_envs
    settings = {
        "task": options.task,
        "preset": options.preset,
        "variant": "scratch",
        "runs": str(runs),
        "name": "startup",
        "total-env-steps": 1_000_000,
        "warmup-env-steps": worlds,
        "epoch-env-steps": 2 * worlds,
    }
    words = [word for name, value in settings.items() for word in (f"--{name}", str(value))]
    return [sys.executable, "-m", "twirl_mjx", "train", *words]


def has_updates(path: Path) -> bool:
    """Return whether a ``metrics.csv`` has a whole row with critic updates."""
    if not path.is_file():
        return False
    rows = files.read_rows(path, "the metrics of a run", {"grad_steps": int}, growing=True)
    return any(row["grad_steps"] > 0 for row in rows)


def start_once(options: StartupBench, cache: Path, folder: Path) -> float:
    """Run the child until it has done critic updates; return the seconds that took.

    Args:
        options: What to run.
        cache: Compilation cache of the child.
        folder: Empty folder to work in.

    Raises:
        RuntimeError: The child ended, or took longer than ``options.seconds``; the message has
            the end of its output.
    """
    child = dict(os.environ)
    child.pop("JAX_COMPILATION_CACHE_DIR", None)  # set by the command line of this process
    child["TWIRL_CACHE_DIR"] = str(cache)
    metrics = folder / "startup" / "metrics.csv"
    log = folder / "log.txt"
    with log.open("wb") as output:
        began = time.perf_counter()
        process = subprocess.Popen(
            command(options, folder),
            env=child,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
        )
        try:
            while not has_updates(metrics):
                spent = time.perf_counter() - began
                if process.poll() is not None or spent > options.seconds:
                    tail = files.read_bytes(log, "a log")[-500:].decode(errors="replace")
                    raise RuntimeError(f"no critic update after {spent:.0f} s: {tail}")
                time.sleep(POLL_S)
            return time.perf_counter() - began
        finally:
            process.kill()  # nothing of this run is kept
            process.wait()


def folder_size(path: Path) -> int:
    """Return the bytes of all files below a folder."""
    return sum(file.stat().st_size for file in path.rglob("*") if file.is_file())


def measure(options: StartupBench) -> Record:
    """Start once with an empty compilation cache, then several times with what it left."""
    record_machine = machine()
    with tempfile.TemporaryDirectory(prefix="twirl-startup-") as name:
        root = Path(name)
        cache = root / "cache"

        def start(number: int) -> float:
            folder = root / str(number)
            folder.mkdir()
            return start_once(options, cache, folder)

        progress("bench startup: cold")
        cold = start(0)
        cache_bytes = folder_size(cache)
        progress(f"bench startup: warm, {options.repeats} times")
        warm = [start(1 + i) for i in range(options.repeats)]
    return {
        "part": "startup",
        "task": options.task,
        "preset": options.preset,
        "cold_s": cold,
        "warm_s": statistics.median(warm),
        "warm_samples": warm,
        "cache_mb": cache_bytes / 1e6,
        "machine": record_machine,
    }
