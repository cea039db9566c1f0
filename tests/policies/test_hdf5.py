"""HDF5 files and datasets of Minari become the rows of an npz file, or one line of refusal."""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pytest

from twirl_mjx import array_files, files
from twirl_mjx.policies import rows
from twirl_mjx.policies.resolve import resolve_policy
from twirl_mjx.replay.dataset import DatasetError
from twirl_mjx.sim.robots import A1
from twirl_mjx.tasks.observations import layout_slices
from twirl_mjx.training.presets import make_config

CONFIG = make_config("biped", "debug").evaluation
PARTS = layout_slices(CONFIG.make_task().observer.layout)
Arrays = dict[str, Any]


def rows_of(lengths: tuple[int, ...]) -> Arrays:
    """Return episodes one after another; the base has moved by the number of the row."""
    count = sum(lengths)
    obs = np.zeros((count, 101))
    for name, part in PARTS.items():
        if name.startswith("joint_pos"):
            obs[:, part] = A1.default_pose
        if name in ("base_x_axis_w", "base_z_axis_w"):
            obs[:, part] = [1.0, 0.0, 0.0]
    obs[:, 0] = np.arange(count)
    last = np.isin(np.arange(1, count + 1), np.cumsum(lengths))
    in_first = np.arange(count) < lengths[0]
    return {
        "observations": obs, "actions": np.zeros((count, 12)), "rewards": np.arange(count) / 10,
        "terminals": last & in_first, "timeouts": last & ~in_first,
    }  # fmt: skip


def write(path: Path, arrays: Arrays, **said: Any) -> str:
    with h5py.File(path, "w") as file:
        file.attrs.update({"task": "biped"} | said)
        for name, array in arrays.items():
            if array is not None:
                file[name] = array
    return str(path)


def test_flat_rows_are_those_of_an_npz_file(tmp_path: Path) -> None:
    """Episodes of 3 rows (terminated) and 4 (cut off): nobody knows what followed the seventh."""
    arrays = rows_of((3, 4))
    name = write(tmp_path / "d.h5", arrays, shift="icy", note="of no interest")
    np.savez(tmp_path / "d.npz", task="biped", shift="icy", **arrays)
    source, other = resolve_policy(name, CONFIG), resolve_policy(str(tmp_path / "d.npz"), CONFIG)
    data = source.data
    assert data is not None
    np.testing.assert_array_equal(data.obs[:, 0], [0, 1, 2, 3, 4, 5])
    np.testing.assert_array_equal(data.next_obs[:, 0], [1, 2, 2, 4, 5, 6])
    np.testing.assert_array_equal(data.terminated, [False, False, True, False, False, False])
    np.testing.assert_allclose(data.reward, [0.0, 0.1, 0.2, 0.3, 0.4, 0.5])
    assert "recorded under shift icy" in source.notes[1]
    assert source.notes[2].startswith("1 of 7 rows are left out")
    for field, array in vars(data).items():
        np.testing.assert_array_equal(array, getattr(other.data, field))


def test_episodes_carry_the_observation_after_their_last_action(tmp_path: Path) -> None:
    flat = rows_of((3, 4))
    arrays = {}
    for number, begin, end in ((10, 3, 7), (2, 0, 3)):  # by number, not by name
        obs = np.concatenate([flat["observations"][begin:end], flat["observations"][end - 1 :][:1]])
        obs[-1, 0] = 100 + number
        part = {"observations": obs, "actions": flat["actions"][begin:end],
                "rewards": flat["rewards"][begin:end], "terminations": flat["terminals"][begin:end],
                "truncations": flat["timeouts"][begin:end]}  # fmt: skip
        arrays |= {f"episode_{number}/{name}": array for name, array in part.items()}
    data = resolve_policy(write(tmp_path / "d.hdf5", arrays), CONFIG).data
    assert data is not None
    np.testing.assert_array_equal(data.obs[:, 0], [0, 1, 2, 3, 4, 5, 6])
    np.testing.assert_array_equal(data.next_obs[:, 0], [1, 2, 102, 4, 5, 6, 110])
    np.testing.assert_array_equal(data.terminated, np.arange(7) == 2)


def inside(**changes: Any) -> Callable[[Path], str]:
    return lambda path: write(path, rows_of((3, 4)) | changes)


def linked(link: Any) -> Callable[[Path], str]:
    def make(path: Path) -> str:
        name = write(path, rows_of((3, 4)) | {"observations": None})
        write(path.with_name("other.h5"), rows_of((3, 4)))
        with h5py.File(name, "a") as file:
            file["observations"] = link
        return name

    return make


def named_twice(path: Path) -> str:
    name = write(path, rows_of((3, 4)))
    with h5py.File(name, "a") as file:
        file["again"] = file["/"]
    return name


def stored_outside(path: Path) -> str:
    name = write(path, rows_of((3, 4)) | {"rewards": None})
    with h5py.File(name, "a") as file:
        outside = [(str(path.with_name("bytes")), 0, h5py.h5f.UNLIMITED)]
        file.create_dataset("rewards", (7,), "f8", external=outside)
    return name


def virtual(path: Path) -> str:
    name = write(path, rows_of((3, 4)) | {"rewards": None})
    layout = h5py.VirtualLayout((7,), "f8")
    layout[:] = h5py.VirtualSource("other.h5", "rewards", (7,))
    with h5py.File(name, "a") as file:
        file.create_virtual_dataset("rewards", layout)
    return name


def declares(*shape: int) -> Callable[[Path], str]:
    def make(path: Path) -> str:
        name = write(path, rows_of((3, 4)) | {"observations": None})
        with h5py.File(name, "a") as file:
            file.create_dataset("observations", shape, "f4", chunks=(1, 101))
        return name

    return make


def cut(path: Path) -> str:
    name = write(path, rows_of((3, 4)))
    path.write_bytes(path.read_bytes()[:3000])
    return name


def text(path: Path) -> str:
    path.write_text("observations, actions\n")
    return str(path)


ENDS = rows_of((3, 4))["terminals"]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (linked(h5py.ExternalLink("other.h5", "observations")), "observations is a link to 'obs"),
        (linked(h5py.SoftLink("/etc/passwd")), "observations is a link to '/etc/passwd'"),
        (named_twice, "is another name of an object that was there before"),
        (stored_outside, "the numbers of rewards lie in another file, which is not opened"),
        (virtual, "the numbers of rewards lie in another file, which is not opened"),
        (declares(10**12, 101), r"bytes that would become 404,000,000,\d+"),
        (cut, "not a readable HDF5 file"),
        (text, "not a readable HDF5 file"),
        (inside(observations=np.full((7, 101), np.nan)), "obs is not finite in row 0"),
        (inside(rewards=np.full(7, 1e300)), "reward is not finite in row 0"),
        (inside(observations=np.zeros((7, 48))), r"obs has shape \(7, 48\), .* needs \(7, 101\)"),
        (inside(actions=np.zeros((6, 12))), r"obs has shape \(7, 101\), .* needs \(6, 101\)"),
        (inside(actions=np.float64(1.0)), r"action has shape \(\), task biped needs \('n', 12\)"),
        (inside(actions=np.full((7, 12), 2.0)), "action reaches 2 in row 0, limit 1"),
        (inside(actions=np.full((7, 12), 0.5)), r"action\[0\]: 0 in row 0, where .* is 0\.5"),
        (inside(timeouts=None), r"neither next_obs nor the ends .* truncated \(trunc"),
        (inside(terminals=None, dones=ENDS), "'dones' mix ends of the task with time limits"),
        (inside(terminations=ENDS), "terminals and terminations are both terminated"),
        (inside(observations=None, **{"observations/camera": np.zeros((7, 9))}),
         r"obs is a group of 1 arrays \(observations/camera, \.\.\.\), need one array"),
        (lambda path: write(path, rows_of((3, 4)), task="stand"),
         r"rewards are those of task stand, and it holds no states .*nearest: the states too\)"),
        (lambda path: write(path, rows_of((3, 4)), task=""),
         r"a task that the file does not name.*, or task='biped' in the file"),
        (lambda path: write(path, rows_of((3, 4)), control_dt=0.02),
         r"control_dt is 0\.02 s, robot a1 acts every 0\.05 s"),
        (lambda path: write(path, {k: v[:0] for k, v in rows_of((3, 4)).items()}), "0 transitions"),
        (lambda path: write(path, {"episode_0/actions": np.zeros((7, 12))}),
         "episode_0: there is no array 'terminations'"),
    ],
)  # fmt: skip
def test_files_that_lie_are_refused(
    make: Callable[[Path], str], message: str, tmp_path: Path
) -> None:
    with pytest.raises((DatasetError, files.FileError), match=rf"d\.hdf5.*{message}") as caught:
        resolve_policy(make(tmp_path / "d.hdf5"), CONFIG)
    assert "\n" not in str(caught.value)


def test_what_is_no_number_is_left_out(tmp_path: Path) -> None:
    name = write(
        tmp_path / "d.hdf5", {"a/b": np.arange(3), "words": ["x", "y"], "none": h5py.Empty("f8")}
    )
    found = array_files.read_hdf5(name, "arrays")
    assert sorted(found) == ["a/b", "task"]
    assert found["task"].item() == "biped"


@pytest.mark.parametrize(
    ("package", "name", "extra"),
    [("h5py", "d.hdf5", "hdf5"), ("minari", "minari:stand/own-v0", "minari")],
)
def test_a_missing_package_is_named(
    package: str, name: str, extra: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.chdir(tmp_path)
    Path("d.hdf5").touch()
    with pytest.raises(ValueError, match=rf"needs the package {package}, .*twirl-mjx\[{extra}\]'"):
        resolve_policy(name, CONFIG)


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no\.hdf5: no such file, expected a source data"):
        resolve_policy(str(tmp_path / "no.hdf5"), CONFIG)


def test_a_dataset_of_minari_that_is_not_there(monkeypatch: pytest.MonkeyPatch) -> None:
    def load_dataset(identity: str) -> Any:
        raise FileNotFoundError(f"Dataset {identity} not found locally")

    fake = SimpleNamespace(
        load_dataset=load_dataset,
        list_local_datasets=lambda: {"a1/trot-v0": {}, "door/human-v2": {}},
    )
    monkeypatch.setitem(sys.modules, "minari", fake)
    with pytest.raises(FileNotFoundError, match=r"not on this machine .*\(nearest: 'a1/trot-v0'\)"):
        resolve_policy("minari:a1/trott-v0", CONFIG)
    fake.load_dataset = lambda identity: json.loads("{")
    with pytest.raises(FileNotFoundError, match=r"minari:x cannot be read \(Expecting property"):
        resolve_policy("minari:x", CONFIG)
    assert rows.is_recording("minari:a1/trott-v0")


COLLECT = """
import gymnasium, minari, numpy as np, twirl_mjx
twirl_mjx.register_gymnasium()
env = minari.DataCollector(gymnasium.make("twirl_mjx/Biped-v0"), record_infos=True)
for seed in range(2):
    env.reset(seed=seed)
    for _ in range(5):
        env.step(np.full(12, 0.1, np.float32))
env.create_dataset("twirl/biped-v0")
from twirl_mjx.policies.resolve import resolve_policy
from twirl_mjx.training.presets import make_config
source = resolve_policy("minari:twirl/biped-v0", make_config("biped", "debug").evaluation)
assert source.data.reward.shape == (10,), source.data.reward.shape
assert source.notes[0].endswith("recorded in task biped"), source.notes
print("read")
"""


@pytest.mark.slow
def test_a_dataset_that_minari_made(tmp_path: Path) -> None:
    """Needs the package minari, which is not in the lock: pip install 'twirl-mjx[minari]'."""
    if importlib.util.find_spec("minari") is None:
        pytest.skip("minari is not installed (pip install 'twirl-mjx[minari]')")
    environment = {**os.environ, "MINARI_DATASETS_PATH": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", COLLECT],
        env=environment,
        capture_output=True,
        text=True,
        timeout=280,
    )
    assert done.stdout.endswith("read\n"), done.stderr
