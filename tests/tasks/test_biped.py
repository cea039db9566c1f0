"""Task ``biped``: reward, measures, terminations and where its goals are."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from twirl_mjx.sim.dynamics import make_dynamics
from twirl_mjx.sim.robots import A1
from twirl_mjx.sim.scene import build_scene
from twirl_mjx.tasks import base
from twirl_mjx.tasks.base import Outcome
from twirl_mjx.tasks.biped import Biped, BipedOptions, BipedState
from twirl_mjx.tasks.goals import GoalOptions, draw_goal, walked
from twirl_mjx.worlds.config import WorldConfig


def numpy_terms(qpos: np.ndarray, goal: np.ndarray, previous: float) -> dict[str, float]:
    """Return the terms of the paper's appendix, from the pose alone."""
    matrix = Rotation.from_quat(qpos[3:7], scalar_first=True).as_matrix()
    way = goal - qpos[:2]
    distance = float(np.hypot(*way))
    down = -matrix[:, 2]
    facing = (0.5 * float(down[:2] @ way) / distance + 0.5) ** 2
    upright, bonus = (0.5 * matrix[2, 0] + 0.5) ** 2, float(np.exp(qpos[2]) - 1.0)
    nearer = 1.0 if distance <= 0.01 else 0.5 * (distance < previous)
    return {
        "upright": upright,
        "height": bonus,
        "stand": upright + bonus,
        "facing": facing,
        "distance": nearer,
        "goal_distance": distance,
        "cosine": matrix[2, 0],
    }


def test_reward_recomputed_from_the_state(
    worlds: Callable[..., Any], actions: Callable[..., np.ndarray], read: Callable[..., Any]
) -> None:
    made = worlds("biped")
    first = made.reset(4)
    state, checked, nearer = read(first), 0, 0
    for after in map(read, made.run(first, actions(8, 3, scale=0.8))):
        for world in np.flatnonzero(~(after.done | state.done)):
            goal, before, qpos = state.goal[world], state.qpos[world], after.qpos[world]
            expected = numpy_terms(qpos, goal, float(np.hypot(*(goal - before[:2]))))
            for name, value in expected.items():
                got = float(after.metrics[name][world])
                assert got == pytest.approx(value, abs=1e-5), name
            total = expected["stand"] * (1.0 + expected["facing"] + expected["distance"])
            assert float(after.reward[world]) == pytest.approx(total, abs=5e-5)
            checked += 1
            nearer += expected["distance"] > 0
        state = after
    assert checked >= 12
    assert 0 < nearer < checked


def raised(x: float, pitch_up: float = 90.0, z: float = 0.5) -> np.ndarray:
    half = np.deg2rad(-pitch_up) / 2
    return np.concatenate([[x, 0, z, np.cos(half), 0, np.sin(half), 0], A1.default_pose])


def test_reward_by_hand(judge: Callable[..., Outcome]) -> None:
    """Goal 1 m ahead; nose up at 0.5 m: r_stand = 1.6487213, the belly faces +x."""
    task = Biped()
    outcome = judge(task, [raised(0.2), raised(1.5), raised(1.005)], previous=0.9)
    # nearer and facing; nearer but the goal is behind; at the goal with it 5 mm behind
    expected = 1.6487213 * np.array([1.0 + 1.0 + 0.5, 1.0 + 0.0 + 0.5, 1.0 + 0.0 + 1.0])
    np.testing.assert_allclose(outcome.reward, expected, rtol=1e-5)
    np.testing.assert_allclose(outcome.metrics["goal_distance"], [0.8, 0.5, 0.005], atol=1e-6)
    np.testing.assert_allclose(outcome.task.previous_distance, [0.8, 0.5, 0.005], atol=1e-6)
    near = np.exp([-0.8, -0.5, -0.005]) * np.asarray(outcome.metrics["standing"])
    assert np.all(near > 0), "upright with its front feet in the air"
    np.testing.assert_allclose(outcome.metrics["at_goal"], near, rtol=1e-5)
    away = judge(task, [raised(0.2)], previous=0.8)  # not nearer than before
    np.testing.assert_allclose(away.reward, 1.6487213 * 2.0, rtol=1e-5)
    four = judge(task, [raised(0.0, pitch_up=0.0, z=0.27)], previous=2.0)
    np.testing.assert_allclose(four.reward, 0.5599645 * (1.0 + 0.25 + 0.5), rtol=1e-5)


@pytest.mark.parametrize(("gap", "value"), [(0.0095, 1.0), (0.0105, 0.5)])
def test_goal_is_reached_within_a_centimetre(
    judge: Callable[..., Outcome], gap: float, value: float
) -> None:
    outcome = judge(Biped(), [raised(1.0 - gap)], previous=0.5)
    assert outcome.metrics["distance"] == pytest.approx(value)


def test_knees_may_touch_the_ground_but_nothing_above_them(
    judge: Callable[..., Outcome], poses: dict[str, np.ndarray]
) -> None:
    outcome = judge(Biped(), list(poses.values()))
    assert dict(zip(poses, outcome.terminated.tolist(), strict=True)) == {
        "on four feet": False,
        "on the hind feet": False,
        "kneeling": False,
        "on its side": True,
        "on the hips": True,
        "on its back": True,
        "on its head": True,
    }


def draw_goals(options: GoalOptions, count: int, *, fixed: bool = False) -> np.ndarray:
    """Return the displacements [count, 2] in m of goals drawn around (2, -3)."""
    start = jnp.array([2.0, -3.0])
    keys = jax.random.split(jax.random.key(2), count)
    goals = jax.jit(jax.vmap(lambda key: draw_goal(key, options, start, fixed_course=fixed)))(keys)
    return np.asarray(goals - start)


def test_goals_lie_on_a_circle_of_random_radius() -> None:
    """radius = clip(Exp(1.5), 0.3, 5): mean 0.3 + 1.5 (e^-0.2 - e^(-10/3)) = 1.47459 m."""
    displacement = draw_goals(GoalOptions(), 20_000)
    radius = np.hypot(*displacement.T)
    assert radius.min() == pytest.approx(0.3, abs=1e-5)
    assert radius.max() == pytest.approx(5.0, abs=1e-5)
    assert radius.mean() == pytest.approx(1.47459, abs=0.03)
    assert (radius < 0.3001).mean() == pytest.approx(1 - np.exp(-0.2), abs=0.01)
    assert (radius > 4.9999).mean() == pytest.approx(np.exp(-10 / 3), abs=0.005)
    angle = np.arctan2(displacement[:, 1], displacement[:, 0])
    counts, _ = np.histogram(angle, bins=8, range=(-np.pi, np.pi))
    np.testing.assert_allclose(counts, 2500, rtol=0.08)


def test_fixed_course() -> None:
    def fixed(**options: Any) -> np.ndarray:
        return draw_goals(BipedOptions(**options), 20, fixed=True)

    np.testing.assert_allclose(fixed(), np.tile([1.5, 0.0], (20, 1)), atol=1e-6)
    np.testing.assert_allclose(
        fixed(fixed_goal=(0.5, 2.0)), np.tile([0.5, 2.0], (20, 1)), atol=1e-6
    )
    np.testing.assert_allclose(fixed(goal_distance=3.0), np.tile([3.0, 0.0], (20, 1)), atol=1e-6)


@pytest.mark.parametrize(
    ("shift", "course", "fixed"),
    [("icy", "auto", True), ("none", "fixed", True), ("icy", "random", False),
     ("none", "auto", False)],
)  # fmt: skip
def test_which_course_is_fixed(shift: str, course: Any, fixed: bool) -> None:
    config = WorldConfig(task="biped", shift=shift, course=course)
    assert config.make_task().fixed_course == fixed
    goals = draw_goals(config.options, 20, fixed=fixed)
    assert len(np.unique(goals, axis=0)) == (1 if fixed else 20)


def test_goal_stays_put_and_observation_points_to_it(
    worlds: Callable[..., Any], actions: Callable[..., np.ndarray]
) -> None:
    made = worlds("biped")
    first = made.reset(5)
    radius = np.hypot(*np.asarray(first.world.goal).T)
    assert (radius >= 0.3 - 1e-6).all()
    assert len(np.unique(radius)) == 3
    last = made.run(first, actions(3, 3))[-1]
    np.testing.assert_array_equal(last.world.goal, first.world.goal)
    np.testing.assert_allclose(
        last.obs[:, :2], np.asarray(first.world.goal - last.data.qpos[:, :2]), atol=1e-6
    )


def test_a_walking_goal_by_hand() -> None:
    task, key = Biped(BipedOptions(goal_speed=0.4)), jax.random.key(3)
    view = base.make_view(
        build_scene("flat"),
        make_dynamics(),
        jnp.asarray(raised(0.2)[None], jnp.float32),
        jnp.zeros((1, 18)),
    )
    goal, places, seen = jnp.array([1.0, 0.0]), [], []
    for _ in range(3):
        world: Any = SimpleNamespace(key=key, goal=goal, task=BipedState(jnp.float32(0.8)))
        outcome = task.judge(world, view, build_scene("flat"))
        goal = outcome.goal
        places.append(goal)
        seen.append(float(outcome.metrics["goal_distance"]))
    steps = np.diff([[1.0, 0.0], *np.array(places)], axis=0)
    np.testing.assert_allclose(np.hypot(*steps.T), 0.4 * 0.05, atol=1e-6)
    np.testing.assert_allclose(steps, np.tile(steps[0], (3, 1)), atol=1e-6)  # straight on
    np.testing.assert_allclose(
        seen, np.linalg.norm(np.array(places) - [0.2, 0.0], axis=1), atol=1e-6
    )
    other = walked(jax.random.key(4), jnp.zeros(2), 1.0)
    assert not np.allclose(other, walked(key, jnp.zeros(2), 1.0), atol=1e-3)
    with pytest.raises(ValueError, match=r"biped\.goal_speed = 3\.0 is outside .*nearest: 2\.0"):
        BipedOptions(goal_speed=3.0)
