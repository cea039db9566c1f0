"""The proof of a GPU: what fails is a row, what is known is kept, and all of it on a CPU."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from twirl_mjx import array_files, files
from twirl_mjx.bench import gpu_proof, gpu_table, parity, report
from twirl_mjx.bench.gpu_proof import Folder, GpuProofBench
from twirl_mjx.bench.gpu_table import GpuTableBench

MACHINE = {
    "processor": "Fast",
    "cpus": 2,
    "memory_gb": 8.0,
    "devices": ["gpu H1"],
    "load_before": 0.1,
    "versions": {"jax": "1.2"},
}


class FakeWorker:
    """Stands for a measuring process; every start is remembered."""

    started: list[str] = []
    broken: set[str] = set()

    def __init__(self, kind: str, options: dict[str, Any], **_: Any) -> None:
        self.name = f"{kind} {options.get('form', options.get('engine'))}"
        self.started.append(self.name)

    def __enter__(self) -> FakeWorker:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def wait_until_ready(self, limit: float) -> None:
        if self.name in self.broken:
            raise RuntimeError("a measuring process ended with status 1")

    def start(self, seconds: float) -> None:
        assert seconds == 3.0

    def samples(self, limit: float) -> list[float]:
        return [90.0, 100.0, 110.0]


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> type[FakeWorker]:
    monkeypatch.setattr(FakeWorker, "started", [])
    monkeypatch.setattr(FakeWorker, "broken", set())
    monkeypatch.setattr(gpu_proof, "Worker", FakeWorker)
    return FakeWorker


def timed(options: GpuProofBench, folder: Folder) -> list[dict[str, Any]]:
    with gpu_proof.compiling(options, folder) as workers:
        return gpu_proof.time_variants(options, folder, workers, 1e9)["rows"]


def test_a_failed_variant_is_a_row_and_is_tried_again(
    tmp_path: Path, fake: type[FakeWorker]
) -> None:
    options, folder = GpuProofBench(tiny=True), Folder(tmp_path / "new")
    fake.broken.add("learner plain")
    first = timed(options, folder)
    assert [bool(row["fault"]) for row in first] == [True, False, False]
    assert first[1]["rate"] == 100.0
    assert first[1]["spread"] == pytest.approx(0.2)
    assert folder.read(gpu_proof.TIMINGS) == first

    fake.broken.clear()
    fake.started.clear()
    second = timed(options, folder)
    assert fake.started == ["learner plain"]
    assert sorted(row["name"] for row in second) == sorted(row["name"] for row in first)
    assert not any(row["fault"] for row in second)


def test_numbers_that_are_missing_are_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = {f"{part}.x": np.ones((1, 1)) for part in ("native", "epoch")}
    whole |= {f"learner.{form}.x": np.ones(1) for form in parity.forms.FORMS}
    lame = {name: value for name, value in whole.items() if "kernels" not in name}
    made: list[str] = []
    given = {"reference.npz": [lame, whole], "numbers.npz": [lame, whole]}

    def write(path: Path, *_: Any) -> parity.Numbers:
        made.append(path.name)
        found = given[path.name].pop(0)
        array_files.write_npz(path, found)
        return found

    monkeypatch.setattr(parity, "write", write)
    options, folder = GpuProofBench(tiny=True), Folder(tmp_path)
    given["numbers.npz"][0] = lame | {"learner.kernels.x": np.full(1, np.nan)}
    for expected in (2, 4, 4):  # all made, all made again, nothing missing
        rows = gpu_proof.prove_parity(options, folder, 1e9)["rows"]
        assert len(made) == expected
    assert {row["error"] for row in rows} == {0.0}


def test_a_full_disk_is_said_once_and_loses_no_result(
    tmp_path: Path,
    fake: type[FakeWorker],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(files, "write_csv", full)
    rows = timed(GpuProofBench(tiny=True), Folder(tmp_path))
    assert len(rows) == 3
    assert capsys.readouterr().err.count("No space left") == 1


def test_variants_have_names_of_their_own_and_options_that_fit() -> None:
    from twirl_mjx.bench.learner import LearnerBench

    for tiny in (True, False):
        made = gpu_proof.variants(GpuProofBench(tiny=tiny))
        assert len({variant.name for variant in made}) == len(made)
        for variant in made:
            if variant.kind == "learner":
                assert LearnerBench(**variant.options).num_workers == 0
    graphs = [v for v in made if "graphs" in v.name]
    assert {v.environment["XLA_FLAGS"] for v in graphs} == {gpu_proof.GRAPHS, gpu_proof.NO_GRAPHS}


def test_table_shows_what_a_folder_holds(tmp_path: Path) -> None:
    folder, page = Folder(tmp_path / "proof"), tmp_path / "page.md"
    page.write_text(f"# Page\n\n{report.BEGIN}\nold\n{report.END}\n\nend\n")
    options = GpuTableBench(results=folder.path, page=page)
    with pytest.raises(ValueError, match=r"no proof was made.*gpu-proof"):
        gpu_table.measure(options)
    folder.write_machine(MACHINE)
    fault = {"name": "mjx, worlds 8", "unit": "u", "rate": 0.0, "spread": 0.0}
    timed = fault | {"name": "fast, seeds 1", "rate": 5123.0, "spread": 0.04, "fault": ""}
    folder.write(gpu_proof.TIMINGS, [timed, fault | {"fault": "status 1"}])
    errors = {"learner.fast.actor": 1e-4, "learner.fast.critic": 2e-3, "native.qpos": 1e-6}
    parity = [{"name": n, "error": e, "tolerance": 1e-3} for n, e in errors.items()]
    folder.write(gpu_proof.PARITY, parity)
    seed = {"run": "a-s0", "env_steps": 6400, "grad_steps": 3200, "wall_s": 61.0}
    folder.write(gpu_proof.TRAINING, [seed | {"updates_per_s": 812.5, "eval_return": 31.0}])
    gpu_table.measure(options)
    text = page.read_text()
    assert text.startswith("# Page") and text.endswith("end\n") and "old" not in text
    assert "gpu H1" in text
    assert "| fast, seeds 1 | 5,123 | u | 4 % |  |" in text
    assert "| mjx, worlds 8 | - | u | - | status 1 |" in text
    assert "| learner.fast | critic | 2.0e-03 | 1e-03 | no |" in text
    assert "| native | qpos | 1.0e-06 | 1e-03 | yes |" in text
    assert "| a-s0 | 6,400 | 3,200 | 61 | 812 | 31 |" in text


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_proof_from_the_shell_on_a_cpu_and_again(tmp_path: Path) -> None:
    """The whole command with tiny settings; a second call measures nothing again and resumes."""
    out = tmp_path / "proof"
    words = f"bench gpu-proof --json --tiny --minutes 20 --seconds 0.5 --seeds 2 --out {out}"
    command = [sys.executable, "-m", "twirl_mjx", *words.split()]
    command += ["--task", "stand", "--preset", "debug"]
    found = []
    for _ in range(2):
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        found.append((json.loads(done.stdout)["parts"], done.stderr))
    (first, _), (second, told) = found
    assert len(first["gpu-timings"]["rows"]) == 3
    assert not any(row["fault"] for row in first["gpu-timings"]["rows"])
    assert all(row["error"] <= row["tolerance"] for row in first["gpu-parity"]["rows"])
    assert len(first["gpu-training"]["rows"]) == 2
    assert {row["env_steps"] for row in first["gpu-training"]["rows"]} == {96}
    assert second["gpu-timings"] == first["gpu-timings"]
    assert "compiling 0 variants, 3 are measured" in told
    assert (out / "machine.json").is_file()
