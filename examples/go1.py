"""The Unitree Go1 as a robot of your own: its MJCF comes from a package, nothing of it is copied.

Looked for in the file that ``GO1_XML`` names, then in the installed package ``mjlab`` (only its
files are read), then through the loader of ``mujoco-menagerie``, which downloads it once.
"""

from __future__ import annotations

import importlib
import importlib.util
import os
from pathlib import Path

from twirl_mjx.sim.robot import Robot

IN_MJLAB = "asset_zoo/robots/unitree_go1/xmls/go1.xml"


def go1_xml() -> Path:
    """Return the path of a Go1's MJCF.

    Raises:
        FileNotFoundError: No package has one.
    """
    if given := os.environ.get("GO1_XML"):
        return Path(given)
    package = importlib.util.find_spec("mjlab")  # finds the folder without importing torch
    for folder in (package and package.submodule_search_locations) or ():
        if (path := Path(folder, IN_MJLAB)).is_file():
            return path
    if importlib.util.find_spec("mujoco_menagerie"):
        return importlib.import_module("mujoco_menagerie").get("unitree_go1").xml("go1")
    raise FileNotFoundError(
        "no MJCF of the Go1 here: `pip install --no-deps mjlab`, or name a file in GO1_XML"
    )


GO1 = Robot.from_mjcf(
    "go1",
    go1_xml,
    feet=("FR", "FL", "RR", "RL"),
    default_pose=(0.0, 0.9, -1.8),
    action_half_range=(0.6, 1.2, 1.2),
    kp=60.0,
    kd=3.0,
    torque_limit=(23.7, 23.7, 35.55),  # N m, Unitree's data sheet
    armature=0.01,
    damping=0.01,
)
"""Gains and action range are those of the A1, which is about as heavy."""
