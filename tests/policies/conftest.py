"""Foreign policies as people have them, built with ``onnx`` itself."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from twirl_mjx.policies.contract import Contract
from twirl_mjx.policies.scripted import TROT, action_table
from twirl_mjx.sim.robots import A1

Shape = list[int | str]
HIDDEN = 256


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


def trot_outputs(contract: Contract) -> np.ndarray:
    """Return one period of the trot [P, J] as the outputs of a policy under ``contract``."""
    targets = A1.default_pose + action_table(TROT, A1) * A1.action_half_range
    own = targets[:, contract.joint_order(A1)] - np.array(contract.default_pose)
    return own / np.asarray(contract.action.scale)


def clone_trot(contract: Contract) -> dict[str, np.ndarray]:
    """Return weights of a small network that trots: from its last output it knows the next.

    Supervised learning in closed form: ridge regression on random tanh features, on the outputs of
    the scripted trot with noise all around, so that what strays from the gait is led back to it.
    """
    rng = np.random.default_rng(0)
    cycle = trot_outputs(contract)
    rest = (A1.default_pose[contract.joint_order(A1)] - np.array(contract.default_pose)) / (
        contract.action.scale
    )
    slices, start = {}, 0
    for term in contract.observation:
        slices[term.name] = slice(start, start + term.size)
        start += term.size
    rows, answers = [], []
    for strength in (0.1, 0.3, 0.6, 0.8, 1.0, 1.1, 1.3):
        for phase in range(len(cycle)):
            last = rest + strength * (cycle[phase] - rest)
            grown = rest + min(1.0, strength + 0.2) * (cycle[(phase + 1) % len(cycle)] - rest)
            noisy = last + 0.05 * rng.standard_normal((60, 12)) * np.abs(cycle).max()
            rows.append(noisy)
            answers.append(np.tile(grown, (60, 1)))
    for start_row in (np.zeros(12), rest):  # at rest the gait begins
        rows.append(start_row + 0.01 * rng.standard_normal((200, 12)))
        answers.append(np.tile(rest + 0.3 * (cycle[0] - rest), (200, 1)))
    last, answer = np.concatenate(rows), np.concatenate(answers)
    spread = last.std(axis=0)
    first = np.zeros((contract.observation_size, HIDDEN), np.float32)
    first[slices["previous_action"]] = rng.standard_normal((12, HIDDEN)) / spread[:, None] / 3.0
    bias = rng.standard_normal(HIDDEN).astype(np.float32)
    features = np.tanh(last @ first[slices["previous_action"]] + bias)
    features = np.concatenate([features, np.ones((len(features), 1))], axis=1)
    gram = features.T @ features + 1e-2 * np.eye(HIDDEN + 1)
    second = np.linalg.solve(gram, features.T @ answer).astype(np.float32)
    return {"w1": first, "b1": bias, "w2": second[:-1], "b2": second[-1]}


def mlp_nodes(obs: str, action: str) -> list[Any]:
    """Return the nodes of a network with one tanh layer."""
    return [
        helper.make_node("MatMul", [obs, "w1"], ["p1"]),
        helper.make_node("Add", ["p1", "b1"], ["s1"]),
        helper.make_node("Tanh", ["s1"], ["h1"]),
        helper.make_node("MatMul", ["h1", "w2"], ["p2"]),
        helper.make_node("Add", ["p2", "b2"], [action]),
    ]


@pytest.fixture
def graphs() -> SimpleNamespace:
    """Return what builds foreign policies: ``save``, ``mlp``, ``clone`` and ``outputs``."""
    return SimpleNamespace(save=save_graph, mlp=mlp_nodes, clone=clone_trot, outputs=trot_outputs)
