"""The table of leaves, and the three ways to set them: shifts, overrides, ranges."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from twirl_mjx.sim.dynamics import Dynamics, broadcast, draw, leaf_value, make_dynamics, stack
from twirl_mjx.sim.leaves import (
    HILL_ANGLE,
    LEAVES,
    NOMINAL_VALUES,
    PAPER_SHIFTS,
    SHIFTS,
    Shift,
    get_shift,
    register_shift,
    shift_names,
)
from twirl_mjx.sim.ranges import NO_RANGES, Ranges, parse_ranges

ROOT = Path(__file__).parents[2]

NOMINAL = {
    "gravity": 9.81,
    "friction": 1.0,
    "leg_strength_min": 1.0,
    "heat_rate": 0.0,
    "bump_height": 0.0,
    "incline": 0.0,
    "payload": 0.0,
    "com_x": 0.0,
    "com_y": 0.0,
    "com_z": 0.0,
    "motor_strength": 1.0,
    "kp_scale": 1.0,
    "kd_scale": 1.0,
    "latency": 0.0,
    "obs_noise": 0.0,
    "push": 0.0,
    "push_interval": 5.0,
}
CORE = {"gravity", "friction", "leg_strength_min", "heat_rate", "bump_height", "incline"}
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
    return {f.name: float(leaf_value(dynamics, f.name)) for f in dataclasses.fields(dynamics)}  # type: ignore[arg-type]


def set_leaves(dynamics: Dynamics) -> set[str]:
    return {name for name in NOMINAL if getattr(dynamics, name) is not None}


@pytest.fixture
def muddy() -> Iterator[Shift]:
    """A user's shift, registered for one test."""
    shift = register_shift(Shift("muddy", friction=0.5, payload=1.5, push_interval=3.0))
    yield shift
    SHIFTS._items.pop("muddy")


def test_struct_and_table_agree() -> None:
    names = [leaf.name for leaf in LEAVES]
    assert names == [field.name for field in dataclasses.fields(Dynamics)]  # type: ignore[arg-type]
    assert names == list(NOMINAL)
    for leaf in LEAVES:
        assert leaf.low <= leaf.nominal <= leaf.high, leaf.name
        assert leaf.low < leaf.high, leaf.name
        assert leaf.unit, leaf.name
        assert leaf.about, leaf.name


def test_docs_have_the_table() -> None:
    """Name, nominal value, unit and range of every leaf, in the order of the struct."""
    text = (ROOT / "docs" / "shifts.md").read_text().split("## Every parameter")[1]
    rows = [line for line in text.split("\n## ")[0].splitlines() if line.startswith("| `")]
    expected = [
        f"| `{x.name}` | {x.nominal:g} | {x.unit} | {x.low:g} to {x.high:g} | {x.about} |"
        for x in LEAVES
    ]
    assert rows == expected


def test_the_names_are_those_of_the_config() -> None:
    assert set(PAPER_SHIFTS) == set(CHANGES)
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
    assert set_leaves(make_dynamics(name, strength)) == CORE


def test_strengths_beyond_the_paper_s() -> None:
    assert float(make_dynamics("icy", 4 / 3).friction) == pytest.approx(0.2)  # the stress level
    assert float(make_dynamics("sloped", 2.0).incline) == pytest.approx(np.deg2rad(16))
    assert pytest.approx(np.deg2rad(8)) == HILL_ANGLE
    assert float(make_dynamics("bumpy", 2.0).bump_height) == pytest.approx(0.1)
    assert float(make_dynamics("weakened", 2.0).leg_strength_min) == pytest.approx(0.05)


@pytest.mark.parametrize(
    ("name", "gives", "nearest"),
    [
        ("icy", "friction -0.2", 1.65),  # (1 - 0.01) / 0.6
        ("gravity", "gravity -2.41", 1.603),  # (9.81 - 0.01) / 6.11 = 1.6039
    ],
)
def test_strength_beyond_physics_is_refused(name: str, gives: str, nearest: float) -> None:
    with pytest.raises(
        ValueError, match=rf"{name} at strength 2.0 gives {gives}, .*strength {nearest}\)"
    ):
        make_dynamics(name, 2.0)
    make_dynamics(name, nearest)


@pytest.mark.parametrize(("strength", "nearest"), [(-0.1, "0"), (2.1, "2"), (np.nan, "0")])
def test_strength_out_of_range_is_refused(strength: float, nearest: str) -> None:
    with pytest.raises(ValueError, match=rf"{strength}.*\[0, 2\].*nearest: {nearest}"):
        make_dynamics("icy", strength)


@pytest.mark.parametrize(("name", "nearest"), [("bump", "bumpy"), ("gravty", "gravity")])
def test_unknown_shift_names_the_nearest(name: str, nearest: str) -> None:
    with pytest.raises(ValueError, match=rf"'{name}'.*nearest: '{nearest}'"):
        get_shift(name)


def test_leaves_are_float32_and_not_weak() -> None:
    leaves = jax.tree.leaves(make_dynamics("icy", 1.0, {"payload": 2.0}))
    assert len(leaves) == 7
    for leaf in leaves:
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


def test_what_is_nominal_in_some_worlds_is_stacked_as_such() -> None:
    heavy = make_dynamics(overrides={"payload": 2.0})
    late = make_dynamics(overrides={"latency": 0.02, "kp_scale": 1.0})
    both = stack([heavy, late], 1)
    assert set_leaves(both) == CORE | {"payload", "latency"}  # a nominal override is none
    np.testing.assert_allclose(both.payload, [2.0, 0.0])
    np.testing.assert_allclose(both.latency, [0.0, 0.02])


def test_overrides_come_after_the_shift() -> None:
    values = values_of(make_dynamics("icy", 0.5, {"friction": 0.3, "payload": 2.0}))
    assert values == pytest.approx(NOMINAL | {"friction": 0.3, "payload": 2.0}, rel=1e-6)
    kept = values_of(make_dynamics("weakened", 1.0, {"heat_rate": 0.0}))
    assert kept == pytest.approx(NOMINAL | {"leg_strength_min": 0.5})
    hill = make_dynamics("sloped", 1.0, {"incline": 0.1})
    assert float(hill.incline) == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"fricton": 0.3}, "unknown dynamics.leaf 'fricton'.*nearest: 'friction'"),
        ({"friction": 5.0}, r"dynamics.friction = 5.0 is outside \[0.01, 4.0\] \(nearest: 4.0\)"),
        ({"payload": float("nan")}, r"dynamics.payload = nan is outside \[-1.0, 10.0\]"),
        ({"push": "hard"}, "dynamics.push = 'hard' is not a number"),
        ({"incline": 0.1}, "dynamics.incline acts in a sloped scene only, not in a flat one"),
    ],
)
def test_refused_overrides(overrides: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_dynamics("icy", 1.0, overrides)


def test_a_user_s_shift(muddy: Shift) -> None:
    assert shift_names() == (*CHANGES, "muddy")
    assert get_shift("muddy") is muddy
    assert register_shift(Shift("muddy", friction=0.5, payload=1.5, push_interval=3.0)) == muddy
    changed = {"friction": 0.75, "payload": 0.75, "push_interval": 4.0}
    assert values_of(make_dynamics("muddy", 0.5)) == pytest.approx(NOMINAL | changed)
    with pytest.raises(ValueError, match="another shift called 'muddy'"):
        register_shift(Shift("muddy", friction=0.4))
    with pytest.raises(ValueError, match="another shift called 'icy'"):
        register_shift(Shift("icy", friction=0.3))


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("deep mud", {}, "shift name 'deep mud' is not one word .nearest: 'deep_mud'"),
        ("../x", {}, "not one word"),
        ("mud", {"frictoin": 0.5}, "shift 'mud': leaf 'frictoin'.*nearest: 'friction'"),
        ("mud", {"friction": 9.0}, "shift 'mud': friction = 9.0 is outside .*nearest: 4.0"),
        ("mud", {"friction": True}, "friction = True is not a number"),
        ("mud", {"bump_height": 0.05}, "bump_height acts in a bumpy scene only"),
        ("mud", {"scene": "hilly"}, "scene 'hilly': choose one of flat, bumpy, sloped"),
    ],
)
def test_refused_shifts(name: str, options: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Shift(name, **options)


def test_ranges_are_read_and_written_back() -> None:
    ranges = parse_ranges(["payload=-1:2", "friction=0.4:1.25", "latency=0:0.03"])
    assert ranges.bounds == (
        ("friction", 0.4, 1.25),
        ("payload", -1.0, 2.0),
        ("latency", 0.0, 0.03),
    )
    assert ranges.texts() == ("friction=0.4:1.25", "payload=-1.0:2.0", "latency=0.0:0.03")
    assert parse_ranges(ranges.texts()) == ranges
    assert len({ranges, parse_ranges(ranges.texts()), NO_RANGES}) == 2
    assert ranges
    assert not parse_ranges([])


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        (["fricton=0.4:1"], "unknown range of leaf 'fricton'.*nearest: 'friction'"),
        (["friction=1.25:0.4"], "is reversed .nearest: friction=0.4:1.25"),
        (["friction=0:1"], r"range of friction = 0.0 is outside \[0.01, 4.0\] .nearest: 0.01"),
        (["payload=-1:99"], r"range of payload = 99.0 is outside .*nearest: 10.0"),
        (["payload=nan:2"], r"range of payload = nan is outside"),
        (["friction=low:1"], "'friction=low:1' is not a pair of numbers"),
        (["friction"], "'friction' is not a range: write leaf=low:high"),
        (["friction=0.4"], "'friction=0.4' is not a range"),
        (["push=0:1", "push=0:0.5"], "range of push is given twice"),
    ],
)
def test_refused_ranges(texts: list[str], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        parse_ranges(texts)


def test_ranges_that_do_nothing_in_a_scene_are_refused() -> None:
    ranges = parse_ranges(["bump_height=0:0.1", "friction=0.5:1"])
    ranges.check_scene("bumpy")
    with pytest.raises(ValueError, match="bump_height acts in a bumpy scene only, not in a flat"):
        ranges.check_scene("flat")


def test_draws_are_uniform_and_independent() -> None:
    """U(0.4, 1.2): mean 0.8, deviation 0.8 / sqrt(12) = 0.231; other leaves are left alone."""
    keys = jax.random.split(jax.random.key(0), 4000)
    sample = jax.jit(jax.vmap(draw, (0, None, None)), static_argnums=2)
    icy = make_dynamics("icy")
    drawn = sample(keys, icy, parse_ranges(["friction=0.4:1.2", "payload=-1:2"]))
    friction, payload = np.asarray(drawn.friction), np.asarray(drawn.payload)
    assert 0.4 <= friction.min() < 0.41
    assert 1.19 < friction.max() <= 1.2
    assert friction.mean() == pytest.approx(0.8, abs=0.01)
    assert friction.std() == pytest.approx(0.231, abs=0.005)
    assert payload.mean() == pytest.approx(0.5, abs=0.04)
    assert abs(np.corrcoef(friction, payload)[0, 1]) < 0.05
    assert set_leaves(drawn) == CORE | {"payload"}
    np.testing.assert_array_equal(drawn.gravity, np.full(4000, np.float32(9.81)))
    alone = sample(keys, icy, Ranges((("payload", -1.0, 2.0),)))
    np.testing.assert_array_equal(alone.payload, payload)  # whatever else is drawn
    np.testing.assert_array_equal(alone.friction, np.full(4000, np.float32(0.4)))
