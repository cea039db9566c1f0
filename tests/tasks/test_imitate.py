"""Task ``imitate``: terms by hand, a perfect tracker, re-alignment, targets, early termination."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from twirl_mjx.motion.clip import Clip
from twirl_mjx.motion.formats import write_clip
from twirl_mjx.sim.dynamics import make_dynamics
from twirl_mjx.sim.robots import A1
from twirl_mjx.sim.scene import CONTROL_DT, build_scene
from twirl_mjx.tasks import base
from twirl_mjx.tasks.imitate import (
    FLIGHT_STEPS,
    WEIGHTS,
    Imitate,
    ImitateMemory,
    ImitateOptions,
    ImitateState,
    count_flights,
)

FLAT = build_scene("flat", collision="feet")
NOMINAL = make_dynamics()
CYCLE = 1.2
SPEED = 1.75
CYCLE_STEPS = 24


def synthetic_clip(yaw: float = 0.0, **changes: Any) -> Clip:
    """A leap-like motion at constant forward speed, 1.2 s and 2.1 m a cycle."""
    phase = np.linspace(0.0, 1.0, 49)
    swing = np.sin(2 * np.pi * phase)
    x = SPEED * CYCLE * phase
    z = A1.home_height + 0.3 * np.sin(np.pi * phase) ** 2
    turn = Rotation.from_euler("z", yaw)
    pitch = Rotation.from_euler("y", 0.2 * swing[:, None])
    joints = A1.default_pose + 0.2 * swing[:, None] * np.tile([0.3, 1.0, -1.0], 4)
    clip = Clip(
        root_pos=turn.apply(np.stack([x, 0.0 * x, z], axis=1)) + np.array([0.4, -0.3, 0.0]),
        root_quat=(turn * pitch).as_quat(scalar_first=True),
        joint_pos=joints,
        frame_duration=CYCLE / 48,
        name="synthetic",
    )
    return dataclasses.replace(clip, **changes)


def options_with(path: Path) -> ImitateOptions:
    return ImitateOptions(clip=str(path))


@pytest.fixture(scope="module")
def options(tmp_path_factory: pytest.TempPathFactory) -> ImitateOptions:
    path = tmp_path_factory.mktemp("clip") / "synthetic.json"
    write_clip(synthetic_clip(), path)
    return options_with(path)


class Harness:
    """A task with its methods compiled, and worlds made by hand."""

    def __init__(self, task: Imitate) -> None:
        self.task = task
        self.observer = task.observer
        self.reference = jax.jit(self.observer.reference)
        self.init_at = jax.jit(self.observer.init_at)
        self.push = jax.jit(self.observer.push)
        self._judge = jax.jit(self._judge_world)

    def _judge_world(self, memory: Any, qpos: jax.Array, qvel: jax.Array) -> base.Outcome:
        unused: Any = None
        none = jnp.zeros((), jnp.int32)
        world = base.World(
            key=unused,
            episode_step=none,
            action=jnp.zeros(12),
            filter=unused,
            motors=unused,
            dynamics=NOMINAL,
            goal=jnp.zeros(2),
            memory=memory,
            task=ImitateState(airborne_steps=none, flew=jnp.zeros((), bool), flights=none),
        )
        view = base.make_view(FLAT, NOMINAL, qpos[None], qvel[None])
        return self.task.judge(world, view, FLAT)

    def judge(self, memory: Any, qpos: Any, qvel: Any) -> base.Outcome:
        return self._judge(memory, jnp.asarray(qpos, jnp.float32), jnp.asarray(qvel, jnp.float32))

    def at(self, time: float, xy: tuple[float, float] = (0.0, 0.0)) -> ImitateMemory:
        qpos = jnp.zeros(19).at[:2].set(jnp.array(xy)).at[3].set(1.0)
        return self.init_at(jnp.float32(time), qpos, jnp.zeros(18))


@pytest.fixture(scope="module")
def harness(options: ImitateOptions) -> Harness:
    return Harness(Imitate(options))


def test_weights_are_the_papers() -> None:
    assert list(WEIGHTS.values()) == [0.5, 0.05, 0.15, 0.1, 0.2]
    assert sum(WEIGHTS.values()) == pytest.approx(1.0)


def test_a_perfect_tracker_scores_one(harness: Harness) -> None:
    memory = harness.at(0.43, (7.0, -2.0))
    for step in range(2 * CYCLE_STEPS + 5):
        out = harness.judge(memory, *harness.reference(memory))
        assert float(out.reward) == pytest.approx(1.0, abs=2e-6), step
        assert float(out.metrics["tracking"]) == pytest.approx(1.0, abs=2e-6)
        assert all(float(out.metrics[name]) == pytest.approx(1.0, abs=2e-6) for name in WEIGHTS)
        assert not out.terminated
        # The robot moves on with the reference, which then has no reason to re-align.
        ahead = memory._replace(step=memory.step + 1)
        memory = harness.push(memory, *harness.reference(ahead), jnp.zeros(12))
        np.testing.assert_allclose(memory.offset, ahead.offset, atol=2e-5)


def test_each_error_lowers_its_own_term(harness: Harness) -> None:
    memory = harness.at(0.43)
    qpos, qvel = map(np.asarray, harness.reference(memory))

    def terms(qpos: np.ndarray, qvel: np.ndarray) -> dict[str, float]:
        out = harness.judge(memory, qpos, qvel)
        values = {name: float(out.metrics[name]) for name in WEIGHTS}
        assert float(out.reward) == pytest.approx(sum(WEIGHTS[n] * v for n, v in values.items()))
        return {name: value for name, value in values.items() if value < 1.0 - 1e-5}

    moved = qpos.copy()
    moved[1] += 0.1
    assert terms(moved, qvel) == {"root_pose": pytest.approx(np.exp(-0.2), abs=1e-5)}

    raised = qpos.copy()
    raised[2] += 0.2
    assert terms(raised, qvel) == {"root_pose": pytest.approx(np.exp(-0.8), abs=1e-5)}

    faster = qvel.copy()
    faster[1] += 0.5
    assert terms(qpos, faster) == {"root_velocity": pytest.approx(np.exp(-0.5), abs=1e-5)}

    spinning = qvel.copy()
    spinning[4] += 1.0
    assert terms(qpos, spinning) == {"root_velocity": pytest.approx(np.exp(-0.2), abs=1e-5)}

    jerking = qvel.copy()
    jerking[9] += 2.0
    assert terms(qpos, jerking) == {"velocity": pytest.approx(np.exp(-0.4), abs=1e-5)}

    # A turn by 0.3 rad about z: the feet keep their place in the heading frame, and the pitch
    # rate w turns with the body, which changes it by 2 w sin(0.15) in the world.
    turned = qpos.copy()
    turn = Rotation.from_euler("z", 0.3) * Rotation.from_quat(qpos[3:7], scalar_first=True)
    turned[3:7] = turn.as_quat(scalar_first=True)
    change = 2 * qvel[4] * np.sin(0.15)
    assert terms(turned, qvel) == {
        "root_pose": pytest.approx(np.exp(-0.9), abs=1e-5),
        "root_velocity": pytest.approx(np.exp(-0.2 * change**2), abs=1e-4),
    }

    # A knee bent by 0.1 rad: its foot moves on a circle of 0.2 m around the knee.
    bent = qpos.copy()
    bent[9] += 0.1
    chord = 2 * 0.2 * np.sin(0.05)
    assert terms(bent, qvel) == {
        "pose": pytest.approx(np.exp(-0.05), abs=1e-5),
        "end_effector": pytest.approx(np.exp(-40 * chord**2), abs=1e-5),
    }


def test_the_reference_moves_to_the_robot_when_the_clip_loops(harness: Harness) -> None:
    memory = harness.at(0.0)
    for step in range(1, CYCLE_STEPS + 3):
        ahead = memory._replace(step=memory.step + 1)
        reference, qvel = harness.reference(ahead)
        robot = reference.at[:3].add(jnp.array([-0.3, 0.2, 0.1]))  # behind, to the left, too high
        memory = harness.push(memory, robot, qvel, jnp.zeros(12))
        new = np.asarray(harness.reference(memory)[0])
        if step == CYCLE_STEPS:
            np.testing.assert_allclose(new[:2], robot[:2], atol=1e-5)
            np.testing.assert_allclose(new[2:], reference[2:], atol=1e-6)  # height stays
            error = harness.judge(memory, robot, qvel).metrics["root_error"]
            assert float(error) == pytest.approx(0.1, abs=1e-5)
        else:
            np.testing.assert_allclose(new, reference, atol=1e-6)
    np.testing.assert_allclose(memory.offset, np.array([-0.3, 0.2]) - [0.4, -0.3], atol=1e-5)


def test_episodes_start_anywhere_on_the_reference(harness: Harness) -> None:
    keys = jax.random.split(jax.random.key(1), 64)
    start = jax.jit(jax.vmap(lambda key: harness.task.start(key, FLAT, NOMINAL)))(keys)
    phases = np.asarray(start.memory.start_time)
    assert 0.0 <= phases.min() < 0.15
    assert CYCLE - 0.15 < phases.max() < CYCLE
    assert len(np.unique(phases)) == 64
    reference, qvel = jax.jit(jax.vmap(harness.observer.reference))(start.memory)
    np.testing.assert_allclose(start.qvel, qvel, atol=1e-5)
    np.testing.assert_allclose(start.qpos[:, :2], 0.0, atol=1e-6)
    np.testing.assert_allclose(reference[:, :2], 0.0, atol=1e-6)
    np.testing.assert_allclose(start.qpos[:, 3:], reference[:, 3:], atol=1e-6)
    np.testing.assert_allclose(start.qvel[:, 0], SPEED, rtol=1e-4)

    def lowest(qpos: jax.Array) -> jax.Array:
        return jnp.min(base.make_view(FLAT, NOMINAL, qpos[None], jnp.zeros((1, 18))).clearance)

    under = np.asarray(jax.jit(jax.vmap(lowest))(reference))
    placed = np.asarray(jax.jit(jax.vmap(lowest))(start.qpos))
    assert under.min() < -0.005  # the swinging legs of this clip go a little under ground
    assert under.max() > 0.2
    np.testing.assert_allclose(placed, np.maximum(under, 0.0), atol=1e-6)


def test_a_share_of_the_episodes_starts_at_rest(options: ImitateOptions) -> None:
    task = Imitate(dataclasses.replace(options, standing_fraction=0.5))
    keys = jax.random.split(jax.random.key(2), 200)
    start = jax.jit(jax.vmap(lambda key: task.start(key, FLAT, NOMINAL)))(keys)
    rest = np.all(np.asarray(start.qvel) == 0.0, axis=1)
    assert 70 < rest.sum() < 130  # 100 +- 4 standard deviations
    assert np.all((np.asarray(start.memory.start_time) == task.observer.standing_time)[rest])
    joints = np.asarray(start.qpos)[rest, 7:] - A1.default_pose
    assert np.abs(joints).max() <= base.START_NOISE + 1e-6
    np.testing.assert_allclose(np.asarray(start.qvel)[~rest, 0], SPEED, rtol=1e-4)


def test_early_termination(harness: Harness) -> None:
    memory = harness.at(0.6)  # highest point, legs straight
    qpos, qvel = map(np.asarray, harness.reference(memory))

    def outcome(change: Callable[[np.ndarray], None]) -> dict[str, bool]:
        pose = qpos.copy()
        change(pose)
        out = harness.judge(memory, pose, qvel)
        flags = {name: bool(out.metrics[name]) for name in ("lost", "fall")}
        assert bool(out.terminated) == any(flags.values())
        return flags

    def shift(distance: float) -> Callable[[np.ndarray], None]:
        way = distance * np.array([0.6, 0.8])
        return lambda pose: pose.__setitem__(slice(0, 2), pose[:2] + way)

    def turn(angle: float) -> Callable[[np.ndarray], None]:
        before = Rotation.from_quat(qpos[3:7], scalar_first=True)
        quat = (Rotation.from_euler("z", angle) * before).as_quat(scalar_first=True)
        return lambda pose: pose.__setitem__(slice(3, 7), quat)

    assert outcome(shift(0.99)) == {"lost": False, "fall": False}
    assert outcome(shift(1.01)) == {"lost": True, "fall": False}
    assert outcome(turn(1.56)) == {"lost": False, "fall": False}
    assert outcome(turn(-1.58)) == {"lost": True, "fall": False}

    def kneel(pose: np.ndarray) -> None:  # the calves lie on the ground, the trunk is high
        pose[2] = 0.2 + 0.014
        pose[7:] = np.tile([0.0, 0.0, -np.pi / 2], 4)

    assert outcome(kneel) == {"lost": False, "fall": True}

    def squat(pose: np.ndarray) -> None:  # lower ends of the calves in the ground, knees above
        pose[2] = 0.2 * np.cos(1.35) + 0.2 * np.cos(1.25) + 0.005
        pose[7:] = np.tile([0.0, 1.35, -2.6], 4)

    assert outcome(squat) == {"lost": False, "fall": False}

    assert outcome(lambda pose: pose.__setitem__(2, A1.home_height - 0.01)) == {
        "lost": False,
        "fall": False,
    }


def test_leaps_are_whole_cycles(harness: Harness) -> None:
    memory = harness.at(1.0)
    qpos, qvel = harness.reference(memory)
    for step, leaps in ((1, 0), (23, 0), (24, 1), (47, 1), (48, 2), (240, 10), (399, 16)):
        late = memory._replace(step=jnp.int32(step))
        assert float(harness.judge(late, qpos, qvel).metrics["leaps"]) == leaps
    high = harness.judge(harness.at(0.6), *harness.reference(harness.at(0.6)))
    assert high.metrics["airborne"]
    assert not harness.judge(memory, qpos.at[2].set(A1.home_height), qvel).metrics["airborne"]


def test_a_flight_counts_once_and_only_when_long() -> None:
    def flights(airborne: str, completed: str) -> list[int]:
        zero = jnp.zeros((), jnp.int32)
        state = ImitateState(airborne_steps=zero, flew=jnp.zeros((), bool), flights=zero)
        counts = []
        for a, c in zip(airborne, completed, strict=True):
            state = count_flights(state, jnp.array(a == "^"), jnp.array(c == "|"))
            counts.append(int(state.flights))
        return counts

    assert FLIGHT_STEPS == 4
    assert flights("_^^^^__", "______|")[-1] == 1
    assert flights("_^^^__^", "______|")[-1] == 0  # too short, twice
    assert flights("^^^^^^^^", "____|__|") == [0, 0, 0, 0, 1, 1, 1, 1]  # one flight over the loop
    assert flights("^^^^_^^^^", "____|___|") == [0, 0, 0, 0, 1, 1, 1, 1, 2]
    assert flights("^^^^_^^^^", "________|")[-1] == 1  # two flights in one cycle


def test_bad_clips_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        Imitate(options_with(tmp_path / "nothing.json"))
    path = tmp_path / "once.json"
    write_clip(synthetic_clip(loop="clamp"), path)
    with pytest.raises(ValueError, match=r"once\.json.* 'clamp'.*need 'wrap'"):
        Imitate(options_with(path))


def test_the_shipped_leap_is_a_leap() -> None:
    """A perfect tracker of it flies in every cycle and is never ended."""
    shipped = Harness(Imitate())
    duration = shipped.observer.duration
    assert int(shipped.observer.cycles(jnp.float32(duration))) == 1
    airborne = []
    for time in np.arange(0.0, duration, CONTROL_DT / 2):
        memory = shipped.at(time)
        out = shipped.judge(memory, *shipped.reference(memory))
        assert float(out.reward) == pytest.approx(1.0, abs=2e-6)
        assert not out.terminated
        airborne.append(bool(out.metrics["airborne"]))
    text = "".join("^" if up else "_" for up in airborne * 2)
    assert max(map(len, text.split("_"))) >= 2 * FLIGHT_STEPS  # in half control steps


def test_rewards_of_simulated_worlds(
    worlds: Callable[..., Any], actions: Callable[..., np.ndarray]
) -> None:
    made = worlds("imitate")
    first = made.reset(0)
    assert first.obs.shape == (3, 160)
    for state in made.run(first, actions(4, 3)):
        assert not state.invalid.any()
        total = sum(WEIGHTS[name] * state.metrics[name] for name in WEIGHTS)
        np.testing.assert_allclose(state.reward, total, rtol=1e-5)
        assert set(state.metrics) == set(made.env.metric_names)
    assert made.traces["step"] == 1
