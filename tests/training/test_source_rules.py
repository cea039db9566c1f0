"""Which source a run starts from."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from twirl_mjx.training import source_rules
from twirl_mjx.training.presets import make_config
from twirl_mjx.training.source_rules import AtPath, NominalRun, RunOf, Scripted, source_of

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
