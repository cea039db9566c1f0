"""The variants are settings of one program; sources are black boxes; shifts start from a run."""

from __future__ import annotations

import csv
import dataclasses
import shutil
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from twirl_mjx.deploy.export import export_onnx
from twirl_mjx.droq import learner as droq
from twirl_mjx.policies.learned import load_policy
from twirl_mjx.policies.resolve import Source, resolve_policy
from twirl_mjx.replay import dataset
from twirl_mjx.training import collection, pipeline, rundir, weights
from twirl_mjx.training.checkpoint import load_learner, load_replay
from twirl_mjx.training.config import TrainConfig
from twirl_mjx.training.presets import make_config
from twirl_mjx.training.rundir import RunDir
from twirl_mjx.training.source import Collector
from twirl_mjx.worlds.make import make_env

NOMINAL = "biped-twirl-debug-s0"
"""Name under which an adaptation looks for its nominal run."""


@pytest.fixture(scope="module")
def biped() -> TrainConfig:
    return dataclasses.replace(make_config("biped", "debug"), total_env_steps=64)


@pytest.fixture(scope="module")
def runs(biped: TrainConfig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a finished nominal biped run from a scripted source."""
    folder = tmp_path_factory.mktemp("runs")
    config = dataclasses.replace(biped, source="trot")
    run_dir = pipeline.run(config, "debug", folder, NOMINAL, print)
    assert run_dir.name == NOMINAL
    return folder


def test_scripted_source_is_recorded_in_the_target_task(biped: TrainConfig, runs: Path) -> None:
    header, data = dataset.read(
        runs / NOMINAL / "source.npz",
        task="biped",
        observation_size=101,
        action_size=12,
    )
    assert (header.source, header.size) == ("scripted trot", biped.replay.source_size)
    assert np.abs(np.asarray(data.action)).max() > 0.1


def test_collected_data_are_used_again_until_settings_change(
    biped: TrainConfig, runs: Path
) -> None:
    said: list[str] = []
    config = dataclasses.replace(biped, source="trot")
    source = pipeline.find_source(config, "debug", runs, said.append)
    collection.source_data(config, RunDir(runs / NOMINAL), source, said.append)
    assert any("source.npz" in line for line in said)
    assert not any("collecting" in line for line in said)
    other = dataclasses.replace(source, digest="another policy")
    digest = collection.collection_digest(config, other)
    assert digest != collection.collection_digest(config, source)


@pytest.mark.parametrize(
    "variant",
    [
        pytest.param("weights", marks=pytest.mark.slow),
        pytest.param("twirl+weights", marks=pytest.mark.slow),
        pytest.param("twirl", marks=pytest.mark.slow),
        "zero-shot",
    ],
)
def test_adaptation_starts_from_the_nominal_run(
    biped: TrainConfig, runs: Path, variant: str
) -> None:
    said: list[str] = []
    config = dataclasses.replace(biped, shift="icy", variant=variant)  # type: ignore[arg-type]
    run_dir = pipeline.run(config, "debug", runs, None, said.append)
    with run_dir.episodes.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert {row["shift"] for row in rows} == {"icy"}
    assert {row["variant"] for row in rows} == {variant}
    replayed = any("the replay of" in line for line in said)
    assert replayed == (variant in ("twirl", "twirl+weights"))
    assert not run_dir.dataset.exists(), "adaptation collects nothing"


def test_source_networks_are_taken_over(biped: TrainConfig, runs: Path) -> None:
    config = dataclasses.replace(biped, shift="icy", variant="weights")
    source = pipeline.find_source(config, "debug", runs, print)
    initial = weights.source_weights(config, source, print)
    fresh = droq.init(jax.random.key(7), config.droq, 101, 12)
    taken = initial(fresh)
    best = load_policy(runs / NOMINAL)
    obs = np.random.default_rng(0).normal(size=(3, 101)).astype(np.float32)
    expected = droq.mean_action(taken.actor, jnp.asarray(obs))
    np.testing.assert_allclose(best.act(obs), np.asarray(expected), atol=1e-6)
    stored = load_learner(runs / NOMINAL)
    jax.tree.map(np.testing.assert_array_equal, taken.critic, stored["critic"])
    jax.tree.map(
        lambda a, b: (
            np.testing.assert_raises(AssertionError, np.testing.assert_array_equal, a, b)
            if a.size > 1 and np.ptp(np.asarray(a)) > 0
            else None
        ),
        taken.critic,
        fresh.critic,
    )


def test_weights_refuse_sources_that_do_not_fit(biped: TrainConfig, runs: Path) -> None:
    scripted = dataclasses.replace(biped, variant="weights", source="trot")
    source = pipeline.find_source(scripted, "debug", runs, print)
    with pytest.raises(ValueError, match="no network weights"):
        weights.source_weights(scripted, source, print)
    hurdles = dataclasses.replace(make_config("hurdles", "debug"), variant="weights")
    source = pipeline.find_source(
        dataclasses.replace(hurdles, source=str(runs / NOMINAL)),
        "debug",
        runs,
        print,
    )
    with pytest.raises(ValueError, match="observes as task biped"):
        weights.source_weights(hurdles, source, print)


def test_replay_of_the_nominal_run_is_the_source(runs: Path) -> None:
    rows = load_replay(runs / NOMINAL, capacity=1000)
    assert rows.shape == (64, 2 * 101 + 12 + 2)
    assert np.isfinite(rows).all()


@pytest.mark.slow
def test_onnx_source_acts_like_the_policy_it_came_from(
    biped: TrainConfig, runs: Path, tmp_path: Path
) -> None:
    run_dir = runs / NOMINAL
    onnx = export_onnx(run_dir, tmp_path / "policy.onnx")
    env = make_env(biped.evaluation, num_envs=2)
    key = jax.random.key(4)
    learned, _ = Collector(env, resolve_policy(str(run_dir), biped).policy)(key, 12)
    hosted, _ = Collector(env, resolve_policy(str(onnx), biped).policy)(key, 12)
    np.testing.assert_allclose(hosted.action, learned.action, atol=1e-4)
    assert learned.reward.shape == (12,)


def test_directory_of_another_config_is_refused(biped: TrainConfig, runs: Path) -> None:
    other = dataclasses.replace(biped, source="trot", warmup_env_steps=0)
    with pytest.raises(rundir.RunMismatchError, match="warmup_env_steps: 32 -> 0"):
        pipeline.run(other, "debug", runs, NOMINAL, print)


def test_another_source_is_refused_in_a_run_that_has_one(biped: TrainConfig, runs: Path) -> None:
    run_dir = runs / NOMINAL
    before = {name: (run_dir / name).read_bytes() for name in ("config.json", "source.npz")}
    other = dataclasses.replace(biped, source="bound")
    with pytest.raises(rundir.RunMismatchError, match="source digest: 'trot' -> 'bound'"):
        pipeline.run(other, "debug", runs, NOMINAL, print)
    assert before == {name: (run_dir / name).read_bytes() for name in before}


def test_a_finished_run_is_left_as_it_is(biped: TrainConfig, runs: Path) -> None:
    run_dir = runs / NOMINAL
    (run_dir / "versions.json").write_text('{"commit": "of the training"}')
    before = {path: path.read_bytes() for path in run_dir.iterdir() if path.is_file()}
    said: list[str] = []
    shorter = dataclasses.replace(biped, source="trot", total_env_steps=32)
    assert pipeline.run(shorter, "debug", runs, NOMINAL, said.append).path == run_dir
    assert f"{run_dir} is finished" in said
    after = {path: path.read_bytes() for path in run_dir.iterdir() if path.is_file()}
    assert before == after


@pytest.mark.slow
def test_weights_act_and_are_measured_from_the_first_step(biped: TrainConfig, runs: Path) -> None:
    path = runs / NOMINAL
    config = dataclasses.replace(
        biped, variant="weights", source=str(path), warmup_env_steps=64, total_env_steps=32
    )
    run_dir = pipeline.run(config, "debug", runs, "warm", print)
    with run_dir.metrics.open(newline="") as file:
        first = [row for row in csv.DictReader(file) if row["env_steps"] == "0"]
    assert "eval/return" in {row["metric"] for row in first}
    # Nothing was learned before the end of the warm-up: the actions are the source's, with noise.
    taken = load_replay(run_dir.path, capacity=1000)
    obs, action = taken[:, :101], taken[:, 101:113]
    mean = load_policy(path).act(obs)
    draws = np.random.default_rng(0).uniform(-1.0, 1.0, (200, *action.shape))
    chance = np.abs(draws - mean).mean(axis=(1, 2)).min()
    assert np.abs(action - mean).mean() < chance


def test_what_needs_no_source_is_refused_before_one_is_sought(
    biped: TrainConfig, runs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def seek(*_: object) -> None:
        raise AssertionError("a source was sought")

    monkeypatch.setattr(pipeline, "find_source", seek)
    trot = dataclasses.replace(biped, source="trot")
    other = dataclasses.replace(trot, droq=dataclasses.replace(biped.droq, tau=0.1))
    with pytest.raises(rundir.RunMismatchError, match="tau"):
        pipeline.run(other, "debug", runs, NOMINAL, print)
    monkeypatch.setattr(RunDir, "owner", lambda run_dir: "process 1 on mars")
    with pytest.raises(rundir.RunBusyError, match="in use by process 1 on mars"):
        pipeline.run(trot, "debug", runs, NOMINAL, print)


@pytest.mark.parametrize(
    ("name", "nearest"), [("../../evil", "evil"), ("a/b", "b"), ("..", "run"), ("/tmp/x", "x")]
)
def test_a_name_leads_nowhere_else(
    name: str, nearest: str, biped: TrainConfig, tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match=rf"plain folder name \(nearest: '{nearest}'"):
        pipeline.run(biped, "debug", tmp_path / "runs", name, print)
    assert list(tmp_path.iterdir()) == []


def test_gaps_are_checked_before_a_source_is_trained(tmp_path: Path) -> None:
    config = make_config("hurdles", "debug")
    narrow = dataclasses.replace(config, options=dataclasses.replace(config.options, min_gap=0.5))
    with pytest.raises(ValueError, match=r"gaps from 0.5 to 2.6 m: .*nearest"):
        pipeline.run(narrow, "debug", tmp_path, None, print)
    assert list(tmp_path.iterdir()) == []


def test_a_misspelt_source_is_told_the_nearest(biped: TrainConfig, runs: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no source trott: .*nearest: 'trot'\)"):
        pipeline.find_source(dataclasses.replace(biped, source="trott"), "debug", runs, print)


def test_a_finished_run_outlives_its_source(biped: TrainConfig, runs: Path, tmp_path: Path) -> None:
    folder = tmp_path / "runs"
    shutil.copytree(runs, folder)
    gone = dataclasses.replace(biped, source=str(tmp_path / "deleted.npz"))
    said: list[str] = []
    run_dir = pipeline.run(gone, "debug", folder, NOMINAL, said.append)
    assert said == [f"{run_dir} is finished; its source is no longer there to compare"]
    with pytest.raises(FileNotFoundError, match=r"deleted\.npz"):
        pipeline.run(
            dataclasses.replace(gone, total_env_steps=96), "debug", folder, NOMINAL, said.append
        )


def test_a_refused_run_leaves_its_name_free(biped: TrainConfig, runs: Path, tmp_path: Path) -> None:
    path = str(runs / NOMINAL)
    wide = dataclasses.replace(biped.droq, num_critics=3)
    config = dataclasses.replace(biped, variant="weights", source=path, droq=wide)
    with pytest.raises(
        ValueError, match=r"has 2 critics, this run 3 \(nearest: --droq.num-critics 2"
    ):
        pipeline.run(config, "debug", tmp_path, "name", print)
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == [".lock"]
    # Killed before any work was done: only the description of the run is there.
    run_dir = RunDir(tmp_path / "name")
    run_dir.open(config)
    assert run_dir.status(biped) == rundir.New()
    run_dir.open(biped)
    (run_dir.path / "checkpoints" / "replay").mkdir(parents=True)  # a start that failed later
    run_dir.metrics.write_text("header\n")
    assert run_dir.status(config) == rundir.New()
    run_dir.metrics.write_text("header\na row\n")
    status = run_dir.status(config)
    assert isinstance(status, rundir.Foreign)
    assert "num_critics: 2 -> 3" in str(status.error)


def test_a_nominal_run_of_another_preset_is_not_taken(biped: TrainConfig, runs: Path) -> None:
    cpu = dataclasses.replace(make_config("biped", "cpu"), shift="icy")
    with pytest.raises(FileNotFoundError, match=r"finished in .*: .*biped-twirl-debug-s0"):
        pipeline.find_source(cpu, "cpu", runs, print)


def test_source_data_hold_whole_episodes_and_one_program_collects_for_all_seeds(
    biped: TrainConfig, runs: Path, tmp_path: Path
) -> None:
    crowd = dataclasses.replace(biped, num_envs=64)
    config = dataclasses.replace(crowd, source="trot")
    source = pipeline.find_source(config, "debug", runs, print)
    collectors: collection.Collectors = {}
    rewards = []
    for seed in (0, 1):
        path, other = tmp_path / f"source{seed}.npz", dataclasses.replace(config, seed=seed)
        data = collection.write_dataset(other, source, path, "digest", print, collectors)
        rewards.append(data.reward)
    (collector,) = collectors.values()
    assert collector.env.num_envs == biped.replay.source_size // biped.eval.episode_length
    assert collector._run._cache_size() == 1  # type: ignore[attr-defined]
    assert not np.array_equal(*rewards)


def test_the_engine_does_not_decide_what_is_collected(biped: TrainConfig, runs: Path) -> None:
    config = dataclasses.replace(biped, source="trot")
    source = pipeline.find_source(config, "debug", runs, print)
    digest = collection.collection_digest(config, source)
    mjx = dataclasses.replace(config, engine="mjx")
    assert collection.collection_digest(mjx, source) == digest
    quiet = dataclasses.replace(config.replay, source_noise=False)
    calm = dataclasses.replace(config, replay=quiet)
    assert collection.collection_digest(calm, source) != digest


def test_a_learned_source_is_noisy_only_while_its_data_are_collected(
    biped: TrainConfig, runs: Path
) -> None:
    path = str(runs / NOMINAL / "policy.npz")
    state = SimpleNamespace(obs=jnp.zeros((3, 101)))

    def actions(config: TrainConfig) -> np.ndarray:
        found = pipeline.find_source(dataclasses.replace(config, source=path), "debug", runs, print)
        return np.asarray(found.policy.act((), state, jax.random.key(0))[0])

    mean = load_policy(path).act(np.zeros((3, 101)))
    np.testing.assert_allclose(
        actions(dataclasses.replace(biped, variant="zero-shot")), mean, atol=1e-6
    )
    calm = dataclasses.replace(biped.replay, source_noise=False)
    np.testing.assert_allclose(actions(dataclasses.replace(biped, replay=calm)), mean, atol=1e-6)
    noisy = actions(biped)
    assert np.abs(noisy - mean).max() > 0.05
    assert np.abs(noisy[0] - noisy[1]).max() > 0.05


def test_the_replay_of_another_task_is_no_source_data(biped: TrainConfig, tmp_path: Path) -> None:
    RunDir(tmp_path).open(make_config("stand", "debug"))
    source = Source(None, "a stand run", "digest", run_dir=tmp_path)  # type: ignore[arg-type]
    config = dataclasses.replace(biped, shift="icy")
    with pytest.raises(ValueError, match="is a run of task stand: its replay is no experience"):
        collection.source_data(config, RunDir(tmp_path), source, print)


def test_weights_that_cannot_fit_are_refused_before_any_stage(
    biped: TrainConfig, runs: Path, tmp_path: Path
) -> None:
    hurdles = dataclasses.replace(make_config("hurdles", "debug"), variant="twirl+weights")
    with pytest.raises(ValueError, match="source task imitate observes as task imitate"):
        pipeline.run(hurdles, "debug", tmp_path, None, print)
    assert list(tmp_path.iterdir()) == []
    wide = dataclasses.replace(
        biped,
        variant="weights",
        source=str(runs / NOMINAL),
        droq=dataclasses.replace(biped.droq, hidden_sizes=(64, 32)),
    )
    with pytest.raises(ValueError, match=r"hidden layers of \(32, 32\) units.*hidden-sizes 32 32"):
        pipeline.run(wide, "debug", tmp_path, None, print)


def test_tasks_without_a_source_of_their_own(tmp_path: Path) -> None:
    stand = dataclasses.replace(make_config("stand", "debug"), variant="twirl")
    with pytest.raises(ValueError, match="task stand has no source policy of its own"):
        pipeline.find_source(stand, "debug", tmp_path, print)
    icy = dataclasses.replace(make_config("stand", "debug"), shift="icy", variant="weights")
    with pytest.raises(FileNotFoundError, match="stand-scratch-debug-s0"):
        pipeline.find_source(icy, "debug", tmp_path, print)
    # The clip is the preset's source of imitate without a shift only.
    imitate = dataclasses.replace(make_config("imitate", "cpu"), shift="icy")
    with pytest.raises(FileNotFoundError, match="imitate-twirl-cpu-s0"):
        pipeline.find_source(imitate, "cpu", tmp_path, print)
