"""Source datasets on disk: round trip, and refusal of everything that does not fit."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from twirl_mjx.replay import dataset
from twirl_mjx.types import Transition

SIZES = {"task": "biped", "observation_size": 3, "action_size": 2}


def make_data(count: int = 4) -> Transition:
    rng = np.random.default_rng(0)
    return Transition(
        obs=jnp.asarray(rng.normal(size=(count, 3)), jnp.float32),
        action=jnp.asarray(rng.uniform(-1, 1, size=(count, 2)), jnp.float32),
        reward=jnp.arange(count, dtype=jnp.float32),
        terminated=jnp.arange(count) % 2 == 1,
        next_obs=jnp.asarray(rng.normal(size=(count, 3)), jnp.float32),
    )


def make_header(**changes: object) -> dataset.DatasetHeader:
    header = dataset.DatasetHeader(
        task="biped", shift="none", source="scripted trot", size=4, observation_size=3,
        action_size=2, mean_return=1.5, digest="abc",
    )  # fmt: skip
    return dataclasses.replace(header, **changes)  # type: ignore[arg-type]


def test_round_trip(tmp_path: Path) -> None:
    path = tmp_path / "source.npz"
    data = make_data()
    dataset.write(path, make_header(), data)
    header, found = dataset.read(path, **SIZES)  # type: ignore[arg-type]
    assert header == make_header()
    for name in dataset.FIELDS:
        np.testing.assert_array_equal(getattr(found, name), getattr(data, name))
    assert [p.name for p in tmp_path.iterdir()] == ["source.npz"]


@pytest.mark.parametrize(
    ("header", "changes", "message"),
    [
        ({"task": "hurdles"}, {}, "task is 'hurdles', this run needs 'biped'"),
        ({"observation_size": 5}, {}, "observation size is 5"),
        ({"action_size": 5}, {}, "action size is 5"),
        ({"size": 5}, {}, "the header says"),
        ({"version": 2}, {}, "version 2"),
        ({}, {"reward": jnp.array([0.0, jnp.nan, 0.0, 0.0])}, "reward is not finite in row 1"),
        ({}, {"action": jnp.full((4, 2), 1.5)}, r"actions reach 1\.5"),
    ],
)
def test_what_does_not_fit_is_refused(
    header: dict, changes: dict, message: str, tmp_path: Path
) -> None:
    path = tmp_path / "source.npz"
    dataset.write(path, make_header(**header), make_data().replace(**changes))
    with pytest.raises(dataset.DatasetError, match=message):
        dataset.read(path, **SIZES)  # type: ignore[arg-type]


def test_missing_and_foreign_files(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="twirl collect"):
        dataset.read(tmp_path / "none.npz", **SIZES)  # type: ignore[arg-type]
    path = tmp_path / "foreign.npz"
    path.write_bytes(b"not an archive")
    with pytest.raises(dataset.DatasetError, match="not a readable"):
        dataset.read(path, **SIZES)  # type: ignore[arg-type]
    with path.open("wb") as file:
        np.save(file, np.zeros(3))
    with pytest.raises(dataset.DatasetError, match="one array, not an archive"):
        dataset.read(path, **SIZES)  # type: ignore[arg-type]
    with path.open("wb") as file:
        np.savez(file, header=np.array("[1]"))
    with pytest.raises(dataset.DatasetError, match=r"header is \[1\], not a JSON object"):
        dataset.read(path, **SIZES)  # type: ignore[arg-type]


def test_damaged_files(tmp_path: Path) -> None:
    """Cut off while it was copied, and with a byte of the data changed."""
    path = tmp_path / "source.npz"
    dataset.write(path, make_header(), make_data())
    whole = path.read_bytes()
    at = whole.index(b"obs.npy") + 200
    for damaged in (whole[: len(whole) // 2], whole[:at] + b"\xff\xff" + whole[at + 2 :]):
        path.write_bytes(damaged)
        with pytest.raises(dataset.DatasetError, match=r"source\.npz is not a readable.*collect"):
            dataset.read(path, **SIZES)  # type: ignore[arg-type]
