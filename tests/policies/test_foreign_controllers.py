"""Foreign controllers as proof: a joystick trot, a recurrent policy and a motion tracker act."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from twirl_mjx.deploy.conditions import IDEAL, RehearsalConfig
from twirl_mjx.deploy.rehearsal import rehearse
from twirl_mjx.policies.ready import GO1_JOYSTICK
from twirl_mjx.policies.resolve import Terms, resolve_policy
from twirl_mjx.sim.robots import A1
from twirl_mjx.training.presets import make_config
from twirl_mjx.training.source import Collector
from twirl_mjx.worlds.make import make_env

KEY = jax.random.key(0)
CALM = dataclasses.replace(IDEAL, episode_s=4.0, sim_dt=0.005, hurdle_gap=10.0)
QUICK = RehearsalConfig(episode_s=0.4, sim_dt=0.005)


@pytest.mark.slow
@pytest.mark.parametrize("task", ["biped", "hurdles"])
def test_the_joystick_trot_becomes_source_data(
    task: str, graphs: SimpleNamespace, tmp_path: Path
) -> None:
    """48 inputs, one row at a time; every action is one of the gait's eight."""
    path = graphs.trot(tmp_path / "a1.onnx")
    config = dataclasses.replace(make_config(task, "debug").evaluation, engine="native")
    source = resolve_policy(str(path), config, terms=Terms("legged_gym_48", "0.7,0,0"))
    data, means = Collector(make_env(config, num_envs=2), source.policy)(KEY, 60, max_clipped=0.2)
    assert data.obs.shape == (60, {"biped": 101, "hurdles": 95}[task])
    assert "clipped" not in means
    assert "20 Hz" in source.notes[1]
    expected = (graphs.teacher(0.7, 0.0, 0.0) - A1.default_pose) / A1.action_half_range
    late = data.action[20:40].reshape(-1, 12)  # steps 10 to 19 of both worlds
    apart = np.abs(late[:, None] - expected[None]).max(axis=2)
    assert apart.min(axis=1).max() < 0.2
    assert set(apart.argmin(axis=1)) == set(range(8))


@pytest.mark.slow
@pytest.mark.parametrize("task", ["biped", "hurdles"])
def test_the_joystick_obeys(task: str, graphs: SimpleNamespace, tmp_path: Path) -> None:
    """In C MuJoCo: forward as fast as told, turning as told, standing when told to."""
    path = str(graphs.trot(tmp_path / "a1.onnx"))

    def drive(command: str) -> np.ndarray:
        terms = Terms("legged_gym_48", command)
        found = rehearse(path, task=task, episodes=1, config=CALM, terms=terms, say=lambda _: None)
        assert found.episodes[0].cause == "time"
        return found.episodes[0].qpos

    def yaw(qpos: np.ndarray) -> float:
        w, x, y, z = qpos[-1, 3:7]
        return float(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))

    fast = drive("0.7,0,0")
    assert fast[-1, 0] / 4.0 > 0.4  # m/s
    if task == "biped":
        left, right, still = (drive(c) for c in ("0.5,0,0.5", "0.5,0,-0.5", "0,0,0"))
        assert yaw(left) > 0.5
        assert yaw(right) < -0.5
        assert np.abs(still[-1, :2]).max() < 0.1


@pytest.mark.parametrize("task", ["biped", "hurdles"])
def test_a_tracker_trots_and_a_recurrent_policy_acts(
    task: str, graphs: SimpleNamespace, tmp_path: Path
) -> None:
    terms = Terms("go1_joystick")
    tracker = str(graphs.tracker(tmp_path / "tracker.onnx", GO1_JOYSTICK))
    found = rehearse(tracker, task=task, episodes=1, config=CALM, terms=terms, say=lambda _: None)
    assert found.episodes[0].cause == "time"
    assert found.episodes[0].metrics["forward_speed"] > 0.3
    lstm = str(graphs.lstm(tmp_path / "lstm.onnx"))
    found = rehearse(lstm, task=task, episodes=2, config=QUICK, terms=terms, say=lambda _: None)
    first, second = (episode.actions for episode in found.episodes)
    assert np.ptp(first, axis=0).max() > 1e-3
    np.testing.assert_allclose(first[0], second[0], atol=0.05)  # the memory begins anew


def test_a_foreign_graph_is_shown_what_its_contract_says(
    graphs: SimpleNamespace, tmp_path: Path
) -> None:
    """Its outputs are its first inputs: velocity and rate of the base, as the sensors say."""
    weights = {"w": np.eye(48, 12, dtype=np.float32)}
    nodes = [graphs.node("MatMul", ["obs", "w"], ["actions"])]
    path = graphs.save(tmp_path / "f.onnx", nodes, {"obs": [1, 48]}, {"actions": [1, 12]}, weights)
    notes: list[str] = []
    found = rehearse(str(path), task="biped", episodes=1, config=QUICK,
                     terms=Terms("go1_joystick", "0.3,0,0"), say=notes.append)  # fmt: skip
    assert "contract go1_joystick: 48 inputs" in notes[0]
    episode = found.episodes[0]
    reading = episode.readings[3]
    shown = np.concatenate([reading.rotation.T @ reading.velocity, reading.angular_velocity])
    pose = np.array([0.1, 0.9, -1.8, -0.1, 0.9, -1.8])
    expected = (pose + 0.5 * shown - np.tile([0.0, 0.9, -1.8], 2)) / np.tile([0.6, 1.2, 1.2], 2)
    np.testing.assert_allclose(episode.actions[3][:6], np.clip(expected, -1, 1), atol=1e-4)
    assert episode.metrics["clipped"] < 0.05
