"""``twirl bench [PART]``."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from twirl_mjx import files
from twirl_mjx.checks import check_choice, check_range
from twirl_mjx.commands.console import json_text, parse, say
from twirl_mjx.commands.waiting import waiting
from twirl_mjx.sweep import launch

PARTS = ("learner", "startup", "epoch", "worlds")
"""Worlds last: they leave out rows when the time is up."""

ALONE = ("forms", "gpu-compile", "gpu-proof", "gpu-table")
"""Parts that `all` leaves out: they take longer than all others together, or need an environment
of their own."""

ROW_S = 75.0
"""s, longest that a row of worlds is expected to take, compilation included."""

USAGE = """usage: twirl bench [PART] [options]

parts:
  learner  critic updates per second, beside SBX and the bare matrix products
  worlds   control steps per second, beside the bare physics
  startup  seconds from the shell to the first critic updates
  epoch    where the time of a training epoch goes, and peak memory
  all      all of these, into runs/bench.json and docs/performance.md (default)

parts that `all` leaves out:
  forms    learning curves with every form of the learner (minutes)
  gpu-compile
           GPU operations per critic update and per physics step, counted without a GPU (minutes;
           needs make gpu-setup)
  gpu-proof
           on a GPU: parity with the CPU, timings, a real training, into runs/gpu-proof (minutes)
  gpu-table
           the results of gpu-proof into the tables of docs/accelerators.md

`twirl bench PART --help` lists the options of a part; `--json` prints one JSON document on stdout.
"""


@dataclasses.dataclass(frozen=True)
class AllBench:
    """Run every part in a process of its own; write a JSON file and the tables of a page."""

    json: bool = False
    """Print one JSON document on stdout, and nothing else."""
    minutes: float = 9.5
    """Time for everything; a part that is not done by then is stopped and reported so."""
    seconds: float | None = None
    """Length of the measurements of learner, worlds and epoch each, in s; their own by default."""
    task: str | None = None
    """Task of worlds, start-up and epoch; their own by default."""
    preset: str = "cpu"
    """Sizes of start-up and epoch: paper, cpu, massive or debug."""
    out: Path = Path("runs/bench.json")
    """All results."""
    page: Path = Path("docs/performance.md")
    """Markdown page whose marked section is replaced."""
    overwrite: bool = False
    """Replace a file that this command did not write."""

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ValueError: A value is out of range.
        """
        check_range("minutes", self.minutes, 0.1, 600.0)
        if self.seconds is not None:
            check_range("seconds", self.seconds, 0.1, 3600.0)


def main(argv: list[str]) -> int:
    """Measure one part, or all of them."""
    if argv[:1] in (["--help"], ["-h"]):
        print(USAGE, end="")
        return 0
    name, rest = ("all", argv) if not argv or argv[0].startswith("-") else (argv[0], argv[1:])
    check_choice("part", name, (*PARTS, *ALONE, "all"))
    return _all(rest) if name == "all" else _part(name, rest)


def _part(name: str, argv: list[str]) -> int:
    """Measure one part and print its table, or its record as JSON."""
    from twirl_mjx.bench import options as asked

    kind = "".join(word.capitalize() for word in (*name.split("-"), "bench"))
    options = parse(getattr(asked, kind), argv, f"twirl bench {name}")
    with waiting("loading jax"):
        from twirl_mjx.bench import report
        from twirl_mjx.bench.measure import only_json_on_stdout

        module: Any = importlib.import_module(f"twirl_mjx.bench.{name.replace('-', '_')}")
    with only_json_on_stdout() as out:
        record = module.measure(options)
        if options.json:
            print(json_text(record), file=out, flush=True)
            return 0
    parts = record.get("parts", {name: record})
    report.print_sheets(report.sheets_of(parts), record["machine"])
    return 0


def _all(argv: list[str]) -> int:
    """Run every part within the time; returns 1 if the page keeps its tables, see ``doubts``."""
    options = parse(AllBench, argv, "twirl bench")
    from twirl_mjx.bench import report
    from twirl_mjx.bench.measure import only_json_on_stdout

    page = files.read_text(options.page, "a page with a marked section")
    files.check_ours(options.out, overwrite=options.overwrite)
    report.replace_section(page, "")  # refuses a page without markers before anything is measured
    with only_json_on_stdout() as out:
        results = run_parts(options)
        files.write_json(options.out, results | {"made_by": files.MARK})
        if options.json:
            print(json_text(results), file=out, flush=True)
    parts = results["parts"]
    sheets, doubts = report.sheets_of(parts), report.doubts(parts)
    if not doubts:
        report.write_section(options.page, report.markdown(sheets, results["machine"]))
    if not options.json:
        report.print_sheets(sheets, results["machine"])
        tables = f"the tables of {options.page}"
        kept = f"; {tables} stay as they were: {'; '.join(doubts)}" if doubts else f" and {tables}"
        say(f"wrote {options.out}{kept}")
    return 1 if doubts else 0


def run_parts(options: AllBench) -> dict[str, Any]:
    """Run the parts one after another, each in a fresh process with the time that is left."""
    from twirl_mjx.bench.measure import machine

    began = time.monotonic()
    result: dict[str, Any] = {"machine": machine(), "parts": {}}
    for name in PARTS:
        left = 60 * options.minutes - (time.monotonic() - began)
        words = part_arguments(name, options)
        if name == "worlds":
            words += ["--limit", f"{max(0.0, left - ROW_S):.0f}"]
        result["parts"][name] = run_part(name, words, left)
    return result | {"minutes": (time.monotonic() - began) / 60}


def part_arguments(name: str, options: AllBench) -> list[str]:
    """Return the options that a part is called with."""
    words = ["--json"]
    if options.seconds is not None and name != "startup":
        words += ["--seconds", str(options.seconds)]
    if name != "learner" and options.task is not None:
        words += ["--task", options.task]
    if name in ("startup", "epoch"):
        words += ["--preset", options.preset]
    return words


def run_part(name: str, arguments: list[str], left: float) -> dict[str, Any]:
    """Run one part; its record, or ``{"part": ..., "error": ...}``.

    Of worlds that ran out of time the rows that were measured are the record.

    However it ends, no process that it started goes on beside the next measurement.

    Args:
        name: Part.
        arguments: Its options.
        left: s, it is stopped after this time.

    Raises:
        KeyboardInterrupt: Interrupted, or asked to end by a signal.
    """
    if left <= 0:
        return {"part": name, "error": "no time left (--minutes)"}
    with _signals_interrupt(), tempfile.TemporaryDirectory() as folder:
        kept = Path(folder) / "kept.json"
        words = ["--keep", str(kept)] if name == "worlds" else []
        process = subprocess.Popen(
            part_command(name, [*arguments, *words]),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            start_new_session=True,
        )
        try:
            output, _ = process.communicate(timeout=left)
        except subprocess.TimeoutExpired:
            if kept.is_file():
                return files.read_json(kept, "the rows of a measurement")
            return {"part": name, "error": f"stopped after {left:.0f} s (--minutes)"}
        finally:
            _end_group(process)
    if process.returncode:
        return {"part": name, "error": f"ended with status {process.returncode}"}
    return json.loads(output)


def part_command(name: str, arguments: list[str]) -> list[str]:
    """Return the command line of a part that dies with this process."""
    launcher = [sys.executable, "-S", launch.__file__, str(os.getpid()), "-"]
    return [*launcher, sys.executable, "-m", "twirl_mjx", "bench", name, *arguments]


def _end_group(process: subprocess.Popen[bytes]) -> None:
    """Kill what is left of the group that a process leads, and reap the process."""
    with contextlib.suppress(ProcessLookupError, PermissionError):  # nobody is left
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    if process.stdout is not None:
        process.stdout.close()


@contextlib.contextmanager
def _signals_interrupt() -> Iterator[None]:
    """Let SIGTERM and SIGHUP raise ``KeyboardInterrupt``: they do not reach another session."""

    def interrupt(number: int, frame: Any) -> None:
        raise KeyboardInterrupt

    found = {s: signal.getsignal(s) for s in (signal.SIGTERM, signal.SIGHUP)}
    # What nohup ignores stays ignored; None is a handler that Python could not restore.
    old = {s: kind for s, kind in found.items() if kind not in (signal.SIG_IGN, None)}
    for number in old:
        signal.signal(number, interrupt)
    try:
        yield
    finally:
        for number, handler in old.items():
            signal.signal(number, handler)
