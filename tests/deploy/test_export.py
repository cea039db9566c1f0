from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper

from twirl_mjx.deploy import export
from twirl_mjx.deploy.export import build_graph, export_onnx
from twirl_mjx.policies.learned import (
    NumpyPolicy,
    Params,
    PolicyFileError,
    PolicyHeader,
    load_policy,
    save_policy,
)
from twirl_mjx.policies.onnx_file import OnnxPolicy


def make_policy(observation: int = 101, hidden: int = 64, action: int = 12) -> NumpyPolicy:
    rng = np.random.default_rng(0)
    sizes = {"hidden_0": (observation, hidden), "hidden_1": (hidden, hidden)}
    sizes |= {"mean": (hidden, action), "log_std": (hidden, action)}
    params: Params = {
        name: {
            "kernel": (rng.standard_normal(size) / np.sqrt(size[0])).astype(np.float32),
            "bias": rng.standard_normal(size[1]).astype(np.float32),
        }
        for name, size in sizes.items()
    }
    header = PolicyHeader("biped", observation, action, 0.05, card={"seed": 1})
    return NumpyPolicy(header, params)


@pytest.fixture
def exported(tmp_path: Path) -> Path:
    return export_onnx(make_policy(), tmp_path / "out" / "policy.onnx")


def loaded(path: Path) -> OnnxPolicy:
    policy = load_policy(path)
    assert isinstance(policy, OnnxPolicy)
    return policy


def test_exported_file_acts_like_the_policy(exported: Path) -> None:
    policy, original = loaded(exported), make_policy()
    obs = np.random.default_rng(5).standard_normal((2, 7, 101)).astype(np.float32)
    np.testing.assert_allclose(policy.act(obs), original.act(obs), atol=1e-5)
    np.testing.assert_allclose(policy.act(obs[0, 3]), original.act(obs[0, 3]), atol=1e-5)
    assert policy.act(obs[0, 3]).shape == (12,)
    assert policy.header == original.header


def test_graph_is_plain_and_labelled(exported: Path) -> None:
    model = onnx.load(str(exported))
    kinds = [node.op_type for node in model.graph.node]
    assert kinds == ["MatMul", "Add", "Relu"] * 2 + ["MatMul", "Add", "Tanh"]
    properties = {p.key: p.value for p in model.metadata_props}
    assert properties["task"] == "biped"
    assert float(properties["control_dt"]) == 0.05
    assert json.loads(properties["twirl_mjx"])["card"] == {"seed": 1}


def test_export_reads_files_and_run_directories(tmp_path: Path) -> None:
    policy = make_policy()
    save_policy(tmp_path / "run" / "policy.npz", policy.actor_params, policy.header)
    out = export_onnx(tmp_path / "run", tmp_path / "policy.onnx")
    assert loaded(out).header == policy.header
    with pytest.raises(ValueError, match="already an ONNX file"):
        export_onnx(out, tmp_path / "again.onnx")
    with pytest.raises(ValueError, match=r"ends in \.onnx, got '\.pt'"):
        export_onnx(policy, tmp_path / "policy.pt")


def test_export_that_differs_is_not_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = make_policy()
    other.actor_params["mean"]["bias"][3] += 1e-3
    graph = build_graph(other)
    monkeypatch.setattr(export, "build_graph", lambda *_: graph)
    with pytest.raises(ValueError, match=r"differs from the policy by .*e-04"):
        export_onnx(make_policy(), tmp_path / "policy.onnx")
    assert not list(tmp_path.iterdir())


def foreign_graph(path: Path, rows: int | str, size: int = 3, scale: float = 5.0) -> Path:
    """Write a graph of other origin: action = scale * observation."""
    source = helper.make_tensor_value_info("x", TensorProto.FLOAT, [rows, size])
    target = helper.make_tensor_value_info("y", TensorProto.FLOAT, [rows, size])
    weight = helper.make_tensor("k", TensorProto.FLOAT, [1], [scale])
    node = helper.make_node("Mul", ["x", "k"], ["y"])
    graph = helper.make_graph([node], "g", [source], [target], [weight])
    opset = [helper.make_opsetid("", 17)]
    onnx.save(helper.make_model(graph, opset_imports=opset, ir_version=8), str(path))
    return path


def test_foreign_graph_with_one_row_is_run_row_by_row_and_clipped(tmp_path: Path) -> None:
    policy = loaded(foreign_graph(tmp_path / "f.onnx", 1))
    assert policy.header is None
    assert policy.batch_size == 1
    obs = np.array([[0.1, 0.02, -0.1], [9.0, 0.0, -9.0]], np.float32)
    np.testing.assert_allclose(policy.act(obs), [[0.5, 0.1, -0.5], [1.0, 0.0, -1.0]], rtol=1e-6)
    with pytest.raises(ValueError, match=r"expected \[\.\.\., 3\]"):
        policy.act(np.zeros(4))


def test_output_that_is_not_finite_is_refused(tmp_path: Path) -> None:
    policy = loaded(foreign_graph(tmp_path / "f.onnx", "n", scale=3e38))
    with pytest.raises(ValueError, match="not finite"):
        policy.act(np.full(3, 10.0))


def test_graph_is_tried_when_it_is_loaded(tmp_path: Path) -> None:
    """An infinite weight makes NaN of zeros; a reshape to other rows, a graph that breaks rows."""
    with pytest.raises(PolicyFileError, match=r"f\.onnx: tried on zeros: .* not finite"):
        load_policy(foreign_graph(tmp_path / "f.onnx", "n", scale=float("inf")))
    for shape, message in (([7, 2], "the ONNX graph failed"), ([2, 3], r"made \(2, 3\) of")):
        source = helper.make_tensor_value_info("x", TensorProto.FLOAT, ["n", 6])
        target = helper.make_tensor_value_info("y", TensorProto.FLOAT, ["m", shape[1]])
        to = helper.make_tensor("to", TensorProto.INT64, [2], shape)
        node = helper.make_node("Reshape", ["x", "to"], ["y"])
        graph = helper.make_graph([node], "g", [source], [target], [to])
        opset = [helper.make_opsetid("", 17)]
        path = tmp_path / "r.onnx"
        onnx.save(helper.make_model(graph, opset_imports=opset, ir_version=8), str(path))
        with pytest.raises(PolicyFileError, match=message):
            load_policy(path)


def test_files_that_are_no_graph_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "bad.onnx"
    path.write_bytes(b"no graph")
    with pytest.raises(PolicyFileError, match="not a readable ONNX graph"):
        load_policy(path)
    value = helper.make_tensor_value_info("x", TensorProto.FLOAT, [1, 3, 3])
    node = helper.make_node("Relu", ["x"], ["y"])
    target = helper.make_tensor_value_info("y", TensorProto.FLOAT, [1, 3, 3])
    graph = helper.make_graph([node], "g", [value], [target])
    opset = [helper.make_opsetid("", 17)]
    onnx.save(helper.make_model(graph, opset_imports=opset, ir_version=8), str(path))
    with pytest.raises(PolicyFileError, match=r"input 'x' is tensor\(float\) \[1, 3, 3\]"):
        load_policy(path)
