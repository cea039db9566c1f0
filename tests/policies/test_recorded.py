"""Recorded data as a source: what is read, and what cannot be of the target task."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from twirl_mjx.policies import rows
from twirl_mjx.policies.resolve import Terms, resolve_policy
from twirl_mjx.replay import dataset
from twirl_mjx.replay.dataset import DatasetError
from twirl_mjx.sim.robots import A1
from twirl_mjx.tasks.observations import layout_slices
from twirl_mjx.training.presets import make_config
from twirl_mjx.types import Transition

CONFIG = make_config("biped", "debug")
LAYOUT = CONFIG.make_task().observer.layout
PARTS = layout_slices(LAYOUT)


def arrays(count: int = 6) -> dict[str, Any]:
    """Return data that could be of ``biped``, under the names of D4RL."""
    rng = np.random.default_rng(0)
    obs = 0.1 * rng.standard_normal((count + 1, 101))
    for name, part in PARTS.items():
        if name.startswith("joint_pos"):
            obs[:, part] = A1.default_pose + 0.1 * rng.standard_normal((count + 1, 12))
        if name in ("base_x_axis_w", "base_z_axis_w"):
            obs[:, part] = [1.0, 0.0, 0.0]
    actions = rng.uniform(-1, 1, (count, 12))
    obs[1:, PARTS["previous_action[0]"]] = actions
    return {
        "task": "biped",
        "observations": obs[:-1],
        "actions": actions,
        "rewards": np.arange(count, dtype=np.float64)[:, None],
        "terminals": np.arange(count) == 3,
        "timeouts": np.arange(count) == 5,
        "next_observations": obs[1:],
    }


def save(path: Path, **changes: Any) -> Path:
    values = {k: v for k, v in (arrays() | changes).items() if v is not None}
    with path.open("wb") as file:
        np.savez(file, **values)
    return path


def test_plain_arrays(tmp_path: Path) -> None:
    source = resolve_policy(str(save(tmp_path / "d.npz")), CONFIG.evaluation)
    assert source.data is not None
    given = arrays()
    np.testing.assert_array_equal(source.data.obs, given["observations"].astype(np.float32))
    np.testing.assert_array_equal(source.data.reward, np.arange(6))
    np.testing.assert_array_equal(source.data.terminated, given["terminals"])
    assert source.data.action.dtype == np.float32
    assert source.data.terminated.dtype == bool
    with pytest.raises(ValueError, match=r"d\.npz is recorded data.*it does not act"):
        source.policy.init(None)
    with pytest.raises(ValueError, match=r"would do nothing: .* is recorded data"):
        resolve_policy(str(tmp_path / "d.npz"), CONFIG.evaluation, terms=Terms("go1_joystick"))


def test_a_dataset_of_another_run(tmp_path: Path) -> None:
    plain = resolve_policy(str(save(tmp_path / "d.npz")), CONFIG.evaluation).data
    assert isinstance(plain, Transition)
    header = dataset.DatasetHeader("biped", "icy", "scripted trot", 6, 101, 12, 1.0, "abc", "other")
    dataset.write(tmp_path / "source.npz", header, plain)
    source = resolve_policy(str(tmp_path / "source.npz"), CONFIG.evaluation)
    jax.tree.map(np.testing.assert_array_equal, source.data, plain)
    assert "recorded under shift icy" in source.notes[1]
    with pytest.raises(DatasetError, match="task is 'biped', this run needs 'hurdles'"):
        resolve_policy(str(tmp_path / "source.npz"), make_config("hurdles", "debug").evaluation)


def entry(name: str, value: Any, row: int = 2) -> dict[str, Any]:
    """Return observations with one entry of a row replaced."""
    obs = arrays()["observations"].copy()
    obs[row, PARTS[name]] = value
    return {"observations": obs}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"observations": np.zeros((6, 48))},
            r"obs has shape \(6, 48\), task biped needs \(6, 101",
        ),
        ({"actions": np.zeros((6, 6))}, r"action has shape \(6, 6\)"),
        ({"rewards": np.zeros(5)}, r"reward has shape \(5,\)"),
        ({"rewards": np.array([0, 0, np.nan, 0, 0, 0])}, "reward is not finite in row 2"),
        ({"rewards": np.array(["a"] * 6)}, "of type <U1, need numbers"),
        ({"rewards": None}, "no array 'reward' .* among action, "),
        (
            {"terminals": None, "dones": np.zeros(6)},
            "'dones' mix ends of the task with time limits",
        ),
        ({"terminals": np.full(6, 2)}, "terminated holds 2"),
        ({"terminals": np.ones(6)}, "every row is terminated"),
        ({"timeouts": np.zeros(4)}, r"truncated has shape \(4,\)"),
        (
            {"actions": np.full((6, 12), 1.8)},
            r"action reaches 1\.8 in row 0, limit 1 \(joint angles",
        ),
        ({"next_observations": arrays()["observations"]}, "nothing ever moved"),
        (entry("joint_pos[0]", 51.0), r"joint_pos\[0\]: .*_joint is 51 in row 2.*degrees"),
        (entry("base_x_axis_w", [3.0, 0, 0]), "length 3 in row 2, need 1"),
        (entry("roll_pitch[-1]", [0.0, 2.5]), r"roll_pitch\[-1\]: pitch is 2\.5"),
        (entry("previous_action[0]", 4.0), r"previous_action\[0\]: .* is 4 in row 2"),
    ],
)
def test_what_cannot_be_of_the_task_is_refused(changes: dict, message: str, tmp_path: Path) -> None:
    path = save(tmp_path / "d.npz", **changes)
    with pytest.raises(DatasetError, match=rf"d\.npz: .*{message}") as caught:
        resolve_policy(str(path), CONFIG.evaluation)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["d.pkl", "d.pt"])
def test_formats_that_are_not_read_are_named(name: str) -> None:
    with pytest.raises(DatasetError, match=r"is not read, because .*nearest: .* \.npz or \.hdf5"):
        resolve_policy(name, CONFIG.evaluation)


def test_a_policy_file_is_no_recording(tmp_path: Path) -> None:
    from twirl_mjx.assets import asset_path

    assert not rows.is_recording(str(asset_path("policies", "biped.npz")))
    assert not rows.is_recording(str(tmp_path))
