"""Settings and helpers of all tests: CPU only, a compilation cache, id-coded transitions."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

# These are read when jax and matplotlib are first imported, and are inherited by the processes
# that tests start, so they have to stand above every other import.
os.environ["JAX_PLATFORMS"] = os.environ.get("TWIRL_TEST_PLATFORMS", "cpu")
os.environ["MPLBACKEND"] = "Agg"
# Programs that run for a second are not worth half a minute of LLVM's optimisation: compiling
# `train_epoch` of the debug preset takes 12 s of processor time instead of 31.
_LEVEL = "--xla_backend_optimization_level=0"
os.environ["XLA_FLAGS"] = f"{_LEVEL} {os.environ.get('XLA_FLAGS', '')}".strip()
_CACHE = os.environ.get("TWIRL_CACHE_DIR", str(Path.home() / ".cache" / "twirl_mjx" / "jax"))
if _CACHE != "off":  # the same place and rule as the command line's
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", _CACHE)
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.5")

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from twirl_mjx.training import source_rules
from twirl_mjx.types import Transition


class TraceCounter:
    """Wraps a function and counts how often its Python body runs, that is: how often it is traced.

    Use as ``counter = TraceCounter(step); jitted = jax.jit(counter)``, call ``jitted`` several
    times, then assert ``counter.traces == 1``.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function = function
        self.traces = 0

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        self.traces += 1
        return self.function(*args, **kwargs)


@pytest.fixture
def no_shipped_policies(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let sources be found as if ``assets/policies`` were empty."""

    def missing(*parts: str) -> Path:
        raise FileNotFoundError(parts)

    monkeypatch.setattr(source_rules, "asset_path", missing)


@pytest.fixture
def count_traces() -> type[TraceCounter]:
    """The wrapper above; a fixture because test modules cannot import each other."""
    return TraceCounter


def coded_transitions(ids: Any, *, obs_size: int = 3, action_size: int = 2) -> Transition:
    """Make transitions in which every field tells the id of its row.

    Args:
        ids: [...] whole numbers below 2**20.
        obs_size: O.
        action_size: A.

    Returns:
        Transitions with leading shape [...]: ``reward = id``, ``obs = id + column / 8``,
        ``action = -id - column / 8``, ``next_obs = obs + 0.5``, ``terminated`` for odd ids. All
        values are exact in float32.
    """
    ids = np.asarray(ids)
    if ids.size and not 0 <= ids.min() <= ids.max() < 2**20:
        raise ValueError(f"ids must lie in [0, {2**20}), got {ids.min()} to {ids.max()}")
    row = ids.astype(np.float32)[..., None]
    obs = row + np.arange(obs_size, dtype=np.float32) / 8
    return Transition(
        obs=jnp.asarray(obs),
        action=jnp.asarray(-row - np.arange(action_size, dtype=np.float32) / 8),
        reward=jnp.asarray(row[..., 0]),
        terminated=jnp.asarray(ids % 2 == 1),
        next_obs=jnp.asarray(obs + 0.5),
    )


def decoded_ids(transitions: Transition) -> np.ndarray:
    """Return the ids [...] of coded transitions, after checking that all fields agree on them."""
    ids = np.asarray(transitions.reward).astype(np.int64)
    expected = coded_transitions(
        ids, obs_size=transitions.obs.shape[-1], action_size=transitions.action.shape[-1]
    )
    for (path, want), have in zip(
        jax.tree_util.tree_leaves_with_path(expected), jax.tree.leaves(transitions), strict=True
    ):
        np.testing.assert_array_equal(have, want, err_msg=jax.tree_util.keystr(path))
    return ids


@pytest.fixture
def transition_code() -> tuple[Callable[..., Transition], Callable[[Transition], np.ndarray]]:
    """The pair ``coded_transitions``, ``decoded_ids``."""
    return coded_transitions, decoded_ids
