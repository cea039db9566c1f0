"""Shifts: each moves its own parameters and no other, by the amount its strength says."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from twirl_mjx.config import SHIFTS as CONFIG_SHIFTS

from twirl_mjx.sim.dynamics import (
    NOMINAL_VALUES,
    SHIFTS,
    Dynamics,
    broadcast,
    get_shift,
    make_dynamics,
    stack,
)

NOMINAL = {
    "gravity": 9.81,
    "friction": 1.0,
    "leg_strength_min": 1.0,
    "heat_rate": 0.0,
    "bump_height": 0.0,
    "incline": 0.0,
}
CHANGES: dict[str, dict[str, float]] = {
    "none": {},
    "bumpy": {"bump_height": 0.05},
    "icy": {"friction": 0.4},
    "weakened": {"leg_strength_min": 0.5, "heat_rate": 0.02},
    "sloped": {"incline": 0.13962634},  # 8 deg
    "gravity": {"gravity": 3.7},
}
HALF: dict[str, dict[str, float]] = {
    "none": {},
    "bumpy": {"bump_height": 0.025},
    "icy": {"friction": 0.7},
    "weakened": {"leg_strength_min": 0.75, "heat_rate": 0.01},
    "sloped": {"incline": 0.06981317},
    "gravity": {"gravity": 6.755},
}


def values_of(dynamics: Dynamics) -> dict[str, float]:
    return {f.name: float(getattr(dynamics, f.name)) for f in dataclasses.fields(dynamics)}  # type: ignore[arg-type]


def test_the_names_are_those_of_the_config() -> None:
    assert set(SHIFTS) == set(CONFIG_SHIFTS) == set(CHANGES)
    assert NOMINAL_VALUES == NOMINAL


@pytest.mark.parametrize("name", CHANGES)
@pytest.mark.parametrize(
    ("strength", "table"), [(0.0, None), (0.5, HALF), (1.0, CHANGES)], ids=["0", "half", "1"]
)
def test_shift_changes_exactly_its_own_leaves(
    name: str, strength: float, table: dict[str, dict[str, float]] | None
) -> None:
    expected = NOMINAL | (table[name] if table else {})
    assert values_of(make_dynamics(name, strength)) == pytest.approx(expected, rel=1e-6)


def test_strengths_beyond_the_paper_s() -> None:
    assert float(make_dynamics("icy", 4 / 3).friction) == pytest.approx(0.2)  # the stress level
    assert float(make_dynamics("sloped", 2.0).incline) == pytest.approx(np.deg2rad(16))
    assert float(make_dynamics("weakened", 2.0).leg_strength_min) == pytest.approx(0.05)


@pytest.mark.parametrize("name", ["icy", "gravity"])
def test_strength_beyond_physics_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match=f"{name} at strength 2"):
        make_dynamics(name, 2.0)


@pytest.mark.parametrize(("strength", "nearest"), [(-0.1, "0.0"), (2.1, "2.0"), (np.nan, "2.0")])
def test_strength_out_of_range_is_refused(strength: float, nearest: str) -> None:
    with pytest.raises(ValueError, match=rf"{strength}.*\[0, 2\].*nearest: {nearest}"):
        make_dynamics("icy", strength)


@pytest.mark.parametrize(("name", "nearest"), [("bump", "bumpy"), ("gravty", "gravity")])
def test_unknown_shift_names_the_nearest(name: str, nearest: str) -> None:
    with pytest.raises(ValueError, match=rf"'{name}'.*nearest: '{nearest}'"):
        get_shift(name)


def test_leaves_are_float32_and_not_weak() -> None:
    for field in dataclasses.fields(Dynamics):  # type: ignore[arg-type]
        leaf = getattr(make_dynamics("icy"), field.name)
        assert leaf.dtype == jnp.float32
        assert not leaf.weak_type


def test_broadcast_and_stack() -> None:
    icy, none = make_dynamics("icy"), make_dynamics("none")
    both = stack([icy, none], 2)
    np.testing.assert_allclose(both.friction, [0.4, 0.4, 1.0, 1.0])
    np.testing.assert_allclose(both.gravity, [9.81] * 4, rtol=1e-6)
    np.testing.assert_array_equal(broadcast(both, 4).friction, both.friction)
    np.testing.assert_allclose(broadcast(icy, 3).friction, [0.4] * 3)
    with pytest.raises(ValueError, match=r"\(4,\): need \(\) or \(3,\)"):
        broadcast(both, 3)
