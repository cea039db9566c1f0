"""Learned policies as single files: save, load and act with numpy alone.

A policy file is an ``.npz`` archive with the actor's arrays, named ``hidden_0/kernel`` ... as in
the actor's parameter tree, and one JSON text named ``header``. Nothing in it is pickled, and
loading imports neither jax nor a simulator, so a file runs on a robot's computer as it is.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from twirl_mjx import array_files, files
from twirl_mjx.checks import one_line

if TYPE_CHECKING:
    from twirl_mjx.policies.onnx_file import OnnxPolicy

FORMAT = "twirl_mjx policy"
FORMAT_VERSION = 1
BEST_POLICY = "policy.npz"
LAST_POLICY = "policy_last.npz"
LIMIT = 1 << 30
"""Bytes, largest policy that is read; the paper's networks have half a million."""

Params = dict[str, dict[str, np.ndarray]]
"""Actor parameters: layer name to ``kernel`` [in, out] and ``bias`` [out]."""


class PolicyFileError(ValueError):
    """A file that is not a readable policy; the message says why."""


@dataclasses.dataclass(frozen=True)
class PolicyHeader:
    """What a policy file says about itself."""

    task: str
    """Name of the task the policy was trained for."""
    observation_size: int
    """O, length of the observation vector."""
    action_size: int
    """A, length of the action vector."""
    control_dt: float
    """Control period in s."""
    observation_layout: tuple[tuple[str, int, int, str], ...] = ()
    """Rows (name, start, stop, unit) that cover [0, O) in order; empty when unknown."""
    config_digest: str = ""
    """Digest of the resolved configuration of the training run."""
    versions: dict[str, str] = dataclasses.field(default_factory=dict)
    """Package name to version at training time."""
    card: dict[str, Any] = dataclasses.field(default_factory=dict)
    """Free-form facts: seed, transitions, wall time, evaluation table."""
    format_version: int = FORMAT_VERSION
    """Version of the file format."""

    def __post_init__(self) -> None:
        """Check sizes, version and the layout."""
        if self.format_version != FORMAT_VERSION:
            raise PolicyFileError(
                f"policy format version {self.format_version} is not supported; this program reads "
                f"version {FORMAT_VERSION}: export the policy again with a matching version"
            )
        for name in ("observation_size", "action_size"):
            if getattr(self, name) < 1:
                raise PolicyFileError(f"{name} must be at least 1, got {getattr(self, name)}")
        if not self.control_dt > 0.0:
            raise PolicyFileError(f"control_dt must be positive (s), got {self.control_dt}")
        if not isinstance(self.card, dict):
            raise PolicyFileError(f"the card must be a JSON object, got {self.card!r}")
        rows = tuple((str(n), int(a), int(b), str(u)) for n, a, b, u in self.observation_layout)
        object.__setattr__(self, "observation_layout", rows)
        end = 0
        for name, start, stop, _ in rows:
            if start != end or stop <= start:
                raise PolicyFileError(
                    f"observation layout has a gap or overlap: {name!r} is [{start}, {stop}), "
                    f"expected to start at {end}"
                )
            end = stop
        if rows and end != self.observation_size:
            raise PolicyFileError(
                f"observation layout covers [0, {end}), but the size is {self.observation_size}"
            )

    def to_json(self) -> str:
        """Return the header as JSON text, keys sorted."""
        record = {"format": FORMAT, **dataclasses.asdict(self)}
        return json.dumps(record, sort_keys=True, allow_nan=False)

    @classmethod
    def from_json(cls, text: str) -> PolicyHeader:
        """Parse JSON text written by ``to_json``.

        Raises:
            PolicyFileError: if the text is not such a header.
        """
        try:
            record = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise PolicyFileError(f"the header is not JSON: {error}") from error
        if not isinstance(record, dict) or record.pop("format", None) != FORMAT:
            raise PolicyFileError(f"the header is not marked as {FORMAT!r}")
        version = record.get("format_version")
        if version != FORMAT_VERSION:
            raise PolicyFileError(
                f"policy format version {version} is not supported; this program reads version "
                f"{FORMAT_VERSION}"
            )
        try:
            return cls(**record)
        except PolicyFileError:
            raise
        except (TypeError, ValueError, OverflowError) as error:
            raise PolicyFileError(f"the header has wrong fields: {one_line(error)}") from error

    def component(self, index: int) -> str:
        """Name observation component ``index``, for example ``joint_pos[3] (rad)``."""
        for name, start, stop, unit in self.observation_layout:
            if start <= index < stop:
                return f"{name}[{index - start}] ({unit})"
        return f"component {index}"


def _as_params(actor_params: Mapping[str, Mapping[str, Any]]) -> Params:
    """Copy a parameter tree to contiguous float32 numpy arrays; what is too large becomes infinite.

    Raises:
        PolicyFileError: naming the first array that holds no real numbers.
    """
    for layer, arrays in actor_params.items():
        for name, value in arrays.items():
            if (kind := np.asarray(value).dtype).kind in "cUSOmM":
                raise PolicyFileError(f"{layer}/{name} is of type {kind}, need real numbers")
    with np.errstate(over="ignore"):
        return {
            layer: {name: np.ascontiguousarray(value, np.float32) for name, value in arrays.items()}
            for layer, arrays in actor_params.items()
        }


def hidden_layers(params: Mapping[str, Any]) -> list[str]:
    """Return the hidden layer names ``hidden_0 ... hidden_{n-1}`` present in ``params``."""
    names = []
    while f"hidden_{len(names)}" in params:
        names.append(f"hidden_{len(names)}")
    return names


def check_params(params: Params, observation_size: int, action_size: int) -> None:
    """Check names, shapes and values of an actor.

    Args:
        params: actor parameters.
        observation_size: O.
        action_size: A.

    Raises:
        PolicyFileError: naming the first array that does not fit.
    """
    hidden = hidden_layers(params)
    expected = {*hidden, "mean", "log_std"}
    if set(params) != expected:
        raise PolicyFileError(
            f"actor layers are {sorted(params)}, expected hidden_0 ... hidden_n, mean and log_std"
        )
    size = observation_size
    for layer in [*hidden, "mean", "log_std"]:
        arrays = params[layer]
        if set(arrays) != {"kernel", "bias"}:
            raise PolicyFileError(f"{layer} holds {sorted(arrays)}, expected bias and kernel")
        kernel, bias = arrays["kernel"], arrays["bias"]
        out = bias.shape[0] if layer in hidden and bias.ndim == 1 else action_size
        if kernel.shape != (size, out) or bias.shape != (out,):
            raise PolicyFileError(
                f"{layer}: kernel {kernel.shape} and bias {bias.shape} do not fit "
                f"({size}, {out}) and ({out},)"
            )
        for name, value in arrays.items():
            if not np.isfinite(value).all():
                raise PolicyFileError(f"{layer}/{name} holds a value that is not finite")
        size = out if layer in hidden else size


def check_observation(obs: Any, size: int, header: PolicyHeader | None) -> np.ndarray:
    """Return ``obs`` [..., O] as float32, or say what is wrong with it.

    Raises:
        ValueError: wrong last axis or a value that is not finite, named by the layout.
    """
    array = np.asarray(obs, np.float32)
    if array.ndim == 0 or array.shape[-1] != size:
        task = f" of task {header.task!r}" if header else ""
        raise ValueError(f"observation has shape {array.shape}, expected [..., {size}]{task}")
    bad = np.argwhere(~np.isfinite(array))
    if len(bad):
        where = tuple(int(i) for i in bad[0])
        name = header.component(where[-1]) if header else f"component {where[-1]}"
        raise ValueError(f"observation{list(where)} is {array[where]}: {name} is not finite")
    return array


@dataclasses.dataclass(frozen=True)
class NumpyPolicy:
    """The deterministic actor, tanh of the mean, in numpy."""

    header: PolicyHeader
    """What the file says about the policy."""
    actor_params: Params
    """Actor parameters, float32 (includes ``log_std`` so that training can start from them)."""

    @property
    def observation_size(self) -> int:
        """O."""
        return self.header.observation_size

    @property
    def action_size(self) -> int:
        """A."""
        return self.header.action_size

    def act(self, obs: Any) -> np.ndarray:
        """Return the mean action.

        Args:
            obs: [O] or [N, O] (any leading axes), finite.

        Returns:
            [A] or [N, A] float32 in [-1, 1].

        Raises:
            ValueError: wrong size or a value that is not finite.
        """
        x = check_observation(obs, self.observation_size, self.header)
        for layer in hidden_layers(self.actor_params):
            x = np.maximum(x @ self.actor_params[layer]["kernel"] + self._bias(layer), 0.0)
        return np.tanh(x @ self.actor_params["mean"]["kernel"] + self._bias("mean"))

    def _bias(self, layer: str) -> np.ndarray:
        return self.actor_params[layer]["bias"]


def save_policy(
    path: str | Path, actor_params: Mapping[str, Mapping[str, Any]], header: PolicyHeader
) -> Path:
    """Write a policy file, whole or not at all; equal inputs give equal bytes.

    Args:
        path: target, ending in ``.npz``.
        actor_params: actor parameters with the fixed layer names.
        header: description; its sizes must fit the parameters.

    Returns:
        The path written.

    Raises:
        PolicyFileError: wrong suffix, or parameters that do not fit the header.
    """
    path = Path(path)
    if path.suffix != ".npz":
        raise PolicyFileError(f"{path}: a policy file ends in .npz, got {path.suffix!r}")
    params = _as_params(actor_params)
    check_params(params, header.observation_size, header.action_size)
    arrays = {f"{la}/{n}": v for la, values in params.items() for n, v in sorted(values.items())}
    array_files.write_npz(path, {"header": np.array(header.to_json())} | arrays, compressed=True)
    return path


def _read_npz(path: Path) -> NumpyPolicy:
    """Read one policy file; every failure becomes a ``PolicyFileError`` with the reason."""
    try:
        arrays = array_files.read_npz(path, "a policy", LIMIT)
    except files.FileError as error:
        raise PolicyFileError(str(error)) from error
    text = arrays.pop("header", None)
    if text is None or text.dtype.kind != "U":
        raise PolicyFileError(f"{path} is not a policy: no header among {sorted(arrays)[:8]}")
    params: Params = {}
    for name, value in arrays.items():
        layer, _, kind = name.partition("/")
        params.setdefault(layer, {})[kind] = value
    try:
        header = PolicyHeader.from_json(str(text))
        params = _as_params(params)
        check_params(params, header.observation_size, header.action_size)
    except (TypeError, ValueError) as error:
        raise PolicyFileError(f"{path}: {error}") from error
    return NumpyPolicy(header, params)


def resolve_policy_path(path: str | Path) -> Path:
    """Turn a policy file or a run directory into the policy file to read.

    Raises:
        FileNotFoundError: nothing to load there; the message lists what is and how to make it.
    """
    path = Path(path)
    if path.exists() and not path.is_dir():
        return path
    if not path.exists():
        raise FileNotFoundError(
            f"no policy at {path}: give a policy file (.npz or .onnx) or a run directory that "
            f"holds {BEST_POLICY}; `twirl train` makes one"
        )
    best = path / BEST_POLICY
    if best.is_file():
        return best
    present = sorted(p.name for p in path.iterdir()) or ["nothing"]
    hint = (
        f"its last policy is {path / LAST_POLICY}, name that file to use it"
        if (path / LAST_POLICY).is_file()
        else "train it (the same `twirl train` command resumes the run)"
    )
    raise FileNotFoundError(
        f"run directory {path} has no {BEST_POLICY} (the best policy, written by the first "
        f"evaluation); it holds {', '.join(present[:12])}; {hint}"
    )


def load_policy(path: str | Path) -> NumpyPolicy | OnnxPolicy:
    """Load a policy to act with: ``policy.act(obs) -> action``.

    Args:
        path: a policy file (``.npz``), an ``.onnx`` file, or a run directory (its best policy).

    Returns:
        A ``NumpyPolicy``, or an ``OnnxPolicy`` for an ``.onnx`` file.

    Raises:
        FileNotFoundError: nothing to load there.
        PolicyFileError: the file is no policy, with the reason.
    """
    file = resolve_policy_path(path)
    if file.suffix == ".npz":
        return _read_npz(file)
    if file.suffix == ".onnx":
        from twirl_mjx.policies.onnx_file import load_onnx

        return load_onnx(file)
    raise PolicyFileError(f"{file}: a policy file ends in .npz or .onnx, got {file.suffix!r}")
