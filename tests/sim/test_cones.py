"""Friction cones: how slippery ice is in each direction, and what a rounder cone costs.

``pytest -m slow -s tests/sim/test_cones.py`` prints the table of docs/physics.md.
"""

import math
import time

import mujoco
import numpy as np
import pytest

from twirl_mjx.assets import asset_path
from twirl_mjx.sim.robots import A1

ICE = 0.4
"""Friction coefficient of the shift ``icy``."""
GRAVITY = 9.81
MASS = 10.0
"""kg, of the block."""
SLIDING = 0.05
"""m/s: below it a block on a soft contact creeps, above it slides."""
CONES = {"pyramidal": mujoco.mjtCone.mjCONE_PYRAMIDAL, "elliptic": mujoco.mjtCone.mjCONE_ELLIPTIC}
SETTINGS = (("pyramidal", 1.0), ("elliptic", 1.0), ("elliptic", 10.0), ("elliptic", 100.0))
"""(cone, impratio)."""


def block() -> mujoco.MjModel:
    """A block of 10 kg on ice that cannot tip, at the robot's settings of step and solver."""
    return mujoco.MjModel.from_xml_string(f"""
    <mujoco>
      <option timestep="0.005" integrator="implicitfast" iterations="4" ls_iterations="8"/>
      <worldbody>
        <geom type="plane" size="0 0 0.05" friction="{ICE} 0.005 0.0001" priority="1"/>
        <body pos="0 0 0.05">
          <joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/>
          <joint type="slide" axis="0 0 1"/>
          <geom type="box" size="0.2 0.2 0.05" mass="{MASS}"/>
        </body>
      </worldbody>
    </mujoco>""")


def set_cone(model: mujoco.MjModel, cone: str, impratio: float) -> mujoco.MjModel:
    model.opt.cone, model.opt.impratio = CONES[cone], impratio
    return model


def felt_friction(cone: str, impratio: float, angle: float) -> float:
    """Return the push over weight, along ``angle`` rad, at which the block begins to slide."""
    model = set_cone(block(), cone, impratio)
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 100)  # at rest on the ground
    direction = np.array([math.cos(angle), math.sin(angle)])
    for push in np.arange(0.5 * ICE, 2 * ICE, 0.001):
        data.xfrc_applied[1, :2] = push * MASS * GRAVITY * direction
        mujoco.mj_step(model, data, 100)
        if np.linalg.norm(data.qvel[:2]) > SLIDING:
            return float(push)
    raise AssertionError("nothing makes it slide")


def creep(cone: str, impratio: float) -> float:
    """Return the speed in mm/s of a block that half of what friction can hold pushes along x."""
    model = set_cone(block(), cone, impratio)
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 100)
    data.xfrc_applied[1, 0] = 0.5 * ICE * MASS * GRAVITY
    mujoco.mj_step(model, data, 100)
    before = data.qpos[0]
    mujoco.mj_step(model, data, 200)
    return float(data.qpos[0] - before) / (200 * model.opt.timestep) * 1000


def robot_steps_per_s(cone: str, impratio: float, steps: int = 20_000) -> float:
    """Return physics steps per second of the robot on ice, moving at random on its feet."""
    spec = mujoco.MjSpec.from_file(str(asset_path("a1", "a1.xml")))
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[0, 0, 0.05],
        friction=[ICE, 0.005, 0.0001],
        contype=1,
        conaffinity=0,
        priority=1,
    )
    model = set_cone(spec.compile(), cone, impratio)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
    rng = np.random.default_rng(0)
    goals = A1.default_pose + 0.2 * A1.action_half_range * rng.uniform(-1, 1, (steps // 10, 12))
    began = time.process_time()
    for goal in goals:
        data.ctrl[:] = goal
        mujoco.mj_step(model, data, 10)
    assert np.isfinite(data.qpos).all()
    return steps / (time.process_time() - began)


@pytest.mark.parametrize(
    ("cone", "impratio", "straight", "diagonal"),
    [
        ("pyramidal", 1.0, 0.40, 0.285),
        ("elliptic", 1.0, 0.40, 0.40),
        ("elliptic", 10.0, 0.40, 0.40),
    ],
)
def test_a_pyramidal_cone_is_more_slippery_on_the_diagonal(
    cone: str, impratio: float, straight: float, diagonal: float
) -> None:
    assert felt_friction(cone, impratio, 0.0) == pytest.approx(straight, abs=0.01)
    assert felt_friction(cone, impratio, math.pi / 4) == pytest.approx(diagonal, abs=0.01)


@pytest.mark.slow
def test_table_of_the_docs(capsys: pytest.CaptureFixture[str]) -> None:
    lines = []
    for cone, impratio in SETTINGS:
        felt = [felt_friction(cone, impratio, a) for a in (0.0, math.pi / 8, math.pi / 4)]
        numbers = " | ".join(f"{f:.3f}" for f in felt)
        best = max(robot_steps_per_s(cone, impratio) for _ in range(3))
        slow = creep(cone, impratio)
        lines.append(f"| {cone}, {impratio:g} | {numbers} | {slow:.2f} | {best / 1000:.1f}k |")
    with capsys.disabled():
        print("\n" + "\n".join(lines))
    assert len(lines) == len(SETTINGS)
