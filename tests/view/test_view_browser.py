"""Replay and live page in a real browser: the robot is seen, and controls act."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest

from twirl_mjx.deploy.conditions import RehearsalConfig
from twirl_mjx.deploy.ground import build_model
from twirl_mjx.view.page import write_replay
from twirl_mjx.view.server import serving
from twirl_mjx.view.stage import Stage


@pytest.mark.timeout(180)
def test_a_replay_shows_the_robot_and_scrubs(browser: Any, tmp_path: Any) -> None:
    model = build_model(RehearsalConfig(), np.zeros(0))
    qpos = np.repeat(model.key("home").qpos[None], 41, axis=0)
    qpos[:, 0] = np.linspace(0.0, 4.0, 41)
    path = write_replay(tmp_path / "replay.html", model, qpos, title="replay",
                        values={"x (m)": qpos[:, 0]})  # fmt: skip
    browser.open(path.as_uri())
    browser.wait_until("document.getElementById('clock').textContent.endsWith('2.00 s')")
    assert browser.dark_share() > 0.005
    browser.run("""(() => {
      document.getElementById('follow').checked = false;
      const time = document.getElementById('time');
      time.value = 1; time.dispatchEvent(new Event('input'));
    })()""")
    browser.wait_until("document.querySelector('#values td:last-child').textContent === '4.00'")
    time.sleep(0.5)
    assert browser.errors() == []
    urls = {
        event["request"]["url"].split(":")[0] for event in browser.of("Network.requestWillBeSent")
    }
    assert urls <= {"file", "data"}


@pytest.mark.slow
@pytest.mark.timeout(180)
def test_the_live_page_shows_the_robot_and_its_controls_act(browser: Any, still: Stage) -> None:
    with serving(still, "live", port=0) as address:
        browser.open(address)
        browser.wait_until("document.querySelectorAll('#controls input').length > 5")
        assert browser.dark_share() > 0.005
        browser.run("""(() => {
          const slider = document.querySelector('input[name=gravity]');
          slider.value = 3.7; slider.dispatchEvent(new Event('change'));
          document.getElementById('pause').click();
        })()""")
        browser.wait_until("document.getElementById('pause').textContent === 'go on'")
        frame = still.frame()
        assert frame["conditions"]["gravity"] == 3.7 and frame["paused"]
        goal = browser.run(f"view.pixelOf({frame['goal']})")
        for kind, (dx, dy) in (("Pressed", (0, 0)), ("Moved", (40, -20)), ("Released", (40, -20))):
            browser.send("Input.dispatchMouseEvent", type=f"mouse{kind}", x=goal[0] + dx,
                         y=goal[1] + dy, button="left", buttons=1, clickCount=1)  # fmt: skip
        deadline = time.monotonic() + 20
        while still.frame()["goal"] == frame["goal"]:
            assert time.monotonic() < deadline
            time.sleep(0.1)
        browser.wait_until("document.getElementById('hint').textContent.startsWith('pull')")
        assert browser.errors() == []
