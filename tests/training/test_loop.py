"""Training end to end on the debug preset: counters, compilation, resume, guards, refusals."""

from __future__ import annotations

import csv
import dataclasses
import json
import shutil
import threading
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from twirl_mjx.droq import learner as droq
from twirl_mjx.policies.learned import load_policy
from twirl_mjx.replay import ring
from twirl_mjx.training import guards, loop, pipeline, rundir, state
from twirl_mjx.training.checkpoint import Checkpoints, load_learner, load_replay
from twirl_mjx.training.config import TrainConfig
from twirl_mjx.training.presets import make_config
from twirl_mjx.training.run import Part
from twirl_mjx.training.rundir import RunDir
from twirl_mjx.training.source import check_dropped
from twirl_mjx.training.state import TrainState
from twirl_mjx.worlds.make import make_env
from twirl_mjx.worlds.vector import FAULTS


def read_rows(path: Path) -> list[dict[str, str]]:
    """Return the rows of a tidy table."""
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def final_state(config: TrainConfig, run_dir: Path) -> TrainState:
    """Return the state stored by a finished run."""
    batch = loop.Batch([Part(config, RunDir(run_dir))], "test")
    try:
        return batch.start()
    finally:
        batch.close()


def train(config: TrainConfig, run_dir: Path) -> rundir.Finished:
    """Train a run to its end, or resume it; return how it was closed."""
    folder, name = run_dir.parent, run_dir.name
    done = pipeline.run(config, "debug", folder, name, lambda _: None).finished()
    assert done is not None
    return done


@pytest.fixture(scope="module")
def whole_run(stand_config: TrainConfig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    run_dir = tmp_path_factory.mktemp("runs") / "whole"
    assert train(stand_config, run_dir).env_steps == 96
    return run_dir


def assert_identical(a: TrainState, b: TrainState) -> None:
    """Assert that two states agree bit for bit."""
    for (path, x), y in zip(
        jax.tree_util.tree_flatten_with_path(a)[0], jax.tree.leaves(b), strict=True
    ):
        if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
            x, y = jax.random.key_data(x), jax.random.key_data(y)
        np.testing.assert_array_equal(np.asarray(x), np.asarray(y), err_msg=str(path))


def test_resumed_run_equals_whole_run_bit_for_bit(
    stand_config: TrainConfig, short_stand_config: TrainConfig, whole_run: Path, tmp_path: Path
) -> None:
    run_dir = tmp_path / "parts"
    assert train(short_stand_config, run_dir).env_steps == 64
    assert train(stand_config, run_dir).env_steps == 96
    a = final_state(stand_config, whole_run)
    b = final_state(stand_config, run_dir)
    assert int(a.learner.grad_steps) == 64
    assert_identical(a, b)


def test_a_run_without_its_replay_goes_on_with_one_of_its_policy(
    stand_config: TrainConfig,
    short_stand_config: TrainConfig,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    run_dir = tmp_path / "light"
    train(short_stand_config, run_dir)
    before = np.asarray(final_state(short_stand_config, run_dir).replay.online.rows)
    shutil.rmtree(run_dir / "checkpoints" / "replay")
    with pytest.raises(ValueError, match="--refill"):
        train(stand_config, run_dir)
    assert train(dataclasses.replace(stand_config, refill=True), run_dir).env_steps == 96
    assert "64 transitions were gathered anew" in " ".join(capsys.readouterr().out.split())
    state = final_state(stand_config, run_dir)  # whole again: the rows are stored
    online = state.replay.online
    assert (int(online.size), int(online.insert_index), int(state.inserted)) == (96, 96, 96)
    rows = np.asarray(online.rows)
    assert np.isfinite(rows).all() and (np.abs(rows[:96]).sum(axis=1) > 0).all()
    assert not np.array_equal(rows[:64], before[:64])
    # Rows are of worlds that were stepped: the next observation of one opens the next of its world.
    envs, obs = stand_config.num_envs, online.obs_size
    follows = (rows[envs:64, :obs] == rows[: 64 - envs, -obs:]).all(axis=1)
    assert follows.mean() > 0.5
    assert int(state.learner.grad_steps) == 64
    card = load_policy(run_dir / "policy_last.npz").header.card
    assert card["replay_refilled_at"] == [64]


@pytest.mark.slow
def test_a_run_goes_on_from_the_checkpoint_before_a_damaged_one(
    stand_config: TrainConfig,
    whole_run: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    run_dir = tmp_path / "stepped"
    often = dataclasses.replace(stand_config, checkpoint_minutes=0.0)
    assert train(often, run_dir).env_steps == 96
    (run_dir / "eval.csv").unlink()
    damaged = next((run_dir / "checkpoints" / "orbax" / "96" / "train_state" / "d").iterdir())
    content = bytearray(damaged.read_bytes())
    content[len(content) // 2] ^= 1
    damaged.write_bytes(content)
    capsys.readouterr()
    assert train(often, run_dir).env_steps == 96
    said = "".join(capsys.readouterr().out.split())
    assert f"{damaged}isdamaged" in said
    assert "resumingsteppedat64transitions" in said
    assert_identical(final_state(stand_config, whole_run), final_state(often, run_dir))


def test_run_directory_is_complete(stand_config: TrainConfig, whole_run: Path) -> None:
    for name in ("config.json", "versions.json", "metrics.csv", "eval.csv", "policy.npz"):
        assert (whole_run / name).is_file(), name
    assert RunDir(whole_run).read_config() == stand_config
    assert json.loads((whole_run / "versions.json").read_text())["jax"] == jax.__version__
    rows = read_rows(whole_run / "metrics.csv")
    assert {row["env_steps"] for row in rows} == {"32", "64", "96"}
    names = {row["metric"] for row in rows}
    assert {"return", "critic_loss", "temperature", "eval/return", "eval/standing_time"} <= names
    episodes = read_rows(whole_run / "eval.csv")
    assert len({row["episode"] for row in episodes}) == stand_config.eval.final_episodes


def test_update_counter_follows_utd(stand_config: TrainConfig, whole_run: Path) -> None:
    final = final_state(stand_config, whole_run)
    trained_on = int(final.env_steps) - stand_config.warmup_env_steps
    assert int(final.learner.grad_steps) == stand_config.droq.utd * trained_on
    assert int(final.inserted) == 96
    assert int(final.replay.online.size) == 96


def test_policy_file_acts_like_the_stored_actor(stand_config: TrainConfig, whole_run: Path) -> None:
    final = final_state(stand_config, whole_run)
    policy = load_policy(whole_run / "policy_last.npz")
    obs = np.random.default_rng(0).normal(size=(5, 101)).astype(np.float32)
    expected = droq.mean_action(final.learner.actor, jnp.asarray(obs))
    np.testing.assert_allclose(policy.act(obs), np.asarray(expected), atol=1e-6)


def test_stored_experience_and_networks_can_be_read_alone(
    stand_config: TrainConfig, whole_run: Path
) -> None:
    final = final_state(stand_config, whole_run)
    rows = load_replay(whole_run, 1000)
    np.testing.assert_array_equal(rows, np.asarray(final.replay.online.rows)[:96])
    stored = load_learner(whole_run)
    jax.tree.map(np.testing.assert_array_equal, stored["critic"], final.learner.critic)


@pytest.mark.slow
@pytest.mark.parametrize("capacity", [40, 20])
def test_stored_experience_is_what_the_ring_still_holds(
    capacity: int, stand_config: TrainConfig, tmp_path: Path
) -> None:
    """20: the ring goes round between two checkpoints, so the log has gaps."""
    small = dataclasses.replace(stand_config.replay, capacity=capacity)
    config = dataclasses.replace(stand_config, replay=small, checkpoint_minutes=0.0)
    train(config, tmp_path / "small")  # a checkpoint every epoch: the log holds more rows
    ring_rows = np.asarray(final_state(config, tmp_path / "small").replay.online.rows)
    oldest = 96 % capacity
    np.testing.assert_array_equal(
        load_replay(tmp_path / "small", capacity), np.roll(ring_rows, -oldest, 0)
    )


def test_a_hole_in_the_stored_experience_is_named(whole_run: Path, tmp_path: Path) -> None:
    shutil.copytree(whole_run, tmp_path / "run")
    min((tmp_path / "run" / "checkpoints" / "replay").iterdir()).unlink()
    with pytest.raises(ValueError, match=r"rows_0+_0+32\.npy is missing"):
        load_replay(tmp_path / "run", 1000)


def test_leftovers_of_a_killed_save_are_swept(whole_run: Path, tmp_path: Path) -> None:
    shutil.copytree(whole_run / "checkpoints", tmp_path / "checkpoints")
    step = tmp_path / "checkpoints" / "orbax" / "128.orbax-checkpoint-tmp"
    (step / "policy.orbax-checkpoint-tmp").mkdir(parents=True)
    (step / "policy.orbax-checkpoint-tmp" / "data").write_text("half")
    checkpoints = Checkpoints(tmp_path)
    assert checkpoints.latest() == 96
    checkpoints.close()
    assert not step.exists()


def test_a_finished_run_without_checkpoints_is_not_trained_anew(
    stand_config: TrainConfig, whole_run: Path, tmp_path: Path
) -> None:
    run_dir = tmp_path / "run"
    shutil.copytree(whole_run, run_dir, ignore=shutil.ignore_patterns("checkpoints"))
    assert train(stand_config, run_dir).env_steps == 96
    before = {path: path.read_bytes() for path in run_dir.iterdir() if path.is_file()}
    longer = dataclasses.replace(stand_config, total_env_steps=128)
    with pytest.raises(rundir.RunMismatchError, match=r"finished at 96 .* checkpoints are gone"):
        train(longer, run_dir)
    assert before == {path: path.read_bytes() for path in run_dir.iterdir() if path.is_file()}


def test_worlds_that_only_diverge_stop_the_run() -> None:
    with pytest.raises(guards.DivergedError, match="none of 64 transitions was finite"):
        guards.check_experience(0, 64, 10_000, "")
    guards.check_experience(9_900, 10_000, 10_000, "")
    with pytest.raises(
        guards.DivergedError,
        match=r"101 of 5,000 transitions were dropped, more than 1% of the 10,000 of this run; the"
        " first one because the reward was not finite",
    ):
        guards.check_experience(4_899, 5_000, 10_000, "the reward was not finite")


def test_a_recording_that_drops_too_much_is_refused() -> None:
    check_dropped(1, 99, 100, "the action was not finite")
    with pytest.raises(guards.DivergedError, match=r"^2 of 60 steps .* because the action was"):
        check_dropped(2, 58, 100, "the action was not finite")


def test_a_run_that_drops_too_much_fails_with_count_and_first_cause(
    stand_config: TrainConfig, whole_run: Path
) -> None:
    batch = loop.Batch([Part(stand_config, RunDir(whole_run))], "test")
    try:
        states = batch.start()
        logger: Any = None  # all seeds fail, so nobody is told apart
        batch.guard(states, np.array(True), states.inserted, logger)
        assert not batch.note_drops(np.array(0.0))
        assert batch.note_drops(np.array([4.0]))
        assert batch.note_drops(np.array(1.0))  # the first one stays the first
        with pytest.raises(guards.DivergedError, match=r"^2 of 96 .*because the reward was not"):
            batch.guard(states, np.array(True), states.inserted - 2, logger)
    finally:
        batch.close()


def test_finished_run_is_left_alone(stand_config: TrainConfig, whole_run: Path) -> None:
    before = (whole_run / "metrics.csv").read_bytes()
    assert train(stand_config, whole_run).env_steps == 96
    assert (whole_run / "metrics.csv").read_bytes() == before


def test_other_config_is_refused_with_a_diff(stand_config: TrainConfig, whole_run: Path) -> None:
    other = dataclasses.replace(
        stand_config, droq=dataclasses.replace(stand_config.droq, discount=0.9)
    )
    before = (whole_run / "config.json").read_bytes()
    with pytest.raises(rundir.RunMismatchError, match=r"droq\.discount: 0\.99 -> 0\.9"):
        train(other, whole_run)
    assert (whole_run / "config.json").read_bytes() == before


def test_options_of_the_source_task_may_change(stand_config: TrainConfig) -> None:
    assert "stand." not in rundir.may_change(stand_config)
    assert "stand." in rundir.may_change(make_config("biped", "debug"))


@pytest.mark.parametrize(("keep", "kept"), [("best", [1, 1, 3]), ("last", [1, 2, 3])])
def test_the_policy_of_a_run_is_the_best_or_the_last(
    keep: Any, kept: list[int], stand_config: TrainConfig, tmp_path: Path
) -> None:
    evaluation = dataclasses.replace(stand_config.eval, keep=keep)
    config = dataclasses.replace(stand_config, eval=evaluation)
    batch = loop.Batch([Part(config, RunDir(tmp_path / "a"))], "test")
    try:
        (run,) = batch.runs
        actor = batch.program.init().learner.actor
        for number, value, expected in zip((1, 2, 3), (5.0, 4.0, 6.0), kept, strict=True):
            counts = {"env_steps": number, "grad_steps": 0}
            run.evaluated(actor, counts, {"return": np.full(4, value)})
            assert load_policy(tmp_path / "a" / "policy.npz").header.card["env_steps"] == expected
            last = load_policy(tmp_path / "a" / "policy_last.npz").header.card
            assert last["env_steps"] == number
        assert run.progress["best"] == 6.0
    finally:
        batch.close()


def test_a_budget_that_is_lowered_to_what_there_is_closes_the_run(
    stand_config: TrainConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Stopped before its first evaluation it has no policy yet."""
    rarely = dataclasses.replace(
        stand_config, eval=dataclasses.replace(stand_config.eval, every=96)
    )
    monkeypatch.setattr(loop.Batch, "is_late", lambda batch: bool(batch.runs[0].progress["wall_s"]))
    with pytest.raises(pipeline.StoppedError, match="stopped at 32"):
        train(rarely, tmp_path / "a")
    assert not (tmp_path / "a" / "policy.npz").exists()
    done = train(dataclasses.replace(rarely, total_env_steps=20), tmp_path / "a")
    assert done.env_steps == 32
    assert load_policy(tmp_path / "a" / "policy.npz").header.card["env_steps"] == 32


def test_stop_event_saves_and_ends_the_loop(
    stand_config: TrainConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    event = threading.Event()
    original = loop.Batch.evaluate

    def stop_after_evaluation(batch: loop.Batch, states: TrainState) -> dict[str, np.ndarray]:
        event.set()
        return original(batch, states)

    class AlwaysThisEvent:
        def __enter__(self) -> threading.Event:
            return event

        def __exit__(self, *_: object) -> None:
            return None

    monkeypatch.setattr(loop, "stop_on_signal", AlwaysThisEvent)
    monkeypatch.setattr(loop.Batch, "evaluate", stop_after_evaluation)
    with pytest.raises(pipeline.StoppedError, match="stopped stopped at 64 transitions"):
        train(stand_config, tmp_path / "stopped")
    checkpoints = Checkpoints(tmp_path / "stopped")
    assert checkpoints.latest() == 64
    checkpoints.close()


def test_epoch_is_traced_once_and_donates(stand_config: TrainConfig) -> None:
    env = make_env(stand_config)
    traces = 0
    observe = env.task.observer.observe

    def counted(*args: object) -> jax.Array:
        nonlocal traces
        traces += 1
        return observe(*args)

    env.task.observer.observe = counted
    epoch = state.compile_epoch(stand_config, env)
    train_state = jax.jit(lambda k: state.init(stand_config, env, k, None))(jax.random.key(0))
    after_init = traces
    first = train_state
    train_state, _ = epoch(train_state)
    after_first = traces
    train_state, _ = epoch(train_state)
    train_state, metrics = epoch(train_state)
    assert after_first > after_init
    assert traces == after_first, "the second epoch compiled again"
    assert first.replay.online.rows.is_deleted()
    assert np.isfinite(float(metrics["critic_loss"]))


def test_diverged_learner_names_the_tensor(stand_config: TrainConfig, whole_run: Path) -> None:
    learner = final_state(stand_config, whole_run).learner
    kernel = learner.actor["mean"]["kernel"].at[0, 0].set(jnp.nan)
    broken = learner.replace(
        actor=learner.actor | {"mean": learner.actor["mean"] | {"kernel": kernel}}
    )
    guards.check_finite(learner)
    assert bool(guards.all_finite(learner))
    assert not bool(guards.all_finite(broken))
    with pytest.raises(guards.DivergedError, match=r"actor\.mean\.kernel"):
        guards.check_finite(broken)


def test_source_data_are_required(tmp_path: Path) -> None:
    config = make_config("biped", "debug")
    with pytest.raises(ValueError, match="needs source data"):
        loop.train([Part(config, RunDir(tmp_path / "x"))])
    assert not (tmp_path / "x").exists()


def test_non_finite_world_never_reaches_the_ring(
    stand_config: TrainConfig, capfd: pytest.CaptureFixture[str]
) -> None:
    env = make_env(stand_config)
    init = jax.jit(lambda key: state.init(stand_config, env, key, None))
    train_state = init(jax.random.key(0))
    data = train_state.env.data
    poisoned = data.replace(qvel=data.qvel.at[1, 0].set(jnp.nan))
    train_state = train_state.replace(env=train_state.env.replace(data=poisoned))
    collect = jax.jit(lambda *args: state.collect_step(stand_config, env, *args))
    after, result, fault = collect(train_state, jax.random.key(1))
    assert np.asarray(result.invalid).tolist() == [False, True, False, False]
    assert np.asarray(fault).tolist() == [0, 1, 0, 0]
    assert FAULTS[1] == "the physical state was not finite"
    assert int(after.inserted) == 3
    assert int(after.replay.online.size) == 3
    rows = ring.gather(after.replay.online, jnp.arange(4))
    assert np.isfinite(np.asarray(rows.next_obs)).all()
    assert np.isfinite(np.asarray(result.obs)).all()
    assert "WARNING" not in "".join(capfd.readouterr())  # MuJoCo's own words
