"""A page that simulates in the browser: MuJoCo in WebAssembly, and our loop in JavaScript.

``make web`` fetches MuJoCo's npm package and calls this; any file server serves the folder::

    .venv/bin/python -m twirl_mjx.view.web build/npm/node_modules/@mujoco/mujoco build/web
"""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from twirl_mjx import files
from twirl_mjx.assets import asset_path
from twirl_mjx.deploy.conditions import IDEAL
from twirl_mjx.deploy.ground import GROUND, build_model
from twirl_mjx.deploy.reference import BIPED, FALL_PARTS
from twirl_mjx.deploy.robot import LOWER, POSE, SWING, UPPER, CommandFilter
from twirl_mjx.policies.learned import NumpyPolicy, hidden_layers, load_policy
from twirl_mjx.view.page import web_page
from twirl_mjx.view.picture import Picture, encode
from twirl_mjx.view.stage import SLIDERS

ENGINE = ("mujoco.js", "mujoco.wasm")
"""Files of MuJoCo's npm package that the page loads."""
OFFERED = ("gravity", "friction")
"""Conditions that the page offers."""


def scene_xml() -> str:
    """Return the rehearsal's flat scene as MJCF that older versions of MuJoCo read, too.

    The robot's own file with a floor, the rehearsal's step and motors that are given torques; it
    compiles to the model of ``ground.build_model``. (MuJoCo's own writer rounds to six digits.)
    """
    root = ElementTree.parse(asset_path("a1", "a1.xml")).getroot()
    option = _first(root, "option")
    option.attrib.update(timestep=str(IDEAL.sim_dt), iterations="50", ls_iterations="50")
    for default in root.iter("default"):
        for position in default.findall("position"):
            default.remove(position)
    for motor in _first(root, "actuator"):
        motor.tag = "motor"
        del motor.attrib["class"]
    world = _first(root, "worldbody")
    for geom in world.iter("geom"):
        if geom.get("name", "").endswith(("_collision", "_foot")):
            geom.set("conaffinity", "1")
    floor = {"name": "floor", "type": "plane", "size": "0 0 0.05", "rgba": "0.78 0.81 0.84 1"}
    floor |= {"friction": f"{IDEAL.friction} 0.005 0.0001"}
    world.insert(0, ElementTree.Element("geom", floor | {k: str(v) for k, v in GROUND.items()}))
    return ElementTree.tostring(root, encoding="unicode")


def _first(root: ElementTree.Element, tag: str) -> ElementTree.Element:
    found = root.find(tag)
    if found is None:
        raise ValueError(f"a1.xml has no <{tag}>")
    return found


def record(policy: NumpyPolicy) -> dict[str, Any]:
    """Return all numbers of the loop, JSON-ready, for a policy of ``biped``."""
    model = build_model(IDEAL, np.zeros(0))
    names = [model.geom(i).name for i in range(model.ngeom)]
    parts = FALL_PARTS[BIPED]
    picture, command = Picture(model), CommandFilter(POSE)
    layers = [*hidden_layers(policy.actor_params), "mean"]
    return {
        "xml": scene_xml(),
        "scene": picture.scene,
        "controls": [slider._asdict() for slider in SLIDERS if slider.name in OFFERED],
        "layers": [
            {key: encode(policy.actor_params[name][key]) for key in ("kernel", "bias")}
            for name in layers
        ],
        "filter": {"b": command.b.tolist(), "a": command.a.tolist()},
        "bodies": picture.bodies,
        "trunk": model.body("trunk").id,
        "floor": model.geom("floor").id,
        "falls": [
            i
            for i, name in enumerate(names)
            if name.endswith("_collision") and any(part in name for part in parts)
        ],
        "home": model.key("home").qpos.tolist(),
        "substeps": IDEAL.n_substeps,
        "kp": IDEAL.kp,
        "kd": IDEAL.kd,
        "torque_limit": IDEAL.torque_limit,
        **{name: array.tolist() for name, array in
           (("pose", POSE), ("swing", SWING), ("lower", LOWER), ("upper", UPPER))},
    }  # fmt: skip


def write_web(package: Path, folder: Path) -> Path:
    """Write the page and all that it loads.

    Args:
        package: MuJoCo's npm package, unpacked.
        folder: Where to write; made if it is not there.

    Returns:
        The page.

    Raises:
        FileNotFoundError: Something of the package is not there.
        PolicyFileError: The shipped policy cannot be read.
    """
    for name in ENGINE:
        if not (package / name).is_file():
            raise FileNotFoundError(
                f"no {name} in {package}: `npm install --prefix build/npm @mujoco/mujoco` brings it"
            )
    policy = load_policy(asset_path("policies", f"{BIPED}.npz"))
    if not isinstance(policy, NumpyPolicy):
        raise TypeError(f"the shipped {BIPED} is no policy of ours")
    folder.mkdir(parents=True, exist_ok=True)
    files.write_text(folder / "robot.json", json.dumps(record(policy), separators=(",", ":")))
    files.write_text(folder / "loop.js", files.read_text(asset_path("view", "loop.js"), "the loop"))
    for name in ENGINE:
        shutil.copyfile(package / name, folder / name)
    page = folder / "index.html"
    files.write_text(page, web_page("An A1 on its hind legs"))
    return page


if __name__ == "__main__":
    print(f"wrote {write_web(Path(sys.argv[1]), Path(sys.argv[2]))}")
