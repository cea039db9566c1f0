"""Task ``hurdles``: terms by hand, hurdle switching, substep contact, clean clearances."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from twirl_mjx.evaluation.record import Recording, scene_model
from twirl_mjx.sim.dynamics import make_dynamics
from twirl_mjx.sim.robots import A1
from twirl_mjx.sim.scene import build_scene, terrain_height
from twirl_mjx.tasks import base, rewards
from twirl_mjx.tasks.hurdles import WEIGHTS, Hurdles, HurdlesOptions, HurdlesState, advance, watch
from twirl_mjx.tasks.observations import layout_size, layout_slices
from twirl_mjx.worlds.config import WorldConfig
from twirl_mjx.worlds.make import make_env

FLAT = build_scene("flat")
NOMINAL = make_dynamics()
TASK = Hurdles()
POSITIONS = (2.0, 4.0, 6.0)
SUBSTEPS = 10


def standing(x: float = 0.0, z: float = A1.home_height) -> np.ndarray:
    return np.concatenate([[x, 0.0, z, 1.0, 0.0, 0.0, 0.0], A1.default_pose])


def flying(xs: np.ndarray, z: float = 0.6) -> np.ndarray:
    """A trace [S, 19] of the default pose high above the ground at the given x."""
    return np.stack([standing(x, z) for x in xs])


def task_state(passed: int = 0) -> HurdlesState:
    none = jnp.zeros(len(POSITIONS), bool)
    return HurdlesState(
        start=jnp.array([0.0, 0.5]),
        positions=jnp.array(POSITIONS),
        passed=jnp.int32(passed),
        stepped_in=none,
        cleared=none,
    )


def judge_with(task: Hurdles) -> Callable[..., base.Outcome]:
    @jax.jit
    def judge(state: HurdlesState, trace: jax.Array, qvel: jax.Array) -> base.Outcome:
        unused: Any = None
        world = base.World(
            key=unused,
            episode_step=jnp.int32(1),
            action=jnp.zeros(12),
            filter=unused,
            motors=unused,
            dynamics=NOMINAL,
            goal=jnp.zeros(2),
            memory=unused,
            task=state,
        )
        view = base.make_view(FLAT, NOMINAL, trace, jnp.tile(qvel, (SUBSTEPS, 1)))
        return task.judge(world, view, FLAT)

    def call(state: HurdlesState, trace: np.ndarray, qvel: np.ndarray | None = None) -> Any:
        qvel = np.zeros(18) if qvel is None else qvel
        return judge(state, jnp.asarray(trace, jnp.float32), jnp.asarray(qvel, jnp.float32))

    return call


JUDGE = judge_with(TASK)
WATCH = jax.jit(
    lambda trace, height=0.01: watch(FLAT, NOMINAL, trace, jnp.array(POSITIONS), height)
)


def test_layout_covers_the_observation() -> None:
    slices = list(layout_slices(TASK.observer.layout).values())
    assert layout_size(TASK.observer.layout) == 95
    assert [s.start for s in slices] == [0, *(s.stop for s in slices[:-1])]
    assert slices[-1].stop == 95


def test_reward_terms_by_hand() -> None:
    assert float(rewards.forward(jnp.array(0.5))) == pytest.approx(0.007)
    assert float(rewards.forward(jnp.array(0.5001))) == 1.0
    assert float(rewards.forward(jnp.array(-3.0))) == pytest.approx(0.007)
    assert float(rewards.orientation(jnp.array(0.0))) == 1.0
    assert float(rewards.orientation(jnp.array(0.5))) == pytest.approx(0.367879, abs=1e-6)
    assert float(rewards.joint_calm(jnp.zeros(12))) == 1.0
    vel = jnp.zeros(12).at[3].set(3.0).at[7].set(-4.0)  # |qdot| = 5
    assert float(rewards.joint_calm(vel)) == pytest.approx(0.606531, abs=1e-6)


def test_judge_weighs_the_terms() -> None:
    trace = flying(np.full(SUBSTEPS, 2.9))
    trace[-1, 3:7] = [np.cos(0.15), 0.0, np.sin(0.15), 0.0]  # 0.3 rad nose down
    qvel = np.zeros(18)
    qvel[0], qvel[6], qvel[5] = 1.5, 10.0, 7.0
    out = JUDGE(task_state(passed=1), trace, qvel)
    want = {"forward": 1.0, "orientation": np.exp(-0.6), "joint_calm": np.exp(-1.0), "hurdle": 1.0}
    for name, value in want.items():
        assert float(out.metrics[name]) == pytest.approx(value, rel=1e-5), name
    assert float(out.reward) == pytest.approx(sum(WEIGHTS[n] * v for n, v in want.items()))
    assert float(out.reward) == pytest.approx(0.7 + 0.05 * 0.548812 + 0.15 * 0.367879 + 0.1)
    assert float(out.metrics["distance_x"]) == pytest.approx(2.9)
    assert float(out.metrics["goal_distance"]) == pytest.approx(np.hypot(1.1, 0.5))
    assert not out.terminated


@pytest.mark.parametrize(
    ("passed", "x", "after"),
    [(0, 2.39, 0), (0, 2.41, 1), (1, 2.0, 1), (1, 4.39, 1), (1, 4.41, 2), (2, 6.5, 3), (3, 9.0, 3)],
)
def test_the_goal_switches_0_4_m_past_a_hurdle(passed: int, x: float, after: int) -> None:
    out = JUDGE(task_state(passed), flying(np.full(SUBSTEPS, x)))
    assert int(out.task.passed) == after
    assert float(out.metrics["hurdles_passed"]) == after
    np.testing.assert_allclose(out.goal, [POSITIONS[min(after, 2)], 0.5])


CLEAN = judge_with(Hurdles(HurdlesOptions(hurdle_bonus="clean")))


def test_count_pays_always_and_event_pays_once() -> None:
    event = HurdlesOptions(hurdle_bonus="event")
    for judge, want in (
        (JUDGE, (0.0, 1.0, 1.0, 2.0)),
        (judge_with(Hurdles(event)), (0, 1, 0, 1)),
        (CLEAN, (0.0, 1.0, 1.0, 2.0)),  # all feet stay in the air
    ):
        state, got = task_state(), []
        for x in (2.3, 2.45, 2.6, 4.5):
            out = judge(state, flying(np.full(SUBSTEPS, x)))
            state = out.task
            got.append(float(out.metrics["hurdle"]))
            rest = sum(WEIGHTS[n] * float(out.metrics[n]) for n in WEIGHTS if n != "hurdle")
            assert float(out.reward) == pytest.approx(rest + 0.1 * got[-1])
        assert got == [*want]


def test_a_step_over_a_hurdle_earns_no_clean_bonus() -> None:
    state = task_state()
    for x, z in ((2.0, A1.home_height - 0.01), (2.5, 0.6), (4.5, 0.6)):
        # On the ground astride the first hurdle, then flying over the second.
        out = CLEAN(state, flying(np.full(SUBSTEPS, x), z))
        state = out.task
    assert (int(state.passed), float(out.metrics["hurdle"])) == (2, 1.0)
    assert float(out.metrics["clean_clearances"]) == 1.0


def test_a_touch_within_the_step_is_found() -> None:
    xs = np.linspace(1.5, 2.0, SUBSTEPS)
    trace = flying(xs)
    assert not JUDGE(task_state(), trace).terminated
    trace[4, 2] = A1.home_height  # feet on the ground for one substep, FR and FL at the hurdle
    trace[4, 0] = 2.0 - 0.183
    out = JUDGE(task_state(), trace)
    assert out.terminated
    assert out.metrics["hit_hurdle"]
    assert not out.metrics["fall"]
    trace[4, 0] = 1.5  # the same beside the hurdle
    assert not JUDGE(task_state(), trace).terminated


@pytest.mark.parametrize("height", [0.01, 0.05, 0.1])
def test_how_near_a_foot_may_come(height: float) -> None:
    # Feet are 0.183 m before and behind the root, calves slant back and up from them.
    for gap, hit in ((-0.0005, True), (0.0005, False)):
        above = standing(2.0 + 0.183, A1.home_height + height + gap)
        beside = standing(2.0 - 0.183 - 0.1 - 0.02 - gap, A1.home_height - 0.01)
        for pose in (above, beside):
            trace = jnp.asarray(np.tile(pose, (SUBSTEPS, 1)), jnp.float32)
            assert bool(WATCH(trace, height).hit) is hit


def test_the_option_height_decides_what_is_a_touch() -> None:
    trace = flying(np.linspace(1.8, 2.2, SUBSTEPS), A1.home_height + 0.03)  # feet 3 cm up
    assert not JUDGE(task_state(), trace).terminated
    higher = judge_with(Hurdles(HurdlesOptions(height=0.05)))(task_state(), trace)
    assert higher.terminated
    assert higher.metrics["hit_hurdle"]
    with pytest.raises(ValueError, match=r"hurdles\.height = 0\.5 is outside .*nearest: 0\.2"):
        HurdlesOptions(height=0.5)


def test_pictures_show_bands_as_high_as_they_are() -> None:
    config = WorldConfig(task="hurdles", options=HurdlesOptions(height=0.05))
    painted = make_env(config, num_envs=1).painter._model((2.0,), 0.0).geom("hurdle_0")
    assert 2 * painted.size[2] == pytest.approx(0.05)
    recording = Recording(
        np.zeros((1, 19)), np.zeros((1, 3)), np.zeros(1), {}, (2.0,), np.ones(4), A1, 0.1
    )
    assert 2 * scene_model(config, recording).geom("hurdle_0").size[2] == pytest.approx(0.1)


def test_hind_feet_still_hit_a_hurdle_that_was_passed() -> None:
    pose = standing(2.41)
    pose[7:] = np.tile([0.0, 1.6, -1.2], 4)  # feet far back: 0.28 m behind their hips
    trace = np.tile(pose, (SUBSTEPS, 1))
    trace[:, 2] = 0.2 * np.cos(1.6) + 0.2 * np.cos(0.4) + A1.foot_radius
    out = JUDGE(task_state(passed=0), trace)
    assert int(out.task.passed) == 1
    assert out.metrics["hit_hurdle"]


def test_fall_is_a_touch_of_the_trunk() -> None:
    for z, fall in ((0.0575, False), (0.0565, True)):  # the trunk's capsules have radius 0.057
        pose = standing(0.0, z)
        pose[7:] = np.tile([0.0, np.pi / 2, -0.92], 4)  # legs folded back and up
        out = JUDGE(task_state(), np.tile(pose, (SUBSTEPS, 1)))
        assert bool(out.metrics["fall"]) is fall
        assert bool(out.terminated) is fall


def cross(land_at: float, take_off_at: float = 1.7) -> HurdlesState:
    """Run over the first hurdle in steps of 0.1 m, off the ground from one root x to another."""
    state = task_state()
    for step in range(12, 30):
        xs = 0.1 * step + np.linspace(0.01, 0.1, SUBSTEPS)
        trace = np.stack(
            [standing(x, A1.home_height + (0.1 if take_off_at <= x < land_at else 0.0)) for x in xs]
        )
        state = advance(state, WATCH(jnp.asarray(trace, jnp.float32)), xs[-1])
    return state


@pytest.mark.parametrize(
    ("take_off_at", "land_at", "clean"),
    # Front feet reach the near edge with the root at 1.717, hind feet the far edge at 2.283.
    [(1.70, 2.30, True), (1.70, 2.27, False), (1.75, 2.30, False), (0.0, 9.0, True)],
)
def test_a_clean_clearance_is_one_flight(take_off_at: float, land_at: float, clean: bool) -> None:
    state = cross(land_at, take_off_at)
    assert int(state.passed) == 1
    assert state.cleared.tolist() == [clean, False, False]
    assert bool(state.stepped_in[0]) is not clean


def test_a_hurdle_is_cleared_only_when_passed_and_behind() -> None:
    crossing = WATCH(jnp.asarray(flying(np.full(SUBSTEPS, 2.35)), jnp.float32))
    assert not advance(task_state(), crossing, jnp.float32(2.35)).cleared.any()
    behind = crossing._replace(last_foot=jnp.float32(2.05))
    assert not advance(task_state(), behind, jnp.float32(2.45)).cleared.any()
    past = crossing._replace(last_foot=jnp.float32(2.15))
    assert advance(task_state(), past, jnp.float32(2.45)).cleared.tolist() == [True, False, False]


def test_start_draws_a_course() -> None:
    keys = jax.random.split(jax.random.key(3), 8)
    start = jax.jit(jax.vmap(lambda key: TASK.start(key, FLAT, NOMINAL)))(keys)
    gaps = np.diff(np.asarray(start.task.positions), axis=1, prepend=0.0)
    assert gaps.min() >= 1.6 - 1e-4
    assert gaps.max() <= 2.6 + 1e-4
    assert len({round(float(x), 4) for x in start.task.positions[:, 0]}) == 8
    np.testing.assert_array_equal(start.goal[:, 0], start.task.positions[:, 0])
    assert 1.6 * TASK.num_hurdles > 20.0 * 3.3  # more than the A1 can run in an episode

    fixed = Hurdles(fixed_course=True)
    start = jax.jit(lambda key: fixed.start(key, FLAT, NOMINAL))(keys[0])
    np.testing.assert_allclose(start.task.positions[:3], [2.1, 4.2, 6.3], rtol=1e-5)


def test_gaps_in_which_two_hurdles_are_within_reach_are_refused() -> None:
    for options in (HurdlesOptions(min_gap=1.0), HurdlesOptions(min_gap=2.0, max_gap=1.8)):
        with pytest.raises(ValueError, match=r"gaps from .* at least 1\.4 m .*nearest"):
            Hurdles(options)


def test_hurdles_stand_on_the_local_ground() -> None:
    scene, dynamics = build_scene("sloped"), make_dynamics("sloped")
    pose = jnp.asarray(standing(2.0 - 0.183), jnp.float32)
    ground = terrain_height(scene, jnp.array([2.0, 0.0]), dynamics.incline, dynamics.bump_height)
    assert float(ground) == pytest.approx(1.5 * np.tan(np.radians(8.0)))
    sloped = jax.jit(lambda trace: watch(scene, dynamics, trace, jnp.array(POSITIONS), 0.01))
    for over, hit in ((0.0, True), (0.02, False)):
        trace = jnp.tile(pose.at[2].add(ground + over), (SUBSTEPS, 1))
        assert bool(sloped(trace).hit) is hit


def test_bumpy_courses_stay_on_the_terrain() -> None:
    scene, dynamics = build_scene("bumpy"), make_dynamics("bumpy")
    keys = jax.random.split(jax.random.key(4), 8)
    start = jax.jit(jax.vmap(lambda key: TASK.start(key, scene, dynamics)))(keys)
    x, y = np.asarray(start.qpos[:, :2]).T
    assert -29.0 <= x.min() < x.max() <= -19.0
    assert np.ptp(y) > 5.0
    np.testing.assert_allclose(start.task.positions[:, 0] - x, 2.1, atol=0.5 + 1e-4)
    np.testing.assert_allclose(start.goal[:, 1], y)


def test_rewards_of_simulated_worlds(
    worlds: Callable[..., Any], actions: Callable[..., np.ndarray]
) -> None:
    made = worlds("hurdles")
    first = made.reset(0)
    assert first.obs.shape == (3, 95)
    for state in made.run(first, actions(4, 3)):
        assert not state.invalid.any()
        total = sum(WEIGHTS[name] * state.metrics[name] for name in WEIGHTS)
        np.testing.assert_allclose(state.reward, total, rtol=1e-5)
        assert set(state.metrics) == set(made.env.metric_names)
    assert made.traces["step"] == 1
    goal = first.world.goal - first.data.qpos[:, :2]
    np.testing.assert_allclose(first.obs[:, :2], goal, atol=1e-6)
