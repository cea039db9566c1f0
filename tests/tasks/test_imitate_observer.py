"""Observer of ``imitate``: layout, target poses, history, use in a foreign task."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from twirl_mjx.motion.clip import Clip, headings
from twirl_mjx.sim.robots import A1
from twirl_mjx.sim.scene import CONTROL_DT
from twirl_mjx.tasks.imitate import (
    TARGET_STEPS,
    ImitateMemory,
    ImitateObserver,
    facing_x,
    load_clip,
    make_layout,
    standing_time,
)
from twirl_mjx.tasks.observations import layout_size, layout_slices

LAYOUT = make_layout(A1)
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


class Harness:
    """An observer with its methods compiled."""

    def __init__(self, observer: ImitateObserver) -> None:
        self.observer = observer
        self.reference = jax.jit(observer.reference)
        self.init_at = jax.jit(observer.init_at)
        self.push = jax.jit(observer.push)
        self.observe = jax.jit(observer.observe)

    def at(self, time: float, xy: tuple[float, float] = (0.0, 0.0)) -> ImitateMemory:
        qpos = jnp.zeros(19).at[:2].set(jnp.array(xy)).at[3].set(1.0)
        return self.init_at(jnp.float32(time), qpos, jnp.zeros(18))


@pytest.fixture(scope="module")
def harness() -> Harness:
    return Harness(ImitateObserver(synthetic_clip()))


def test_layout_covers_the_observation(harness: Harness) -> None:
    slices = layout_slices(LAYOUT)
    spans = list(slices.values())
    assert len(slices) == len(LAYOUT)  # no name twice
    assert layout_size(LAYOUT) == 160
    assert [s.start for s in spans] == [0, *(s.stop for s in spans[:-1])]
    assert spans[-1].stop == 160
    assert slices["target_base_displacement_h[+1]"].start == 84
    memory = harness.at(0.3)
    qpos, qvel = harness.reference(memory)
    assert harness.observe(memory, jnp.zeros(2), qpos, qvel).shape == (160,)


def test_target_poses_of_a_robot_on_the_reference(harness: Harness) -> None:
    slices = layout_slices(LAYOUT)
    memory = harness.at(0.0, (5.0, 6.0))
    qpos, qvel = harness.reference(memory)
    np.testing.assert_allclose(qpos[:2], [5.0, 6.0], atol=1e-6)
    memory = harness.init_at(jnp.zeros((), jnp.float32), qpos, qvel)
    obs = np.asarray(harness.observe(memory, jnp.zeros(2), qpos, qvel))
    for step in TARGET_STEPS:
        phase = step * CONTROL_DT / CYCLE
        swing = np.sin(2 * np.pi * phase)
        lift = 0.3 * np.sin(np.pi * phase) ** 2
        move = obs[slices[f"target_base_displacement_h[+{step}]"]]
        np.testing.assert_allclose(move, [SPEED * CONTROL_DT * step, 0.0, lift], atol=2e-4)
        quat = obs[slices[f"target_base_quat_h[+{step}]"]]
        half = 0.1 * swing
        np.testing.assert_allclose(quat, [np.cos(half), 0, np.sin(half), 0], atol=2e-4)
        joints = obs[slices[f"target_joint_pos[+{step}]"]]
        want = A1.default_pose + 0.2 * swing * np.tile([0.3, 1.0, -1.0], 4)
        np.testing.assert_allclose(joints, want, atol=1e-3)
    for i in (-2, -1, 0):
        np.testing.assert_allclose(obs[slices[f"joint_pos[{i}]"]], A1.default_pose, atol=1e-6)
        np.testing.assert_allclose(obs[slices[f"base_quat_h[{i}]"]], [1, 0, 0, 0], atol=1e-6)


def test_targets_are_seen_from_the_robots_heading(harness: Harness) -> None:
    slices = layout_slices(LAYOUT)
    memory = harness.at(0.0)
    qpos, qvel = harness.reference(memory)
    left = jnp.array([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)], jnp.float32)
    turned = qpos.at[3:7].set(-left)  # the other sign is the same rotation
    obs = np.asarray(harness.observe(memory, jnp.zeros(2), turned, qvel))
    move = obs[slices["target_base_displacement_h[+7]"]]
    np.testing.assert_allclose(move[:2], [0.0, -SPEED * 7 * CONTROL_DT], atol=2e-4)
    quat = obs[slices["target_base_quat_h[+7]"]]
    swing = Rotation.from_euler("y", 0.2 * np.sin(2 * np.pi * 7 / 24))
    want = (Rotation.from_euler("z", -np.pi / 2) * swing).as_quat(scalar_first=True)
    np.testing.assert_allclose(quat, want * np.sign(want[0]), atol=2e-4)
    # The history does not know the heading, only the tilt.
    pushed = harness.push(memory, turned, qvel, jnp.full(12, 0.7))
    obs = np.asarray(harness.observe(pushed, jnp.zeros(2), turned, qvel))
    np.testing.assert_allclose(obs[slices["base_quat_h[0]"]], [1, 0, 0, 0], atol=1e-6)
    np.testing.assert_allclose(obs[slices["previous_action[0]"]], 0.7)
    np.testing.assert_allclose(obs[slices["previous_action[-1]"]], 0.0)


def test_the_observer_serves_a_foreign_task(harness: Harness) -> None:
    """What a learned source does with it in ``hurdles``: init, push, observe, of many worlds."""
    observer = harness.observer
    standing = np.concatenate([[0.0, 0.0, A1.home_height, 1.0, 0.0, 0.0, 0.0], A1.default_pose])
    qpos = jnp.asarray(np.stack([standing, standing]), jnp.float32)
    qpos = qpos.at[1, :2].set(jnp.array([3.0, -4.0]))
    qvel = jnp.zeros((2, 18))
    reference = jax.jit(jax.vmap(observer.reference))
    memory = jax.jit(jax.vmap(observer.init))(qpos, qvel)
    np.testing.assert_allclose(observer.time(memory), observer.standing_time)
    np.testing.assert_allclose(reference(memory)[0][:, :2], qpos[:, :2], atol=1e-6)
    push = jax.jit(jax.vmap(observer.push))
    for _ in range(CYCLE_STEPS):
        memory = push(memory, qpos, qvel, jnp.zeros((2, 12)))
    # The robots stood still for a cycle: the reference came back to them.
    np.testing.assert_allclose(observer.time(memory), observer.standing_time + CYCLE, rtol=1e-6)
    behind = SPEED * observer.standing_time  # it came back when the clip looped, a while ago
    np.testing.assert_allclose(reference(memory)[0][:, 0], qpos[:, 0] + behind, atol=1e-5)
    np.testing.assert_allclose(reference(memory)[0][:, 1], qpos[:, 1], atol=1e-5)
    obs = jax.jit(jax.vmap(observer.observe))(memory, jnp.zeros((2, 2)), qpos, qvel)
    np.testing.assert_allclose(obs[0], obs[1], atol=1e-5)


def test_clips_are_turned_to_face_forward() -> None:
    clip = facing_x(synthetic_clip(yaw=2.0))
    np.testing.assert_allclose(headings(clip.root_quat), 0.0, atol=1e-9)
    np.testing.assert_allclose(clip.cycle_displacement, [SPEED * CYCLE, 0.0, 0.0], atol=1e-9)
    straight = synthetic_clip()
    np.testing.assert_allclose(facing_x(straight).qpos, straight.qpos, atol=1e-9)


def test_a_robot_at_rest_joins_the_clip_where_all_feet_are_down_and_it_is_slowest() -> None:
    clip = synthetic_clip()
    flat = np.tile(clip.qpos[:1], (5, 1))
    x = np.array([0.0, 0.3, 0.5, 0.9, 1.5])
    level = dataclasses.replace(
        clip,
        root_pos=np.stack([x, 0 * x, flat[:, 2]], axis=1),
        root_quat=flat[:, 3:7],
        joint_pos=flat[:, 7:],
        frame_duration=0.1,
    )
    assert standing_time(level) == pytest.approx(0.1)


def test_the_shipped_leap_is_joined_crouching_with_a_run_up_ahead() -> None:
    clip = load_clip("leap")
    time = standing_time(clip)
    assert 0.3 * clip.cycle_duration < time < 0.5 * clip.cycle_duration
