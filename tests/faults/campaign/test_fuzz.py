"""The readers of policies, datasets, clips, contracts, configs and grids, fed by hypothesis.

What is valid is changed in one place or in several, and read: it is taken, or refused in one line.
``make fuzz`` tries for ten minutes, the campaign ``TWIRL_FUZZ`` examples of each.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

hypothesis = pytest.importorskip("hypothesis", reason="the environment is older than the lock")
from hypothesis import HealthCheck, Phase, settings  # noqa: E402
from hypothesis import strategies as st  # noqa: E402

from twirl_mjx import array_files, faults  # noqa: E402
from twirl_mjx.assets import asset_path  # noqa: E402
from twirl_mjx.motion.formats import read_clip  # noqa: E402
from twirl_mjx.motion.plausible import check_plausible  # noqa: E402
from twirl_mjx.policies import contract, ready  # noqa: E402
from twirl_mjx.policies.learned import load_policy  # noqa: E402
from twirl_mjx.replay import dataset  # noqa: E402
from twirl_mjx.sweep.grid import expand  # noqa: E402
from twirl_mjx.training import config_json  # noqa: E402
from twirl_mjx.training.presets import make_config  # noqa: E402
from twirl_mjx.training.rundir import RunDir  # noqa: E402

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]

PLAIN = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=12)
VALUES = st.recursive(
    PLAIN,
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4)
    ),
    max_leaves=8,
)
KINDS = ("float32", "float64", "int64", "bool", "complex64", "U3", "uint8")
SHAPES = st.lists(st.integers(0, 5), max_size=4).map(tuple)


def places(record: Any, before: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Return the way to every value of a record, of lists the first three."""
    found = [before] if before else []
    inner: Any = ()
    if isinstance(record, dict):
        inner = record.items()
    elif isinstance(record, list):
        inner = list(enumerate(record))[:3]
    for key, value in inner:
        found += places(value, (*before, key))
    return found


@st.composite
def changed(draw: Any, record: Any) -> Any:
    """Draw a record of which some values are others, or gone, or have another name."""
    record = json.loads(json.dumps(record))
    for _ in range(draw(st.integers(1, 3))):
        way = draw(st.sampled_from(places(record) or [()]))
        if not way:
            return draw(VALUES)
        owner = record
        for step in way[:-1]:
            owner = owner[step]
        match draw(st.sampled_from(["value", "value", "gone", "name"])):
            case "gone":
                del owner[way[-1]]
            case "name" if isinstance(owner, dict):
                owner[draw(st.text(max_size=8))] = owner.pop(way[-1])
            case _:
                owner[way[-1]] = draw(VALUES)
    return record


@st.composite
def archive(draw: Any, arrays: dict[str, np.ndarray], header: Any) -> dict[str, np.ndarray]:
    """Draw an archive of which the header, or arrays, are others."""
    out = {"header": np.array(json.dumps(draw(changed(header) | st.just(header))))} | arrays
    for name in draw(st.lists(st.sampled_from(sorted(out)), max_size=2, unique=True)):
        array = np.zeros(draw(SHAPES), draw(st.sampled_from(KINDS)))
        if array.dtype.kind in "fc":
            with np.errstate(all="ignore"):
                array[...] = draw(st.floats())
        out[name] = array
    if draw(st.booleans()):
        out.pop(draw(st.sampled_from(sorted(out))))
    return out


def policy_parts() -> tuple[dict[str, np.ndarray], Any]:
    arrays = array_files.read_npz(asset_path("policies", "stand.npz"), "a policy")
    return arrays, json.loads(str(arrays.pop("header")))


def dataset_parts(folder: Path) -> tuple[dict[str, np.ndarray], Any]:
    from twirl_mjx.types import Transition

    size, rng = 3, np.random.default_rng(0)
    data: Any = Transition(
        obs=rng.normal(size=(size, 4)), action=np.zeros((size, 2)), reward=np.zeros(size),
        terminated=np.zeros(size, bool), next_obs=rng.normal(size=(size, 4)),
    )  # type: ignore[arg-type]  # fmt: skip
    header = dataset.DatasetHeader("stand", "none", "zero", size, 4, 2, 0.5)
    dataset.write(folder / "whole.npz", header, data)
    arrays = array_files.read_npz(folder / "whole.npz", "a dataset")
    return arrays, json.loads(str(arrays.pop("header")))


def read_policy(path: Path) -> None:
    policy = load_policy(path)
    with np.errstate(all="ignore"):  # weights may be as large as float32 has them
        policy.act(np.zeros(policy.observation_size, np.float32))


def read_motion(path: Path) -> None:
    clip = read_clip(path)
    check_plausible(clip)
    assert all(np.isfinite(leaf).all() for leaf in (clip.root_pos, clip.joint_pos))


def read_config(path: Path) -> None:
    RunDir(path.parent).read_config()


def read_dataset(path: Path) -> None:
    dataset.read(path, task="stand", observation_size=4, action_size=2)


def clip_record() -> Any:
    record = json.loads(asset_path("a1", "leap.json").read_text())
    return record | {"Frames": record["Frames"][:4], "LegOrder": "FR FL RR RL"}


BLOCK = {
    "preset": "debug", "seeds": [0, 1], "base": {"replay.phi": 0.5}, "nominal": {}, "smoke": True,
    "axes": {"task": {"biped": {"task": "biped"}}, "utd": {"u1": {"droq.utd": 1.0}}},
}  # fmt: skip


def written_as_json(path: Path, record: Any) -> None:
    path.write_text(json.dumps(record), encoding="utf-8", errors="surrogatepass")


def written_as_arrays(path: Path, arrays: Any) -> None:
    array_files.write_npz(path, arrays)


def readers(folder: Path) -> dict[str, tuple[Any, Callable[[Path, Any], None], Callable, str]]:
    """Return what is drawn, how it is written and read, and the name of the file, by kind."""
    return {
        "policy": (archive(*policy_parts()), written_as_arrays, read_policy, "a.npz"),
        "dataset": (archive(*dataset_parts(folder)), written_as_arrays, read_dataset, "a.npz"),
        "clip": (changed(clip_record()), written_as_json, read_motion, "a.json"),
        "contract": (
            changed(ready.READY["go1_joystick"].to_record()), written_as_json, contract.read,
            "a.json",
        ),
        "config": (
            changed(json.loads(config_json.to_json(make_config("biped", "debug")))),
            written_as_json, read_config, "config.json",
        ),
        "grid": (
            changed(BLOCK), written_as_json,
            lambda path: expand(json.loads(path.read_text(errors="surrogatepass")), "here", None),
            "a.json",
        ),
    }  # fmt: skip


@pytest.mark.parametrize("kind", ["policy", "dataset", "clip", "contract", "config", "grid"])
def test_a_reader_takes_or_refuses(kind: str, tally: Any, tmp_path: Path) -> None:
    drawn, write, read, name = readers(tmp_path)[kind]
    path = tmp_path / name

    @settings(
        max_examples=int(os.environ.get("TWIRL_FUZZ", "200")), deadline=None, database=None,
        suppress_health_check=list(HealthCheck), derandomize="TWIRL_FUZZ" not in os.environ,
        phases=[Phase.generate],  # to make an example smaller takes minutes
    )  # fmt: skip
    @hypothesis.given(content=drawn)
    def try_one(content: Any) -> None:
        write(path, content)
        try:
            read(path)
        except Exception as error:
            text = faults.explain(error).text
            assert "a fault of this program" not in text, text
            assert "\n" not in text, text
            tally.add(f"fuzz: {kind}", "refused clearly")
        else:
            tally.add(f"fuzz: {kind}", "survived equal")

    try:
        try_one()
    except Exception as error:
        tally.add(f"fuzz: {kind}", "fell short", str(error)[:500])
    tally.check()
