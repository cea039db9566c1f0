"""Foreign policies as people have them, built with ``onnx`` itself."""

from __future__ import annotations

import functools
import importlib.util
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from twirl_mjx.policies.contract import Contract
from twirl_mjx.policies.ready import LEGGED_GYM_48
from twirl_mjx.sim.robots import A1

Shape = list[int | str]


def load_example() -> Any:
    """Return ``examples/foreign_trot.py`` as a module."""
    path = Path(__file__).parents[2] / "examples" / "foreign_trot.py"
    spec = importlib.util.spec_from_file_location("foreign_trot", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


EXAMPLE = load_example()


def save_graph(
    path: Path,
    nodes: list[Any],
    inputs: dict[str, Shape],
    outputs: dict[str, Shape],
    weights: dict[str, np.ndarray],
    metadata: dict[str, str] | None = None,
    kinds: dict[str, int] | None = None,
) -> Path:
    """Write a graph; inputs and outputs are float32 unless ``kinds`` says otherwise."""
    kinds = kinds or {}

    def infos(values: dict[str, Shape]) -> list[Any]:
        return [
            helper.make_tensor_value_info(name, kinds.get(name, TensorProto.FLOAT), shape)
            for name, shape in values.items()
        ]

    arrays = [numpy_helper.from_array(value, name) for name, value in weights.items()]
    graph = helper.make_graph(nodes, "foreign", infos(inputs), infos(outputs), arrays)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    helper.set_model_props(model, metadata or {})
    onnx.checker.check_model(model)
    onnx.save(model, str(path))
    return path


@functools.cache
def trot_graph() -> onnx.ModelProto:
    """Return the joystick trot of 48 inputs, learned once for all tests."""
    return EXAMPLE.graph(LEGGED_GYM_48)


def save_trot(path: Path) -> Path:
    """Write the joystick trot."""
    onnx.save(trot_graph(), str(path))
    return path


def save_tracker(path: Path, contract: Contract, kind: int = TensorProto.FLOAT) -> Path:
    """Write a motion tracker: the trot by the number of times it was asked, 20 ms each."""
    table = (
        EXAMPLE.teacher(0.7, 0.0, 0.0)[:, contract.joint_order(A1)] - contract.default_pose
    ) / (np.asarray(contract.action.scale))
    nodes = [
        helper.make_node("Cast", ["time_step"], ["ticks"], to=TensorProto.FLOAT),
        helper.make_node("Mul", ["ticks", "rate"], ["shares"]),
        helper.make_node("Add", ["shares", "margin"], ["turned"]),
        helper.make_node("Cast", ["turned"], ["index"], to=TensorProto.INT64),
        helper.make_node("Mod", ["index", "period"], ["phase"]),
        helper.make_node("Reshape", ["phase", "flat"], ["row"]),
        helper.make_node("Gather", ["table", "row"], ["pose"]),
        helper.make_node("MatMul", ["obs", "zero"], ["none"]),
        helper.make_node("Add", ["pose", "none"], ["actions"]),
        helper.make_node("Identity", ["pose"], ["joint_pos"]),
    ]
    weights = {
        "rate": np.array(0.4, np.float32),
        "margin": np.array(0.25, np.float32),
        "period": np.array(8),
        "flat": np.array([1]),
        "table": table.astype(np.float32),
        "zero": np.zeros((contract.observation_size, 12), np.float32),
    }
    return save_graph(
        path, nodes, {"obs": [1, contract.observation_size], "time_step": [1, 1]},
        {"actions": [1, 12], "joint_pos": [1, 12]}, weights, kinds={"time_step": kind},
    )  # fmt: skip


def save_lstm(path: Path, rows: int | str = 1) -> Path:
    """Write a recurrent policy as rsl_rl exports it: obs, h_in, c_in -> actions, h_out, c_out."""
    rng = np.random.default_rng(1)
    weights = {
        "w": rng.standard_normal((1, 32, 48)).astype(np.float32) / 8,
        "r": rng.standard_normal((1, 32, 8)).astype(np.float32) / 8,
        "axes": np.array([0]),
        "w2": rng.standard_normal((8, 12)).astype(np.float32) / 8,
    }
    nodes = [
        helper.make_node("Unsqueeze", ["obs", "axes"], ["x"]),
        helper.make_node(
            "LSTM", ["x", "w", "r", "", "", "h_in", "c_in"], ["seq", "h_out", "c_out"],
            hidden_size=8,
        ),
        helper.make_node("Squeeze", ["h_out", "axes"], ["h"]),
        helper.make_node("MatMul", ["h", "w2"], ["actions"]),
    ]  # fmt: skip
    memory: list[int | str] = [1, rows, 8]
    return save_graph(
        path, nodes, {"obs": [rows, 48], "h_in": memory, "c_in": memory},
        {"actions": [rows, 12], "h_out": memory, "c_out": memory}, weights,
    )  # fmt: skip


@pytest.fixture
def graphs() -> SimpleNamespace:
    """Return what writes foreign policies: ``save``, ``trot``, ``tracker``, ``lstm``; and nodes."""
    return SimpleNamespace(
        save=save_graph,
        trot=save_trot,
        tracker=save_tracker,
        lstm=save_lstm,
        teacher=EXAMPLE.teacher,
        node=helper.make_node,
    )
