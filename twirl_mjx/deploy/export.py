"""Export a learned policy to an ONNX file and its contract, which need nothing of this package."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from twirl_mjx import files
from twirl_mjx.policies import contract as schema
from twirl_mjx.policies.contract import Contract, ContractError
from twirl_mjx.policies.learned import NumpyPolicy, PolicyHeader, hidden_layers, load_policy
from twirl_mjx.policies.onnx_file import METADATA_KEY, load_onnx
from twirl_mjx.policies.ready import motion_of, own_contract
from twirl_mjx.policies.resolve import config_of_card, robot_of_card
from twirl_mjx.sim.robots import ROBOTS
from twirl_mjx.tasks.observations import Entry

if TYPE_CHECKING:
    import onnx

OPSET = 17
IR_VERSION = 8
TOLERANCE = 1e-5
"""Largest difference allowed between the exported graph and the numpy policy."""


CONTRACT = "contract.json"
"""Name of the contract beside an exported policy."""


class Exported(NamedTuple):
    """What an export has written."""

    onnx: Path
    """The graph, with its contract among the metadata."""
    contract: Path | None
    """The same contract as JSON; None where there is none."""
    why: str
    """Why there is none."""


def contract_of(header: PolicyHeader, robot: str = "") -> Contract:
    """Return how a policy of this project meets its robot, by what its file says.

    Args:
        header: Of the file.
        robot: Its robot, a name or ``file.py:NAME``; that on its card by default.

    Raises:
        ContractError: It sees something that no contract can say.
        PolicyFileError: A task, a robot or options that are not there.
    """
    legs = ROBOTS.get(ROBOTS.admit(robot or robot_of_card(header)))
    layout = tuple(Entry(n, stop - start, u) for n, start, stop, u in header.observation_layout)
    motion = None
    if not layout or any(entry.name.startswith(schema.OF_MOTION) for entry in layout):
        observer = config_of_card(header, "the policy").make_task().observer
        layout, motion = observer.layout, motion_of(observer)
    return own_contract(header.task, layout, legs, motion)


def build_graph(policy: NumpyPolicy, contract: Contract | None = None) -> onnx.ModelProto:
    """Return the ``onnx.ModelProto`` of a policy: MatMul, Add, Relu ..., Tanh.

    The graph has one input ``observation`` [batch, O], as the task emits it (no normalisation),
    and one output ``action`` [batch, A] in [-1, 1]. The header travels as the metadata property
    ``twirl_mjx``, the contract as ``twirl_contract``, both JSON text; ``task``, ``control_dt`` and
    the sizes are repeated in plain form.
    """
    from onnx import TensorProto, helper, numpy_helper

    nodes, weights = [], []
    last = "observation"
    for layer in [*hidden_layers(policy.actor_params), "mean"]:
        for name, value in policy.actor_params[layer].items():
            weights.append(numpy_helper.from_array(value, f"{layer}.{name}"))
        activation, out = ("Tanh", "action") if layer == "mean" else ("Relu", f"{layer}.output")
        nodes += [
            helper.make_node("MatMul", [last, f"{layer}.kernel"], [f"{layer}.product"]),
            helper.make_node("Add", [f"{layer}.product", f"{layer}.bias"], [f"{layer}.sum"]),
            helper.make_node(activation, [f"{layer}.sum"], [out]),
        ]
        last = out
    ends = [("observation", policy.observation_size), ("action", policy.action_size)]
    source, target = (
        helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", n]) for name, n in ends
    )
    graph = helper.make_graph(nodes, f"twirl_mjx {policy.header.task}", [source], [target], weights)
    model = helper.make_model(
        graph,
        producer_name="twirl_mjx",
        doc_string=files.MARK,
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
    )
    header = policy.header
    properties = {
        METADATA_KEY: header.to_json(),
        "task": header.task,
        "control_dt": repr(header.control_dt),
        "observation_size": str(header.observation_size),
        "action_size": str(header.action_size),
    }
    if contract is not None:
        properties[schema.METADATA_KEY] = contract.to_json()
    helper.set_model_props(model, properties)
    return model


def max_difference(policy: NumpyPolicy, file: Path, rows: int = 256, seed: int = 0) -> float:
    """Return by how much an ONNX file differs from a policy beyond rounding, at most.

    Both are compared with the policy in float64, on random observations at scales from 0.1 to 10,
    alone and in batches; four times the policy's own rounding is no difference.
    """
    rng = np.random.default_rng(seed)
    scale = 10.0 ** rng.uniform(-1.0, 1.0, (rows, 1))
    obs = (scale * rng.standard_normal((rows, policy.observation_size))).astype(np.float32)
    exact = _exact(policy, obs)
    rounding = np.abs(policy.act(obs) - exact).max()
    exported = load_onnx(file)
    batch = np.abs(exported.act(obs) - exact).max()
    single = np.abs(exported.act(obs[0]) - exact[0]).max()
    return float(max(batch, single, 4.0 * rounding) - 4.0 * rounding)


def _exact(policy: NumpyPolicy, obs: np.ndarray) -> np.ndarray:
    """Return actions [N, A] at observations [N, O], in float64."""
    x = obs.astype(np.float64)
    for layer in hidden_layers(policy.actor_params):
        weights = policy.actor_params[layer]
        x = np.maximum(x @ weights["kernel"].astype(np.float64) + weights["bias"], 0.0)
    weights = policy.actor_params["mean"]
    return np.tanh(x @ weights["kernel"].astype(np.float64) + weights["bias"])


def export(
    policy: str | Path, out: str | Path, *, robot: str = "", overwrite: bool = False
) -> Exported:
    """Write a policy as ONNX and its contract as ``contract.json`` beside it.

    Args:
        policy: A policy file or a run directory (its best policy).
        out: Target, ending in ``.onnx``.
        robot: Its robot, a name or ``file.py:NAME``; that on its card by default.
        overwrite: Whether files may be replaced that are not of this policy.

    Raises:
        ValueError: As :func:`export_onnx`, or a file is there that this did not write.
    """
    loaded = load_policy(policy)
    if not isinstance(loaded, NumpyPolicy):
        raise ValueError(f"{policy} is already an ONNX file; copy it")
    out = Path(out)
    beside = out.with_name(CONTRACT)
    files.check_ours(out, overwrite=overwrite)
    try:
        contract = contract_of(loaded.header, robot)
    except ContractError as error:
        _check_beside(beside, None, overwrite)
        if beside.exists():  # it would be taken for that of the new graph
            beside.unlink()
        return Exported(export_onnx(loaded, out), None, str(error))
    _check_beside(beside, contract, overwrite)
    written = export_onnx(loaded, out, contract)
    schema.write(beside, contract)
    return Exported(written, beside, "")


def _check_beside(path: Path, contract: Contract | None, overwrite: bool) -> None:
    """Refuse to replace the contract of another policy; None: this one has none."""
    files.check_target(path)
    if overwrite or not path.exists():
        return
    try:
        is_same = schema.read(path) == contract
    except (ContractError, files.FileError):
        is_same = False
    if not is_same:
        raise files.FileError(
            f"{path} is there and is not the contract of this policy; nothing was touched (nearest:"
            f" --out {path.parent / (contract.name if contract else 'mine') / 'policy.onnx'}, or"
            " --overwrite to replace it)"
        )


def export_onnx(
    policy: NumpyPolicy | str | Path, out: str | Path, contract: Contract | None = None
) -> Path:
    """Write a policy as ONNX and verify the written file before it takes its name.

    Args:
        policy: a loaded policy, a policy file or a run directory (its best policy).
        out: target, ending in ``.onnx``.
        contract: how it meets its robot, for the metadata.

    Returns:
        The path written.

    Raises:
        ValueError: wrong suffix, a policy that is already ONNX, or a file whose actions differ
            from the policy's by more than ``TOLERANCE``.
    """
    import onnx

    out = Path(out)
    if out.suffix != ".onnx":
        raise ValueError(f"{out}: an ONNX file ends in .onnx, got {out.suffix!r}")
    loaded = policy if isinstance(policy, NumpyPolicy) else load_policy(policy)
    if not isinstance(loaded, NumpyPolicy):
        raise ValueError(f"{policy} is already an ONNX file; copy it")
    model = build_graph(loaded, contract)
    onnx.checker.check_model(model)
    with files.replacing(out) as temporary:
        onnx.save(model, str(temporary))
        difference = max_difference(loaded, temporary)
        if not difference <= TOLERANCE:
            raise ValueError(
                f"the exported graph differs from the policy by {difference:.2e} (allowed "
                f"{TOLERANCE:.0e}); nothing was written to {out}"
            )
    return out
