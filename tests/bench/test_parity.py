"""Parity of machines: errors are relative and finite, and the numbers tell a change."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from twirl_mjx.bench import parity


def test_errors_are_relative_and_what_is_missing_is_infinite() -> None:
    want = {
        "learner.critic": np.array([3.0, 4.0]),
        "epoch.episodes": np.array([np.nan, 1.0]),
        "learner.gone": np.zeros(2),
        "mjx.shape": np.zeros(2),
        "mjx.nan": np.ones((1, 3)),
    }
    found = {
        "learner.critic": np.array([3.0, 4.5]),
        "epoch.episodes": np.array([np.nan, 1.0]),
        "mjx.shape": np.zeros(3),
        "mjx.nan": np.array([[1.0, np.nan, 1.0]]),
        "mjx.new": np.zeros(1),
    }
    errors = parity.errors(found, want)
    assert errors["learner.critic"] == pytest.approx(0.1)
    assert errors["epoch.episodes"] == 0.0
    for name in ("learner.gone", "mjx.shape", "mjx.nan", "mjx.new"):
        assert errors[name] == float("inf")
    told = parity.failures(errors)
    assert [line.split(":")[0] for line in told] == [
        "learner.critic", "learner.gone", "mjx.shape", "mjx.nan", "mjx.new",
    ]  # fmt: skip
    assert told[0] == "learner.critic: 1.0e-01 > 1e-03"


def test_physics_is_judged_by_the_median_world() -> None:
    """One of three worlds may part from its twin, as contacts do; two may not."""
    want = np.arange(1.0, 13.0).reshape(2, 3, 2)
    found = want.copy()
    found[:, 1] *= 2.0
    assert parity.errors({"mjx.qvel": found}, {"mjx.qvel": want})["mjx.qvel"] == 0.0
    found[:, 2] *= 1.5
    assert parity.errors({"mjx.qvel": found}, {"mjx.qvel": want})["mjx.qvel"] == pytest.approx(0.5)


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
