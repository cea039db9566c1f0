"""Parity of machines: errors are relative and finite, and the numbers tell a change."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from twirl_mjx.bench import parity


def test_errors_are_relative_and_what_is_missing_is_infinite() -> None:
    want = {
        "native.qpos": np.array([3.0, 4.0]),
        "epoch.episodes": np.array([np.nan, 1.0]),
        "learner.gone": np.zeros(2),
        "mjx.shape": np.zeros(2),
        "mjx.nan": np.ones(2),
    }
    found = {
        "native.qpos": np.array([3.0, 4.5]),
        "epoch.episodes": np.array([np.nan, 1.0]),
        "mjx.shape": np.zeros(3),
        "mjx.nan": np.array([1.0, np.nan]),
        "mjx.new": np.zeros(1),
    }
    errors = parity.errors(found, want)
    assert errors["native.qpos"] == pytest.approx(0.1)
    assert errors["epoch.episodes"] == 0.0
    for name in ("learner.gone", "mjx.shape", "mjx.nan", "mjx.new"):
        assert errors[name] == float("inf")
    told = parity.failures(errors)
    assert [line.split(":")[0] for line in told] == [
        "native.qpos", "learner.gone", "mjx.shape", "mjx.nan", "mjx.new",
    ]  # fmt: skip
    assert told[0] == "native.qpos: 1.0e-01 > 1e-04"


def test_a_command_that_fails_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # where ``python -m`` looks first
    environment = {"JAX_PLATFORMS": "cpu", "PYTHONPATH": str(tmp_path)}
    (tmp_path / "twirl_mjx").mkdir()
    (tmp_path / "twirl_mjx" / "__init__.py").write_text("raise SystemExit('no such device')")
    with pytest.raises(RuntimeError, match="no such device"):
        parity.write(tmp_path / "x.npz", environment)


@pytest.mark.slow
def test_learner_numbers_move_and_are_complete() -> None:
    found = parity.learner_numbers()
    for form in ("plain", "fast", "accelerator", "kernels"):
        assert np.linalg.norm(found[f"learner.{form}.critic"]) > 1e-3
        assert np.isfinite(found[f"learner.{form}.critic_loss"])
    assert parity.errors(found, found) == dict.fromkeys(found, 0.0)


@pytest.mark.slow
def test_the_command_gives_the_numbers_of_this_process(tmp_path: Path) -> None:
    written = parity.write(tmp_path / "x.npz", {"PYTHONPATH": os.getcwd()})
    found = parity.numbers()
    assert set(found) == set(written)
    assert not parity.failures(parity.errors(found, written))
    changed = found | {"native.qpos": found["native.qpos"] * 1.001}
    assert parity.failures(parity.errors(changed, written))
