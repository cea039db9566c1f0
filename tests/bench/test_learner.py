"""The learner's measurement: products counted, options checked, records complete."""

from __future__ import annotations

import dataclasses
import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from twirl_mjx.bench import learner, matmuls, worker
from twirl_mjx.bench.learner import LearnerBench
from twirl_mjx.bench.matmuls import Shapes

TINY = Shapes(obs=5, action=2, batch=8, hidden=6, updates=3)


def product_flops(jaxpr: Any, times: int = 1) -> float:
    """Return the operations of all matrix products of a traced function."""
    total = 0.0
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            (contracted, _), _ = equation.params["dimension_numbers"]
            length = math.prod(equation.invars[0].aval.shape[i] for i in contracted)
            total += 2.0 * math.prod(equation.outvars[0].aval.shape) * length * times
        inner = equation.params.get("length", 1) * times
        for value in equation.params.values():
            if hasattr(value, "jaxpr"):
                total += product_flops(value.jaxpr, inner)
    return total


@pytest.mark.parametrize("layout", matmuls.LAYOUTS)
@pytest.mark.parametrize("shapes", [TINY, Shapes(101, 12, 256, 256, 20)], ids=["tiny", "paper"])
def test_chain_has_the_operations_it_claims(shapes: Shapes, layout: matmuls.Layout) -> None:
    tensors = jax.eval_shape(lambda: matmuls.to_layout(matmuls.inputs(shapes), layout))
    traced = jax.make_jaxpr(lambda t: matmuls.block(t, layout, "float32"))(tensors)
    assert product_flops(traced.jaxpr) == matmuls.flops(shapes) * shapes.updates


def test_paper_sizes_take_two_fifths_of_a_gflop() -> None:
    """By hand: 2 * 256 * (2 * (2 * 94,720 + 160,000) + 97,536) operations."""
    assert matmuls.flops(Shapes(101, 12, 256, 256, 20)) == 512 * (2 * (189_440 + 160_000) + 97_536)


def test_layouts_compute_the_same() -> None:
    given = matmuls.inputs(TINY)
    first, last = (
        matmuls.block(matmuls.to_layout(given, layout), layout, "float32")
        for layout in matmuls.LAYOUTS
    )
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(last), strict=True):
        np.testing.assert_allclose(a, np.swapaxes(b, -1, -2), rtol=1e-4, atol=1e-5)
        assert np.abs(a).min(initial=np.inf) > 0


def test_chain_is_that_of_two_layers_and_their_gradients() -> None:
    """One update by numpy, one critic at a time."""
    t = {name: np.asarray(x, np.float64) for name, x in matmuls.inputs(TINY).items()}
    _, (gradients, q, _) = matmuls.block(matmuls.inputs(TINY), "batch first", "float32")
    for e in range(2):
        hidden = t["rows"][0] @ t["first"][e]
        returned = t["next_rows"][0] @ t["first"][e] @ t["second"][e]
        np.testing.assert_allclose(gradients[1][0, e], hidden.T @ returned, rtol=1e-4, atol=1e-5)
        first = t["rows"][0].T @ (returned @ t["second"][e].T)
        np.testing.assert_allclose(gradients[0][0, e], first, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(
            q[0, e], hidden @ t["second"][e] @ t["out"][e], rtol=1e-4, atol=1e-5
        )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seconds": 0.0}, r"seconds = 0.0 is outside \[0.1"),
        ({"batch": 0}, r"batch = 0 is outside \[1"),
        ({"seeds": 0}, r"seeds = 0 is outside \[1"),
        ({"workers": 10_000}, r"workers = 10000 is outside \[0, \d+\]"),
    ],
)
def test_numbers_out_of_range_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        LearnerBench(**changes)


def test_options_reach_the_learner() -> None:
    config = LearnerBench(form="plain", matmul_dtype="bfloat16", batch=64, utd=5, hidden=32).droq
    assert (config.fast, config.matmul_dtype) == (False, "bfloat16")
    assert (config.batch_size, config.updates_per_block, config.hidden_sizes) == (64, 5, (32, 32))
    assert LearnerBench().droq.fast
    assert LearnerBench(form="accelerator").droq.form == "accelerator"


def test_replay_is_full_of_usable_rows() -> None:
    options = LearnerBench(obs=4, action=3)
    for seeds, lead in ((1, ()), (2, (2,))):
        online = learner.random_ring(options, seeds)
        assert online.rows.shape == (*lead, learner.ROWS, 2 * 4 + 3 + 2)
        assert online.rows.dtype == np.float32
        np.testing.assert_array_equal(online.size, np.full(lead, learner.ROWS))
        ends = np.asarray(online.rows[..., 4 + 3 + 1])
        assert set(np.unique(ends)) == {0.0, 1.0}
        assert 0.005 < ends.mean() < 0.02


def record(found: dict[str, list[float]], **reasons: str | None) -> dict[str, Any]:
    given = {"batch first": [900.0], "batch last": [1000.0]} | found
    options = LearnerBench(seeds=2)
    return learner._record(options, given, {"sbx": None, "workers": None} | reasons, 5.0, 6.0)


def test_record_has_ratios_of_medians() -> None:
    found = record(
        {
            "single": [500.0, 400.0, 600.0],
            "seeds": [700.0],
            "worker 0": [450.0],
            "worker 1": [350.0, 450.0, 460.0],
            "sbx": [200.0, 100.0, 300.0],
        }
    )
    assert found["critic_updates_per_s"] == found["median"] == 500.0
    assert found["spread"] == 0.4
    assert found["matmul_bound_updates_per_s"] == 1000.0
    assert found["share_of_matmul_bound"] == 0.5
    assert (found["aggregate_updates_per_s"], found["aggregate_by"]) == (900.0, "workers")
    assert (found["ratio_to_sbx"], found["aggregate_ratio_to_sbx"]) == (2.5, 4.5)
    assert (found["seeds"], found["workers"], found["compile_s"]) == (2, 2, 5.0)
    assert json.loads(json.dumps(found, allow_nan=False)) == found


def test_record_without_peer_and_workers_says_why() -> None:
    found = record({"single": [500.0], "seeds": [700.0]}, sbx="absent", workers="off")
    assert found["sbx_updates_per_s"] is found["ratio_to_sbx"] is None
    assert found["workers_updates_per_s"] is None
    assert (found["sbx_reason"], found["workers_reason"]) == ("absent", "off")
    assert (found["aggregate_updates_per_s"], found["aggregate_by"]) == (700.0, "vmap")


def test_missing_peer_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(learner, "_sbx_python", lambda: Path("nowhere"))
    assert "make bench-setup" in str(learner.sbx_missing(LearnerBench()))
    assert "--no-sbx" in str(learner.sbx_missing(LearnerBench(sbx=False)))
    monkeypatch.setattr(learner, "_sbx_python", lambda: Path(sys.executable))
    assert learner.sbx_missing(LearnerBench()) is None
    assert "256" in str(learner.sbx_missing(LearnerBench(hidden=128)))


def test_failing_peer_is_not_hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(learner, "_sbx_python", lambda: Path(sys.executable))
    with pytest.raises(RuntimeError, match=r"(?s)SBX peer failed: .*No module named"):
        learner.sbx_samples(LearnerBench(), 0.1)


def test_workers_may_be_switched_off() -> None:
    assert "--workers 0" in str(worker.pinning_missing(0))


def test_worker_that_dies_is_reported() -> None:
    options = dataclasses.asdict(LearnerBench()) | {"batch": 0}
    with (
        worker.Worker("learner", options, cpu=0) as broken,
        pytest.raises(RuntimeError, match="measuring process ended with status 1"),
    ):
        broken.wait_until_ready()


@pytest.mark.slow
def test_learner_measured_from_the_shell() -> None:
    sizes = "--obs 5 --action 2 --batch 16 --hidden 16 --utd 2 --seeds 2 --workers 1 --no-sbx"
    words = f"-m twirl_mjx bench learner --json --seconds 2 --rounds 1 {sizes}".split()
    done = subprocess.run(
        [sys.executable, *words],
        capture_output=True,
        text=True,
        timeout=290,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    found = json.loads(done.stdout)
    assert found["critic_updates_per_s"] > 0
    assert found["matmul_bound_updates_per_s"] > 0  # above the learner only where nothing else runs
    assert found["workers"] == 1
    assert found["aggregate_updates_per_s"] >= found["seeds_updates_per_s"] > 0
    assert found["sbx_updates_per_s"] is None
    assert (found["obs"], found["batch"], found["utd"], found["hidden"]) == (5, 16, 2, 16)
