"""Policies stored as ONNX graphs, ours or anyone's, run by onnxruntime."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from twirl_mjx import files
from twirl_mjx.policies.learned import PolicyFileError, PolicyHeader, check_observation

if TYPE_CHECKING:
    import onnxruntime

METADATA_KEY = "twirl_mjx"
"""Name of the metadata property that holds the header as JSON."""


@dataclasses.dataclass(frozen=True)
class OnnxPolicy:
    """An ONNX graph with one input [N, O] and one output [N, A], both float32."""

    session: onnxruntime.InferenceSession
    """The loaded graph."""
    observation_size: int
    """O."""
    action_size: int
    """A."""
    batch_size: int | None
    """Rows the graph takes at once; ``None`` when it takes any number."""
    header: PolicyHeader | None
    """What the file says about the policy; ``None`` for a graph of other origin."""

    def act(self, obs: Any) -> np.ndarray:
        """Return the action.

        Args:
            obs: [O] or [N, O] (any leading axes), finite.

        Returns:
            [A] or [N, A] float32, clipped to [-1, 1] as every task clips actions.

        Raises:
            ValueError: wrong size, a value that is not finite going in or coming out, or the
                graph failed.
        """
        array = check_observation(obs, self.observation_size, self.header)
        rows = array.reshape(-1, self.observation_size)
        step = self.batch_size or max(len(rows), 1)
        if len(rows) % step:
            raise ValueError(f"{len(rows)} observations are no multiple of the graph's {step} rows")
        parts = [self._run(rows[i : i + step]) for i in range(0, max(len(rows), 1), step)]
        action = np.concatenate(parts).reshape(*array.shape[:-1], self.action_size)
        return np.clip(action, -1.0, 1.0)

    def _run(self, rows: np.ndarray) -> np.ndarray:
        """Run the graph once on [n, O] and check what comes out."""
        name = self.session.get_inputs()[0].name
        try:
            action = np.asarray(self.session.run(None, {name: rows})[0])
        except Exception as error:  # onnxruntime's own errors share no other base class
            raise ValueError(f"the ONNX graph failed: {error}") from error
        if action.shape != (len(rows), self.action_size):
            raise ValueError(
                f"the ONNX graph made {action.shape} of {rows.shape}, expected"
                f" {(len(rows), self.action_size)}"
            )
        if not np.isfinite(action).all():
            raise ValueError("the ONNX graph returned an action that is not finite")
        return action


def _only(values: Sequence[Any], kind: str, path: Path) -> Any:
    """Return the only float32 [rows, size] input or output of a graph."""
    if len(values) != 1:
        raise PolicyFileError(f"{path} has {len(values)} {kind}s, a policy has one")
    value = values[0]
    shape = value.shape
    if value.type != "tensor(float)" or len(shape) != 2 or not isinstance(shape[1], int):
        raise PolicyFileError(
            f"{path}: {kind} {value.name!r} is {value.type} {value.shape}, expected float32 "
            "[rows, size] with a fixed size"
        )
    return value


def load_onnx(path: str | Path) -> OnnxPolicy:
    """Open an ONNX policy on the CPU with one thread and try it once, on zeros.

    Raises:
        PolicyFileError: no readable graph, or one that is no policy or fails.
    """
    import onnxruntime

    path = Path(path)
    files.check_readable(path, "an ONNX policy")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    try:
        session = onnxruntime.InferenceSession(
            str(path), options, providers=["CPUExecutionProvider"]
        )
    except Exception as error:  # onnxruntime's own errors share no other base class
        raise PolicyFileError(f"{path} is not a readable ONNX graph: {error}") from error
    source = _only(session.get_inputs(), "input", path)
    target = _only(session.get_outputs(), "output", path)
    rows = source.shape[0] if isinstance(source.shape[0], int) else None
    text = session.get_modelmeta().custom_metadata_map.get(METADATA_KEY)
    try:
        header = PolicyHeader.from_json(text) if text else None
    except PolicyFileError as error:
        raise PolicyFileError(f"{path}: {error}") from error
    if header and (header.observation_size, header.action_size) != (
        source.shape[1],
        target.shape[1],
    ):
        raise PolicyFileError(
            f"{path}: the graph maps {source.shape[1]} to {target.shape[1]} numbers, its header "
            f"says {header.observation_size} to {header.action_size}"
        )
    policy = OnnxPolicy(session, source.shape[1], target.shape[1], rows, header)
    try:
        policy.act(np.zeros((rows or 1, policy.observation_size), np.float32))
    except ValueError as error:
        raise PolicyFileError(f"{path}: tried on zeros: {error}") from error
    return policy
