"""Names of runs: the preset's, and what departs from it."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest

from twirl_mjx.training import pipeline, rundir
from twirl_mjx.training.config import TrainConfig
from twirl_mjx.training.config_json import settle
from twirl_mjx.training.presets import PRESETS, make_config


def named(preset: str = "cpu", task: str = "biped", **settings: Any) -> str:
    flat = {name.replace("__", "."): value for name, value in settings.items()}
    return rundir.default_name(settle(make_config(task, preset), flat), preset)


@pytest.mark.parametrize("preset", PRESETS)
def test_a_plain_preset_has_its_plain_name(preset: str) -> None:
    assert named(preset) == f"biped-twirl-{preset}-s0"
    assert named(preset, seed=3, shift="icy") == f"biped-icy-twirl-{preset}-s3"
    assert named(preset, variant="twirl+weights") == f"biped-twirl_weights-{preset}-s0"


def test_what_departs_is_in_the_name() -> None:
    assert named(source="trot") == "biped-twirl-cpu-s0-source_trot"
    assert named(replay__phi=0.25, droq__utd=1.0) == "biped-twirl-cpu-s0-utd_1.0-phi_0.25"
    assert named(num_envs=32) == "biped-twirl-cpu-s0-num_envs_32"
    assert named(biped__goal_distance=1.0) == "biped-twirl-cpu-s0-goal_distance_1.0"


def test_what_a_resumed_run_may_change_is_not() -> None:
    settings = {"total_env_steps": 5000, "eval__every": 3200, "engine": "mjx"}
    assert named(**settings, checkpoint_minutes=1.0) == "biped-twirl-cpu-s0"


def test_many_or_long_ones_are_a_digest() -> None:
    many = {"droq__utd": 1.0, "replay__phi": 0.2, "num_envs": 8, "droq__tau": 0.1}
    long = {"source": "some where/policy.npz"}
    names = [named(**many), named(**long), named(**many | {"droq__tau": 0.2})]
    assert len({*names}) == 3
    for name in names:
        assert rundir.check_name(name) == name
        assert len(name) == len("biped-twirl-cpu-s0-") + 8
    assert named(**many) == names[0]


def test_the_nominal_run_of_an_adaptation_is_the_plain_one(tmp_path: Path) -> None:
    config: TrainConfig = dataclasses.replace(
        make_config("biped", "debug"), shift="icy", variant="weights", seed=4, num_envs=8
    )
    found = pipeline._nominal_dir(config, "debug", tmp_path)
    assert found.path == tmp_path / "biped-twirl-debug-s4"


@pytest.mark.parametrize(
    ("name", "nearest"),
    [("a\nb", "a_b"), ("a\rb", "a_b"), ("a\u2028b", "a_b"), ("a\0", "a_"), ("\u200b", "_"),
     ("a\udcff", "a_")],
)  # fmt: skip
def test_names_that_would_break_tables_are_refused(name: str, nearest: str) -> None:
    with pytest.raises(ValueError, match=rf"\(nearest: '{nearest}'\)$") as error:
        rundir.check_name(name)
    assert str(error.value).isprintable()
    assert rundir.check_name(nearest) == nearest
    assert rundir.check_name("läuft 3 ok") == "läuft 3 ok"
