from __future__ import annotations

import dataclasses
from collections import deque
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from scipy import signal

from twirl_mjx.deploy import trial as module
from twirl_mjx.deploy.ground import build_model, err_bodies, set_conditions
from twirl_mjx.deploy.rehearsal import IDEAL, RehearsalConfig, rehearse
from twirl_mjx.deploy.robot import CommandFilter, Contacts, Encoder, Sensors, motor_torque
from twirl_mjx.policies.learned import PolicyHeader, save_policy

SHORT = dataclasses.replace(RehearsalConfig(), episode_s=0.5)
HOME = np.tile([0.0, 0.9, -1.8], 4)


class Constant:
    """Answers every observation with one action."""

    def __init__(self, action: float) -> None:
        self.action = np.full(12, action, np.float32)

    def act(self, obs: np.ndarray) -> np.ndarray:
        del obs
        return self.action


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return build_model(IDEAL, np.array([1.0, 2.5]))


def test_torque_by_hand() -> None:
    config = RehearsalConfig()
    pos, vel = np.zeros(12), np.zeros(12)
    target = np.zeros(12)
    target[:3] = [0.1, 2.0, -2.0]
    vel[3:6] = [1.0, 30.0, -30.0]
    torque = motor_torque(config, target, pos, vel, vel)
    # 60 * 0.1; limits; braking 3 * 1 and, beyond the no-load speed, still with the whole torque
    np.testing.assert_allclose(torque[:6], [6.0, 33.5, -33.5, -3.0, -33.5, 33.5], atol=1e-9)
    speed = np.array([10.5, 15.75, 20.0, 21.0, -15.75])
    vel = np.concatenate([speed, np.zeros(7)])
    pulled = motor_torque(config, np.full(12, 10.0), pos, vel, vel)
    # full, half, 1/10.5, none of 33.5 N m; and all of it against the motion
    np.testing.assert_allclose(pulled[:5], [33.5, 16.75, 33.5 / 10.5, 0.0, 33.5], atol=1e-9)


def test_filter_equals_scipy_s() -> None:
    rng = np.random.default_rng(0)
    start = HOME + 0.1
    actions = rng.uniform(-0.2, 0.2, (30, 12))
    b, a = np.asarray(signal.butter(2, 0.4))
    swing = np.tile([0.6, 1.2, 1.2], 4)
    targets = HOME + swing * actions
    rest = signal.lfilter_zi(b, a)[:, None] * start
    expected, _ = signal.lfilter(b, a, targets, axis=0, zi=rest)
    command = CommandFilter(start)
    ours = np.array([command(action) for action in actions])
    np.testing.assert_allclose(ours, expected, atol=1e-9)


def test_targets_stay_within_the_joint_limits() -> None:
    command = CommandFilter(HOME)
    target = [command(np.ones(12)) for _ in range(20)][-1]
    assert target[2] == pytest.approx(-0.916297857297)
    assert target[1] == pytest.approx(2.1, abs=1e-3)


def test_actuators_pass_torque_through(model: mujoco.MjModel) -> None:
    data = mujoco.MjData(model)
    data.ctrl[:] = np.arange(12) * 5.0
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.actuator_force, np.arange(12) * 5.0)
    np.testing.assert_allclose(data.qfrc_actuator[6:], np.arange(12) * 5.0)
    assert model.opt.timestep == 0.001


def test_latency_delays_a_target_by_physics_steps(
    model: mujoco.MjModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = []

    def spy(config: RehearsalConfig, target: np.ndarray, *state: np.ndarray) -> np.ndarray:
        seen.append(target[0])
        return motor_torque(config, target, *state)

    monkeypatch.setattr(module, "motor_torque", spy)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
    config = dataclasses.replace(IDEAL, latency_ms=70.0)
    contacts, drive = Contacts(model, "biped"), module.Drive(np.zeros(12), np.zeros(12))
    targets, encoder = deque([(0, HOME)]), Encoder(config, data)
    for step in range(3):
        start = step * config.n_substeps + config.latency_steps
        targets.append((start, HOME + 0.001 * (step + 1)))
        ended = module.advance(model, data, config, targets, contacts, drive, encoder)
        assert ended is None
    changes = np.flatnonzero(np.diff(seen)) + 1
    np.testing.assert_array_equal(changes, [70, 120])
    assert drive.peak.max() > 1.0


def test_sensors_without_noise_are_exact_and_with_noise_have_its_size(
    model: mujoco.MjModel,
) -> None:
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
    encoder = Encoder(IDEAL, data)
    exact = Sensors(IDEAL, np.random.default_rng(0)).read(data, encoder)
    np.testing.assert_array_equal(exact.joint_pos, HOME)
    np.testing.assert_allclose(exact.rotation, np.eye(3), atol=1e-12)
    config = dataclasses.replace(IDEAL, joint_noise=0.01, orientation_noise=0.02)
    sensors = Sensors(config, np.random.default_rng(0))
    readings = [sensors.read(data, encoder) for _ in range(500)]
    joints = np.array([r.joint_pos for r in readings])
    assert np.std(joints - HOME) == pytest.approx(0.01, rel=0.05)
    pitch = np.array([np.arcsin(-r.rotation[2, 0]) for r in readings])
    assert np.std(pitch) == pytest.approx(0.02, rel=0.1)
    for reading in readings[:5]:
        np.testing.assert_allclose(reading.rotation @ reading.rotation.T, np.eye(3), atol=1e-9)


def test_position_drifts_as_a_random_walk(model: mujoco.MjModel) -> None:
    config = dataclasses.replace(IDEAL, position_drift=0.02)
    data = mujoco.MjData(model)
    encoder, ends = Encoder(config, data), []
    for seed in range(300):
        sensors = Sensors(config, np.random.default_rng(seed))
        last = [sensors.read(data, encoder) for _ in range(20)][-1]
        ends.append(last.position - data.qpos[:3])
    assert np.std(ends) == pytest.approx(0.02, rel=0.1)  # 20 readings are one second


def test_encoder_is_late_and_in_steps(model: mujoco.MjModel) -> None:
    config = dataclasses.replace(IDEAL, encoder_delay_ms=2.0, encoder_step=0.01)
    data = mujoco.MjData(model)
    data.qpos[7], data.qvel[6] = 0.004, 1.0
    encoder = Encoder(config, data)
    seen = [encoder.read()]
    for angle, speed in ((0.016, 2.0), (0.024, 3.0), (0.036, 4.0)):
        data.qpos[7], data.qvel[6] = angle, speed
        encoder.push(data)
        seen.append(encoder.read())
    np.testing.assert_allclose([angles[0] for angles, _ in seen], [0.0, 0.0, 0.0, 0.02])
    np.testing.assert_allclose([speeds[0] for _, speeds in seen], [1.0, 1.0, 1.0, 2.0])
    reading = Sensors(config, np.random.default_rng(0)).read(data, encoder)
    assert (reading.joint_pos[0], reading.joint_vel[0]) == (pytest.approx(0.02), 2.0)


def test_motors_follow_what_the_encoder_says_at_the_speed_they_have(
    model: mujoco.MjModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen, config = [], dataclasses.replace(IDEAL, encoder_delay_ms=3.0)

    def spy(*given: np.ndarray) -> np.ndarray:
        seen.append([x[2] for x in given[2:5]])  # angle and speed as known, speed as it is
        return motor_torque(*given)  # type: ignore[arg-type]

    monkeypatch.setattr(module, "motor_torque", spy)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
    contacts, drive = Contacts(model, "biped"), module.Drive(np.zeros(12), np.zeros(12))
    targets = deque([(0, HOME + 0.1)])
    module.advance(model, data, config, targets, contacts, drive, Encoder(config, data))
    angle, known, real = np.array(seen).T
    np.testing.assert_array_equal(known[:4], 0.0)
    np.testing.assert_array_equal(known[3:], real[:-3])
    np.testing.assert_array_equal(angle[:4], -1.8)
    np.testing.assert_allclose(np.diff(angle[3:]), 0.001 * known[4:], atol=1e-12)
    assert np.ptp(angle) > 0.01


def test_errors_of_mass_and_inertia_are_drawn_per_body() -> None:
    right = build_model(IDEAL, np.array([1.0]))
    config = dataclasses.replace(IDEAL, mass_error=0.2, inertia_error=0.1, payload=3.0)
    wrong = build_model(config, np.array([1.0]))
    trunk_mass = err_bodies(wrong, config, np.random.default_rng(0))
    set_conditions(wrong, config, trunk_mass)
    trunk = wrong.body("trunk").id
    wrong.body_mass[trunk] -= 3.0
    mass = wrong.body_mass[1:] / right.body_mass[1:]
    shape = wrong.body_inertia[1:] / right.body_inertia[1:] / mass[:, None]
    assert mass[trunk - 1] == pytest.approx(trunk_mass / 4.713)
    assert len(np.unique(mass)) == len(mass) == 13  # trunk and 12 links
    assert 0.1 < np.abs(mass - 1.0).max() <= 0.2
    assert 0.05 < np.abs(shape - 1.0).max() <= 0.1 + 1e-9
    np.testing.assert_allclose(shape, shape[:, :1] * np.ones(3))  # one factor for a body's three


def test_the_goal_walks_straight_on() -> None:
    config = dataclasses.replace(SHORT, goal_speed=0.4)
    walking, standing = (
        rehearse(Constant(0.0), task="biped", episodes=1, config=c).episodes[0]
        for c in (config, SHORT)
    )
    steps = np.diff(walking.goals, axis=0)
    np.testing.assert_allclose(np.hypot(*steps.T), 0.02, atol=1e-9)
    np.testing.assert_allclose(steps, np.tile(steps[0], (10, 1)), atol=1e-9)
    np.testing.assert_array_equal(walking.goals[0], standing.goals[0])
    assert np.ptp(standing.goals, axis=0).max() == 0.0
    distances = np.linalg.norm(walking.goals - walking.qpos[:, :2], axis=1)[1:]
    assert walking.metrics["mean_distance"] == pytest.approx(distances.mean())
    assert walking.metrics["final_distance"] == pytest.approx(distances[-1])


def test_an_error_changes_nothing_else_that_is_drawn() -> None:
    config = dataclasses.replace(SHORT, mass_error=0.2)
    runs = [rehearse("trot", task="biped", episodes=1, config=c).episodes[0]
            for c in (SHORT, config)]  # fmt: skip
    np.testing.assert_array_equal(runs[0].goals, runs[1].goals)
    np.testing.assert_array_equal(runs[0].readings[0].joint_pos, runs[1].readings[0].joint_pos)
    assert np.abs(runs[0].qpos[-1] - runs[1].qpos[-1]).max() > 1e-4


def test_softer_ground_gives_way_further() -> None:
    depths = {}
    for contact in ("plain", "soft", "hard"):
        config = dataclasses.replace(IDEAL, contact=contact)
        model = build_model(config, np.zeros(0))
        data = mujoco.MjData(model)
        mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
        contacts, drive = Contacts(model, "biped"), module.Drive(np.zeros(12), np.zeros(12))
        encoder = Encoder(config, data)
        for _ in range(10):
            module.advance(model, data, config, deque([(0, HOME)]), contacts, drive, encoder)
        depths[contact] = -data.contact.dist.min()
    assert depths["soft"] > 2 * depths["plain"] > 4 * depths["hard"] > 0.0


@pytest.mark.parametrize("integrator", ["implicitfast", "implicit", "Euler", "RK4"])
def test_integrators_agree_on_a_short_way(integrator: str) -> None:
    ways = [
        rehearse(
            Constant(0.2),
            task="biped",
            episodes=1,
            config=dataclasses.replace(IDEAL, episode_s=0.2, integrator=name, sim_dt=step),
        )
        .episodes[0]
        .qpos
        for name, step in ((integrator, 0.0005), ("implicitfast", 0.001))
    ]
    assert 1e-7 < np.abs(ways[0] - ways[1]).max() < 0.01


def test_episode_depends_on_its_seed_only() -> None:
    results = [rehearse("trot", task="biped", episodes=2, seed=s, config=SHORT)
               for s in (3, 3, 4)]  # fmt: skip
    first, same, other = (r.episodes for r in results)
    np.testing.assert_array_equal(first[1].qpos, same[1].qpos)
    np.testing.assert_array_equal(first[1].observations, same[1].observations)
    assert not np.array_equal(first[0].goals, first[1].goals)
    assert not np.array_equal(first[1].goals, other[1].goals)
    assert np.linalg.norm(first[0].goals[0]) == pytest.approx(1.0)


def test_a_divergence_ends_the_episode_and_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """MuJoCo alone would go on from its first pose without a word."""
    step = mujoco.mj_step

    def diverging(model: mujoco.MjModel, data: mujoco.MjData) -> None:
        if data.time > 0.5:
            data.qvel[2] = np.nan
        step(model, data)

    monkeypatch.setattr(module.mujoco, "mj_step", diverging)
    (episode,) = rehearse("zero", task="stand", episodes=1, config=IDEAL).episodes
    assert episode.cause == "diverged"
    assert episode.metrics["episode_length"] == pytest.approx(0.5 * 20, abs=1.0)
    assert np.isfinite(episode.qpos).all() and np.isfinite(episode.metrics["return"])


def test_arrays_of_an_episode_line_up() -> None:
    episode = rehearse(Constant(0.0), task="biped", episodes=1, config=SHORT).episodes[0]
    assert episode.cause == "time"
    assert episode.metrics["episode_length"] == 10
    assert episode.qpos.shape == (11, 19)
    assert episode.goals.shape == (11, 2)
    assert episode.observations.shape == (10, 101)
    assert episode.actions.shape == (10, 12)
    assert episode.metrics["terminated"] == 0.0


def test_falling_ends_a_stand_episode() -> None:
    result = rehearse(Constant(-1.0), task="stand", episodes=1)
    assert result.episodes[0].cause == "fall"
    assert result.episodes[0].metrics["episode_length"] < 60
    assert result.summary()["ended/fall"] == 1.0


def test_touching_a_hurdle_ends_the_episode() -> None:
    config = dataclasses.replace(IDEAL, hurdle_gap=0.6)
    episode = rehearse("bound", task="hurdles", episodes=1, config=config).episodes[0]
    assert episode.cause == "hurdle"
    assert 0.1 < episode.qpos[-1, 0] < 0.6
    np.testing.assert_allclose(episode.goals, np.tile([0.6, 0.0], (len(episode.goals), 1)))
    assert episode.observations.shape[1] == 95


def test_policy_file_names_its_task(tmp_path: Path) -> None:
    zero = {"kernel": np.zeros((101, 12)), "bias": np.zeros(12)}
    header = PolicyHeader("stand", 101, 12, 0.05)
    path = save_policy(tmp_path / "policy.npz", {"mean": zero, "log_std": zero}, header)
    result = rehearse(path, episodes=1, config=SHORT)
    assert result.task == "stand"
    np.testing.assert_array_equal(result.episodes[0].actions, np.zeros((10, 12)))
    brought = rehearse(path, task="hurdles", episodes=1, config=SHORT)  # with its own observer
    assert brought.episodes[0].observations.shape == (10, 95)
    np.testing.assert_array_equal(brought.episodes[0].actions, np.zeros((10, 12)))


def test_bad_requests_are_refused() -> None:
    with pytest.raises(ValueError, match="cannot rehearse task 'trot'; choose one of stand"):
        rehearse(Constant(0.0), task="trot")
    with pytest.raises(ValueError, match="the policy does not name its task"):
        rehearse(Constant(0.0))
    with pytest.raises(ValueError, match="episodes must be at least 1, got 0"):
        rehearse(Constant(0.0), task="stand", episodes=0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sim_dt": 0.003}, "does not divide the control step"),
        ({"latency_ms": -1.0}, r"latency_ms = -1\.0 is outside \[0\.0, 200\.0\]"),
        ({"gravity": 0.0}, r"gravity = 0\.0 is outside .*nearest: 0\.01"),
        ({"bump_height": 0.05, "incline_deg": 8.0}, "nearest: incline_deg 0"),
        ({"full_torque_speed": 30.0}, r"below no_load_speed 21\.0"),
        ({"contact": "hard", "sim_dt": 0.005}, r"at most 0\.002 s.*nearest: contact plain"),
        ({"mass_error": 0.6}, r"mass_error = 0\.6 is outside .*nearest: 0\.5"),
        ({"encoder_step": -0.1}, r"encoder_step = -0\.1 is outside .*nearest: 0\.0"),
        ({"encoder_delay_ms": 21.0}, r"encoder_delay_ms = 21\.0 is outside .*nearest: 20\.0"),
        ({"rate_noise": -0.1}, "rate_noise must not be negative"),
    ],
)
def test_bad_settings_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(RehearsalConfig(), **changes)
