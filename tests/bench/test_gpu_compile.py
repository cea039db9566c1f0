"""Operations counted without a GPU: the list is read right, bad options are refused in words."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import pytest

from twirl_mjx.bench import gpu_compile, gpu_target, report, thunks
from twirl_mjx.bench.gpu_compile import GpuCompileBench

ROOT = Path(__file__).resolve().parents[2]

THUNKS = """\
000: kCommandBuffer [source       | next=004 (1)]
    001: kCopy         [source       | sink        ] kCopy
    002: kCustomKernel [source       | sink        ] loop_add_fusion grid: [1, 1, 1]
    003: kSequential [source] 004: kCublasLtMatmul
004: kWhile         [prev=000 (1) | next=015 (1)]
condition:
    005: kCustomKernel [source | sink] loop_compare_fusion grid: [1, 1, 1]
  body:
    006: kAsyncStart    [source       | next=000 (4)] stream=computation_stream[0]
        007: kDynamicSliceFusion [source | sink] params=1, results=1
            008: kCopy [source | sink] kCopy
    000: kCommandBuffer [prev=006 (2) | next=014 (1)]
        009: kCustomKernel [source       | next=010 (1)] gemm_fusion_dot_7 grid: [4, 1, 1]
        010: kCustomKernel [prev=009 (1) | sink        ] fusion_131 grid: [4, 1, 1]
    011: kWhile         [prev=000 (1) | next=014 (1)]
    condition:
        012: kCustomKernel [source | sink] loop_compare_fusion grid: [1, 1, 1]
      body:
        013: kTriangularSolve [source | sink] trsm
    014: kAsyncDone     [source       | sink        ] async_id=6
015: kConditional [prev=004 (1) | sink]
  false_branch:
    016: kCopy [source | sink] kCopy
017: kCustomKernel [source | sink] wrapped_slice
"""


def test_operations_are_counted_by_block() -> None:
    program = thunks.parse(THUNKS)
    found = [(depth, block.name, block.count, block.graphs) for depth, block in program.walk()]
    assert found == [
        (0, "program", 4, 1),
        (1, "condition", 1, 0),
        (1, "body", 3, 1),
        (2, "condition", 1, 0),
        (2, "body", 1, 0),
        (1, "false_branch", 1, 0),
    ]
    assert program.operations == {"kCopy": 1, "kCustomKernel": 2, "kCublasLtMatmul": 1}
    assert program.innermost().operations == {"kTriangularSolve": 1}
    assert thunks.parse("000: kCopy [source | sink] kCopy\n").innermost().count == 1


def test_a_card_is_described_by_its_data_sheet() -> None:
    text = gpu_target.description("h200")
    assert 'name: "NVIDIA H200"' in text
    assert "memory_bandwidth: 4800000000000" in text
    assert text.count("{") == text.count("}") == 3
    with pytest.raises(ValueError, match="unknown card 'h1000': choose one of h100, h200"):
        gpu_target.description("h1000")


def test_without_a_gpu_compiler_the_way_to_one_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gpu_target, "PLUGINS", ("no_such_plugins.cuda",))
    with pytest.raises(RuntimeError, match=r"make gpu-setup.*\.venv-gpu/bin/twirl bench"):
        gpu_compile.measure(GpuCompileBench())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"programs": ("blok",)}, "nearest: 'block'"),
        ({"forms": ()}, "forms needs at least one"),
        ({"seeds": (0,)}, r"seeds = 0.0 is outside \[1, 1000\]"),
        ({"card": "h300"}, "nearest: 'h"),
        ({"flags": ("xla_gpu_x",)}, "nearest: 'xla_gpu_x=true'"),
    ],
)
def test_bad_options_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        GpuCompileBench(**changes)


def test_flags_are_values_of_their_kind() -> None:
    options = GpuCompileBench(flags=("--xla_a=+WHILE", "xla_b=true"))
    assert options.options == {"xla_a": "+WHILE", "xla_b": True}


@pytest.mark.parametrize(
    "make",
    [
        lambda: gpu_compile.learner_program("block", "accelerator", 2),
        lambda: gpu_compile.learner_program("update", "plain", 1),
    ],
)
def test_programs_are_functions_of_their_shapes(make: Callable[[], gpu_compile.Task]) -> None:
    function, args, donate = make()
    out = jax.eval_shape(function, *args)
    assert jax.tree.leaves(out)
    assert set(donate) <= set(range(len(args)))


def test_sheet_has_a_row_for_each_program() -> None:
    loops = [
        {"depth": depth, "name": b.name, "operations": {}, "count": b.count, "graphs": b.graphs}
        for depth, b in thunks.parse(THUNKS).walk()
    ]
    row = {
        "program": "block", "form": "fast", "seeds": 8, "in_loop": 54, "loops": loops,
        "temporary_mb": 13.9, "compile_s": 40.2,
    }  # fmt: skip
    record = {
        "card": "h100", "task": "biped", "num_envs": 1024, "flags": [],
        "rows": [row, row | {"program": "worlds", "form": ""}],
    }  # fmt: skip
    sheet = report.sheets_of({"gpu-compile": record})[0]
    path = "program 4 > body 3 > body 1 > false_branch 1"
    assert sheet.rows[0] == ("block", "fast", "8", "54", path, "14", "40")
    assert sheet.rows[1][1] == "MJX"


def compiler() -> str | None:
    """Return an interpreter with a GPU compiler: this one, or that of ``make gpu-setup``."""
    if gpu_target.compiler_missing() is None:
        return sys.executable
    other = ROOT / ".venv-gpu" / "bin" / "python"
    return str(other) if other.exists() else None


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.skipif(compiler() is None, reason="no GPU compiler here (make gpu-setup)")
@pytest.mark.parametrize(("form", "fewest", "most"), [("accelerator", 20, 40), ("kernels", 7, 12)])
def test_an_update_stays_within_its_operations(form: str, fewest: int, most: int) -> None:
    words = ["--json", "--programs", "block", "--forms", form, "--seeds", "1", "8"]
    done = subprocess.run(
        [str(compiler()), "-m", "twirl_mjx", "bench", "gpu-compile", *words],
        env={**os.environ, "JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=True,
    )
    counts = [row["in_loop"] for row in json.loads(done.stdout)["rows"]]
    assert len(counts) == 2
    assert fewest <= min(counts) <= max(counts) <= most
