"""Recorded states: the target task observes and judges them as if its own robot had moved so."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from twirl_mjx.policies.resolve import resolve_policy
from twirl_mjx.replay.dataset import DatasetError
from twirl_mjx.sim.robots import A1
from twirl_mjx.training.presets import make_config
from twirl_mjx.worlds import judging
from twirl_mjx.worlds.make import make_env

CONFIG = make_config("biped", "debug").evaluation
STEPS = 8
Episode = dict[str, np.ndarray]
Write = Callable[..., Path]


def standing(steps: int, height: float, pace: float = 0.0) -> Episode:
    """Return a robot in its default pose that glides along x by ``pace`` m per control step."""
    rest = [0.0, 0.0, height, 1.0, 0.0, 0.0, 0.0, *A1.default_pose]
    qpos = np.tile(rest, (steps + 1, 1))
    qpos[:, 0] = pace * np.arange(steps + 1)
    qvel = np.zeros((steps + 1, 18))
    qvel[:, 0] = pace / A1.control_dt
    return {
        "qpos": qpos, "qvel": qvel, "goal": np.tile([2.0, 0.0], (steps + 1, 1)),
        "actions": np.zeros((steps, 12)),
    }  # fmt: skip


def elsewhere(episode: Episode) -> Episode:
    """Return the same motion begun at another place and heading."""
    turn, shift = Rotation.from_euler("z", 1.0), np.array([3.0, -2.0, 0.0])
    qpos, qvel = episode["qpos"].copy(), episode["qvel"].copy()
    qpos[:, :3] = turn.apply(qpos[:, :3]) + shift
    rotation = turn * Rotation.from_quat(qpos[:, 3:7], scalar_first=True)
    qpos[:, 3:7] = rotation.as_quat(scalar_first=True)
    qvel[:, :3] = turn.apply(qvel[:, :3])
    goal = turn.apply(np.pad(episode["goal"], ((0, 0), (0, 1)))) + shift
    return episode | {"qpos": qpos, "qvel": qvel, "goal": goal[:, :2]}


def write_file(path: Path, *episodes: Episode, **attributes: Any) -> Path:
    """Write episodes as Minari does."""
    with h5py.File(path, "w") as file:
        file.attrs.update(attributes)
        for number, episode in enumerate(episodes):
            group, steps = file.create_group(f"episode_{number}"), len(episode["actions"])
            values = {"terminations": np.zeros(steps), "truncations": np.zeros(steps)}
            for name, array in (values | episode).items():
                inside = f"infos/{name}" if name in ("qpos", "qvel", "goal") else name
                group[inside] = array
    return path


@pytest.fixture
def write(tmp_path: Path) -> Write:
    return functools.partial(write_file, tmp_path / "data.hdf5")


def record() -> tuple[list[Episode], Any, Any]:
    """Return two episodes of ``biped`` under small actions, and what the task showed and paid."""
    env = make_env(dataclasses.replace(CONFIG, engine="native"), num_envs=2)
    state = env.reset(jax.random.key(3))
    actions = 0.3 * np.random.default_rng(0).uniform(-1, 1, (STEPS, 2, 12)).astype(np.float32)
    states = [state]
    for action in actions:
        states.append(env.step(states[-1], action))
    assert not any(np.asarray(s.done).any() for s in states)
    episodes = [
        {
            "qpos": np.array([s.data.qpos[world] for s in states]),
            "qvel": np.array([s.data.qvel[world] for s in states]),
            "goal": np.array([s.world.goal[world] for s in states]),
            "actions": actions[:, world],
        }
        for world in range(2)
    ]
    paid = np.array([s.reward for s in states[1:]]).T
    shown = np.array([s.obs for s in states]).swapaxes(0, 1)
    return episodes, paid, shown


@pytest.fixture(scope="module")
def judged(tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    """One file with all that is looked at below: the task's program is compiled once."""
    own, paid, shown = record()
    fall = standing(STEPS, 0.3)
    fall["qpos"][4:, 2] = 0.05
    parts = [*own, standing(STEPS, 0.3), standing(STEPS, 0.3, 0.03), elsewhere(own[0]), fall]
    path = write_file(tmp_path_factory.mktemp("states") / "data.hdf5", *parts)
    source = resolve_policy(str(path), CONFIG)
    return SimpleNamespace(source=source, data=source.data, paid=paid, shown=shown)


def part(judged: SimpleNamespace, number: int) -> Any:
    return jax.tree.map(lambda x: x[STEPS * number : STEPS * (number + 1)], judged.data)


@pytest.mark.parametrize("world", [0, 1])
def test_a_run_of_the_task_is_paid_and_shown_again(judged: SimpleNamespace, world: int) -> None:
    """Its goals were drawn at random: the file has them."""
    data = part(judged, world)
    np.testing.assert_allclose(data.reward, judged.paid[world], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(data.obs, judged.shown[world, :-1], atol=1e-6)
    np.testing.assert_allclose(data.next_obs, judged.shown[world, 1:], atol=1e-6)
    assert not data.terminated.any()


def test_rewards_by_hand(judged: SimpleNamespace) -> None:
    """Level (0.25), 0.3 m high (e^0.3 - 1), facing 0.25; half a point more for being nearer."""
    stand = 0.25 + math.exp(0.3) - 1.0
    np.testing.assert_allclose(part(judged, 2).reward, stand * 1.25, rtol=1e-5)
    np.testing.assert_allclose(part(judged, 3).reward, stand * 1.75, rtol=1e-5)


def test_place_and_heading_of_a_recording_do_not_matter(judged: SimpleNamespace) -> None:
    here, there = part(judged, 0), part(judged, 4)
    np.testing.assert_allclose(there.obs, here.obs, atol=2e-5)
    np.testing.assert_allclose(there.reward, here.reward, atol=2e-5)


def test_the_task_ends_an_episode_and_the_rest_is_left_out(judged: SimpleNamespace) -> None:
    """The trunk is down after the fourth of eight steps."""
    np.testing.assert_array_equal(part(judged, 5).terminated, [False, False, False, True])
    assert judged.source.notes == (
        "task biped observed and judged its states, at the end of every control step",
        "4 steps after an end of the task are left out",
    )


def test_states_of_single_rows_end_where_the_file_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """D4RL has no state after the last action of an episode: that row is left out."""
    motions: list[judging.Motion] = []

    def judge(env: Any, key: Any, motion: judging.Motion) -> tuple[dict, np.ndarray]:
        motions.append(motion)
        return {}, np.ones(len(motion.first), bool)

    monkeypatch.setattr(judging, "judge", judge)
    states = standing(5, 0.3, 0.03)
    arrays = {
        "infos/qpos": states["qpos"], "infos/qvel": states["qvel"],
        "actions": np.arange(72.0).reshape(6, 12) / 100,
        "terminals": np.arange(6) == 2, "timeouts": np.zeros(6),
    }  # fmt: skip
    np.savez(tmp_path / "flat.npz", **arrays)
    source = resolve_policy(str(tmp_path / "flat.npz"), CONFIG)
    (motion,) = motions
    np.testing.assert_allclose(motion.qpos[:, 0], [0.0, 0.03, 0.09, 0.12])
    np.testing.assert_allclose(motion.next_qpos[:, 0], [0.03, 0.06, 0.12, 0.15])
    np.testing.assert_allclose(motion.action[:, 0], [0.0, 0.12, 0.36, 0.48])
    np.testing.assert_array_equal(motion.first, [True, False, True, False])
    assert source.notes[1].startswith("2 of 6 rows are left out, because nothing in the file says")
    np.savez(tmp_path / "flat.npz", **{k: v for k, v in arrays.items() if k != "timeouts"})
    with pytest.raises(DatasetError, match=r"neither next_qpos nor the ends of its episodes"):
        resolve_policy(str(tmp_path / "flat.npz"), CONFIG)


def changed(**changes: Any) -> Episode:
    episode = standing(STEPS, 0.3, 0.03)
    for name, change in changes.items():
        episode[name] = change(episode[name])
    return episode


@pytest.mark.parametrize(
    ("episode", "message"),
    [
        (changed(qpos=lambda x: x[:, 1:]), r"qpos has shape \(8, 18\), task biped needs \(8, 19\)"),
        (changed(qpos=lambda x: x[:-1]), r"episode_0: qpos has shape .* need 9 rows for 8 actions"),
        (changed(qvel=lambda x: x * np.nan), "qvel is not finite in row 0"),
        (changed(qpos=lambda x: np.roll(x, 3, axis=1)), r"quaternion has length .*then w x y z"),
        (changed(qpos=lambda x: x * [*[1] * 7, *[57.3] * 12]), "FR_calf_joint is -103 .*degrees"),
        (changed(qpos=lambda x: x * [1, 1, 100, *[1] * 16]), "height is 30 .*unit than m"),
        (changed(qvel=lambda x: 2.5 * x), r"states are 0\.02 s apart, .* every 0\.05"),
        (changed(actions=lambda x: x + 4.0), "action reaches 4 in row 0"),
        (changed(goal=lambda x: x[:, :1]), r"goal has shape \(8, 1\)"),
    ],
)  # fmt: skip
def test_states_that_cannot_be_are_refused(episode: Episode, message: str, write: Write) -> None:
    with pytest.raises(DatasetError, match=message) as caught:
        resolve_policy(str(write(episode)), CONFIG)
    assert "\n" not in str(caught.value)


def test_uneven_ground_is_refused(write: Write) -> None:
    bumpy = dataclasses.replace(CONFIG, shift="bumpy")
    with pytest.raises(ValueError, match=r"judged on flat ground, .* bumpy \(nearest: --shift"):
        resolve_policy(str(write(standing(STEPS, 0.3))), bumpy)
