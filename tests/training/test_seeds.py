"""A batch of seeds against the same seed alone."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from twirl_mjx.droq import learner as droq
from twirl_mjx.policies.learned import load_policy
from twirl_mjx.replay import ring
from twirl_mjx.training import seeds, state
from twirl_mjx.training.config import TrainConfig
from twirl_mjx.training.presets import make_config
from twirl_mjx.training.run import Part, Run
from twirl_mjx.training.rundir import RunDir
from twirl_mjx.training.state import TrainState
from twirl_mjx.types import Metrics
from twirl_mjx.worlds.make import make_env
from twirl_mjx.worlds.vector import VectorEnv

SEEDS = [3, 5]

Stages = list[tuple[TrainState, Metrics]]
"""A host copy of the state, and the metrics, after every epoch."""


def to_host(tree: TrainState) -> TrainState:
    """Copy the leaves before the next epoch overwrites them; keys become their words."""

    def copy(leaf: jax.Array) -> np.ndarray:
        is_key = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        return np.array(jax.random.key_data(leaf) if is_key else leaf)

    return jax.tree.map(copy, tree)


@pytest.fixture(scope="module")
def env(stand_config: TrainConfig) -> VectorEnv:
    return make_env(stand_config, threads=1)


@pytest.fixture(scope="module")
def batch_stages(stand_config: TrainConfig, env: VectorEnv) -> Stages:
    epoch = seeds.compile_epoch_seeds(stand_config, env)
    states = seeds.init_seeds(stand_config, env, SEEDS, None)
    stages: Stages = [(to_host(states), {})]
    for _ in range(3):
        states, metrics = epoch(states)
        stages.append((to_host(states), jax.tree.map(np.array, metrics)))
    assert epoch._cache_size() == 1  # type: ignore[attr-defined]
    return stages


@pytest.fixture(scope="module")
def single_stages(stand_config: TrainConfig, env: VectorEnv) -> Stages:
    """The last seed of the batch, alone."""
    epoch = state.compile_epoch(stand_config, env)
    init = jax.jit(functools.partial(state.init, stand_config, env, source=None))
    train_state = init(jax.random.key(SEEDS[-1]))
    stages: Stages = [(to_host(train_state), {})]
    for _ in range(3):
        train_state, metrics = epoch(train_state)
        stages.append((to_host(train_state), jax.tree.map(np.array, metrics)))
    return stages


@pytest.mark.slow
def test_seeds_start_as_they_start_alone(batch_stages: Stages, single_stages: Stages) -> None:
    jax.tree.map(
        np.testing.assert_array_equal, seeds.seed_state(batch_stages[0][0], 1), single_stages[0][0]
    )


@pytest.mark.slow
def test_experience_before_learning_agrees(batch_stages: Stages, single_stages: Stages) -> None:
    """The first epoch only warms up: physics, guards, resets and the ring, no network."""
    batch, single = batch_stages[1][0], single_stages[1][0]
    assert int(single.env_steps) == 32
    assert int(single.learner.grad_steps) == 0
    same = functools.partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-5)
    jax.tree.map(same, seeds.seed_state(batch, 1), single)


@pytest.mark.slow
def test_learning_agrees_to_float32_rounding(batch_stages: Stages, single_stages: Stages) -> None:
    """After 64 updates weights were seen to differ by 3e-8, joint speeds by 4e-6 rad/s."""
    batch, single = seeds.seed_state(batch_stages[3][0], 1), single_stages[3][0]
    assert int(single.learner.grad_steps) == int(batch.learner.grad_steps) == 64
    moved = (
        single.learner.actor["mean"]["kernel"] - single_stages[0][0].learner.actor["mean"]["kernel"]
    )
    assert np.abs(moved).max() > 1e-4
    jax.tree.map(
        functools.partial(np.testing.assert_allclose, rtol=1e-6, atol=1e-6),
        batch.learner.actor,
        single.learner.actor,
    )
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-4), batch, single)


@pytest.mark.slow
def test_metrics_are_those_of_every_seed(batch_stages: Stages, single_stages: Stages) -> None:
    metrics, alone = batch_stages[3][1], single_stages[3][1]
    assert set(metrics) == set(alone)
    for name, value in metrics.items():
        assert value.shape == (len(SEEDS),), name
        np.testing.assert_allclose(value[1], alone[name], rtol=1e-4, atol=1e-4, err_msg=name)


def test_seeds_differ(batch_stages: Stages) -> None:
    one, two = (seeds.seed_state(batch_stages[3][0], i) for i in range(2))
    assert np.abs(one.env.obs - two.env.obs).max() > 1e-2
    assert np.abs(one.learner.actor["mean"]["kernel"] - two.learner.actor["mean"]["kernel"]).max()
    assert (one.key != two.key).any()


def test_one_seed_can_be_saved(
    stand_config: TrainConfig, env: VectorEnv, batch_stages: Stages, tmp_path: Path
) -> None:
    chosen = seeds.seed_state(batch_stages[3][0], 1)
    config = dataclasses.replace(stand_config, seed=SEEDS[1])
    run = Run(Part(config, RunDir(tmp_path / "seed5")), env, "test")
    try:
        counts = {"env_steps": 96, "grad_steps": int(chosen.learner.grad_steps)}
        run.save_policy(run.run_dir.policy, chosen.learner.actor, counts, {})
    finally:
        run.close()
    policy = load_policy(tmp_path / "seed5" / "policy.npz")
    assert policy.header.card["seed"] == SEEDS[1]
    assert policy.header.card["grad_steps"] == 64
    assert policy.header.card["form"] == "fast"  # what ``auto`` means on a CPU
    obs = np.random.default_rng(0).normal(size=(5, 101)).astype(np.float32)
    actor = jax.tree.map(jnp.asarray, chosen.learner.actor)
    expected = droq.mean_action(actor, jnp.asarray(obs))
    np.testing.assert_allclose(policy.act(obs), np.asarray(expected), atol=1e-6)


def test_source_ring_is_shared_not_copied() -> None:
    """Shapes only; a batch with a source keeps one source ring and one counter of transitions."""
    config = make_config("biped", "debug")
    env = make_env(config, threads=1)
    data = ring.init(64, env.observation_size, env.action_size)
    source = data.replace(size=jnp.int32(64))

    def run(source: ring.RingBuffer) -> tuple[TrainState, Metrics]:
        states = seeds.init_seeds(config, env, SEEDS, source)
        return seeds.batch_epoch(config, env)(states)

    states, metrics = jax.eval_shape(run, source)
    assert states.replay.source.rows.shape == source.rows.shape
    assert states.replay.online.rows.shape == (2, config.replay.capacity, source.rows.shape[1])
    assert states.env_steps.shape == ()
    assert states.learner.grad_steps.shape == (2,)
    assert metrics["critic_loss"].shape == (2,)
    one = jax.eval_shape(lambda s: seeds.seed_state(s, 0), states)
    assert one.replay.source.rows.shape == source.rows.shape


def test_no_seed_is_refused(stand_config: TrainConfig, env: VectorEnv) -> None:
    with pytest.raises(ValueError, match="at least one seed"):
        seeds.init_seeds(stand_config, env, [], None)


@pytest.mark.parametrize("index", [-1, 2])
def test_place_outside_the_batch_is_refused(batch_stages: Stages, index: int) -> None:
    with pytest.raises(ValueError, match=rf"seed index {index} is outside \[0, 1\]"):
        seeds.seed_state(batch_stages[0][0], index)
