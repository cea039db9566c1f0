"""``twirl rehearse``: any source, a table, CSV, JSON, a film, and refusals before anything runs."""

from __future__ import annotations

import csv
import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from twirl_mjx import files
from twirl_mjx.assets import asset_path
from twirl_mjx.commands import rehearse as command
from twirl_mjx.deploy import render
from twirl_mjx.deploy.conditions import RehearsalConfig
from twirl_mjx.deploy.ground import build_model
from twirl_mjx.deploy.rehearsal import rehearse
from twirl_mjx.policies.scripted import TROT, action_table
from twirl_mjx.sim.robots import A1

SHORT = ["--robot.episode-s", "0.4", "--robot.sim-dt", "0.005"]
QUICK = RehearsalConfig(episode_s=0.4, sim_dt=0.005)


def run(*words: str) -> int:
    return command.main([*words, *SHORT], lambda draws: None)


def test_table_csv_and_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    policy = str(asset_path("policies", "biped.npz"))
    for name in ("r.csv", "r.json"):
        settings = ["--setting", "latency_ms=15"] if name == "r.csv" else []
        words = [f"walker={policy}", "--episodes", "3", *settings, "--out", str(tmp_path / name)]
        assert run(*words) == 0
    printed = capsys.readouterr().out
    assert "3 episodes" in printed
    assert "95 % from" in printed
    notes, *lines = (tmp_path / "r.csv").read_text().splitlines()
    assert notes.startswith("# command: .venv/bin/twirl rehearse walker=")
    rows = list(csv.DictReader(lines))
    assert {row["episode"] for row in rows} == {"0", "1", "2"}
    assert {(row["run"], row["variant"], row["latency_ms"]) for row in rows} == {
        ("walker", "twirl+weights", "15")
    }
    assert {"success", "fall", "standing_time"} <= {row["metric"] for row in rows}
    power = [float(row["value"]) for row in rows if row["metric"] == "mean_power"]
    record = json.loads((tmp_path / "r.json").read_text())
    line = next(row for row in record["table"] if row["metric"] == "mean_power")
    assert line["mean"] == pytest.approx(np.mean(power), rel=1e-6)
    assert min(power) - 1e-3 <= line["low"] < line["mean"] < line["high"] <= max(power) + 1e-3
    assert len(record["episodes"]) == 3
    assert record["robot"]["latency_ms"] == 15.0


class NumpyTrot:
    """The trot as the deployable policy of somebody else: numpy, and a clock."""

    def reset(self) -> None:
        self.clock = 0

    def act(self, obs: np.ndarray) -> np.ndarray:
        fade = min(self.clock / TROT.ramp_steps, 1.0)
        self.clock += 1
        return action_table(TROT, A1)[(self.clock - 1) % TROT.period_steps] * fade


def test_a_scripted_source_does_what_a_numpy_policy_does() -> None:
    named = rehearse("trot", task="hurdles", episodes=1, config=QUICK).episodes[0]
    numpy = rehearse(NumpyTrot(), task="hurdles", episodes=1, config=QUICK).episodes[0]
    np.testing.assert_allclose(named.actions, numpy.actions, atol=1e-6)
    np.testing.assert_allclose(named.qpos, numpy.qpos, atol=1e-4)
    noise = rehearse("random", task="hurdles", episodes=1, config=QUICK).episodes[0].actions
    assert np.ptp(noise, axis=0).min() > 0.1


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["zero"], "does not name its task: give --task|does not name its task: give one"),
        (["zero", "--task", "biped", "--out", "r.txt"], r"need \.json or \.csv \(nearest: r\.csv"),
        (["zero", "--task", "biped", "--film", "r.gif"], r"is no \.mp4 \(nearest: r\.mp4"),
        (["zero", "--task", "biped", "--dynamics.friction", "0.3"], "nearest: --robot.friction"),
        (["zero", "--task", "biped", "--biped.goal-speed", "0.1"], "nearest: --robot.goal-speed"),
        (["zero", "--task", "hurdles", "--hurdles.gap", "2.4"], "nearest: --robot.hurdle-gap"),
        (
            ["zero", "--task", "hurdles", "--hurdles.min-gap", "2"],
            "has its own .nearest: without it",
        ),
        (["zero", "--task", "biped", "--source-contract", "go1_joystick"], "would do nothing"),
        (["zero", "--task", "jump"], "jump"),
    ],
)
def test_refusals(words: list[str], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        run(*words)


def test_nothing_of_others_is_replaced(tmp_path: Path) -> None:
    for name in ("mine.csv", "mine.json"):
        path = tmp_path / name
        path.write_text("episode,value\n1,2\n")
        with pytest.raises(files.FileError, match=r"not written by this command.*mine-2\."):
            run("zero", "--task", "biped", "--out", str(path))
        assert path.read_text() == "episode,value\n1,2\n"
        again = ["zero", "--task", "biped", "--episodes", "1", "--out", str(path)]
        assert run(*again, "--overwrite") == 0
        assert run(*again) == 0
    with pytest.raises(files.FileError, match="not written by this command"):
        (tmp_path / "f.mp4").write_bytes(b"holiday")
        run("zero", "--task", "biped", "--film", str(tmp_path / "f.mp4"))


def test_a_film_of_the_first_episode(tmp_path: Path) -> None:
    film = tmp_path / "hurdles.mp4"
    words = ["zero", "--task", "hurdles", "--episodes", "1", "--film", str(film)]
    assert run(*words) == 0
    files.check_ours(film)
    files.check_ours(film.with_suffix(".png"))


def test_a_film_shows_the_ground_that_was_rehearsed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown = []
    monkeypatch.setattr(render, "render_episode", lambda model, *_, **__: shown.append(model))
    conditions = RehearsalConfig(incline_deg=8.0, episode_s=0.2)
    flat = dataclasses.replace(conditions, incline_deg=0.0)
    for config in (conditions, flat):
        result = rehearse("zero", task="hurdles", episodes=1, config=config)
        command.film(tmp_path / "a.mp4", result)
        rehearsed = build_model(config, result.episodes[0].hurdles)
        ground = [model.geom_bodyid == 0 for model in (rehearsed, shown[-1])]
        assert shown[-1].geom("hurdle_0").pos == pytest.approx(rehearsed.geom("hurdle_0").pos)
        assert shown[-1].geom_quat[ground[1]][0] == pytest.approx(rehearsed.geom_quat[ground[0]][0])
    assert shown[0].geom("hurdle_0").quat[2] != 0.0 and shown[1].geom("hurdle_0").quat[2] == 0.0


def test_recorded_data_do_not_act(tmp_path: Path) -> None:
    np.savez(tmp_path / "d.npz", obs=np.zeros((2, 101)), action=np.zeros((2, 12)))
    with pytest.raises(ValueError, match=r"d\.npz"):
        rehearse(str(tmp_path / "d.npz"), task="biped")
