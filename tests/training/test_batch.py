"""Several seeds in one program: each run is one that could have been trained alone."""

from __future__ import annotations

import csv
import dataclasses
import io
import re
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console

import twirl_mjx
from twirl_mjx import cli, exits
from twirl_mjx.replay import dataset, mixed, ring
from twirl_mjx.training import collection, loop, pipeline, seeds
from twirl_mjx.training.checkpoint import Checkpoints, stored_steps
from twirl_mjx.training.config import TrainConfig
from twirl_mjx.training.guards import DivergedError
from twirl_mjx.training.logger import RunLogger
from twirl_mjx.training.program import Program
from twirl_mjx.training.run import Part
from twirl_mjx.training.rundir import RunDir
from twirl_mjx.training.sinks.base import RunInfo, Sink
from twirl_mjx.training.sinks.registry import resolve_each
from twirl_mjx.training.sinks.terminal import written
from twirl_mjx.training.state import TrainState
from twirl_mjx.types import MetricInfo
from twirl_mjx.worlds.make import make_env

SEEDS = (3, 5)


def train(config: TrainConfig, folder: Path, chosen: Sequence[int] = SEEDS) -> list[str]:
    """Train a batch; return what was said."""
    said: list[str] = []
    pipeline.run_seeds(config, chosen, "debug", folder, "b", said.append)
    return said


@pytest.fixture(scope="module")
def template(stand_config: TrainConfig) -> TrainState:
    """Shapes and dtypes of the state of one run."""
    return Program([stand_config]).template(0)


def stored(template: TrainState, run_dir: Path) -> TrainState:
    """Return the newest checkpoint of one run, read as its own."""
    checkpoints = Checkpoints(run_dir)
    try:
        return checkpoints.restore(template)[0]
    finally:
        checkpoints.close()


def assert_states(a: TrainState, b: TrainState, compare: Any) -> None:
    def words(leaf: Any) -> np.ndarray:
        is_key = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        return np.asarray(jax.random.key_data(leaf) if is_key else leaf)

    jax.tree.map(lambda x, y: compare(words(x), words(y)), a, b)


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def files_of(run_dir: Path) -> set[str]:
    found = {str(path.relative_to(run_dir)) for path in run_dir.rglob("*") if path.is_file()}
    return {re.sub(r"events\.out.*|ocdbt.*|d/.*", "", name) for name in found}


@pytest.fixture(scope="module")
def whole(stand_config: TrainConfig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a finished batch of ``SEEDS``."""
    folder = tmp_path_factory.mktemp("batch")
    train(stand_config, folder)
    return folder


@pytest.fixture(scope="module")
def alone(stand_config: TrainConfig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The directory of the second seed, trained alone."""
    config = dataclasses.replace(stand_config, seed=SEEDS[1])
    folder = tmp_path_factory.mktemp("alone")
    return pipeline.run(config, "debug", folder, "b-s5", lambda _: None).path


@pytest.mark.slow
def test_a_run_of_a_batch_looks_like_one_trained_alone(whole: Path, alone: Path) -> None:
    ours = whole / "b-s5"
    assert files_of(ours) == files_of(alone)
    assert (ours / "config.json").read_text() == (alone / "config.json").read_text()
    timed = {"env_steps_per_s", "updates_per_s", "compile_s"}
    for name in ("metrics.csv", "eval.csv"):
        a, b = ([r for r in rows_of(d / name) if r["metric"] not in timed] for d in (ours, alone))
        assert len(a) > 20
        for mine, other in zip(a, b, strict=True):
            value, expected = float(mine.pop("value")), float(other.pop("value"))
            mine.pop("wall_s", None), other.pop("wall_s", None)
            assert mine == other
            assert value == pytest.approx(expected, rel=1e-3, abs=1e-3), mine
    assert {row["seed"] for row in rows_of(whole / "b-s3" / "metrics.csv")} == {"3"}


@pytest.mark.slow
def test_its_state_is_that_of_the_seed_alone(
    template: TrainState, whole: Path, alone: Path
) -> None:
    a, b = stored(template, whole / "b-s5"), stored(template, alone)
    assert int(a.learner.grad_steps) == 64
    assert_states(a, b, lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-4, atol=1e-4))


@pytest.mark.slow
def test_a_batch_goes_on_without_the_replay_of_one(
    stand_config: TrainConfig, short_stand_config: TrainConfig, template: TrainState, tmp_path: Path
) -> None:
    train(short_stand_config, tmp_path)
    kept = np.asarray(stored(template, tmp_path / "b-s3").replay.online.rows)[:64]
    shutil.rmtree(tmp_path / "b-s5" / "checkpoints" / "replay")
    train(dataclasses.replace(stand_config, refill=True), tmp_path)
    rows = [stored(template, tmp_path / name).replay.online.rows for name in ("b-s3", "b-s5")]
    np.testing.assert_array_equal(np.asarray(rows[0])[:64], kept)
    assert (np.abs(np.asarray(rows[1])[:96]).sum(axis=1) > 0).all()


@pytest.mark.slow
def test_a_batch_resumes_bit_for_bit(
    stand_config: TrainConfig,
    short_stand_config: TrainConfig,
    template: TrainState,
    whole: Path,
    tmp_path: Path,
) -> None:
    train(short_stand_config, tmp_path)
    assert stored_steps(tmp_path / "b-s3") == [32, 64]
    train(stand_config, tmp_path)
    for seed in SEEDS:
        a, b = (stored(template, folder / f"b-s{seed}") for folder in (whole, tmp_path))
        assert_states(a, b, np.testing.assert_array_equal)


@pytest.mark.slow
def test_a_batch_killed_while_it_saved_goes_back_to_the_common_checkpoint(
    stand_config: TrainConfig, template: TrainState, whole: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "killed"
    shutil.copytree(whole, folder)
    for seed in SEEDS:
        (folder / f"b-s{seed}" / "eval.csv").unlink()
    shutil.rmtree(folder / "b-s3" / "checkpoints" / "orbax" / "96")
    train(stand_config, folder)
    for seed in SEEDS:
        assert stored_steps(folder / f"b-s{seed}") == [64, 96]
        a, b = (stored(template, each / f"b-s{seed}") for each in (whole, folder))
        assert_states(a, b, np.testing.assert_array_equal)
        now, then = (rows_of(each / f"b-s{seed}" / "metrics.csv") for each in (folder, whole))
        logged = [{(r["metric"], r["env_steps"]) for r in rows} for rows in (now, then)]
        assert logged[0] - logged[1] <= {("compile_s", "96")}
        assert len({(r["metric"], r["env_steps"]) for r in now}) == len(now)


@pytest.mark.slow
def test_seeds_without_a_common_checkpoint_are_named(
    stand_config: TrainConfig, whole: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "mixed"
    shutil.copytree(whole, folder)
    for seed in SEEDS:
        (folder / f"b-s{seed}" / "eval.csv").unlink()
    shutil.rmtree(folder / "b-s3" / "checkpoints")
    before = (folder / "b-s5" / "metrics.csv").read_bytes()
    told = r"nothing was touched\. Train them in groups: b-s3 \(without any\), b-s5 \(at 96\)"
    with pytest.raises(ValueError, match=told):
        train(stand_config, folder)
    assert (folder / "b-s5" / "metrics.csv").read_bytes() == before
    assert stored_steps(folder / "b-s5") == [64, 96]


@pytest.mark.slow
def test_finished_seeds_are_left_alone(stand_config: TrainConfig, whole: Path) -> None:
    before = (whole / "b-s3" / "metrics.csv").read_bytes()
    said = train(stand_config, whole)
    assert [line.endswith("is finished") for line in said] == [True, True]
    assert (whole / "b-s3" / "metrics.csv").read_bytes() == before


@pytest.mark.slow
def test_a_seed_goes_on_alone(stand_config: TrainConfig, whole: Path, tmp_path: Path) -> None:
    shutil.copytree(whole / "b-s5", tmp_path / "b-s5")
    longer = dataclasses.replace(stand_config, seed=5, total_env_steps=128)
    run_dir = pipeline.run(longer, "debug", tmp_path, "b-s5", lambda _: None)
    done = run_dir.finished()
    assert done is not None
    assert done.env_steps == 128


@pytest.mark.slow
def test_a_seed_that_diverges_stops_alone(
    stand_config: TrainConfig,
    template: TrainState,
    whole: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def broken(learner: Any) -> Any:
        nan = jax.tree.map(lambda leaf: jnp.full_like(leaf, jnp.nan), learner.actor)
        return learner.replace(actor=nan)

    parts = [
        Part(
            dataclasses.replace(stand_config, seed=seed),
            RunDir(tmp_path / f"b-s{seed}"),
            initial=broken if seed == 3 else None,
        )
        for seed in SEEDS
    ]
    with pytest.raises(DivergedError, match=r"^b-s3: the learner diverged: actor"):
        loop.train(parts)
    assert "b-s3 stops, the others go on: the learner diverged" in capsys.readouterr().out
    assert not (tmp_path / "b-s3" / "eval.csv").exists()
    assert stored_steps(tmp_path / "b-s3") == []
    assert rows_of(tmp_path / "b-s3" / "metrics.csv") == []
    assert not (tmp_path / "b-s3" / "policy.npz").exists()
    a, b = (stored(template, folder / "b-s5") for folder in (whole, tmp_path))
    assert_states(a, b, np.testing.assert_array_equal)
    assert (tmp_path / "b-s5" / "eval.csv").is_file()


@pytest.mark.slow
def test_when_all_diverge_the_batch_ends(stand_config: TrainConfig, tmp_path: Path) -> None:
    def broken(learner: Any) -> Any:
        return learner.replace(log_temperature=jnp.float32(jnp.nan))

    parts = [
        Part(
            dataclasses.replace(stand_config, seed=seed),
            RunDir(tmp_path / f"b-s{seed}"),
            initial=broken,
        )
        for seed in SEEDS
    ]
    with pytest.raises(DivergedError, match=r"b-s3: .*log_temperature.*\nb-s5: .*log_temperature"):
        loop.train(parts)


@pytest.mark.slow
def test_time_that_is_over_stops_and_saves(
    stand_config: TrainConfig, template: TrainState, tmp_path: Path
) -> None:
    with pytest.raises(pipeline.StoppedError, match="b-s3, b-s5 stopped at 0 transitions"):
        pipeline.run_seeds(
            stand_config, SEEDS, "debug", tmp_path, "b", lambda _: None, deadline=0.0
        )
    assert stored_steps(tmp_path / "b-s5") == [0]
    start = seeds.seed_state(seeds.init_seeds(stand_config, make_env(stand_config), SEEDS, None), 1)
    assert_states(stored(template, tmp_path / "b-s5"), start, np.testing.assert_array_equal)


@pytest.mark.slow
def test_the_command_line_names_and_sources_every_seed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A seed of a batch has the source experience it collects alone."""
    command = ["train", "--task", "biped", "--preset", "debug", "--source", "trot"]
    folder = ["--runs", str(tmp_path), "--total-env-steps", "64"]
    assert cli.main([*command, *folder, "--seeds", "0", "1"]) == 0
    shown = capsys.readouterr().out
    assert "biped-twirl-debug-source_trot, seeds 0 1" in shown
    assert " each of 2 seeds" in shown
    for seed in (0, 1):
        run_dir = RunDir(tmp_path / f"biped-twirl-debug-s{seed}-source_trot")
        config = run_dir.read_config()
        assert config.seed == seed
        known = run_dir.read_source()
        assert known and known["origin"] == "scripted trot"
        assert run_dir.episodes.is_file()
        other = RunDir(tmp_path / f"collected-s{seed}")
        other.path.mkdir()
        source = pipeline.find_source(config, "debug", tmp_path, print)
        collection.source_data(config, other, source, print)
        a, b = (
            dataset.read(d.dataset, task="biped", observation_size=101, action_size=12)[1]
            for d in (run_dir, other)
        )
        jax.tree.map(np.testing.assert_array_equal, a, b)
    assert cli.main([*command, *folder, "--seeds", "0", "1"]) == 0
    assert capsys.readouterr().out.count("is finished") == 2


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--seeds", "1", "2", "1"], "--seeds 1 2 1 names one twice (nearest: --seeds 1 2)"),
        (["--seeds", "1", "2", "--seed", "3"], "give one of them (nearest: --seeds 1 2)"),
        (["--seeds", "1", "-2"], "seed"),
        (["--minutes", "0"], "minutes"),
    ],
)
def test_unusable_seeds_and_times_are_refused(
    words: list[str], told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    common = ["train", "--task", "stand", "--preset", "debug", "--runs", str(tmp_path / "runs")]
    assert cli.main([*common, *words]) == exits.UNUSABLE
    assert told in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()


@pytest.mark.slow
def test_python_gets_one_result_for_each_seed(whole: Path) -> None:
    results = twirl_mjx.train("stand", preset="debug", name="b", runs=whole, seeds=iter(SEEDS))
    assert [result.config.seed for result in results] == list(SEEDS)
    assert [result.directory.name for result in results] == ["b-s3", "b-s5"]
    assert results[0].measures["return"] != results[1].measures["return"]
    with pytest.raises(ValueError, match=r"seed 1 beside seeds \[3, 5\]"):
        twirl_mjx.train("stand", preset="debug", runs=whole, seeds=SEEDS, seed=1)


def test_stacked_source_rings_give_each_seed_its_own_draws() -> None:
    """The shorter ring is padded; a seed draws from its own rows what it draws alone."""
    rings = [ring.from_rows(jnp.arange(n * 5.0).reshape(n, 5) + 1000 * n, 1, 1) for n in (7, 4)]
    online = ring.init(3, 1, 1)

    def draw(source: ring.RingBuffer, key: jax.Array) -> jax.Array:
        replay = mixed.MixedReplay(source=source, online=online)
        found = mixed.sample(replay, key, num_minibatches=50, batch_size=4, phi=1.0)
        return found.reward

    keys = jnp.stack([jax.random.key(1), jax.random.key(2)])
    both = jax.vmap(draw)(seeds.stack_rings(rings), keys)
    for index, each in enumerate(rings):
        np.testing.assert_array_equal(both[index], draw(each, keys[index]))


class Plain:
    """A sink that keeps what it is told."""

    def __init__(self) -> None:
        self.told: list[Any] = []

    def open(self, run: RunInfo) -> None:
        self.told.append(run.identity["run"])

    def log(self, *args: Any) -> None:
        self.told.append(dict(args[3])["q_mean"])

    def close(self) -> None:
        self.told.append("closed")


def make_infos(folder: Path) -> list[RunInfo]:
    common = {"task": "stand", "shift": "none", "variant": "scratch"}
    learning = {"q_mean": MetricInfo("critic value", "1")}
    return [
        RunInfo(folder / f"r{s}", {"run": f"r{s}", "seed": str(s)} | common, 100, learning=learning)
        for s in range(3)
    ]


def test_the_terminal_shows_mean_and_range(tmp_path: Path) -> None:
    text = io.StringIO()
    sinks: list[Sequence[Sink]] = [(Plain(),) for _ in range(3)]
    with RunLogger(
        make_infos(tmp_path), sinks, name="all", console=Console(file=text, width=200)
    ) as logger:
        logger.log(50, 7, {"q_mean": np.array([1.0, 2.0, 6.0]), "replay_ratio": 4.0})
        logger.leave(2)
        logger.log(60, 8, {"q_mean": np.array([2.0, 2.0, 9.0])})
    first, second = [line for line in text.getvalue().splitlines() if "q mean" in line]
    assert "train all  50.0 %" in first
    assert "q mean 3 (1 to 6)" in first
    assert second.endswith("q mean 2")
    told = [sink.told for (sink,) in sinks]  # type: ignore[attr-defined]
    assert told == [["r0", 1.0, 2.0, "closed"], ["r1", 2.0, 2.0, "closed"], ["r2", 6.0, "closed"]]
    rows = rows_of(tmp_path / "r1" / "metrics.csv")
    values = [row["value"] for row in rows if row["metric"] in ("q_mean", "replay_ratio")]
    assert values == ["2", "4", "2"]


def test_values_that_look_alike_have_no_range() -> None:
    assert written("{:.1f} s", [1.01, 1.02]) == "1.0 s"
    assert written("{:.0%}", [0.5, 1.0]) == "75% (50% to 100%)"


def test_a_sink_that_is_one_object_serves_no_batch() -> None:
    sink = Plain()
    assert resolve_each([sink], 1) == [(sink,)]
    with pytest.raises(ValueError, match="sink plain serves one run at a time, not 2 seeds"):
        resolve_each([sink], 2)
