"""What a GPU does with this program, in one call: parity, timings, a real training (minutes).

Made for a machine that is lent for minutes: everything has a deadline, what fails becomes a row
that says why, and what was found lies in a few small files from the moment it is known. A second
call goes on from them: measured rows are not measured again, and the training resumes.
"""

from __future__ import annotations

import concurrent.futures
import contextlib
import dataclasses
import json
import math
import os
import signal
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from twirl_mjx import array_files, files
from twirl_mjx.bench import parity
from twirl_mjx.bench.measure import Record, progress, summary
from twirl_mjx.bench.options import GpuProofBench
from twirl_mjx.bench.worker import Worker

PARITY, TIMINGS, TRAINING, MACHINE = "parity.csv", "timings.csv", "training.csv", "machine.json"
"""What a proof leaves in its folder, beside the runs of the training."""
REFERENCE = "reference.npz"
"""The numbers of a CPU; those of an earlier call, or brought from another machine, are used if they
are complete."""
COLUMNS: dict[str, dict[str, type]] = {
    PARITY: {"name": str, "error": float, "tolerance": float},
    TIMINGS: {"name": str, "unit": str, "rate": float, "spread": float, "fault": str},
    TRAINING: {"run": str, "env_steps": int, "grad_steps": int, "wall_s": float}
    | {"updates_per_s": float, "eval_return": float},
}
"""Table -> its columns."""
GRAPHS = "--xla_gpu_enable_command_buffer=+WHILE --xla_gpu_command_buffer_unroll_loops=true"
NO_GRAPHS = "--xla_gpu_enable_command_buffer="
SAVING_S = 60.0
"""s that a training is given to evaluate, save and stop."""


@dataclasses.dataclass(frozen=True)
class Variant:
    """One thing to time, in a process of its own."""

    name: str
    kind: str
    """``learner`` or ``worlds``."""
    options: Mapping[str, Any]
    """See ``worker.Worker``."""
    environment: Mapping[str, str] = dataclasses.field(default_factory=dict)

    @property
    def unit(self) -> str:
        """What its rate counts."""
        return {"learner": "critic updates/s", "worlds": "control steps/s"}[self.kind]


def variants(options: GpuProofBench) -> list[Variant]:
    """Return what is timed, the most telling first: the time may end before the last."""

    def learner(form: str, seeds: int, label: str = "", flags: str = "", **more: Any) -> Variant:
        sizes: dict[str, Any] = {"form": form, "seeds": seeds, "workers": 0, **more}
        if options.tiny:
            sizes |= {"obs": 5, "action": 2, "batch": 16, "hidden": 16, "utd": 2}
        name = f"{form}, seeds {seeds}" + (f", {label}" if label else "")
        return Variant(name, "learner", sizes, {"XLA_FLAGS": flags} if flags else {})

    def worlds(engine: str, num_envs: int) -> Variant:
        settings = {"task": options.task, "engine": engine, "num_envs": num_envs}
        return Variant(f"{engine}, worlds {num_envs}", "worlds", settings)

    if options.tiny:
        return [learner("plain", 1), learner("accelerator", 2), worlds("native", 2)]
    return [
        *(learner(form, seeds) for seeds in (1, 8) for form in ("accelerator", "fast", "plain")),
        *(worlds("mjx", number) for number in (1024, 4096)),
        *(worlds("native", number) for number in (128, 1024)),
        learner("accelerator", 1, "loops in graphs", GRAPHS),
        learner("accelerator", 8, "loops in graphs", GRAPHS),
        learner("accelerator", 1, "no graphs", NO_GRAPHS),
        learner("kernels", 1),
        learner("kernels", 8),
        learner("accelerator", 32),
        learner("accelerator", 8, "bfloat16", matmul_dtype="bfloat16"),
        *(worlds("mjx", number) for number in (256, 8192)),
        learner("accelerator", 128),
    ]


class Folder:
    """The small files of a proof. A disk that refuses them is named once, and the proof goes on."""

    def __init__(self, path: Path) -> None:
        """Keep the place; nothing is made yet."""
        self.path = path
        self._refused = False

    def read(self, table: str) -> list[Record]:
        """Return the rows of a table that an earlier call left."""
        path = self.path / table
        if not path.exists():
            return []
        return list(files.read_rows(path, "a table of a proof", COLUMNS[table]))

    def write(self, table: str, rows: Sequence[Record]) -> None:
        """Leave the rows of a table."""
        names = list(COLUMNS[table])
        with self._unless_refused(table):
            files.make_folders(self.path)
            lines = [[row[name] for name in names] for row in rows]
            files.write_csv(self.path / table, [names, *lines])

    def write_machine(self, record: Record) -> None:
        """Leave what the numbers depend on."""
        with self._unless_refused(MACHINE):
            files.make_folders(self.path)
            files.write_json(self.path / MACHINE, record)

    @contextlib.contextmanager
    def _unless_refused(self, name: str) -> Any:
        try:
            yield
        except OSError as error:
            if not self._refused:
                progress(f"bench gpu-proof: {name} could not be written, going on: {error}")
            self._refused = True


def environment() -> dict[str, str]:
    """Return what every process of a proof sees: no process takes the whole memory of a GPU."""
    return {"XLA_PYTHON_CLIENT_PREALLOCATE": "false"}


def find_machine(limit: float) -> Record:
    """Return ``measure.machine()`` of a process of its own: this one leaves the GPU alone.

    Raises:
        RuntimeError: jax found no device, or not in time.
    """
    code = "import json; from twirl_mjx.bench.measure import machine; print(json.dumps(machine()))"
    try:
        done = subprocess.run(
            [sys.executable, "-c", code],
            env={**os.environ, **environment()},
            capture_output=True,
            text=True,
            timeout=max(1.0, limit),
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise RuntimeError(f"jax found no device in {limit:.0f} s (--minutes)") from None
    if done.returncode:
        raise RuntimeError(f"jax found no device: {done.stderr.strip()[-300:]}")
    return json.loads(done.stdout.splitlines()[-1])


def prove_parity(options: GpuProofBench, folder: Folder, deadline: float) -> Record:
    """Compare learner, physics and an epoch of this device with those of the CPU."""
    rows = folder.read(PARITY)
    if rows and all(math.isfinite(row["error"]) for row in rows):
        return {"rows": rows}
    progress("bench gpu-proof: parity with the CPU")
    engines = parity.ENGINES[:1] if options.tiny else parity.ENGINES
    left = max(1.0, deadline - time.monotonic())

    def numbers(name: str, platform: Mapping[str, str]) -> parity.Numbers:
        if name == REFERENCE and (folder.path / name).exists():
            known = array_files.read_npz(folder.path / name, "numbers of parity")
            if parity.is_complete(known, engines):
                return known
        return parity.write(folder.path / name, {**environment(), **platform}, left, engines)

    try:
        files.make_folders(folder.path)
        with concurrent.futures.ThreadPoolExecutor() as pool:
            found = list(
                pool.map(numbers, (REFERENCE, "numbers.npz"), ({"JAX_PLATFORMS": "cpu"}, {}))
            )
    except subprocess.TimeoutExpired as late:
        return {"error": f"parity was not done in {late.timeout:.0f} s (--minutes)"}
    except (OSError, RuntimeError, ValueError) as error:
        return {"error": f"parity: {error}"}
    rows = [
        {"name": name, "error": error, "tolerance": parity.TOLERANCE[name.split(".")[0]]}
        for name, error in parity.errors(found[1], found[0]).items()
    ]
    folder.write(PARITY, rows)
    return {"rows": rows}


@contextlib.contextmanager
def compiling(options: GpuProofBench, folder: Folder) -> Iterator[list[tuple[Variant, Worker]]]:
    """Give the processes of all variants that were not measured yet; they compile at once."""
    known = {row["name"] for row in folder.read(TIMINGS) if not row["fault"]}
    missing = [variant for variant in variants(options) if variant.name not in known]
    progress(f"bench gpu-proof: compiling {len(missing)} variants, {len(known)} are measured")
    with contextlib.ExitStack() as stack:
        workers = []
        for variant in missing:
            given = {**environment(), **variant.environment}
            worker = Worker(variant.kind, dict(variant.options), environment=given)
            workers.append((variant, stack.enter_context(worker)))
        yield workers


def time_variants(
    options: GpuProofBench,
    folder: Folder,
    workers: Sequence[tuple[Variant, Worker]],
    deadline: float,
) -> Record:
    """Wait until all variants are compiled, then time each alone; a failed one is a row."""
    rows = [row for row in folder.read(TIMINGS) if not row["fault"]]
    ready: list[tuple[Variant, Worker]] = []
    for variant, worker in workers:
        try:
            worker.wait_until_ready(max(1.0, deadline - time.monotonic()))
            ready.append((variant, worker))
        except RuntimeError as error:
            rows.append(_row(variant, fault=str(error)))
    for variant, worker in ready:
        progress(f"bench gpu-proof: {variant.name}")
        try:
            worker.start(options.seconds)
            found = summary(worker.samples(10 * options.seconds + 60))
            rows.append(_row(variant, found["median"], found["spread"]))
        except (RuntimeError, OSError, ValueError) as error:
            rows.append(_row(variant, fault=str(error)))
        folder.write(TIMINGS, rows)
    folder.write(TIMINGS, rows)
    return {"rows": rows}


def _row(variant: Variant, rate: float = 0.0, spread: float = 0.0, fault: str = "") -> Record:
    return {
        "name": variant.name,
        "unit": variant.unit,
        "rate": rate,
        "spread": spread,
        "fault": fault,
    }


def train(options: GpuProofBench, folder: Folder, deadline: float) -> Record:
    """Train all seeds in one program until the deadline; the same call resumes them.

    Their replay, nearly all of the folder, may be left behind: it is gathered anew (``--refill``).
    """
    runs, status = folder.path / "runs", None
    if options.seeds:
        status = _train_until(options, runs, deadline)
    rows = _progress_of(runs)
    folder.write(TRAINING, rows)
    return {"rows": rows, "status": status, "task": options.task, "preset": options.preset}


def _train_until(options: GpuProofBench, runs: Path, deadline: float) -> int:
    """Return the exit status of a training that was given the time that is left."""
    left = deadline - time.monotonic()
    minutes = (left - SAVING_S) / 60.0 if left > 2 * SAVING_S else left / 120.0
    words = ["--task", options.task, "--preset", options.preset, "--runs", str(runs), "--refill"]
    words += ["--seeds", *map(str, range(options.seeds)), "--minutes", f"{max(minutes, 0.01):.2f}"]
    progress(f"bench gpu-proof: training {options.seeds} seeds for {minutes:.1f} min")
    process = subprocess.Popen(
        [sys.executable, "-m", "twirl_mjx", "train", *words],
        stdout=sys.stderr,
        env={**os.environ, **environment()},
    )
    try:
        return process.wait(timeout=max(1.0, left))
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGTERM)  # it saves and stops
    try:
        return process.wait(timeout=SAVING_S)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait()


def _progress_of(runs: Path) -> list[Record]:
    """Return how far every run of a folder is, that of a source too."""
    columns = {"metric": str, "env_steps": int, "grad_steps": int, "wall_s": float, "value": float}
    found = []
    for path in sorted(runs.glob("*/metrics.csv")):
        rows = files.read_rows(path, "the metrics of a run", columns, growing=True)
        by_name: dict[str, list[Record]] = {}
        for row in rows:
            by_name.setdefault(row["metric"], []).append(row)
        if not by_name:
            continue
        last = max((each[-1] for each in by_name.values()), key=lambda row: row["env_steps"])
        rates = [row["value"] for row in by_name.get("updates_per_s", []) if row["value"] > 0]
        returns = [row["value"] for row in by_name.get("eval/return", [])]
        found.append(
            {
                "run": path.parent.name,
                "env_steps": last["env_steps"],
                "grad_steps": last["grad_steps"],
                "wall_s": last["wall_s"],
                "updates_per_s": statistics.median(rates) if rates else 0.0,
                "eval_return": returns[-1] if returns else float("nan"),
            }
        )
    return found


def measure(options: GpuProofBench) -> Record:
    """Prove, time and train within the time; nothing that was found is lost on the way."""
    began = time.monotonic()
    whole = 60.0 * options.minutes
    folder = Folder(options.out)
    machine = find_machine(whole / 4)
    folder.write_machine(machine)
    parts = {}
    with compiling(options, folder) as workers:
        parts["gpu-parity"] = prove_parity(options, folder, began + 0.4 * whole)
        parts["gpu-timings"] = time_variants(options, folder, workers, began + 0.5 * whole)
    parts["gpu-training"] = train(options, folder, began + whole)
    return {"part": "gpu-proof", "parts": parts, "machine": machine}
