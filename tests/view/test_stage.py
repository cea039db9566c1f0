"""The loop behind the live page: what people do moves the robot, and nothing else does."""

from __future__ import annotations

import json
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from twirl_mjx.assets import asset_path
from twirl_mjx.deploy.conditions import IDEAL
from twirl_mjx.policies.learned import PolicyHeader, save_policy
from twirl_mjx.view import stage as module
from twirl_mjx.view.stage import DT, SLIDERS, Actor, Stage, play


def ticks(stage: Stage, seconds: float) -> list[dict[str, Any]]:
    return [stage.tick() for _ in range(round(seconds / DT))]


def trunk(frame: dict[str, Any]) -> np.ndarray:
    return np.array(frame["poses"][7:10])


def zero_policy(path: Path, task: str, size: int, bias: float = 0.0) -> Path:
    mean = {"kernel": np.zeros((size, 12)), "bias": np.full(12, bias)}
    card = {"env_steps": 1000 if bias == 0.0 else 2000}
    header = PolicyHeader(task, size, 12, 0.05, card=card)
    return save_policy(path, {"mean": mean, "log_std": mean}, header)


def test_a_push_moves_the_robot_the_way_it_points(still: Stage) -> None:
    before = trunk(ticks(still, 0.5)[-1])
    assert abs(before[1]) < 0.01
    still.do("push", [0.0, 60.0, 0.0])
    pushed = ticks(still, 0.2)
    assert [frame["force"] for frame in pushed] == [[0.0, 60.0, 0.0]] * 4
    after = ticks(still, 0.3)
    assert trunk(after[-1])[1] - before[1] > 0.015
    assert after[-1]["force"] == [0.0, 0.0, 0.0]


def test_a_pull_lasts_until_it_is_let_go(still: Stage) -> None:
    still.do("pull", [-30.0, 0.0, 0.0])
    assert ticks(still, 1.0)[-1]["force"] == [-30.0, 0.0, 0.0]
    still.do("pull", [0, 0, 0])
    assert still.tick()["force"] == [0.0, 0.0, 0.0]


def test_the_goal_moves_the_robot() -> None:
    ends = []
    for goal in ([0.8, 0.0], [-0.8, 0.0]):
        stage = Stage({"biped": Actor(asset_path("policies", "biped.npz"))}, config=IDEAL)
        stage.do("goal", goal)
        frames = ticks(stage, 4.0)
        assert frames[-1]["goal"] == [*goal, 0.0]
        assert frames[-1]["values"]["distance to goal (m)"] < 0.6
        ends.append(trunk(frames[-1])[0])
    assert ends[0] > 0.2 and ends[1] < -0.2


def test_a_goal_stays_where_it_was_put(still: Stage) -> None:
    still.do("goal", [2.0, -1.0])
    still.do("restart")
    assert still.tick()["goal"] == [2.0, -1.0, 0.0]


def test_conditions_act_on_the_running_episode(still: Stage) -> None:
    first = still.tick()
    still.do("gravity", 3.7)
    still.do("friction", 0.2)
    still.do("payload", 4.0)
    frame = still.tick()
    assert (frame["scene"], frame["time"]) == (first["scene"], 0.1)
    model = still._trial.model
    assert model.opt.gravity[2] == -3.7
    assert model.geom("floor").friction[0] == 0.2
    assert model.body("trunk").mass[0] == pytest.approx(8.713)
    assert model.body("trunk").subtreemass[0] == pytest.approx(12.453 + 4.0, abs=1e-3)
    assert frame["conditions"]["gravity"] == 3.7
    still.do("torque_limit", 1.0)
    still.do("friction", 1.0)
    assert trunk(ticks(still, 2.0)[-1])[2] < trunk(first)[2] - 0.02  # too weak to carry it


@pytest.mark.parametrize("slider", [s for s in SLIDERS if "biped" in s.tasks], ids=lambda s: s.name)
def test_every_slider_can_be_at_either_end(still: Stage, slider: module.Slider) -> None:
    for value in (slider.low, slider.high):
        still.do(slider.name, value)
        assert still.tick()["conditions"][slider.name] == value


def test_shifts_of_the_ground_begin_a_scene_of_their_own(still: Stage) -> None:
    scenes = [still.tick()["scene"]]
    for shift, kind in (("sloped", "plane"), ("bumpy", "hfield"), ("none", "plane")):
        still.do("shift", shift)
        frame = still.tick()
        ground = [g["type"] for g in still.scene()["geoms"] if g["body"] == 0]
        assert frame["shift"] == shift
        assert kind in ground
        assert len(ground) == (2 if shift == "sloped" else 1)
        scenes.append(frame["scene"])
    assert len(set(scenes)) == 4
    height = [abs(ticks(still, 0.5)[-1]["values"]["height (m)"] - 0.26) for _ in range(1)]
    assert max(height) < 0.05


def test_bumps_do_not_swallow_the_feet(still: Stage) -> None:
    still.do("shift", "bumpy")
    frame = ticks(still, 1.0)[-1]
    assert "fell" not in frame["status"]
    assert 0.2 < frame["values"]["height (m)"] < 0.35


def test_hurdles_have_their_own_sliders() -> None:
    stage = Stage({"hurdles": Actor(asset_path("policies", "hurdles.npz"))}, config=IDEAL)
    stage.do("hurdle_gap", 3.0)
    stage.do("hurdle_height", 0.05)
    frame = stage.tick()
    bands = [g for g in stage.scene()["geoms"] if g["type"] == "box" and g["body"] == 0]
    assert [band["pose"][0] for band in bands[:3]] == [3.0, 6.0, 9.0]
    assert bands[0]["size"] == [0.1, 20.0, 0.025]
    assert frame["goal"] == [3.0, 0.0, 0.0] and not frame["goalMoves"]
    with pytest.raises(ValueError, match="goal of task hurdles stays"):
        stage.do("goal", [1.0, 0.0])
    with pytest.raises(ValueError, match="bump_height does nothing in task hurdles"):
        stage.do("bump_height", 0.05)
    with pytest.raises(ValueError, match="unknown shift 'bumpy'"):
        stage.do("shift", "bumpy")


def test_pause_and_the_end_of_an_episode(still: Stage, tmp_path: Path) -> None:
    still.do("pause", True)
    assert {frame["time"] for frame in ticks(still, 0.3)} == {0.0}
    falling = zero_policy(tmp_path / "falls.npz", "stand", 101, bias=-9.0)
    stage = Stage({"falls": Actor(falling)}, config=IDEAL)
    frames = ticks(stage, 6.0)
    fallen = [i for i, frame in enumerate(frames) if "it fell" in frame["status"]]
    first = fallen[0]
    rest = round(module.REST_S / DT)
    assert fallen[:rest] == list(range(first, first + rest))
    assert frames[first + rest]["time"] == 0.0
    assert frames[first + rest]["scene"] == frames[first]["scene"] + 1


def test_a_policy_that_changes_on_disk_is_shown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "LOOK_S", 0.0)
    path, notes = zero_policy(tmp_path / "policy.npz", "biped", 101), []
    stage = Stage({"newest": Actor(path)}, config=IDEAL, note=notes.append)
    first = ticks(stage, 0.2)[-1]
    assert "1,000 transitions" in first["status"]
    zero_policy(path, "biped", 101, bias=0.1)
    frame = stage.tick()
    assert "2,000 transitions" in frame["status"]
    assert (frame["scene"], frame["time"]) == (first["scene"] + 1, DT)
    path.write_bytes(b"no policy")
    frame = stage.tick()
    assert frame["scene"] == first["scene"] + 1
    assert "policy.npz" in frame["status"] and len(notes) == 2
    path.unlink()
    assert stage.tick()["time"] == pytest.approx(3 * DT)


def test_policies_are_chosen_and_those_that_do_not_fit_refused(tmp_path: Path) -> None:
    odd = zero_policy(tmp_path / "odd.npz", "biped", 95)
    other = zero_policy(tmp_path / "other.npz", "walk", 101)
    good = zero_policy(tmp_path / "good.npz", "stand", 101)
    actors = {"good": Actor(good), "odd": Actor(odd), "other": Actor(other)}
    stage = Stage(actors | {"as biped": Actor(good, "biped")}, config=IDEAL)
    for name, message in (
        ("odd", r"expected \[..., 95\]"),
        ("other", "walk"),
        ("none", "unknown policy 'none'"),
    ):
        with pytest.raises(ValueError, match=message):
            stage.do("policy", name)
        assert stage.tick()["policy"] == "good"
    stage.do("policy", "as biped")
    assert stage.tick()["status"].startswith("biped, as biped")


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("gravty", 1.0, "unknown control 'gravty'.*nearest: 'gravity'"),
        ("gravity", 100, r"gravity = 100 is outside \[0\.01, 30\.0\] \(nearest: 30\.0\)"),
        ("gravity", "low", "'low' is not a number"),
        ("goal", [1.0], "not a list of 2 numbers"),
        ("goal", [1.0, float("nan")], r"goal\[1\] = nan"),
        ("push", [0, 0, 900], r"force\[2\] = 900 is outside"),
        ("pause", 1, "neither true nor false"),
        ("speed", 0, "speed = 0 is outside"),
    ],
)
def test_bad_requests_change_nothing(still: Stage, name: str, value: Any, message: str) -> None:
    before = still.frame()
    with pytest.raises(ValueError, match=message):
        still.do(name, value)
    assert still.frame() == before


def test_frames_and_scene_are_json_of_fitting_sizes(still: Stage) -> None:
    scene, frame = still.scene(), still.tick()
    assert json.dumps(scene, allow_nan=False)
    assert json.loads(json.dumps(frame, allow_nan=False)) == frame
    assert scene["bodies"] == 14  # the world, the trunk and three links of four legs
    assert len(frame["poses"]) == 7 * 14
    assert {g["body"] for g in scene["geoms"]} == set(range(14))
    assert not [g for g in scene["geoms"] if g["colour"] == [0.9, 0.3, 0.3]]  # collision shapes


def test_play_keeps_time_and_stops(still: Stage) -> None:
    stop, frames = threading.Event(), []

    def show(frame: dict[str, Any]) -> None:
        frames.append(frame)
        if len(frames) == 3:
            stop.set()

    still.do("speed", 4.0)
    play(still, show, stop)
    assert [frame["time"] for frame in frames] == pytest.approx([DT, 2 * DT, 3 * DT])
