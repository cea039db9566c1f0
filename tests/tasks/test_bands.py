"""Hurdle bands: draws, exact distances against MuJoCo's, crossings by hand."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from twirl_mjx.sim import kinematics
from twirl_mjx.sim.robots import A1
from twirl_mjx.sim.scene import HURDLE_LENGTH
from twirl_mjx.tasks import bands

HALF = HURDLE_LENGTH / 2
RAISED = jnp.array([0.0, 0.05])


def test_gaps_are_drawn_within_their_range() -> None:
    keys = jax.random.split(jax.random.key(0), 50)
    positions = np.asarray(jax.vmap(lambda key: bands.draw(key, 40, 1.6, 2.6))(keys))
    gaps = np.diff(positions, axis=1, prepend=0.0)
    assert gaps.min() >= 1.6 - 1e-4
    assert gaps.max() <= 2.6 + 1e-4
    assert gaps[:, 0].min() < 1.7  # the first hurdle is drawn as well
    assert gaps[:, 0].max() > 2.5
    np.testing.assert_allclose(gaps.mean(), 2.1, atol=0.03)
    np.testing.assert_allclose(bands.draw(keys[0], 3, 2.1, 2.1), [2.1, 4.2, 6.3], rtol=1e-6)


def test_nearest_band() -> None:
    positions = jnp.array([2.0, 4.0, 7.0])
    got = bands.nearest(positions, jnp.array([-9.0, 2.9, 3.1, 5.4, 5.6, 99.0]))
    np.testing.assert_array_equal(got, [2.0, 2.0, 4.0, 4.0, 7.0, 7.0])


@pytest.mark.parametrize(
    ("start", "end", "distance"),
    [
        ((0.0, 0.05), (0.0, 0.05), 0.04),  # a sphere over the middle
        ((0.13, 0.05), (0.13, 0.05), 0.05),  # 3-4-5 off the corner
        ((-0.5, 0.02), (0.5, 0.02), 0.01),  # a beam across, both ends far away
        ((0.1, 0.05), (0.2, -0.05), None),  # slanted beside the corner
        ((-0.5, 0.005), (0.5, 0.005), 0.0),  # right through
        ((-0.05, 0.002), (0.05, 0.008), 0.0),  # inside
        ((-0.2, 0.105), (0.0, 0.005), 0.0),  # into the top
    ],
)
def test_rectangle_distance_by_hand(
    start: tuple[float, float], end: tuple[float, float], distance: float | None
) -> None:
    if distance is None:  # the line h = 0.15 - x misses the corner (0.1, 0.01) by 0.04 / sqrt(2)
        distance = 0.04 / np.sqrt(2)
    got = bands.rectangle_distance(jnp.array(start), jnp.array(end), 0.01)
    np.testing.assert_allclose(got, distance, atol=1e-6)
    swapped = bands.rectangle_distance(jnp.array(end), jnp.array(start), 0.01)
    np.testing.assert_allclose(swapped, distance, atol=1e-6)
    higher = bands.rectangle_distance(jnp.array(start) + RAISED, jnp.array(end) + RAISED, 0.06)
    np.testing.assert_allclose(higher, distance, atol=1e-6)  # its top is as far away


def random_shapes(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Capsule ends [count, 2, 3] around a band at x = 2, and radii [count]; a third are spheres."""
    centre = rng.uniform([1.6, -0.4, -0.02], [2.4, 0.4, 0.2], (count, 3))
    axis = rng.normal(size=(count, 3)) * rng.uniform(0.01, 0.2, (count, 1))
    axis[: count // 3] = 0.0
    return np.stack([centre - axis, centre + axis], axis=1), rng.uniform(0.01, 0.06, count)


def mujoco_distances(ends: np.ndarray, radii: np.ndarray, height: float) -> np.ndarray:
    """MuJoCo's own distance of every shape to a box 10 m long in y."""
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(
        name="band",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[HALF, 5.0, height / 2],
        pos=[2.0, 0.0, height / 2],
    )
    for i, (a, b) in enumerate(ends):
        body = spec.worldbody.add_body(name=f"body_{i}")
        if np.array_equal(a, b):
            body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[radii[i], 0, 0], pos=a)
        else:
            body.add_geom(
                type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=[radii[i], 0, 0], fromto=[*a, *b]
            )
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    # From far away, so that none is cut off.
    return np.array(
        [mujoco.mj_geomDistance(model, data, 0, i + 1, 10.0, None) for i in range(len(ends))]
    )


@pytest.mark.parametrize(("height", "most"), [(0.01, 80), (0.1, 250)])
def test_distance_agrees_with_mujoco(height: float, most: int) -> None:
    ends, radii = random_shapes(np.random.default_rng(1), 400)
    got = np.asarray(
        bands.shape_distance(
            jnp.asarray(ends[..., 0], jnp.float32),
            jnp.asarray(ends[..., 2], jnp.float32),
            jnp.asarray(radii, jnp.float32),
            jnp.float32(2.0),
            height,
        )
    )
    # Points along every axis: the truth to within their spacing, also where an axis runs through
    # the band; there MuJoCo's capsule-box routine can be some cm off (checked in 4.0.0).
    share = np.linspace(0.0, 1.0, 4001)[:, None]
    points = ends[:, None, 0] + share * (ends[:, None, 1] - ends[:, None, 0])
    out_x = np.maximum(np.abs(points[..., 0] - 2.0) - HALF, 0.0)
    out_h = np.maximum(np.maximum(points[..., 2] - height, -points[..., 2]), 0.0)
    axis_distance = np.hypot(out_x, out_h).min(axis=1)
    np.testing.assert_allclose(got, axis_distance - radii, atol=2e-4)

    pierced = axis_distance == 0.0
    assert 20 < pierced.sum() < most
    np.testing.assert_array_equal(got[pierced] < 0.0, True)
    want = mujoco_distances(ends, radii, height)[~pierced]
    assert (want > 0.0).sum() > 100
    assert (want < 0.0).sum() > 20
    np.testing.assert_allclose(got[~pierced], want, atol=2e-5)


def test_no_pose_reaches_beyond_the_nearest_band() -> None:
    rng = np.random.default_rng(2)
    quat = rng.normal(size=(4000, 4))
    qpos = np.concatenate(
        [
            np.zeros((4000, 3)),
            quat / np.linalg.norm(quat, axis=1, keepdims=True),
            rng.uniform(A1.joint_limits[:, 0], A1.joint_limits[:, 1], (4000, 12)),
        ],
        axis=1,
    )
    # And both legs of a side stretched out fore and aft.
    qpos[0, 3:] = [1, 0, 0, 0, *np.tile([0, -np.pi / 2 + 0.458, -0.916], 4)]
    qpos[1, 3:] = [1, 0, 0, 0, *np.tile([0, np.pi / 2 + 0.458, -0.916], 4)]
    ends = kinematics.forward(A1, jnp.asarray(qpos, jnp.float32)).endpoints
    reach = np.abs(np.asarray(ends[..., 0])).max(axis=-1) + A1.contact_radii
    assert 0.5 < reach.max() < bands.reach(A1) - HALF


def test_crossing_window() -> None:
    positions = jnp.array([2.0, 4.0])
    flat = jnp.zeros(4, bool)

    def step(feet_x: list[float], contact: bool, foot: int = 0) -> list[bool]:
        touching = flat.at[foot].set(contact)
        return bands.stepped_in(positions, jnp.array([feet_x]), touching[None]).tolist()

    assert step([1.89, 1.89, 1.5, 1.5], True) == [False, False]  # before the near edge
    assert step([1.91, 1.89, 1.5, 1.5], True) == [True, False]  # first foot beyond it
    assert step([1.91, 1.89, 1.5, 1.5], False) == [False, False]  # in the air
    assert step([2.5, 2.5, 2.2, 2.09], True) == [True, False]  # front foot landed too early
    assert step([2.5, 2.5, 2.2, 2.11], True, foot=3) == [False, False]  # all beyond the far edge
    assert step([3.95, 3.8, 3.5, 3.5], True, foot=2) == [False, True]
    # One substep of many is enough.
    feet = jnp.array([[1.8, 1.8, 1.5, 1.5], [1.95, 1.95, 1.6, 1.6], [2.5, 2.5, 2.2, 2.2]])
    contact = jnp.array([[True] * 4, [False] * 3 + [True], [True] * 4])
    assert bands.stepped_in(positions, feet, contact).tolist() == [True, False]
    assert bands.stepped_in(positions, feet, contact.at[1].set(False)).tolist() == [False, False]
