"""Worlds: the bare physics replays what the environment did; rows, headline, time limit."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from twirl_mjx.bench import worlds
from twirl_mjx.bench.worlds import WorldsBench
from twirl_mjx.worlds.make import make


@pytest.fixture(autouse=True)
def few_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """So few that random actions have not ended every episode."""
    monkeypatch.setattr(worlds, "STEPS", 4)


def check_bare_physics(engine: str, error: float) -> None:
    """Assert that the bare engine ends where the environment ended, in worlds not restarted."""
    env = make("stand", num_envs=2, engine=engine)
    state = jax.jit(env.reset)(jax.random.key(0))
    (after, _), targets = jax.jit(lambda s: worlds.random_steps(env, s))((state, jax.random.key(1)))
    going = np.asarray(after.world.episode_step) == worlds.STEPS
    assert going.any()
    bare = (worlds.bare_mjx if engine == "mjx" else worlds.bare_native)(env, state.data, targets)()
    qpos = bare[:, 1:20] if engine == "native" else bare.qpos  # type: ignore[attr-defined, index]
    moved = np.abs(np.asarray(after.data.qpos) - np.asarray(state.data.qpos))[going]
    assert moved.max() > 0.1
    np.testing.assert_allclose(
        np.asarray(qpos)[going], np.asarray(after.data.qpos)[going], atol=error
    )


@pytest.mark.slow
def test_bare_native_physics_is_that_of_the_environment() -> None:
    """The environment rounds states to float32 after every control step."""
    check_bare_physics("native", 1e-4)


@pytest.mark.slow
def test_bare_mjx_physics_is_that_of_the_environment() -> None:
    check_bare_physics("mjx", 1e-3)


def row(engine: str, num_envs: int, rate: float) -> dict[str, Any]:
    return {"engine": engine, "num_envs": num_envs, "control_steps_per_s": rate}


def test_headline_is_the_default_engine_at_128_worlds() -> None:
    rows = [row("mjx", 128, 1.0), row("native", 16, 2.0), row("native", 128, 3.0)]
    assert worlds.headline(rows, WorldsBench()) == rows[2]
    assert worlds.headline(rows[:2], WorldsBench()) == rows[1]
    assert worlds.headline(rows[:1], WorldsBench()) == rows[0]
    assert worlds.headline([], WorldsBench())["control_steps_per_s"] is None


def test_rows_are_sorted_compared_and_json(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def measured(task: str, engine: str, num_envs: int, seconds: float) -> dict[str, Any]:
        asked.append((engine, num_envs))
        return row(engine, num_envs, num_envs * {"mjx": 1.0, "native": 4.0}[engine])

    monkeypatch.setattr(worlds, "measure_row", measured)
    found = worlds.measure(WorldsBench(num_envs=(16, 128)))
    assert asked == [("native", 128), ("native", 16), ("mjx", 128), ("mjx", 16)]
    order = [(r["engine"], r["num_envs"]) for r in found["rows"]]
    assert order == [("mjx", 16), ("mjx", 128), ("native", 16), ("native", 128)]
    assert found["native_over_mjx"] == {"16": 4.0, "128": 4.0}
    assert (found["engine"], found["num_envs"], found["control_steps_per_s"]) == (
        "native", 128, 512.0,
    )  # fmt: skip
    assert json.loads(json.dumps(found, allow_nan=False)) == found


def test_rows_after_the_limit_are_left_out_with_a_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worlds, "measure_row", None)
    found = worlds.measure(WorldsBench(limit=0.0, engine="mjx", num_envs=(1, 16)))
    assert found["rows"] == []
    assert [s["num_envs"] for s in found["skipped"]] == [1, 16]
    assert "--limit" in found["skipped"][0]["reason"]


def test_rows_are_kept_for_a_caller_that_ends_the_measurement(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def measured(task: str, engine: str, num_envs: int, seconds: float) -> dict[str, Any]:
        if num_envs == 16:
            raise KeyboardInterrupt
        return row(engine, num_envs, 512.0)

    monkeypatch.setattr(worlds, "measure_row", measured)
    kept = tmp_path / "kept.json"
    with pytest.raises(KeyboardInterrupt):
        worlds.measure(WorldsBench(engine="native", num_envs=(1, 16, 128), keep=kept))
    record = json.loads(kept.read_text())
    assert [(r["engine"], r["num_envs"]) for r in record["rows"]] == [
        ("native", 1), ("native", 128),
    ]  # fmt: skip
    assert [(r["num_envs"], r["reason"]) for r in record["skipped"]] == [
        (16, "not done when the part was stopped")
    ]
    assert record["control_steps_per_s"] == 512.0


def test_missing_envpool_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worlds.importlib.util, "find_spec", lambda name: None)
    assert worlds.envpool_rate(4, 0.1) == (None, "envpool is not installed")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"task": "stnad"}, "nearest: 'stand'"),
        ({"num_envs": ()}, "at least one"),
        ({"num_envs": (16, 0)}, "num_envs = 0"),
    ],
)
def test_bad_options_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        WorldsBench(**changes)
