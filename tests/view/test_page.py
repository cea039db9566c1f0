"""Replay pages as files, and the server of the live page, without a browser."""

from __future__ import annotations

import base64
import json
import re
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import mujoco
import numpy as np
import pytest

from twirl_mjx import cli
from twirl_mjx.commands import view
from twirl_mjx.deploy.conditions import RehearsalConfig
from twirl_mjx.deploy.ground import build_model
from twirl_mjx.policies.learned import PolicyHeader, save_policy
from twirl_mjx.view.page import live_page, write_replay
from twirl_mjx.view.picture import Picture
from twirl_mjx.view.server import serving
from twirl_mjx.view.stage import Stage


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return build_model(RehearsalConfig(), np.array([2.0]))


@pytest.fixture(scope="module")
def home(model: mujoco.MjModel) -> np.ndarray:
    return model.key("home").qpos.copy()


def record_of(page: Path) -> dict:
    found = re.search(r"^const REPLAY = (.*);$", page.read_text(encoding="utf-8"), re.M)
    assert found is not None
    return json.loads(found[1].replace("<\\/", "</"))


def test_poses_are_those_of_mujoco(model: mujoco.MjModel, home: np.ndarray) -> None:
    picture, data = Picture(model), mujoco.MjData(model)
    data.qpos[:] = home
    mujoco.mj_kinematics(model, data)
    poses = picture.poses(home).reshape(-1, 7)
    np.testing.assert_allclose(poses[0], [0, 0, 0, 1, 0, 0, 0])
    np.testing.assert_allclose(poses[1, :3], data.body("trunk").xpos, atol=1e-6)
    np.testing.assert_allclose(poses[-1], [*data.body("RL_calf").xpos, *data.body("RL_calf").xquat],
                               atol=1e-6)  # fmt: skip


def test_a_replay_holds_every_frame_and_asks_for_nothing_else(
    model: mujoco.MjModel, home: np.ndarray, tmp_path: Path
) -> None:
    qpos = np.repeat(home[None], 5, axis=0)
    qpos[:, 0] = np.arange(5) / 10
    path = write_replay(
        tmp_path / "a b.html",
        model,
        qpos,
        title="<b>",
        note="</script>",
        goals=np.ones((5, 2)),
        values={"x": [*range(4), float("inf")]},
    )
    text, record = path.read_text(encoding="utf-8"), record_of(path)
    poses = np.frombuffer(base64.b64decode(record["poses"]), np.float32).reshape(5, 14, 7)
    np.testing.assert_allclose(poses[:, 1, 0], qpos[:, 0], atol=1e-6)
    goals = np.frombuffer(base64.b64decode(record["goals"]), np.float32).reshape(5, 3)
    np.testing.assert_array_equal(goals[3], [1, 1, 0])
    assert record["values"]["x"] == [0, 1, 2, 3, None]
    assert "&lt;b&gt;" in text and "<b>" not in text
    assert text.count("</script>") == 3
    assert not re.findall(r"(?:src|href)=\"(?!data:)|https?:|import\(", text)
    assert not re.findall(r"@[A-Z]+@", text + live_page("live"))
    assert len(text) < 200_000


def test_what_cannot_be_shown_is_refused(
    model: mujoco.MjModel, home: np.ndarray, tmp_path: Path
) -> None:
    one = home[None]
    for path, qpos, more, message in (
        ("a.txt", one, {}, r"ends in \.html, got '\.txt' \(nearest: a\.html\)"),
        ("a.html", one[:, :5], {}, r"shape \(1, 5\), expected \[T >= 1, 19\]"),
        ("a.html", one * np.nan, {}, r"qpos\[0\] is not finite"),
        ("a.html", one, {"values": {"x": [1, 2]}}, "2 x for 1 frames"),
        ("a.html", one, {"goals": np.zeros((2, 2))}, "2 goals for 1 frames"),
    ):
        with pytest.raises(ValueError, match=message):
            write_replay(tmp_path / path, model, qpos, title="", **more)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["nowhere.npz"], "no policy at nowhere.npz"),
        (["nowhere.npz", "--html", "a.html"], "no policy at nowhere.npz"),
        (["--html", "a.txt"], "nearest: a.html"),
        (["--shift", "icey"], "nearest: 'icy'"),
        (["my.py:policy", "--task", "biped"], "there is no file my.py"),
        (["trot"], "give one of stand, biped"),
        (["imitate.npz", "--task", "imitate"], "no policy at"),
    ],
)
def test_bad_input_is_refused_in_one_line(
    argv: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    assert cli.main(["view", *argv]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_policies_traces_and_clips_become_pages(
    home: np.ndarray, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    np.savez("trace.npz", qpos=np.repeat(home[None], 7, axis=0), frame_dt=0.02)
    assert cli.main(["view", "--seconds", "0.5", "--html", "policy.html"]) == 0
    assert cli.main(["view", "trace.npz", "--html", "trace.html"]) == 0
    policy, trace = record_of(Path("policy.html")), record_of(Path("trace.html"))
    assert len(policy["values"]["distance to goal (m)"]) == 10
    assert (len(trace["values"]["root height (m)"]), trace["dt"]) == (7, 0.02)


@pytest.fixture
def address(still: Stage) -> Iterator[str]:
    with serving(still, "a page", port=0) as address:
        yield address


def ask(url: str, content: str | None = None, **headers: str) -> tuple[int, str]:
    data = None if content is None else content.encode()
    headers = {"Content-Type": "application/json"} | {
        k.replace("_", "-"): v for k, v in headers.items()
    }
    try:
        with urllib.request.urlopen(
            urllib.request.Request(url, data, headers), timeout=20
        ) as reply:
            return reply.status, reply.read().decode()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read().decode()


def frames_of(address: str, count: int) -> list[dict]:
    with urllib.request.urlopen(f"{address}events", timeout=20) as stream:
        lines = (line.decode() for line in stream)
        events = (line for line in lines if line.startswith("data: "))
        return [json.loads(next(events).removeprefix("data: ")) for _ in range(count)]


def test_the_server_shows_frames_and_takes_requests(address: str) -> None:
    assert "a page" in ask(address)[1]
    assert json.loads(ask(f"{address}scene")[1])["bodies"] == 14
    first, second = frames_of(address, 2)
    assert second["time"] > first["time"]
    assert ask(f"{address}do", '{"name": "gravity", "value": 3.7}') == (200, "done")
    assert frames_of(address, 2)[-1]["conditions"]["gravity"] == 3.7


def test_the_server_refuses_what_is_no_request(address: str, still: Stage) -> None:
    before = still.frame()["conditions"]
    status, text = ask(f"{address}do", '{"name": "gravity", "value": 100}')
    assert (status, text.count("\n")) == (400, 0) and "nearest: 30.0" in text
    for content in ("", "[]", "{}", "gravity", '{"name": ["a"]}', "9" * 20_000):
        assert ask(f"{address}do", content)[0] == 400
    assert ask(f"{address}do", "{}", Content_Type="text/plain")[0] == 400
    assert ask(f"{address}do", "{}", Origin="http://elsewhere.example")[0] == 403
    assert ask(f"{address}nothing")[0] == 404
    assert still.frame()["conditions"] == before


def test_places_where_no_page_can_be_served_are_refused(address: str, still: Stage) -> None:
    port = int(address.rsplit(":", 1)[1].strip("/"))
    for host, number, message in (
        ("127.0.0.1", port, rf"cannot listen at 127\.0\.0\.1:{port}: .*nearest: --port 0"),
        ("no such host", 0, "--host no such host: .*nearest: 127.0.0.1"),
    ):
        with pytest.raises(ValueError, match=message), serving(still, "", host=host, port=number):
            pass


@pytest.mark.parametrize(("robot", "compiled"), [("a1", False), ("go1", True)])
def test_a_policy_of_another_robot_is_not_rehearsed_but_recorded(
    robot: str, compiled: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    layer = {"kernel": np.zeros((101, 12)), "bias": np.zeros(12)}
    header = PolicyHeader("stand", 101, 12, 0.05, card={"robot": robot})
    path = save_policy(tmp_path / "p.npz", {"mean": layer, "log_std": layer}, header)
    taken: list[str] = []
    for name in ("_write_rehearsal", "_write_recording"):
        monkeypatch.setattr(view, name, lambda *_, name=name: taken.append(name) or tmp_path)
    for task in ("", "biped"):
        options = view.ViewOptions(str(path), html=tmp_path / "a.html", task=task or None)
        view._write(options, tmp_path / "a.html")
    assert taken == ["_write_recording" if compiled else "_write_rehearsal"] * 2
