"""Which source a run starts from."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from twirl_mjx.policies.recorded import RecordedPolicy
from twirl_mjx.policies.resolve import Source, Terms
from twirl_mjx.replay import dataset
from twirl_mjx.training import collection, pipeline, source_rules
from twirl_mjx.training.presets import make_config
from twirl_mjx.training.rundir import Foreign, New, RunDir, RunMismatchError
from twirl_mjx.training.source_rules import (
    AtPath,
    InFile,
    NominalRun,
    RunOf,
    Scripted,
    check_source_is_used,
    source_of,
    terms_of,
)
from twirl_mjx.types import Transition

SHIPPED = Path("a", "policy.npz")


@pytest.fixture(autouse=True)
def _shipped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(source_rules, "asset_path", lambda *_: SHIPPED)


def test_a_default_source_is_the_shipped_policy() -> None:
    assert source_of(make_config("biped", "cpu"), "cpu") == AtPath(SHIPPED, is_shipped=True)


def test_debug_networks_are_too_small_for_shipped_policies() -> None:
    config = dataclasses.replace(make_config("hurdles", "debug"), seed=3)
    expected = dataclasses.replace(make_config("imitate", "debug"), seed=3)
    assert source_of(config, "debug") == RunOf(expected)


def test_train_asks_for_a_run_of_ones_own() -> None:
    config = dataclasses.replace(make_config("biped", "cpu"), source="train", seed=2)
    expected = dataclasses.replace(make_config("stand", "cpu"), seed=2)
    assert source_of(config, "cpu") == RunOf(expected)


def test_other_options_of_the_source_task_need_another_source() -> None:
    plain = make_config("hurdles", "cpu")
    own = dataclasses.replace(plain.source_options, clip="own.json")
    config = dataclasses.replace(plain, source_options=own)
    expected = dataclasses.replace(make_config("imitate", "cpu"), options=own)
    assert source_of(config, "cpu") == RunOf(expected)


@pytest.mark.usefixtures("no_shipped_policies")
def test_nothing_shipped_means_a_run() -> None:
    assert source_of(make_config("biped", "cpu"), "cpu") == RunOf(make_config("stand", "cpu"))


@pytest.mark.parametrize("shift", ["none", "icy"])
def test_a_named_source_is_taken_under_a_shift_too(shift: str) -> None:
    config = dataclasses.replace(make_config("biped", "cpu"), shift=shift)
    path = dataclasses.replace(config, source="runs/other")
    assert source_of(path, "cpu") == AtPath(Path("runs/other"))
    assert source_of(dataclasses.replace(config, source="trot"), "cpu") == Scripted("trot")


@pytest.mark.parametrize("task", ["stand", "biped", "imitate", "hurdles"])
def test_a_shift_starts_from_the_nominal_run_even_with_a_scripted_default(task: str) -> None:
    config = dataclasses.replace(make_config(task, "cpu"), shift="icy")
    assert source_of(config, "cpu") == NominalRun()


def test_stand_has_no_source_of_its_own() -> None:
    config = dataclasses.replace(make_config("stand", "cpu"), variant="twirl")
    with pytest.raises(ValueError, match="no source policy of its own"):
        source_of(config, "cpu")


@pytest.mark.parametrize(
    ("task", "option", "value"),
    [
        ("stand", "height_of", "root"),
        ("biped", "distance_weight", 4.0),
        ("biped", "distance_reward", "speed"),
        ("hurdles", "hurdle_bonus", "clean"),
        ("imitate", "clip", "own.json"),
    ],
)
def test_a_replay_of_other_rewards_does_not_fit(task: str, option: str, value: object) -> None:
    config = make_config(task, "cpu")
    options = dataclasses.replace(config.options, **{option: value})
    other = dataclasses.replace(config, options=options)
    with pytest.raises(ValueError, match=rf"a run with {task}\.{option} {value!r} \(here .*anew"):
        source_rules.check_replay_fits(config, other, Path("runs/other"))


def test_a_replay_of_another_course_fits() -> None:
    config = make_config("hurdles", "cpu")
    wide = dataclasses.replace(config, options=dataclasses.replace(config.options, max_gap=3.7))
    source_rules.check_replay_fits(config, wide, Path("runs/wide"))


def test_a_source_without_effect_is_refused() -> None:
    scratch = dataclasses.replace(make_config("biped", "cpu"), variant="scratch")
    source_rules.check_source_is_used(scratch, "cpu")
    imitate = dataclasses.replace(make_config("imitate", "cpu"), variant="scratch")
    source_rules.check_source_is_used(imitate, "cpu")  # the preset's own: `clip`
    with pytest.raises(
        ValueError, match=r"source trot would do nothing .*nearest: --variant twirl"
    ):
        source_rules.check_source_is_used(dataclasses.replace(scratch, source="trot"), "cpu")


def test_a_function_is_a_source_and_terms_need_one() -> None:
    config = make_config("biped", "cpu")
    mine = dataclasses.replace(config, source="mine.py:walk", source_contract="go1_joystick")
    assert source_of(mine, "cpu") == InFile("mine.py:walk")
    assert terms_of(mine) == Terms("go1_joystick")
    check_source_is_used(mine, "cpu")
    lost = dataclasses.replace(config, source_command="1,0,0")
    with pytest.raises(ValueError, match="--source-command 1,0,0 would do nothing without a"):
        check_source_is_used(lost, "cpu")


@pytest.mark.parametrize("name", ["source.npz", "policy.npz", "policy_last.npz", "eval.csv"])
def test_files_that_no_run_wrote_are_left_alone(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(b"mine")
    found = RunDir(tmp_path).status(make_config("biped", "debug"))
    assert isinstance(found, Foreign)
    assert f"holds {name} of a run and no config.json" in str(found.error)
    (tmp_path / name).rename(tmp_path / "notes.txt")
    assert RunDir(tmp_path).status(make_config("biped", "debug")) == New()


def test_data_that_the_run_did_not_collect_are_not_collected_over(tmp_path: Path) -> None:
    """Of the right format, beside a config of this very run, for other settings."""
    config = dataclasses.replace(make_config("biped", "debug"), source="trot")
    run_dir = RunDir(tmp_path / "mine")
    run_dir.open(config)
    zeros = np.zeros((4, 101), np.float32)
    rows = Transition(zeros, zeros[:, :12], zeros[:, 0], zeros[:, 0] > 0, zeros)
    header = dataset.DatasetHeader("biped", "none", "me", 4, 101, 12, 0.0, "other", "theirs")
    dataset.write(run_dir.dataset, header, rows)
    before = run_dir.dataset.read_bytes()
    source = pipeline.find_source(config, "debug", tmp_path, print)
    with pytest.raises(RunMismatchError, match=r"this run did not collect \(run theirs did"):
        collection.source_data(config, run_dir, source, print)
    assert run_dir.dataset.read_bytes() == before


def test_recorded_data_become_the_source_ring(tmp_path: Path) -> None:
    config = make_config("biped", "debug")
    zeros = np.zeros((4, 101), np.float32)
    rows = Transition(zeros, zeros[:, :12], zeros[:, 0] + 7.0, zeros[:, 0] > 0, zeros)
    data = Source(RecordedPolicy("d.npz"), "d.npz", "abc", data=rows)
    said: list[str] = []
    found = collection.source_data(config, RunDir(tmp_path / "run"), data, said.append)
    assert int(found.size) == 4
    assert "4 recorded transitions" in said[-1]
    assert not (tmp_path / "run").exists()
