"""Colours and captions of conditions: each is told apart, and none touches the physics."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from twirl_mjx.sim import look
from twirl_mjx.sim.dynamics import make_dynamics
from twirl_mjx.sim.engine import world_model
from twirl_mjx.sim.leaves import PAPER_SHIFTS, get_shift
from twirl_mjx.sim.robots import A1
from twirl_mjx.sim.scene import Bands, build_scene, terrain_height

WHOLE = np.ones(4)


def painted(shift: str, strength: float, legs: np.ndarray = WHOLE) -> mujoco.MjModel:
    dynamics = make_dynamics(shift, strength)
    model = world_model(build_scene(get_shift(shift).scene), dynamics)
    look.paint(model, A1, dynamics, legs)
    return model


def ground_colour(model: mujoco.MjModel) -> np.ndarray:
    return np.array(model.mat_rgba[model.mat("ground").id, :3])


def test_nominal_and_strength_zero_are_unpainted() -> None:
    plain = ground_colour(build_scene().mj_model)
    for shift in ("none", "icy", "gravity", "weakened"):
        np.testing.assert_array_equal(ground_colour(painted(shift, 0.0)), plain)


@pytest.mark.parametrize(("shift", "factor"), [("icy", look.ICE), ("gravity", look.MARS)])
def test_ground_turns_with_the_strength_of_the_shift(shift: str, factor: np.ndarray) -> None:
    plain, half, full = (ground_colour(painted(shift, s)) for s in (0.0, 0.5, 1.0))
    np.testing.assert_allclose(full, plain * factor, rtol=1e-5)
    np.testing.assert_allclose(half, plain * (1 + factor) / 2, rtol=1e-5)


def test_only_the_weak_leg_is_red() -> None:
    model, plain = painted("weakened", 1.0, np.array([1, 1, 0.6, 1.0])), build_scene().mj_model
    changed = np.flatnonzero((model.geom_rgba != plain.geom_rgba).any(axis=1))
    bodies = {model.body(model.geom_bodyid[geom]).name for geom in changed}
    assert bodies == {"RR_hip", "RR_thigh", "RR_calf"}
    assert (model.geom_rgba[changed, 0] > 1.5 * model.geom_rgba[changed, 1]).all()


def test_paint_leaves_the_physics_alone() -> None:
    plain = build_scene().mj_model
    model = painted("none", 1.0, np.full(4, 0.5))
    for name in ("geom_friction", "geom_size", "geom_contype", "body_mass", "actuator_gainprm"):
        np.testing.assert_array_equal(getattr(model, name), getattr(plain, name))


def test_captions_have_the_number_of_every_shift() -> None:
    legs = np.array([1.0, 0.63, 1.0, 1.0])
    shown = {name: look.describe(name, A1, make_dynamics(name), legs) for name in PAPER_SHIFTS}
    assert shown == {
        "none": "",
        "bumpy": "bumps to 5 cm",
        "icy": "friction 0.4",
        "weakened": "FL leg at 63 %",
        "sloped": "hill of 8 deg",
        "gravity": "gravity 3.7 m/s^2",
    }


def test_bands_lie_on_the_bumps_in_pieces() -> None:
    built = build_scene("bumpy", bands=Bands((-20.0, 3.0), y=4.0))
    model = built.mj_model
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    pieces = [i for i in range(model.ngeom) if model.geom(i).name.startswith("hurdle_")]
    assert len(pieces) == 2 * 2 * 20
    centres = data.geom_xpos[pieces]
    ground = terrain_height(
        built, centres[:, :2].astype(np.float32), np.float32(0), np.float32(0.05)
    )  # type: ignore[arg-type]
    np.testing.assert_allclose(centres[:, 2] - np.asarray(ground), 0.005, atol=1e-5)
    assert centres[:, 1].min() == pytest.approx(2.5 + 0.075)
    assert centres[:, 1].max() == pytest.approx(5.5 - 0.075)
    assert set(np.round(centres[:, 0], 6)) == {-20.05, -19.95, 2.95, 3.05}
