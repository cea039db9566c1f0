"""Every command takes a foreign source: the same options, the same policy, nothing compiled."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pytest

from twirl_mjx.commands import collect, evaluate, render
from twirl_mjx.commands.curriculum import CurriculumOptions
from twirl_mjx.commands.curriculum import plan as chain
from twirl_mjx.commands.options import parse_collect, parse_train
from twirl_mjx.deploy.rehearsal import rehearse
from twirl_mjx.policies import ready
from twirl_mjx.policies.contract import ContractError
from twirl_mjx.policies.meeting import ContractPolicy
from twirl_mjx.sim.robots import A1
from twirl_mjx.sweep import plan
from twirl_mjx.sweep.grid import load
from twirl_mjx.tasks.observations import layout_slices
from twirl_mjx.training import pipeline
from twirl_mjx.training.config import TrainConfig
from twirl_mjx.training.presets import make_config


@pytest.fixture
def graph(graphs: SimpleNamespace, tmp_path: Path) -> str:
    """Return a stranger's file of 48 inputs that stands still."""
    weights = {"w": np.zeros((48, 12), np.float32)}
    nodes = [graphs.node("MatMul", ["obs", "w"], ["actions"])]
    path = tmp_path / "still.onnx"
    return str(graphs.save(path, nodes, {"obs": [1, 48]}, {"actions": [1, 12]}, weights))


SAID = ["--source-contract", "legged_gym_48", "--source-command", "towards-goal:0.4"]


def check(policy: Any) -> None:
    """Check that a policy is the graph under its contract and command."""
    assert isinstance(policy, ContractPolicy)
    assert policy.contract == ready.LEGGED_GYM_48
    assert policy._command.speed == 0.4


@pytest.mark.parametrize("parse", [parse_train, parse_collect])
def test_train_and_collect(parse: Callable[[list[str]], Any], graph: str, tmp_path: Path) -> None:
    options = parse(["--task", "biped", "--preset", "debug", "--source", graph, *SAID])
    collect.check_source(options.config, "debug")
    pipeline.check_early(options.config, "debug", pipeline.RunDir(tmp_path / "run"))
    check(pipeline.find_source(options.config, "debug", tmp_path, print).policy)


def test_evaluate(graph: str) -> None:
    options = evaluate.EvaluateOptions(
        (graph,), task="hurdles", source_contract="legged_gym_48", source_command="towards-goal:0.4"
    )
    (candidate,) = evaluate.resolve_all(options, {})
    check(candidate.found.policy)
    both = dataclasses.replace(options, policies=("zero", graph))
    check(evaluate.resolve_all(both, {})[1].found.policy)
    with pytest.raises(ValueError, match="would do nothing: zero is scripted"):
        evaluate.resolve_all(dataclasses.replace(options, policies=("zero",)), {})


def test_render(graph: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    class Enough(Exception):  # noqa: N818
        """What would be filmed has been seen."""

    def seen(config: Any, policy: Any, **rest: Any) -> None:
        check(policy)
        raise Enough

    monkeypatch.setattr("twirl_mjx.evaluation.record.record_episode", seen)
    words = [graph, "--task", "biped", "--out", str(tmp_path / "film"), *SAID]
    with pytest.raises(Enough):
        render.main(words, lambda draws: None)


GRID = """
BASE = {{
    "task": "biped", "source": {source!r}, "source_contract": {contract!r},
    "source_command": "towards-goal:0.4",
}}
GRID = ({{"preset": "debug", "seeds": (0,), "axes": {{"arm": {{"foreign": BASE}}}}}},)
REDUCED = GRID
REDUCED_NOTE = "a test"
"""


def test_sweep(graph: str, tmp_path: Path) -> None:
    """A contract in a file is known by its content, and found from any folder."""
    contract = tmp_path / "mine.json"
    contract.write_text(json.dumps(ready.LEGGED_GYM_48.to_record()))
    module = tmp_path / "foreign_grid.py"
    module.write_text(GRID.format(source=graph, contract=str(contract)))
    (cell,) = plan.make_plan(load(str(module)), tmp_path)
    argv = plan.arguments(cell, tmp_path)
    options = parse_train(argv[1:])
    assert options.config.source_contract == str(contract)
    check(pipeline.find_source(options.config, "debug", tmp_path, print).policy)
    contract.write_text(json.dumps(ready.LEGGED_GYM_48.to_record() | {"name": "other"}))
    (other,) = plan.make_plan(load(str(module)), tmp_path)
    assert other.name != cell.name
    named = dataclasses.replace(cell.config, source_contract="legged_gym_48")
    assert plan._contract_of(named) == ("legged_gym_48", "legged_gym_48")


def test_curriculum(graph: str, tmp_path: Path) -> None:
    options = CurriculumOptions(
        task="biped", runs=tmp_path, shifts=("icy",), source=graph,
        source_contract="legged_gym_48", source_command="towards-goal:0.4",
    )  # fmt: skip
    (_, first), (name, shifted) = chain(options, "debug")
    assert (first.task, first.variant, first.shift) == ("biped", "twirl", "none")
    check(pipeline.find_source(first, "debug", tmp_path, print).policy)
    assert shifted.shift == "icy"
    assert (shifted.source_contract, shifted.source_command) == ("", "")
    assert "icy" in name
    stand = dataclasses.replace(options, task="stand", shifts=())
    assert [config.variant for _, config in chain(stand, "debug")] == ["twirl"]
    with pytest.raises(ValueError, match=r"would do nothing .*nearest: --source FILE\.onnx"):
        chain(dataclasses.replace(options, source=""), "debug")


@pytest.mark.parametrize("change", [{"source_contract": "legged_gym_45"}, {"source_command": "2"}])
def test_a_contract_that_does_not_fit_is_refused_before_anything_runs(
    change: dict[str, str], graph: str, tmp_path: Path
) -> None:
    config = parse_train(["--task", "biped", "--preset", "debug", "--source", graph, *SAID]).config
    wrong: TrainConfig = dataclasses.replace(config, **change)  # type: ignore[arg-type]
    with pytest.raises(ContractError):
        pipeline.run(wrong, "debug", tmp_path / "runs", "x", print)
    assert not (tmp_path / "runs").exists()


@pytest.fixture
def recording(tmp_path: Path) -> str:
    """Return an HDF5 file with three rows of ``biped``."""
    obs = np.zeros((4, 101))
    layout = make_config("biped", "debug").make_task().observer.layout
    for name, part in layout_slices(layout).items():
        if name.startswith("joint_pos"):
            obs[:, part] = A1.default_pose
        if name in ("base_x_axis_w", "base_z_axis_w"):
            obs[:, part] = [1.0, 0.0, 0.0]
    obs[:, 0] = np.arange(4)
    with h5py.File(tmp_path / "data.hdf5", "w") as file:
        file.attrs["task"] = "biped"
        zeros = np.zeros(3)
        rows = {"observations": obs, "actions": np.zeros((3, 12)), "rewards": zeros}
        for name, array in (rows | {"terminations": zeros, "truncations": zeros}).items():
            file[f"episode_0/{name}"] = array
    return str(tmp_path / "data.hdf5")


def test_recorded_data_train(recording: str, tmp_path: Path) -> None:
    """In train, collect, a sweep and a curriculum."""

    def check_data(config: TrainConfig) -> None:
        pipeline.check_early(config, "debug", pipeline.RunDir(tmp_path / "run"))
        data = pipeline.find_source(config, "debug", tmp_path, print).data
        assert data is not None
        np.testing.assert_array_equal(data.next_obs[:, 0], [1, 2, 3])

    words = ["--task", "biped", "--preset", "debug", "--source", recording]
    check_data(parse_train(words).config)
    check_data(parse_collect(words).config)
    module = tmp_path / "grid.py"
    module.write_text(
        f"""
GRID = ({{"preset": "debug", "seeds": (0,),
         "axes": {{"arm": {{"data": {{"task": "biped", "source": {recording!r}}}}}}}}},)
REDUCED = GRID
REDUCED_NOTE = "a test"
"""
    )
    (cell,) = plan.make_plan(load(str(module)), tmp_path)
    check_data(parse_train(plan.arguments(cell, tmp_path)[1:]).config)
    options = CurriculumOptions(task="biped", runs=tmp_path, source=recording, shifts=())
    ((_, first),) = chain(options, "debug")
    assert first.variant == "twirl"
    check_data(first)


def test_recorded_data_do_not_act(recording: str, tmp_path: Path) -> None:
    """Said before they are read, or any world is made."""
    words = "is recorded data, which does not act"
    with pytest.raises(ValueError, match=words):
        evaluate.resolve_all(evaluate.EvaluateOptions((recording,), task="biped"), {})
    with pytest.raises(ValueError, match=words):
        film = [recording, "--task", "biped", "--out", str(tmp_path / "film")]
        render.main(film, lambda draws: None)
    with pytest.raises(ValueError, match=words):
        rehearse(recording, task="biped")
    config = parse_train(["--task", "biped", "--preset", "debug", "--source", recording]).config
    for variant in ("zero-shot", "weights", "twirl+weights"):
        asked = dataclasses.replace(config, variant=variant)
        with pytest.raises(ValueError, match=words):
            pipeline.run(asked, "debug", tmp_path / "runs", "x", print)
    assert not (tmp_path / "runs").exists()
