"""Scenes: what collides, ground heights against MuJoCo's ray casting, and refused settings."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from twirl_mjx.sim import scene
from twirl_mjx.sim.engine import write_physics
from twirl_mjx.sim.leaves import SceneKind
from twirl_mjx.sim.robots import A1
from twirl_mjx.sim.scene import Bands, Scene, SimOptions, build_scene, terrain_height


@pytest.fixture(scope="module")
def scenes() -> dict[str, Scene]:
    kinds: tuple[SceneKind, ...] = ("flat", "bumpy", "sloped")
    return {kind: build_scene(kind, collision="feet") for kind in kinds}


def ray_heights(built: Scene, xy: np.ndarray, incline: float, bump_height: float) -> np.ndarray:
    """Return the ground's height [K] under ``xy`` [K, 2] as C MuJoCo's rays see it."""
    model = built.mj_model.__copy__()
    leaves = {"bumpy": {"bump_height": bump_height}, "sloped": {"incline": incline}, "flat": {}}
    write_physics(built, model, leaves[built.kind])
    data = mujoco.MjData(model)
    data.qpos[:] = model.key("home").qpos
    data.qpos[2] = 50.0  # out of the rays' way
    mujoco.mj_forward(model, data)
    geom = np.zeros(1, np.int32)
    heights = []
    for x, y in xy:
        start = np.array([x, y, 20.0])
        distance = mujoco.mj_ray(model, data, start, np.array([0.0, 0, -1]), None, 1, -1, geom)
        assert geom[0] in built.ground_geoms
        heights.append(20.0 - distance)
    return np.array(heights)


def our_heights(built: Scene, xy: np.ndarray, incline: float, bump_height: float) -> np.ndarray:
    values = jnp.float32(incline), jnp.float32(bump_height)
    return np.asarray(terrain_height(built, jnp.asarray(xy, jnp.float32), *values))


def test_flat_ground(scenes: dict[str, Scene]) -> None:
    xy = np.random.default_rng(0).uniform(-5, 5, (20, 2))
    np.testing.assert_array_equal(our_heights(scenes["flat"], xy, 0.14, 0.05), np.zeros(20))
    np.testing.assert_allclose(ray_heights(scenes["flat"], xy, 0.14, 0.05), np.zeros(20))


@pytest.mark.parametrize("degrees", [0.0, 4.0, 8.0, 16.0])
def test_hill_equals_rays(scenes: dict[str, Scene], degrees: float) -> None:
    xy = np.random.default_rng(1).uniform([-2, -3], [8, 3], (100, 2))
    xy = np.concatenate([xy, [[0.5, 0.0], [0.4999, 1.0], [0.5001, -1.0]]])
    angle = float(np.deg2rad(degrees))
    ours = our_heights(scenes["sloped"], xy, angle, 0.0)
    np.testing.assert_allclose(ours, ray_heights(scenes["sloped"], xy, angle, 0.0), atol=2e-6)
    np.testing.assert_allclose(
        ours, np.tan(angle) * np.maximum(xy[..., 0] - scene.HILL_START, 0.0), atol=2e-6
    )


def test_hill_by_hand(scenes: dict[str, Scene]) -> None:
    """8 deg from 0.5 m on: 2.5 m ahead the ground is 2 tan(8 deg) = 0.28108 m high."""
    xy = np.array([[2.5, 7.0], [0.5, 0.0], [-3.0, 0.0]])
    ours = our_heights(scenes["sloped"], xy, float(np.deg2rad(8)), 0.0)
    np.testing.assert_allclose(ours, [0.28108, 0.0, 0.0], atol=1e-5)


@pytest.mark.parametrize("bump_height", [0.05, 0.1, 0.02])
def test_bumps_equal_rays(scenes: dict[str, Scene], bump_height: float) -> None:
    """Random points, then both triangles of a few cells: the diagonal is MuJoCo's."""
    rng = np.random.default_rng(2)
    anywhere = rng.uniform(-29, 29, (300, 2))
    corners = rng.integers(5, 190, (20, 1, 2))
    inside = np.array([[0.1, 0.1], [0.9, 0.9], [0.45, 0.5], [0.55, 0.5], [0.2, 0.7], [0.8, 0.3]])
    cells = (-scene.BUMP_HALF_SIZE + scene.BUMP_CELL * (corners + inside)).reshape(-1, 2)
    xy = np.concatenate([anywhere, cells])
    ours = our_heights(scenes["bumpy"], xy, 0.0, bump_height)
    # float32 places a point in its cell to 2e-6 of 30 m; a slope is at most 0.1 m / 0.3 m
    np.testing.assert_allclose(ours, ray_heights(scenes["bumpy"], xy, 0.0, bump_height), atol=5e-6)
    assert 0.0 <= ours.min() < 0.1 * bump_height
    assert 0.9 * bump_height < ours.max() <= bump_height


def test_the_other_diagonal_would_be_noticed(scenes: dict[str, Scene]) -> None:
    """In the middle of a cell the two ways to split it differ by several millimetres."""
    bumps = scenes["bumpy"].bumps
    along = (bumps[:-1, 1:] + bumps[1:, :-1]) / 2
    across = (bumps[:-1, :-1] + bumps[1:, 1:]) / 2
    assert 0.05 * np.abs(along - across).mean() > 3e-3


def test_tiles_and_extent(scenes: dict[str, Scene]) -> None:
    """Tiles of 0.3 m, wider than two foot radii, so that few of them face a foot (MJX's cost)."""
    model, bumps = scenes["bumpy"].mj_model, scenes["bumpy"].bumps
    size = model.hfield_size[0]
    np.testing.assert_allclose(2 * size[:2] / (np.array(bumps.shape) - 1), 0.3)
    assert 2 * A1.foot_radius <= scene.BUMP_CELL
    heights = model.hfield_data.reshape(bumps.shape) * size[2]  # as compiled: the paper's value
    np.testing.assert_allclose(heights, 0.05 * bumps, atol=1e-7)
    assert bumps.min() == 0.0
    assert bumps.max() == 1.0


@pytest.mark.parametrize(
    ("collision", "bodies"),
    [
        ("feet", {"foot"}),
        ("legs", {"foot", "calf"}),
        ("full", {"trunk", "hip", "thigh", "calf", "foot"}),
    ],
)
def test_collision_sets(collision: scene.CollisionSet, bodies: set[str]) -> None:
    model = build_scene("flat", collision=collision).mj_model
    for shape in A1.contact_geoms:
        geom = model.geom(shape.name)
        assert bool(geom.conaffinity[0]) == (shape.body in bodies), shape.name
        assert geom.contype[0] == 0  # robot geoms never meet each other
    others = set(range(model.ngeom)) - {model.geom("floor").id}
    assert not model.geom_contype[list(others)].any()


@pytest.mark.parametrize("friction", [0.2, 1.0])
def test_contact_friction_is_the_ground_s(scenes: dict[str, Scene], friction: float) -> None:
    model = scenes["flat"].mj_model.__copy__()
    model.geom_friction[list(scenes["flat"].ground_geoms), 0] = friction
    data = mujoco.MjData(model)
    data.qpos[:] = model.key("home").qpos
    data.qpos[2] -= 0.001
    mujoco.mj_forward(model, data)
    assert data.ncon == 4
    for contact in data.contact:
        assert contact.dim == 3
        np.testing.assert_allclose(contact.friction[:2], friction)


def test_hurdles_are_drawn_on_the_ground_without_contact() -> None:
    built = build_scene("sloped", bands=Bands((0.3, 2.5), height=0.05))
    data = mujoco.MjData(built.mj_model)
    mujoco.mj_forward(built.mj_model, data)
    for i, x in enumerate((0.3, 2.5)):
        geom = built.mj_model.geom(f"hurdle_{i}")
        assert geom.contype[0] == geom.conaffinity[0] == 0
        np.testing.assert_allclose(2 * geom.size[[0, 2]], [0.2, 0.05])
        z = np.tan(np.deg2rad(8)) * max(x - 0.5, 0.0)
        np.testing.assert_allclose(data.geom_xpos[geom.id], [x, 0.0, z + 0.025], atol=1e-6)
        slope = data.geom_xmat[geom.id].reshape(3, 3)[2, 0]  # rise of the band's own x-axis
        assert slope == pytest.approx(np.sin(np.deg2rad(8)) if x > 0.5 else 0.0, abs=1e-6)


def test_goal_marker_moves_and_touches_nothing() -> None:
    model = build_scene("flat", goal_marker=True).mj_model
    body = model.body("goal")
    assert model.nmocap == 1
    geoms = range(body.geomadr[0], body.geomadr[0] + body.geomnum[0])
    assert len(geoms) == 2
    assert not model.geom_contype[geoms].any()
    assert not model.geom_conaffinity[geoms].any()


def test_options() -> None:
    model = build_scene("flat", options=SimOptions(sim_dt=0.0025, iterations=7)).mj_model
    assert model.opt.timestep == 0.0025
    assert model.opt.iterations == 7
    assert SimOptions().n_substeps == 10
    assert SimOptions(sim_dt=0.0025).n_substeps == 20


@pytest.mark.parametrize(
    ("sim_dt", "nearest"), [(0.004, "0.00416667"), (0.1, "0.05"), (-1.0, "0.05"), (0.0, "0.05")]
)
def test_step_that_does_not_divide_is_refused(sim_dt: float, nearest: str) -> None:
    with pytest.raises(ValueError, match=rf"{sim_dt} s does not divide.*nearest: {nearest}"):
        SimOptions(sim_dt=sim_dt)


def test_the_device_model_asked_for_in_a_trace_serves_the_next_one() -> None:
    built = build_scene("flat", collision="feet")

    def gravity(scale: jax.Array) -> jax.Array:
        return scale * built.mjx_model.opt.gravity

    for function in (jax.jit(gravity), jax.jit(lambda scale: gravity(scale) + 0.0)):
        np.testing.assert_allclose(function(jnp.float32(2.0)), [0.0, 0.0, -19.62], rtol=1e-6)
