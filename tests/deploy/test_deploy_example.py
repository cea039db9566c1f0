"""What leaves: the ONNX, its contract, and the example that a robot engineer starts from."""

from __future__ import annotations

import ast
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest

from twirl_mjx import files, plugins
from twirl_mjx.assets import asset_path
from twirl_mjx.commands import export as command
from twirl_mjx.deploy.conditions import RehearsalConfig
from twirl_mjx.deploy.export import export
from twirl_mjx.deploy.rehearsal import rehearse
from twirl_mjx.policies import contract as schema
from twirl_mjx.policies.learned import load_policy, save_policy
from twirl_mjx.policies.ready import find_contract
from twirl_mjx.policies.resolve import resolve_policy
from twirl_mjx.sim.robots import A1
from twirl_mjx.worlds.config import WorldConfig

EXAMPLE = Path(__file__).parents[2] / "examples" / "deploy.py"


@pytest.mark.parametrize("task", ["stand", "biped", "hurdles", "imitate"])
def test_the_example_reproduces_a_rehearsal(task: str, tmp_path: Path) -> None:
    """Noise, latency and all: what was measured goes in, actions and joint targets come out."""
    exported = export(asset_path("policies", f"{task}.npz"), tmp_path / "policy.onnx").onnx
    config = RehearsalConfig(episode_s=1.0)
    episodes = rehearse(exported, episodes=2, seed=3, config=config).episodes
    robot = plugins.load(f"{EXAMPLE}:Controller")(str(exported))
    for episode in episodes:
        robot.frames = None
        for step, reading in enumerate(episode.readings):
            action, target = robot.step(
                rotation=reading.rotation, gyro=reading.angular_velocity,
                joints=reading.joint_pos, position=reading.position, goal=episode.goals[step],
            )  # fmt: skip
            np.testing.assert_allclose(action, episode.actions[step], atol=1e-5)
            np.testing.assert_allclose(target, episode.targets[step], atol=1e-5)
        assert len(episode.readings) > 10


def test_the_example_is_short_and_needs_nothing_of_ours() -> None:
    source = EXAMPLE.read_text()
    assert len(source.splitlines()) <= 60
    tree = ast.parse(source)
    imports = [x for x in ast.walk(tree) if isinstance(x, ast.Import)]
    names = {alias.name for x in imports for alias in x.names}
    names |= {str(x.module) for x in ast.walk(tree) if isinstance(x, ast.ImportFrom)}
    assert names - sys.stdlib_module_names == {"numpy", "onnxruntime"}


def test_what_an_export_says(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "biped" / "policy.onnx"
    assert command.main([str(asset_path("policies", "biped.npz")), "--out", str(out)]) == 0
    assert "contract.json" in capsys.readouterr().out
    found = schema.read(out.with_name("contract.json"))
    assert found == find_contract("biped", A1)
    record = json.loads(out.with_name("contract.json").read_text())
    assert {"joints", "default_pose", "action", "gains", "joint_limits", "torque_limit", "lowpass",
            "history_layout", "history_order", "control_dt"} <= record.keys()  # fmt: skip
    properties = {p.key: p.value for p in onnx.load(str(out)).metadata_props}
    assert schema.from_json(properties[schema.METADATA_KEY], "here") == found


def test_an_exported_policy_is_the_same_source_by_header_and_by_contract(tmp_path: Path) -> None:
    """A stranger who strips our header still has the contract in the file."""
    out = export(asset_path("policies", "biped.npz"), tmp_path / "policy.onnx").onnx
    model = onnx.load(str(out))
    kept = [p for p in model.metadata_props if p.key == schema.METADATA_KEY]
    del model.metadata_props[:]
    model.metadata_props.extend(kept)
    onnx.save(model, str(tmp_path / "stranger.onnx"))
    source = resolve_policy(str(tmp_path / "stranger.onnx"), WorldConfig(task="hurdles"))
    assert source.notes[0] == "contract biped: 101 inputs"


def test_imitate_leaves_with_its_motion(tmp_path: Path) -> None:
    done = export(asset_path("policies", "imitate.npz"), tmp_path / "policy.onnx")
    assert done.contract is not None
    motion = schema.read(done.contract).motion
    assert motion is not None
    assert len(motion.frames) == 101
    assert motion.frame_dt == 0.0125


def test_an_observation_without_words_leaves_without_a_contract(tmp_path: Path) -> None:
    policy: Any = load_policy(asset_path("policies", "hurdles.npz"))
    rows = list(policy.header.observation_layout)
    rows[0] = ("camera", *rows[0][1:])
    header = policy.header.__class__(**{**vars(policy.header), "observation_layout": tuple(rows)})
    path = save_policy(tmp_path / "own.npz", policy.actor_params, header)
    done = export(path, tmp_path / "policy.onnx")
    assert done.contract is None
    assert "'camera', which is no word of a contract" in done.why
    beside = tmp_path / "contract.json"
    assert not beside.exists()
    export(asset_path("policies", "biped.npz"), tmp_path / "policy.onnx")
    before = {file: file.read_bytes() for file in tmp_path.iterdir()}
    with pytest.raises(
        files.FileError, match=r"contract\.json is there and is not the contract of"
    ):
        export(path, tmp_path / "policy.onnx")
    assert {file: file.read_bytes() for file in tmp_path.iterdir()} == before
    assert export(path, tmp_path / "policy.onnx", overwrite=True).contract is None
    assert not beside.exists()


def test_nothing_of_others_is_replaced(tmp_path: Path) -> None:
    biped, hurdles = (asset_path("policies", f"{task}.npz") for task in ("biped", "hurdles"))
    theirs = tmp_path / "policy.onnx"
    theirs.write_bytes(b"a stranger's graph")
    with pytest.raises(files.FileError, match=r"not written by this command.*policy-2\.onnx"):
        export(biped, theirs)
    assert theirs.read_bytes() == b"a stranger's graph"
    assert list(tmp_path.iterdir()) == [theirs]
    export(biped, theirs, overwrite=True)
    export(biped, theirs)  # ours now, and of the same policy
    with pytest.raises(files.FileError, match=r"contract\.json is there and is not the contract"):
        export(hurdles, tmp_path / "other.onnx")
    assert not (tmp_path / "other.onnx").exists()
