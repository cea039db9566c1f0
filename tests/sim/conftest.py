"""Robots that are not the A1: one written here, and a Go1 where a package has its file."""

from __future__ import annotations

import functools
import importlib.util
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from twirl_mjx.sim.robot import Robot

GO1_FILE = Path(__file__).resolve().parents[2] / "examples" / "go1.py"

LEG = """
<body name="{leg}_hip" pos="{x} {y} 0.01">
  <joint name="{leg}_hip_joint" axis="1 0 0" range="-50 50"/>
  <geom class="seen" type="cylinder" size="0.04 0.03" mass="0.6"/>
  <body name="{leg}_thigh" pos="0 {out} 0">
    <joint name="{leg}_thigh_joint" axis="0 1 0" range="-40 250"/>
    <geom class="seen" type="capsule" size="0.02" fromto="0 0 0 0 0 -0.21" mass="1.1"/>
    <geom class="hidden" name="{leg}_thigh_collision" type="box" size="0.02 0.02 0.1" mass="0"/>
    <body name="{leg}_calf" pos="0 0 -0.21">
      <joint name="{leg}_calf_joint" axis="0 1 0" range="-160 -50" actuatorfrcrange="-40 40"/>
      <inertial pos="0 0 -0.12" mass="0.2" diaginertia="0.002 0.002 0.0001"/>
      <geom class="seen" type="capsule" size="0.01" fromto="0 0 0 0 0 -0.24"/>
      <geom class="hidden" name="{leg}_toe" type="sphere" size="0.025" pos="0.002 0 -0.24"/>
    </body>
  </body>
</body>"""

CORNERS = {"FL": (0.2, 0.06), "FR": (0.2, -0.06), "RR": (-0.2, -0.06), "RL": (-0.2, 0.06)}
"""m, hips in the order of the model; the A1 has its right legs first."""


def quadruped_xml(**changes: tuple[str, str]) -> str:
    """A quadruped's MJCF in degrees, with what scenes bring along; ``changes`` replace text."""
    legs = "".join(
        LEG.format(leg=leg, x=x, y=y, out=0.09 if y > 0 else -0.09)
        for leg, (x, y) in CORNERS.items()
    )
    motors = "".join(  # in another order than the joints
        f'<motor name="{leg}_{part}" joint="{leg}_{part}_joint" forcerange="-30 30"/>'
        for part in ("calf", "hip", "thigh")
        for leg in CORNERS
    )
    xml = f"""<mujoco model="other">
      <option timestep="0.002" cone="elliptic" impratio="10"/>
      <default>
        <default class="seen"><geom group="1" material="ground"/></default>
        <default class="hidden"><geom group="3"/></default>
      </default>
      <asset>
        <texture name="sky" type="skybox" builtin="flat" width="8" height="8"/>
        <material name="ground" rgba="0.2 0.4 0.8 1"/>
      </asset>
      <worldbody>
        <geom name="floor" type="plane" size="1 1 1"/>
        <light pos="0 0 3"/>
        <body name="crate" pos="2 0 0"><geom type="box" size="0.1 0.1 0.1"/></body>
        <body name="base" pos="0 0 0.5">
          <freejoint name="float"/>
          <light pos="0 0 1"/>
          <geom class="seen" name="shell" type="box" size="0.22 0.08 0.05" mass="6"/>
          <site name="imu"/>{legs}
        </body>
      </worldbody>
      <contact><pair geom1="floor" geom2="FL_toe"/></contact>
      <actuator>{motors}</actuator>
      <sensor><gyro site="imu"/><touch site="imu"/></sensor>
      <keyframe><key name="sit" qpos="{" ".join(["0"] * 3 + ["1"] + ["0"] * 15)}"/></keyframe>
    </mujoco>"""
    for old, new in changes.values():
        assert old in xml
        xml = xml.replace(old, new)
    return xml


FACTS: dict[str, Any] = {
    "feet": tuple(f"{leg}_toe" for leg in CORNERS),
    "default_pose": (0.0, 0.8, -1.5),
    "action_half_range": 0.5,
    "kp": (70.0, 80.0, 90.0),
    "kd": 3.0,
    "armature": 0.012,
    "damping": 0.02,
}


@functools.cache
def other_robot() -> Robot:
    return Robot.from_mjcf("other", quadruped_xml(), **FACTS)


@functools.cache
def go1_robot() -> Robot:
    spec = importlib.util.spec_from_file_location("go1", GO1_FILE)
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except FileNotFoundError as error:
        pytest.skip(str(error))
    return module.GO1


@pytest.fixture
def quadruped() -> Callable[..., str]:
    """``quadruped(name=(old, new))`` -> the MJCF of ``other``, with text replaced."""
    return quadruped_xml


@pytest.fixture
def facts() -> dict[str, Any]:
    """What is said of ``other`` beside its MJCF."""
    return dict(FACTS)


@pytest.fixture
def other() -> Robot:
    """A quadruped with sizes of its own and its left front leg first."""
    return other_robot()


@pytest.fixture(params=["other", "go1"])
def made(request: pytest.FixtureRequest) -> Robot:
    """Each of the two robots."""
    return other_robot() if request.param == "other" else go1_robot()
