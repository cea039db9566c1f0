"""Policies stored as ONNX graphs, ours or anyone's, run by onnxruntime.

A graph has an observation, and may have recurrent states and a time step. What is what is told by
its names: ``h_in`` and ``h_out`` (or ``hidden_in``, ``h0`` and ``hn``, ...) belong together,
``time_step`` is one, and the action is ``action``, ``actions`` or the first output left.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from twirl_mjx import files
from twirl_mjx.policies.learned import PolicyFileError, PolicyHeader, check_observation

if TYPE_CHECKING:
    import onnxruntime

METADATA_KEY = "twirl_mjx"
"""Name of the metadata property that holds the header as JSON."""
TYPES = {
    "tensor(float)": np.float32,
    "tensor(double)": np.float64,
    "tensor(float16)": np.float16,
    "tensor(int64)": np.int64,
    "tensor(int32)": np.int32,
}
"""What inputs and outputs may be made of."""
REAL = ("tensor(float)", "tensor(double)", "tensor(float16)")
OBSERVATIONS = ("obs", "observation", "observations", "policy", "state", "x", "input")
TIMES = ("time_step", "timestep", "time_steps", "step", "t")
ACTIONS = ("action", "actions", "output", "y", "mu", "mean")
ENDINGS = (("_in", "_out"), ("in", "out"), ("0", "n"), ("_0", "_n"), ("", "_out"), ("", "_n"))
"""How the names of a recurrent state end going in and coming out."""


@dataclasses.dataclass(frozen=True)
class State:
    """One recurrent state of a graph."""

    source: str
    """Name of the input."""
    target: str
    """Name of the output."""
    dtype: type
    shape: tuple[int, ...]
    """Of one world."""
    axis: int | None
    """Where the axis of worlds is; None where the graph has none."""


@dataclasses.dataclass(frozen=True)
class OnnxPolicy:
    """An ONNX graph as a policy: ``act`` for one without memory, ``step`` for any."""

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
    source: Any = None
    """onnxruntime's description of the input that is the observation."""
    target: str = ""
    """Name of the output that is the action."""
    time: Any = None
    """Description of the input that is the time step, if there is one."""
    states: tuple[State, ...] = ()
    """Recurrent states."""
    metadata: Mapping[str, str] = dataclasses.field(default_factory=dict)
    """Every metadata property of the file."""

    @property
    def initial_memory(self) -> tuple[np.ndarray, ...]:
        """Zeros, the recurrent states of one fresh world."""
        return tuple(np.zeros(state.shape, _plain(state.dtype)) for state in self.states)

    def act(self, obs: Any) -> np.ndarray:
        """Return the action.

        Args:
            obs: [O] or [N, O] (any leading axes), finite.

        Returns:
            [A] or [N, A] float32, clipped to [-1, 1] as every task clips actions.

        Raises:
            ValueError: wrong size, a value that is not finite going in or coming out, the
                graph failed, or it keeps a memory or a clock.
        """
        return np.clip(self.outputs(obs), -1.0, 1.0)

    def outputs(self, obs: Any) -> np.ndarray:
        """Return what the graph makes of observations, unclipped; otherwise as :meth:`act`."""
        if self.states or self.time is not None:
            raise ValueError(
                "the ONNX graph keeps a memory or a clock, so an observation alone gives no action:"
                " use it as a source (twirl collect, train, evaluate, render)"
            )
        array = check_observation(obs, self.observation_size, self.header)
        rows = array.reshape(-1, self.observation_size)
        output, _ = self.step(rows, np.zeros(len(rows)), ())
        return output.reshape(*array.shape[:-1], self.action_size)

    def step(
        self, rows: np.ndarray, ticks: np.ndarray, memory: Sequence[np.ndarray]
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
        """Return outputs and next memory of several worlds.

        Args:
            rows: [n, O] float32.
            ticks: [n] control steps of the policy since reset.
            memory: Recurrent states, each [n, ...].

        Raises:
            ValueError: As :meth:`act`; or ``n`` is no multiple of the rows the graph takes.
        """
        size = self.batch_size or max(len(rows), 1)
        if len(rows) % size:
            raise ValueError(f"{len(rows)} observations are no multiple of the graph's {size} rows")
        outputs, states = [], []
        for i in range(0, max(len(rows), 1), size):
            part = slice(i, i + size)
            output, following = self._run(rows[part], ticks[part], [m[part] for m in memory])
            outputs.append(output)
            states.append(following)
        merged = tuple(np.concatenate(parts) for parts in zip(*states, strict=True))
        return np.concatenate(outputs), merged

    def _run(
        self, rows: np.ndarray, ticks: np.ndarray, memory: Sequence[np.ndarray]
    ) -> tuple[np.ndarray, list[np.ndarray]]:
        """Run the graph once on [n, O] and check what comes out."""
        feeds = {self.source.name: _shaped(rows, self.source)}
        if self.time is not None:
            feeds[self.time.name] = _shaped(ticks[:, None], self.time)
        for state, value in zip(self.states, memory, strict=True):
            given = value[0] if state.axis is None else np.moveaxis(value, 0, state.axis)
            feeds[state.source] = np.ascontiguousarray(given, state.dtype)
        try:
            names = [self.target, *(state.target for state in self.states)]
            found = [np.asarray(value) for value in self.session.run(names, feeds)]
        except Exception as error:  # onnxruntime's own errors share no other base class
            raise ValueError(f"the ONNX graph failed: {error}") from error
        action = found[0].astype(np.float32)
        action = action[None] if len(self.source.shape) == 1 and action.ndim == 1 else action
        if action.shape != (len(rows), self.action_size):
            raise ValueError(
                f"the ONNX graph made {action.shape} of {rows.shape}, expected"
                f" {(len(rows), self.action_size)}"
            )
        if not np.isfinite(action).all():
            raise ValueError("the ONNX graph returned an action that is not finite")
        following = [
            (value[None] if s.axis is None else np.moveaxis(value, s.axis, 0)).astype(
                _plain(s.dtype)
            )
            for s, value in zip(self.states, found[1:], strict=True)
        ]
        return action, following


def _plain(dtype: type) -> type:
    """Return the type in which a state is kept: jax has no float64 and int64 by default."""
    return np.float32 if np.issubdtype(dtype, np.floating) else np.int32


def _shaped(rows: np.ndarray, value: Any) -> np.ndarray:
    """Return rows [n, k] in the type and rank of an input."""
    array = rows.astype(TYPES[value.type])
    return array.reshape(-1) if len(value.shape) == 1 else array


def _names(values: Sequence[Any]) -> str:
    return ", ".join(f"{v.name} {v.type.removeprefix('tensor')}{v.shape}" for v in values) or "none"


def _pick(values: list[Any], names: tuple[str, ...], kind: str, path: Path) -> Any:
    """Return the input or output of one of ``names``, or the only one.

    Raises:
        PolicyFileError: Several, or one that is no [rows, size] of numbers.
    """
    named = [v for name in names for v in values if v.name.lower() == name]
    if not named and len(values) != 1:
        raise PolicyFileError(
            f"{path}: which {kind} of {_names(values)} is the policy's? Call one {names[0]!r}, and"
            " recurrent states alike going in and coming out (h_in, h_out), or name these pairs in"
            " the contract's memory"
        )
    value = (named or values)[0]
    rank = len(value.shape)
    if value.type not in REAL or rank not in (1, 2) or not isinstance(value.shape[-1], int):
        raise PolicyFileError(
            f"{path}: {kind} {value.name!r} is {value.type} {value.shape}, expected float32, "
            "float64 or float16 [rows, size] or [size] with a fixed size"
        )
    return value


def _partner(name: str, outputs: Mapping[str, Any]) -> str | None:
    """Return the output that continues a recurrent input, by its name."""
    for start, end in ENDINGS:
        candidate = name.removesuffix(start) + end if name.endswith(start) else None
        if candidate is not None and candidate != name and candidate in outputs:
            return candidate
    return None


def _state(source: Any, target: Any, path: Path) -> State:
    shape = list(source.shape)
    free = [i for i, n in enumerate(shape) if not isinstance(n, int)]
    if source.type not in TYPES or len(free) > 1 or len(target.shape) != len(shape):
        raise PolicyFileError(
            f"{path}: state {source.name!r} is {source.type} {shape} and becomes {target.name!r}"
            f" {target.shape}: need equal ranks and at most one free axis, that of the worlds"
        )
    # torch keeps [layers, batch, units]; anything flatter has the worlds first.
    axis = free[0] if free else {0: None, 1: None, 3: 1}.get(len(shape), 0)
    if axis is not None:
        del shape[axis]
    return State(source.name, target.name, TYPES[source.type], tuple(shape), axis)


def _states(
    inputs: dict[str, Any],
    outputs: dict[str, Any],
    pairs: Sequence[tuple[str, str]],
    path: Path,
) -> tuple[State, ...]:
    """Take the recurrent states out of ``inputs`` and ``outputs``; return them."""
    for source, target in pairs:
        if source not in inputs or target not in outputs:
            raise PolicyFileError(
                f"{path}: the contract's memory ({source}, {target}) is not among the inputs"
                f" {_names(list(inputs.values()))} and outputs {_names(list(outputs.values()))}"
            )
    given = dict(pairs)
    for name in list(inputs) if not pairs else []:
        if name.lower() in OBSERVATIONS or name.lower() in TIMES:
            continue
        if (partner := _partner(name, outputs)) and inputs[name].shape == outputs[partner].shape:
            given[name] = partner
    if len(given) == len(inputs):  # something has to be the observation
        given = dict(pairs)
    return tuple(_state(inputs.pop(a), outputs.pop(b), path) for a, b in given.items())


def load_onnx(path: str | Path, memory: Sequence[tuple[str, str]] = ()) -> OnnxPolicy:
    """Open an ONNX policy on the CPU with one thread and try it once, on zeros.

    Args:
        path: The file.
        memory: Names (input, output) of its recurrent states; told by the names if not given.

    Raises:
        PolicyFileError: no readable graph, or one that is no policy or fails.
    """
    path = Path(path)
    session = _open(path)
    metadata = session.get_modelmeta().custom_metadata_map
    inputs = {value.name: value for value in session.get_inputs()}
    outputs = {value.name: value for value in session.get_outputs()}
    states = _states(inputs, outputs, memory, path)
    times = [name for name in inputs if name.lower() in TIMES and len(inputs) > 1]
    time = inputs.pop(times[0]) if times else None
    source = _pick(list(inputs.values()), OBSERVATIONS, "input", path)
    if extra := [value for name, value in inputs.items() if name != source.name]:
        raise PolicyFileError(
            f"{path}: input {_names(extra)} is neither an observation, nor a time step"
            f" ({', '.join(TIMES)}), nor a state that an output continues (h_in, h_out)"
        )
    if time is not None and time.type not in TYPES:
        raise PolicyFileError(f"{path}: time step {_names([time])} is no number")
    target = _pick(_actions(list(outputs.values())), ACTIONS, "output", path)
    header = _header(metadata, path)
    sizes = (source.shape[-1], target.shape[-1])
    if header and (header.observation_size, header.action_size) != sizes:
        raise PolicyFileError(
            f"{path}: the graph maps {sizes[0]} to {sizes[1]} numbers, its header "
            f"says {header.observation_size} to {header.action_size}"
        )
    policy = OnnxPolicy(
        session, *sizes, _rows(source, time, states, path), header, source, target.name, time,
        states, dict(metadata),
    )  # fmt: skip
    rows = policy.batch_size or 1
    start = [np.repeat(m[None], rows, axis=0) for m in policy.initial_memory]
    try:
        policy.step(np.zeros((rows, sizes[0]), np.float32), np.zeros(rows), start)
    except ValueError as error:
        raise PolicyFileError(f"{path}: tried on zeros: {error}") from error
    return policy


def _open(path: Path) -> onnxruntime.InferenceSession:
    import onnxruntime

    files.check_readable(path, "an ONNX policy")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's own errors share no other base class
        raise PolicyFileError(f"{path} is not a readable ONNX graph: {error}") from error


def _header(metadata: Mapping[str, str], path: Path) -> PolicyHeader | None:
    try:
        return (
            PolicyHeader.from_json(metadata[METADATA_KEY]) if metadata.get(METADATA_KEY) else None
        )
    except PolicyFileError as error:
        raise PolicyFileError(f"{path}: {error}") from error


def _actions(outputs: list[Any]) -> list[Any]:
    """Return what may be the action: the output so named, else the first one."""
    named = [value for value in outputs if value.name.lower() in ACTIONS]
    return named[:1] or outputs


def _rows(source: Any, time: Any, states: Sequence[State], path: Path) -> int | None:
    """Return how many rows a graph takes at once, None for any number."""
    first = 1 if len(source.shape) == 1 else source.shape[0]
    rows = first if isinstance(first, int) else None
    if any(state.axis is None for state in states):
        rows = rows or 1
    if time is not None and (not time.shape or time.shape[0] == 1):
        rows = rows or 1
    if states and rows not in (None, 1):
        raise PolicyFileError(
            f"{path}: it takes {rows} worlds at once and keeps a memory for each: export it for 1"
            " world or for any number"
        )
    return rows


def read_header(path: str | Path) -> PolicyHeader | None:
    """Return what an ONNX file says about its policy; None for a graph of other origin.

    Raises:
        PolicyFileError: no readable graph, or a header that cannot be.
    """
    return _header(_open(Path(path)).get_modelmeta().custom_metadata_map, Path(path))
