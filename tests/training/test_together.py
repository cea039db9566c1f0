"""Runs that differ in seed and phi as one program; phi that chooses itself."""

from __future__ import annotations

import csv
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from twirl_mjx import cli, exits
from twirl_mjx.training import collection, pipeline
from twirl_mjx.training.checkpoint import Checkpoints
from twirl_mjx.training.config import TrainConfig
from twirl_mjx.training.presets import make_config
from twirl_mjx.training.program import Program
from twirl_mjx.training.state import TrainState

RUNS: tuple[tuple[int, Any], ...] = ((0, 0.0), (0, 0.25), (1, "auto"), (1, 0.25))
"""(seed, phi) of the runs of one program; phi 0 has no source data."""
NAMES = [f"phi{phi}-s{seed}" for seed, phi in RUNS]


@pytest.fixture(scope="module")
def configs() -> list[TrainConfig]:
    base = dataclasses.replace(make_config("biped", "debug"), source="trot")
    return [
        dataclasses.replace(base, seed=seed, replay=dataclasses.replace(base.replay, phi=phi))
        for seed, phi in RUNS
    ]


def together(configs: Sequence[TrainConfig], folder: Path) -> None:
    pipeline.run_together(configs, NAMES, "debug", folder, lambda _: None)


@pytest.fixture(scope="module")
def whole(configs: list[TrainConfig], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the four runs, trained as one program."""
    folder = tmp_path_factory.mktemp("together")
    together(configs, folder)
    return folder


def stored(config: TrainConfig, run_dir: Path) -> TrainState:
    """Return the newest checkpoint of a run, read as its own; keys as their words."""
    checkpoints = Checkpoints(run_dir)
    try:
        state = checkpoints.restore(Program([config]).template(0))[0]
    finally:
        checkpoints.close()
    return state.replace(key=jax.random.key_data(state.key), env=None)


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.slow
@pytest.mark.timeout(1900)
@pytest.mark.parametrize("index", range(len(RUNS)))
def test_each_run_is_the_one_that_is_trained_alone(
    index: int, configs: list[TrainConfig], whole: Path, tmp_path: Path
) -> None:
    config, ours = configs[index], whole / NAMES[index]
    alone = pipeline.run(config, "debug", tmp_path, NAMES[index], lambda _: None).path
    assert (ours / "config.json").read_text() == (alone / "config.json").read_text()
    assert (ours / "source.npz").exists() == (alone / "source.npz").exists() == (index > 0)
    timed = {"env_steps_per_s", "updates_per_s", "compile_s"}
    for name in ("metrics.csv", "eval.csv"):
        a, b = ([r for r in rows_of(d / name) if r["metric"] not in timed] for d in (ours, alone))
        for mine, other in zip(a, b, strict=True):
            value, expected = float(mine.pop("value")), float(other.pop("value"))
            for row in (mine, other):
                row.pop("wall_s", None)
            assert mine == other
            assert value == pytest.approx(expected, rel=1e-3, abs=1e-3), mine
    metrics = {row["metric"] for row in rows_of(ours / "metrics.csv")}
    assert ("phi" in metrics) == (RUNS[index][1] == "auto")
    a, b = (stored(config, folder) for folder in (ours, alone))
    assert int(a.learner.grad_steps) == 64
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-4, atol=1e-4), a, b)


@pytest.mark.slow
@pytest.mark.timeout(1900)
def test_they_resume_bit_for_bit(configs: list[TrainConfig], whole: Path, tmp_path: Path) -> None:
    together([dataclasses.replace(config, total_env_steps=64) for config in configs], tmp_path)
    together(configs, tmp_path)
    for config, name in zip(configs, NAMES, strict=True):
        a, b = (stored(config, folder / name) for folder in (whole, tmp_path))
        jax.tree.map(np.testing.assert_array_equal, a, b)
        assert (a.share is None) == (config.replay.phi != "auto")
    share = stored(configs[2], whole / NAMES[2]).share
    assert share is not None
    assert float(share.rows) != 8.0  # it moved
    told = [r for r in rows_of(whole / NAMES[2] / "metrics.csv") if r["metric"] == "phi"]
    assert [row["value"] for row in told][:1] == ["0.5"]
    assert len(told) == 3


@pytest.mark.slow
@pytest.mark.timeout(1900)
def test_the_command_line_trains_them_with_one_program_of_collection(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[Any] = []

    class Counted(collection.Collector):
        def __init__(self, *given: Any) -> None:
            super().__init__(*given)
            made.append(self)

    monkeypatch.setattr(collection, "Collector", Counted)
    common = ["--task", "biped", "--preset", "debug", "--source", "trot", "--runs", str(tmp_path)]
    common += ["--total-env-steps", "64"]
    words = ["train", *common, "--replay.phi", "0.25", "--and", *common, "--replay.phi", "auto"]
    assert cli.main(words) == 0
    first, second = sorted(path.name for path in tmp_path.iterdir())
    assert f"done: {tmp_path / first} {tmp_path / second}" in capsys.readouterr().out
    assert first.endswith("phi_0.25")
    assert second.endswith("phi_auto")
    assert [collector._run._cache_size() for collector in made] == [1]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--and", "--num-envs", "8"], "these in num_envs: 4 -> 8 (nearest: a command for each)"),
        (["--and"], "the names of the runs"),
        (["--seeds", "1", "--and", "--seed", "2"], "give each run its own --seed"),
        (["--minutes", "1", "--and"], "--minutes is 1.0 on one side of --and and None on the"),
        (["--replay.phi", "auto"], "variant scratch has none (nearest: variant 'twirl')"),
        (["--seed", "0", "--seeds", "1", "2"], "give one of them (nearest: --seeds 1 2)"),
    ],
)
def test_runs_that_are_no_program_are_refused(
    words: list[str], told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    common = ["--task", "stand", "--preset", "debug", "--runs", str(tmp_path / "runs")]
    line = ["train", *common]
    for word in words:
        line += [word, *common] if word == "--and" else [word]
    assert cli.main(line) == exits.UNUSABLE
    assert told in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()


def test_phi_is_a_number_or_auto() -> None:
    base = make_config("biped", "debug")
    with pytest.raises(ValueError, match=r"'atuo' is neither a number .* \(nearest: 'auto'\)"):
        dataclasses.replace(base.replay, phi="atuo")
    replay, droq = (dataclasses.replace(part, **changes) for part, changes in (
        (base.replay, {"phi": "auto"}), (base.droq, {"batch_size": 1}),
    ))  # fmt: skip
    with pytest.raises(ValueError, match=r"batch_size is 1 \(nearest: 2\)"):
        dataclasses.replace(base, replay=replay, droq=droq)


def test_a_seed_without_source_data_draws_none(configs: list[TrainConfig]) -> None:
    """Shapes and counts only: the shares of a program whose runs differ in phi."""
    program = Program(configs, own_sources=True)
    states = jax.eval_shape(program.init)
    assert states.share is not None
    assert states.share.rows.shape == (4,)
    shares = [program._share(config) for config in configs]
    assert [int(share.num_source) for share in shares if share] == [0, 4, 8, 4]
    alone = Program([configs[1]])
    assert jax.eval_shape(alone.init).share is None
    counted = jnp.zeros((), jnp.float32)
    assert jax.eval_shape(Program([configs[2]]).init).share.rows.dtype == counted.dtype
