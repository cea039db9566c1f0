"""The page that simulates in the browser, step by step against the rehearsal."""

from __future__ import annotations

import functools
import http.server
import json
import shutil
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from twirl_mjx.assets import asset_path
from twirl_mjx.deploy.conditions import IDEAL
from twirl_mjx.deploy.ground import build_model
from twirl_mjx.deploy.pilots import OwnPilot
from twirl_mjx.deploy.trial import Trial
from twirl_mjx.policies.learned import NumpyPolicy, load_policy
from twirl_mjx.view.web import record, scene_xml, write_web

PACKAGE = Path(__file__).resolve().parents[2] / "build/npm/node_modules/@mujoco/mujoco"
STEPS = 20
GOAL = (1.0, 0.5)
ONE_STEP = """
import { readFileSync } from "node:fs";
import { CommandFilter, Loop, Network, Observer } from "./loop.mjs";
const record = JSON.parse(readFileSync("robot.json")), rows = JSON.parse(readFileSync("rows.json"));
const network = new Network(record.layers), first = rows[0];
const observer = new Observer(first.qpos, first.qvel);
const filter = new CommandFilter(record, first.qpos.slice(7, 19));
const out = rows.map(({ qpos, qvel, after, action }) => {
  const obs = observer.observe(qpos, record.goal), wanted = Array.from(network.act(obs));
  const target = filter.target(action);
  observer.push(after.qpos, after.qvel, action);
  return { obs: Array.from(obs), action: wanted, target };
});
console.log(JSON.stringify(out));
"""
MANY_STEPS = """
import { readFileSync } from "node:fs";
import load from "./mujoco.js";
import { Loop } from "./loop.mjs";
const record = JSON.parse(readFileSync("robot.json")), loop = new Loop(await load(), record);
loop.goal = record.goal;
const out = [];
for (let i = 0; i < record.steps; i++) {
  loop.step();
  out.push(Array.from(loop.data.qpos));
}
console.log(JSON.stringify({ qpos: out, fallen: loop.fallen }));
"""


@pytest.fixture(scope="module")
def policy() -> NumpyPolicy:
    found = load_policy(asset_path("policies", "biped.npz"))
    assert isinstance(found, NumpyPolicy)
    return found


@pytest.fixture(scope="module")
def rehearsed(policy: NumpyPolicy) -> list[dict[str, Any]]:
    """State before and after, observation, action and target of every control step."""
    trial = Trial(OwnPilot(policy, "biped", None), "biped", IDEAL, np.random.default_rng(0))
    trial.aim(np.array(GOAL))
    rows = []
    for _ in range(STEPS):
        state = {"qpos": trial.data.qpos.tolist(), "qvel": trial.data.qvel.tolist()}
        done = trial.step()
        after = {"qpos": trial.data.qpos.tolist(), "qvel": trial.data.qvel.tolist()}
        made = {"obs": done.observation, "action": done.action, "target": done.target}
        rows.append(state | {"after": after} | {key: x.tolist() for key, x in made.items()})
    assert trial.cause is None
    return rows


def in_node(script: str, folder: Path, **contents: Any) -> Any:
    node = shutil.which("node")
    if node is None:
        pytest.skip("node is not installed, which runs the loop of the page")
    (folder / "loop.mjs").write_text(asset_path("view", "loop.js").read_text())
    for name, content in contents.items():
        (folder / f"{name}.json").write_text(json.dumps(content))
    (folder / "run.mjs").write_text(script)
    done = subprocess.run([node, "run.mjs"], cwd=folder, capture_output=True, text=True,
                          timeout=120, check=False)  # fmt: skip
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def test_the_scene_is_that_of_the_rehearsal() -> None:
    ours, theirs = build_model(IDEAL, np.zeros(0)), mujoco.MjModel.from_xml_string(scene_xml())
    for name in ("nq", "nv", "nu", "nbody", "ngeom"):
        assert getattr(ours, name) == getattr(theirs, name)
    for name in ("body_mass", "body_inertia", "body_ipos", "body_iquat", "body_pos", "dof_armature",
                 "dof_damping", "jnt_axis", "jnt_range", "geom_type", "geom_size", "geom_pos",
                 "geom_quat", "geom_friction", "geom_contype", "geom_conaffinity", "geom_priority",
                 "geom_solref", "geom_solimp", "geom_margin", "actuator_gainprm",
                 "actuator_biasprm", "actuator_trnid", "actuator_gear"):  # fmt: skip
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name), err_msg=name)
    for name in ("timestep", "iterations", "ls_iterations", "integrator", "solver", "cone"):
        assert getattr(ours.opt, name) == getattr(theirs.opt, name), name
    assert not theirs.actuator_ctrllimited.any() and not theirs.actuator_forcelimited.any()
    assert [ours.geom(i).name for i in range(ours.ngeom)] == [
        theirs.geom(i).name for i in range(theirs.ngeom)
    ]


def test_observation_action_and_target_are_those_of_the_rehearsal(
    policy: NumpyPolicy, rehearsed: list[dict[str, Any]], tmp_path: Path
) -> None:
    robot = record(policy) | {"goal": GOAL}
    steps = in_node(ONE_STEP, tmp_path, robot=robot, rows=rehearsed)
    for name in ("obs", "action", "target"):
        theirs, ours = (np.array([row[name] for row in rows]) for rows in (steps, rehearsed))
        np.testing.assert_allclose(theirs, ours, atol=1e-5, err_msg=name)
    assert np.ptp([row["action"] for row in rehearsed], axis=0).min() > 0.1  # it moves


needs_package = pytest.mark.skipif(
    not (PACKAGE / "mujoco.wasm").is_file(), reason="`make web` fetches MuJoCo's npm package"
)


@needs_package
@pytest.mark.slow
def test_a_second_of_physics_is_that_of_the_rehearsal(
    policy: NumpyPolicy, rehearsed: list[dict[str, Any]], tmp_path: Path
) -> None:
    for name in ("mujoco.js", "mujoco.wasm"):
        (tmp_path / name).symlink_to(PACKAGE / name)
    (tmp_path / "package.json").write_text('{"type": "module"}')
    robot = record(policy) | {"goal": GOAL, "steps": STEPS}
    found = in_node(MANY_STEPS, tmp_path, robot=robot)
    assert not found["fallen"]
    ours = np.array([row["after"]["qpos"] for row in rehearsed])
    np.testing.assert_allclose(found["qpos"], ours, atol=1e-3)


@pytest.fixture
def served(tmp_path: Path) -> Iterator[str]:
    write_web(PACKAGE, tmp_path / "web")

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, format: str, *args: Any) -> None:
            del format, args

    handler = functools.partial(Quiet, directory=str(tmp_path / "web"))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()


@needs_package
@pytest.mark.slow
@pytest.mark.timeout(290)
def test_in_a_browser_it_walks_to_where_was_clicked(browser: Any, served: str) -> None:
    browser.open(served)
    browser.wait_until("document.querySelectorAll('#controls input').length === 2")
    assert browser.dark_share() > 0.005
    browser.run("document.getElementById('follow').checked = false")
    x, y = browser.run("view.pixelOf([0.6, 0.6, 0])")
    for kind in ("Pressed", "Released"):
        browser.send("Input.dispatchMouseEvent", type=f"mouse{kind}", x=x, y=y, button="left",
                     buttons=1, clickCount=1)  # fmt: skip
    browser.wait_until(f"{VALUE}[1] > 1 && {VALUE}[0] < 0.35", 200)
    browser.run("""(() => {
      const slider = document.querySelector('input[name=gravity]');
      slider.value = 3.7; slider.dispatchEvent(new Event('change'));
    })()""")
    browser.wait_until("document.getElementById('status').textContent.includes('walk to')")
    assert browser.errors() == []


VALUE = "[...document.querySelectorAll('#values td:last-child')].map(c => Number(c.textContent))"


def test_a_package_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no mujoco.js in .*npm install"):
        write_web(tmp_path, tmp_path / "web")
    assert not (tmp_path / "web").exists()
