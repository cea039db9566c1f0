"""The numpy task definitions of the rehearsal: by hand, and against the simulation's own."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from twirl_mjx.deploy.reference import Observer, Reading, Score, quaternion_matrix
from twirl_mjx.sim.robots import A1
from twirl_mjx.tasks.observations import ProprioceptiveObserver


def random_states(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return qpos [T, 19], qvel [T, 18] and actions [T, 12]; any attitude is possible."""
    rng = np.random.default_rng(seed)
    qpos, qvel = rng.standard_normal((count, 19)), rng.standard_normal((count, 18))
    qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
    return qpos, qvel, rng.uniform(-1, 1, (count, 12))


def reading_of(qpos: np.ndarray, qvel: np.ndarray) -> Reading:
    return Reading(quaternion_matrix(qpos[3:7]), qvel[3:6], qpos[7:19], qpos[:3])


def test_rotation_matrix() -> None:
    for quat in random_states(5)[0][:, 3:7]:
        expected = Rotation.from_quat(quat, scalar_first=True).as_matrix()
        np.testing.assert_allclose(quaternion_matrix(quat), expected, atol=1e-12)


def test_observation_by_hand() -> None:
    """Nose up by 30 deg, yawed by 90 deg, after one step: every block where it belongs."""
    first = Reading(np.eye(3), np.zeros(3), np.zeros(12), np.array([1.0, 2.0, 0.3]))
    observer = Observer("biped", first)
    rotation = Rotation.from_euler("ZYX", [90, -30, 0], degrees=True).as_matrix()
    joints, action = np.arange(12) / 10, np.arange(12) / -12
    second = Reading(rotation, np.array([0.5, 0.6, 0.7]), joints, np.array([1.5, 2.0, 0.4]))
    observer.push(second, action)
    obs = observer.observe(second, np.array([3.0, 1.0]))
    assert obs.shape == (101,)
    assert obs.dtype == np.float32
    np.testing.assert_allclose(obs[0:2], [1.5, -1.0], atol=1e-6)
    np.testing.assert_array_equal(obs[2:64], np.zeros(62))  # two copies of the first reading
    newest = obs[64:95]
    np.testing.assert_allclose(newest[:2], [0.0, np.deg2rad(-30)], atol=1e-6)
    np.testing.assert_allclose(newest[2:4], [0.5, 0.6], atol=1e-6)
    np.testing.assert_allclose(newest[4:16], joints, atol=1e-6)
    np.testing.assert_allclose(newest[16:19], [0.5, 0.0, 0.1], atol=1e-6)
    np.testing.assert_allclose(newest[19:31], action, atol=1e-6)
    np.testing.assert_allclose(obs[95:98], [0.0, np.sqrt(0.75), 0.5], atol=1e-6)
    np.testing.assert_allclose(obs[98:101], [0.0, -0.5, np.sqrt(0.75)], atol=1e-6)


@pytest.mark.parametrize(("task", "size"), [("stand", 101), ("biped", 101), ("hurdles", 95)])
def test_observation_equals_the_simulation_s(task: str, size: int) -> None:
    qpos, qvel, actions = random_states(6)
    goal = np.array([1.0, -2.0])
    theirs = ProprioceptiveObserver(A1, axes=size == 101)
    memory = theirs.init(jnp.asarray(qpos[0]), jnp.asarray(qvel[0]))
    ours = Observer(task, reading_of(qpos[0], qvel[0]))
    for i in range(6):
        if i:
            args = (jnp.asarray(x, jnp.float32) for x in (qpos[i], qvel[i], actions[i]))
            memory = theirs.push(memory, *args)
            ours.push(reading_of(qpos[i], qvel[i]), actions[i])
        expected = theirs.observe(memory, jnp.asarray(goal), jnp.asarray(qpos[i]), jnp.zeros(18))
        obs = ours.observe(reading_of(qpos[i], qvel[i]), goal)
        assert obs.shape == (size,)
        np.testing.assert_allclose(obs, expected, atol=2e-5)


def make_qpos(pitch_up_deg: float, x: float = 0.0, z: float = 0.5) -> np.ndarray:
    half = np.deg2rad(-pitch_up_deg) / 2
    qpos = np.zeros(19)
    qpos[:7] = [x, 0.0, z, np.cos(half), 0.0, np.sin(half), 0.0]
    return qpos


LIFTED, DOWN = np.array([0.3, 0.3]), np.array([0.3, 0.005])


def test_stand_reward_by_hand() -> None:
    score = Score("stand", np.zeros(0))
    goal = np.zeros(2)
    # nose straight up: (0.5 + 0.5)^2 + e^0.5 - 1
    assert score.step(make_qpos(90), np.zeros(18), LIFTED, goal) == pytest.approx(1.6487213)
    # level: (0.5)^2 + e^0.5 - 1
    assert score.step(make_qpos(0), np.zeros(18), LIFTED, goal) == pytest.approx(0.8987213)
    assert score.reward_sum == pytest.approx(1.6487213 + 0.8987213)
    feet = Score("stand", np.zeros(0), height_of="front_feet")
    # foot centres at 0.32 m: 1 + e^0.32 - 1
    assert feet.step(make_qpos(90), np.zeros(18), LIFTED, goal) == pytest.approx(1.3771278)


def test_standing_needs_cosine_and_both_front_feet() -> None:
    score = Score("stand", np.zeros(0))
    for pitch, feet in ((44, LIFTED), (45, LIFTED), (90, DOWN), (90, LIFTED)):
        score.step(make_qpos(pitch), np.zeros(18), feet, np.zeros(2))
    assert score.standing_steps == 2  # sin 44 deg = 0.695 is below 0.7


def test_biped_reward_by_hand() -> None:
    score = Score("biped", np.zeros(0))
    goal = np.array([1.0, 0.0])
    score.start(make_qpos(0)[:3], goal)
    assert score.min_distance == 1.0
    # Nose up, so down points along +x, to the goal: r_stand (1 + 1 + 0.5 for getting nearer).
    reward = score.step(make_qpos(90, x=0.2), np.zeros(18), LIFTED, goal)
    assert reward == pytest.approx(1.6487213 * 2.5)
    # Further away than before: no distance term.
    reward = score.step(make_qpos(90, x=0.1), np.zeros(18), LIFTED, goal)
    assert reward == pytest.approx(1.6487213 * 2.0)
    # Past the goal, facing away: r_facing = 0; at 5 mm: r_distance = 1.
    reward = score.step(make_qpos(90, x=1.005), np.zeros(18), LIFTED, goal)
    assert reward == pytest.approx(1.6487213 * 2.0, rel=1e-5)
    assert score.min_distance == pytest.approx(0.005)


def test_hurdles_reward_and_goal_by_hand() -> None:
    score = Score("hurdles", np.array([2.0, 4.0]))
    np.testing.assert_array_equal(score.goal(np.ones(2)), [2.0, 0.0])
    slow, fast = np.zeros(18), np.zeros(18)
    fast[0], fast[6:8] = 0.6, [3.0, 4.0]
    # 0.7 * 0.007 + 0.05 + 0.15
    reward = score.step(make_qpos(0, x=2.39), slow, LIFTED, np.array([2.0, 0.0]))
    assert reward == pytest.approx(0.2049)
    assert score.passed == 0
    # 0.7 + 0.05 e^(-2 * 0.5236) + 0.15 e^(-0.5) + 0.1
    reward = score.step(make_qpos(30, x=2.41), fast, LIFTED, np.array([2.0, 0.0]))
    assert reward == pytest.approx(0.7 + 0.05 * np.exp(-np.pi / 3) + 0.15 * np.exp(-0.5) + 0.1)
    assert score.passed == 1
    np.testing.assert_array_equal(score.goal(np.ones(2)), [4.0, 0.0])


def test_a_hurdle_stays_passed_when_the_robot_moves_back() -> None:
    score = Score("hurdles", np.array([2.0, 4.0]))
    for x in (2.41, 2.3):
        reward = score.step(make_qpos(0, x=x), np.zeros(18), LIFTED, np.array([2.0, 0.0]))
        assert reward == pytest.approx(0.2049 + 0.1)
        assert score.passed == 1
        np.testing.assert_array_equal(score.goal(np.ones(2)), [4.0, 0.0])
