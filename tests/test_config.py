"""Configs: presets, refusals with numbers, JSON, differences."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import pytest

from twirl_mjx import machine, records
from twirl_mjx.droq.config import DroqConfig
from twirl_mjx.policies.resolve import SCRIPTED_SOURCES
from twirl_mjx.replay.config import ReplayConfig
from twirl_mjx.tasks.biped import BipedOptions
from twirl_mjx.tasks.hurdles import HurdlesOptions
from twirl_mjx.tasks.imitate import ImitateOptions
from twirl_mjx.tasks.registry import TASKS
from twirl_mjx.training import config_json, presets
from twirl_mjx.training.config import EvalConfig, TrainConfig
from twirl_mjx.training.presets import PRESETS, make_config, multiplies_bfloat16


@pytest.mark.parametrize("task", TASKS.names())
@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_builds_and_gives_whole_updates(task: str, preset: str) -> None:
    config = make_config(task, preset)
    assert config.task == task
    assert config.updates_per_step == pytest.approx(config.droq.utd * config.num_envs)
    assert config.blocks_per_step * config.droq.updates_per_block == config.updates_per_step
    sourced = config.task_type.source or config.source in SCRIPTED_SOURCES
    assert config.variant == ("twirl" if sourced else "scratch")
    assert make_config(task, preset) == config
    hash(config)


@pytest.mark.parametrize(
    ("flags", "has"), [("fpu avx2 avx512_bf16 amx", True), ("fpu avx2", False), (None, False)]
)
def test_instructions_for_bfloat16(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, flags: str | None, has: bool
) -> None:
    path = tmp_path / "cpuinfo"
    if flags is not None:
        path.write_text(f"processor : 0\nflags : {flags}\nbugs :\n")
    monkeypatch.setattr(presets, "CPU_FLAGS", path)
    assert multiplies_bfloat16.__wrapped__() is has


@pytest.mark.parametrize(
    ("preset", "cpu_has", "accelerator", "dtype"),
    [
        ("cpu", True, False, "bfloat16"),
        ("cpu", True, True, "float32"),
        ("cpu", False, False, "float32"),
        ("paper", True, False, "float32"),
        ("debug", True, False, "float32"),
    ],
)
def test_the_cpu_preset_multiplies_as_the_machine_does_fastest(
    monkeypatch: pytest.MonkeyPatch, preset: str, cpu_has: bool, accelerator: bool, dtype: str
) -> None:
    monkeypatch.setattr(presets, "multiplies_bfloat16", lambda: cpu_has)
    monkeypatch.setattr(machine, "may_have_accelerator", lambda: accelerator)
    assert make_config("biped", preset).droq.matmul_dtype == dtype


def test_paper_preset_has_the_numbers_of_table_4() -> None:
    config = make_config("biped", "paper")
    droq = config.droq
    assert (droq.batch_size, droq.discount, droq.learning_rate) == (256, 0.99, 3e-4)
    assert (droq.tau, droq.utd, droq.hidden_sizes) == (0.005, 20.0, (256, 256))
    assert (droq.initial_temperature, droq.target_entropy) == (1.0, None)
    assert (config.replay.phi, config.replay.source_size) == (0.5, 50_000)
    assert config.total_env_steps == 1_000_000
    assert droq.utd * droq.batch_size == 5120.0


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: TrainConfig(task="bipde"), "nearest: 'biped'"),
        (lambda: TrainConfig(shift="ice"), "nearest: 'icy'"),
        (lambda: TrainConfig(variant="twrl"), "nearest: 'twirl'"),  # type: ignore[arg-type]
        (lambda: make_config("stand", "cpus"), "nearest: 'cpu'"),
        (lambda: ReplayConfig(phi=-0.1), r"phi = -0.1 is outside \[0.0, 1.0\] \(nearest: 0.0\)"),
        (lambda: DroqConfig(tau=2.0), r"outside \[0.0, 1.0\] \(nearest: 1.0\)"),
        (lambda: DroqConfig(discount=float("nan")), "discount"),
        (lambda: DroqConfig(hidden_sizes=()), "hidden_sizes"),
        (lambda: TrainConfig(num_envs=0), r"nearest: 1\)"),
        (lambda: TrainConfig(replay=ReplayConfig(capacity=8)), "capacity 8 is below"),
        (
            lambda: TrainConfig(replay=ReplayConfig(phi=0.001)),
            r"phi 0\.001 of droq\.batch_size 256 rounds to no source row \(nearest: 0\.00390625\)",
        ),
        (
            lambda: TrainConfig(replay=ReplayConfig(phi=0.999)),
            r"phi 0\.999 .* rounds to no online row \(nearest: 0\.996094\)",
        ),
        (lambda: TrainConfig(droq=DroqConfig(batch_size=1)), r"no source row \(nearest: 0\)"),
        (lambda: TrainConfig(seed=-1), r"seed = -1 is outside \[0, 4294967295\] \(nearest: 0\)"),
        (lambda: TrainConfig(seed=2**32), r"seed = 4294967296 .*nearest: 4294967295"),
    ],
)
def test_bad_values_are_refused_with_the_nearest_valid(build, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        build()


def test_a_share_that_is_not_used_is_not_judged() -> None:
    assert TrainConfig(variant="scratch", replay=ReplayConfig(phi=0.001)).effective_phi == 0.0
    for phi in (0.0, 1 / 256, 0.99609375, 1.0):
        TrainConfig(replay=ReplayConfig(phi=phi))


def test_updates_that_do_not_divide_are_refused_with_the_numbers() -> None:
    with pytest.raises(ValueError, match=r"1\.25 x num_envs 16 = 20 .*block 16 .*utd 1\)"):
        TrainConfig(droq=DroqConfig(utd=1.25, updates_per_block=16))
    with pytest.raises(ValueError, match="whole number"):
        TrainConfig(num_envs=1, droq=DroqConfig(utd=0.5, updates_per_block=1))


def test_the_nearest_utd_is_accepted() -> None:
    with pytest.raises(ValueError, match=r"nearest: utd 0\.416667\)"):
        TrainConfig(num_envs=48, droq=DroqConfig(utd=0.4))
    assert TrainConfig(num_envs=48, droq=DroqConfig(utd=0.416667)).updates_per_step == 20


def test_variants_decide_phi() -> None:
    base = TrainConfig(replay=ReplayConfig(phi=0.25))
    phis = {
        variant: dataclasses.replace(base, variant=variant).effective_phi
        for variant in ("scratch", "twirl", "twirl+weights", "weights", "zero-shot")
    }
    assert phis == {
        "scratch": 0.0, "twirl": 0.25, "twirl+weights": 0.25, "weights": 0.0, "zero-shot": 0.0,
    }  # fmt: skip


def test_course_is_fixed_under_a_shift() -> None:
    assert not TrainConfig().fixed_course
    assert TrainConfig(shift="icy").fixed_course
    assert not TrainConfig(shift="icy", course="random").fixed_course


@pytest.mark.parametrize("preset", PRESETS)
def test_json_round_trip(preset: str) -> None:
    config = make_config("hurdles", preset)
    assert config_json.from_json(config_json.to_json(config)) == config


def test_json_with_an_unknown_key_is_refused() -> None:
    record = json.loads(config_json.to_json(TrainConfig()))
    record["droq"]["dicount"] = 0.9
    with pytest.raises(ValueError, match="nearest: 'discount'"):
        config_json.from_json(json.dumps(record))


@pytest.mark.parametrize(
    ("part", "field", "value", "message"),
    [
        ("", "total_env_steps", "1000", r"total_env_steps = '1000' is str, expected int .*1000"),
        ("", "total_env_steps", 1000.5, r"1000.5 is float, expected int \(nearest: 1000\)"),
        ("", "seed", True, "seed = True is bool, expected int"),
        ("", "task", 5, "task = 5 is int, expected str"),
        ("", "variant", 5, "variant = 5 is int, expected one of 'scratch', 'twirl'"),
        ("", "droq", 5, "config.droq is 5, expected names and values"),
        ("droq", "num_critics", 2.5, r"droq.num_critics = 2.5 is float, expected int .*nearest: 2"),
        ("droq", "hidden_sizes", 256, r"256 is int, expected tuple\[int, ...\] .*\(256,\)"),
        ("droq", "hidden_sizes", [256, 0.5], r"hidden_sizes = \(256, 0.5\) is tuple, expected"),
        ("droq", "utd", "20", r"droq.utd = '20' is str, expected float \(nearest: 20.0\)"),
        ("droq", "fast", 1, "droq.fast = 1 is int, expected bool"),
        ("droq", "target_entropy", "low", r"target_entropy = 'low' is str, expected float \| None"),
        ("eval", "episode_length", 9.5, r"9.5 is float, expected int .*nearest: 10"),
        ("biped", "fixed_goal", [1.0, 0.0, 0.0], r"fixed_goal = .* expected tuple\[float, float\]"),
    ],
)
def test_values_of_another_type_are_refused(
    part: str, field: str, value: object, message: str
) -> None:
    record = json.loads(config_json.to_json(TrainConfig()))
    (record[part] if part else record)[field] = value
    with pytest.raises(ValueError, match=message):
        config_json.from_json(json.dumps(record))


def test_whole_numbers_stay_as_they_are_where_any_number_fits() -> None:
    record = json.loads(config_json.to_json(TrainConfig()))
    record["droq"] |= {"utd": 20, "target_entropy": -12}
    droq = config_json.from_json(json.dumps(record)).droq
    assert repr((droq.utd, droq.target_entropy)) == "(20, -12)"  # the digest of a run says so too
    with pytest.raises(ValueError, match="expected names and values"):
        config_json.from_json("[1]")


def test_diff_names_every_field_that_differs() -> None:
    a = TrainConfig()
    b = dataclasses.replace(a, seed=3, droq=dataclasses.replace(a.droq, tau=0.01))
    assert config_json.diff(a, b) == ["seed: 0 -> 3", "droq.tau: 0.005 -> 0.01"]
    assert config_json.diff(a, a) == []


@pytest.mark.parametrize(
    ("build", "match"),
    [
        (
            lambda: BipedOptions(goal_min_radius=6.0),
            r"radius = 6.0 is outside \[0.0, 5.0\]",
        ),
        (lambda: BipedOptions(goal_mean_radius=-1.0), "goal_mean_radius = -1.0 is outside"),
        (lambda: ImitateOptions(max_root_error=0.0), "max_root_error = 0.0 is outside"),
        (lambda: ImitateOptions(standing_fraction=1.5), "standing_fraction = 1.5 is outside"),
        (lambda: HurdlesOptions(hurdle_bonus="evnt"), "nearest: 'event'"),  # type: ignore[arg-type]
        (
            lambda: TrainConfig(total_env_steps=110_000_000),
            r"total_env_steps = 110000000 is outside \[1, 107372182\]",  # UTD 20: counts in int32
        ),
        (lambda: TrainConfig(warmup_env_steps=2**31), "warmup_env_steps = 2147483648 is outside"),
        (lambda: BipedOptions(fixed_goal=(float("nan"), 0.0)), "fixed_goal = nan is outside"),
        (lambda: HurdlesOptions(max_gap=float("inf")), "max_gap = inf is outside"),
        (lambda: DroqConfig(target_entropy=float("-inf")), "target_entropy = -inf is outside"),
        (lambda: EvalConfig(seed=2**32), "eval.seed = 4294967296 is outside"),
    ],
)
def test_task_options_are_checked(build: Callable[[], object], match: str) -> None:
    with pytest.raises(ValueError, match=match):
        build()


def test_departures_ignore_fields_at_their_default() -> None:
    assert config_json.departures(TrainConfig()) == {}
    config = dataclasses.replace(TrainConfig(), seed=3, droq=DroqConfig(tau=0.01))
    assert config_json.departures(config) == {"seed": 3, "droq.tau": 0.01}
    assert records.departures(config.droq) == {"tau": 0.01}


def test_names_on_the_command_line_are_those_of_the_file_and_of_grids() -> None:
    config = make_config("biped", "debug")
    names = set(config_json.flatten(config))
    assert {"task", "num_envs", "shift", "biped.distance_weight", "stand.height_of", "droq.utd",
            "replay.phi", "eval.episode_length"} <= names  # fmt: skip
    changed = config_json.settle(config, {"biped.distance_weight": 4.0, "num_envs": 8})
    assert (changed.options.distance_weight, changed.num_envs) == (4.0, 8)
    with pytest.raises(ValueError, match=r"nearest: 'biped\.distance_weight'"):
        config_json.settle(config, {"biped.distance_wait": 4.0})


def test_evaluation_is_without_what_is_for_training_only() -> None:
    config = make_config("stand", "cpu")
    assert (config.options.risen_fraction, config.episode_length) == (0.9, 100)
    worlds = config.evaluation
    assert (worlds.options.risen_fraction, worlds.episode_length) == (0.0, 400)
    assert worlds.options.height_of == "front_feet"
    assert worlds.num_envs == config.eval.episodes


OLD = Path(__file__).parent / "training" / "version_0_1"


@pytest.mark.parametrize("path", sorted(OLD.glob("*.json")), ids=lambda path: path.stem)
def test_configs_of_version_0_1_are_read(path: Path) -> None:
    """Written by commit d06aa54; ``*-debug`` are plain presets, ``stand-goal`` has options."""
    config = config_json.from_json(path.read_text())
    task, _, kind = path.stem.partition("-")
    if kind == "debug":
        assert config_json.diff(make_config(task, "debug"), config) == ["eval.episodes: 4 -> 2"]
    else:
        plain = make_config("stand", "cpu")
        assert config_json.diff(plain, config) == [
            "stand.goal_max_radius: 5.0 -> 4.0", "stand.risen_fraction: 0.9 -> 0.5",
            "num_envs: 64 -> 32", "episode_length: 100 -> 80", "seed: 0 -> 3",
            "droq.utd: 0.5 -> 0.25", "eval.episode_length: 400 -> 300",
        ]  # fmt: skip
