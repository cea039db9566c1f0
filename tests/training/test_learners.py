"""A second learner, behaviour cloning, defined here and trained by the same program."""

from __future__ import annotations

import csv
import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from twirl_mjx.droq import networks
from twirl_mjx.droq.config import DroqConfig
from twirl_mjx.droq.learner import LEARNER
from twirl_mjx.droq.state import AdamState, adam_init, adam_step
from twirl_mjx.policies.learned import load_policy
from twirl_mjx.replay import ring
from twirl_mjx.sweep import estimate, grid, plan
from twirl_mjx.training import api, config_json, learners, loop, pipeline, state, weights
from twirl_mjx.training.config import TrainConfig
from twirl_mjx.training.learner_check import check_learner
from twirl_mjx.training.presets import make_config
from twirl_mjx.training.run import Part
from twirl_mjx.training.rundir import RunDir
from twirl_mjx.types import Learner, MetricInfo, Transition
from twirl_mjx.worlds.make import make_env


@dataclasses.dataclass(frozen=True)
class CloneConfig:
    """The three settings that training reads, and one of its own."""

    utd: float = 4.0
    updates_per_block: int = 4
    batch_size: int = 16
    learning_rate: float = 3e-3


class CloneState(flax.struct.PyTreeNode):
    actor: Any
    opt: AdamState
    grad_steps: jax.Array


def init(key: jax.Array, config: CloneConfig, obs_size: int, action_size: int) -> CloneState:
    actor = networks.init_actor(key, (32,), obs_size, action_size)
    return CloneState(actor, adam_init(actor), jnp.zeros((), jnp.int32))


def mean(actor: Any, obs: jax.Array) -> jax.Array:
    return jnp.tanh(networks.actor_distribution(actor, obs)[0])


def sample(actor: Any, obs: jax.Array, key: jax.Array) -> jax.Array:
    action = mean(actor, obs)
    return jnp.clip(action + 0.1 * jax.random.normal(key, action.shape), -1.0, 1.0)


def update(
    state: CloneState, config: CloneConfig, minibatches: Transition, key: jax.Array
) -> tuple[CloneState, dict[str, jax.Array]]:
    def step(carry: CloneState, batch: Transition) -> tuple[CloneState, jax.Array]:
        def loss_fn(actor: Any) -> jax.Array:
            return jnp.mean(jnp.square(mean(actor, batch.obs) - batch.action))

        loss, grads = jax.value_and_grad(loss_fn)(carry.actor)
        actor, opt = adam_step(carry.actor, grads, carry.opt, config.learning_rate)
        return CloneState(actor, opt, carry.grad_steps + 1), loss

    state, loss = jax.lax.scan(step, state, minibatches)
    return state, {"clone_loss": jnp.mean(loss)}


CLONE = Learner(
    "clone",
    CloneConfig,
    init,
    sample,
    mean,
    update,
    {"clone_loss": MetricInfo("squared distance of the mean action from the stored one", "1")},
)


@pytest.fixture
def clone() -> Iterator[Learner]:
    yield learners.register(CLONE)
    learners.LEARNERS._items.pop("clone")


@pytest.fixture
def clone_config(clone: Learner, stand_config: TrainConfig) -> TrainConfig:
    """Every minibatch comes from the source: 64 transitions, 4 updates each, after the warm-up."""
    replay = dataclasses.replace(stand_config.replay, phi=1.0)
    settings: Any = CloneConfig()
    return dataclasses.replace(
        stand_config, variant="twirl", replay=replay, learner="clone", droq=settings
    )


def constant_source(size: int, action: float) -> ring.RingBuffer:
    """Random observations of ``stand``, always the same action."""
    obs = jax.random.normal(jax.random.key(7), (size, 101))
    rows = Transition(
        obs, jnp.full((size, 12), action), jnp.zeros(size), jnp.zeros(size, bool), obs
    )
    return ring.from_transitions(rows)


@pytest.mark.slow
def test_a_learner_of_its_own_trains_a_run_to_its_end(
    clone: Learner, clone_config: TrainConfig, tmp_path: Path
) -> None:
    source = constant_source(200, 0.5)
    (outcome,) = loop.train([Part(clone_config, RunDir(tmp_path / "run"), source)])
    assert outcome.finished
    with (tmp_path / "run" / "metrics.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    losses = [float(row["value"]) for row in rows if row["metric"] == "clone_loss"]
    assert len(losses) == 2  # the first epoch only warms up
    assert losses[1] < 0.5 * losses[0]
    assert {row["value"] for row in rows if row["metric"] == "replay_ratio"} == {"64"}
    assert rows[-1]["grad_steps"] == "256"
    policy = load_policy(tmp_path / "run" / "policy_last.npz")
    obs = np.random.default_rng(0).normal(size=(50, 101)).astype(np.float32)
    np.testing.assert_allclose(policy.act(obs).mean(0), 0.5, atol=0.1)


@pytest.mark.slow
def test_the_compiled_epoch_uses_the_learner_of_the_settings(
    clone: Learner, clone_config: TrainConfig
) -> None:
    env = make_env(clone_config, threads=1)
    source = constant_source(200, 0.5)
    begin = jax.jit(lambda key: state.init(clone_config, env, key, None))(jax.random.key(0))
    begin = begin.replace(replay=begin.replay.replace(source=source))
    assert isinstance(begin.learner, CloneState)
    before = np.array(begin.learner.actor["mean"]["kernel"])
    epoch = state.compile_epoch(clone_config, env)
    after, _ = epoch(begin)
    np.testing.assert_array_equal(before, after.learner.actor["mean"]["kernel"])
    after, metrics = epoch(after)
    assert int(after.learner.grad_steps) == 128  # 32 transitions at 4 updates each
    assert "clone_loss" in metrics
    assert "critic_loss" not in metrics


def test_a_run_of_another_learner_is_read_back(clone: Learner) -> None:
    config = make_config("stand", "debug", "clone")
    assert (config.learner, type(config.droq)) == ("clone", CloneConfig)
    assert config_json.from_json(config_json.to_json(config)) == config
    changed = config_json.settle(config, {"clone.learning_rate": 0.5})
    assert changed.droq.learning_rate == 0.5
    with pytest.raises(ValueError, match="learner droq has settings of DroqConfig"):
        dataclasses.replace(config, learner="droq")


def test_the_class_of_the_settings_decides_who_learns(clone: Learner) -> None:
    assert learners.learner_of(CloneConfig()) is CLONE
    assert learners.learner_of(DroqConfig()) is LEARNER
    assert learners.register(CLONE) is CLONE  # again, as a file that is loaded twice does
    with pytest.raises(ValueError, match="DroqConfig holds the settings of learner droq"):
        learners.register(dataclasses.replace(CLONE, Config=DroqConfig))


def test_networks_of_another_learner_are_not_taken_over(
    clone: Learner, clone_config: TrainConfig
) -> None:
    config = make_config("biped", "debug", "clone")
    config = dataclasses.replace(config, variant="weights")
    with pytest.raises(ValueError, match="networks of droq, not those of learner clone"):
        weights.check_weights_fit(config, "debug")


def test_settings_that_nobody_registered_are_refused() -> None:
    with pytest.raises(ValueError, match=r"no learner has settings of class CloneConfig: register"):
        learners.learner_of(CloneConfig())


@dataclasses.dataclass
class ThawedConfig:
    """Not frozen, so it has no hash."""

    utd: float = 1.0
    updates_per_block: int = 1
    batch_size: int = 1


class BareConfig:
    utd = 1.0


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        (ThawedConfig, "ThawedConfig should be a frozen dataclass with defaults for utd"),
        (BareConfig, "it has no updates_per_block, batch_size"),
    ],
)
def test_settings_without_what_training_reads_are_refused(kind: type, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        learners.register(dataclasses.replace(CLONE, Config=kind))
    assert "clone" not in learners.LEARNERS.names()


@pytest.mark.parametrize("config", [DroqConfig(), DroqConfig(fast=False, utd=1.0)])
def test_droq_keeps_what_the_protocol_asks(config: DroqConfig) -> None:
    check_learner(config, 7, 3)


def wrong_init(key: jax.Array, config: CloneConfig, obs_size: int, action_size: int) -> CloneState:
    return init(key, config, obs_size, action_size).replace(grad_steps=jnp.zeros(()))


def wrong_actor(key: jax.Array, config: CloneConfig, obs_size: int, action_size: int) -> CloneState:
    return CloneState({"layer": jnp.zeros(3)}, adam_init({}), jnp.zeros((), jnp.int32))


def no_state(key: jax.Array, config: CloneConfig, obs_size: int, action_size: int) -> list:
    return [jnp.zeros(3)]


def half_update(state: CloneState, config: CloneConfig, batch: Transition, key: jax.Array) -> tuple:
    half = jax.tree.map(lambda x: x.astype(jnp.bfloat16), state.actor)
    return state.replace(actor=half), {"clone_loss": jnp.zeros(())}


@pytest.mark.parametrize(
    ("function", "made", "message"),
    [
        ("init", wrong_init, r"init, state.grad_steps: .* float32\[\], expected int32\[\]"),
        ("init", wrong_actor, r"init, state.actor: actor layers are \['layer'\], expected hidden"),
        (
            "init",
            no_state,
            "init, state.grad_steps: AttributeError: 'list' object",
        ),
        ("sample", lambda a, o, k: o, r"sample: .* float32\[4, 16, 7\], expected .*\[4, 16, 3\]"),
        ("mean", lambda a, o: mean(a, o)[0], r"mean: .* float32\[16, 3\], expected"),
        ("mean", lambda a: a, r"mean: TypeError: .* positional argument"),
        ("update", half_update, r"update, the state after it: .* is bfloat16.*, expected float32"),
        (
            "update",
            lambda s, c, b, k: (s, {"cloned": jnp.zeros(())}),
            r"update, its metrics .*clone_loss is missing, expected float32\[\]",
        ),
    ],
)
def test_what_a_learner_returns_is_checked_before_anything_is_compiled(
    function: str, made: Any, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    wrong = dataclasses.replace(CLONE, **{function: made})
    monkeypatch.setitem(learners.LEARNERS._items, wrong.name, wrong)
    with pytest.raises(ValueError, match=f"learner clone: {message}") as refusal:
        check_learner(CloneConfig(), 7, 3)
    assert "\n" not in str(refusal.value)


def test_a_learner_is_named_in_a_grid_and_from_python(
    clone: Learner, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    settings = {"task": "stand", "learner": "clone", "clone.utd": 2.0}
    config = grid.configure("debug", settings, "here")
    assert config.learner == "clone" and config.droq == CloneConfig(utd=2.0)
    with pytest.raises(ValueError, match=r"^here: unknown learner 'clon'.*nearest: 'clone'"):
        grid.configure("debug", settings | {"learner": "clon"}, "here")

    class Trained(Exception):  # noqa: N818, it ends the call
        pass

    def train(config: TrainConfig, *_: Any) -> None:
        raise Trained(config)

    monkeypatch.setattr(pipeline, "run_seeds", train)
    with pytest.raises(Trained) as told:
        api.train("stand", preset="debug", learner="clone", clone={"utd": 2.0}, runs=tmp_path)
    assert told.value.args == (config,)


def test_runs_of_a_learner_do_not_stop_the_estimates_of_others(
    clone_config: TrainConfig, stand_config: TrainConfig, tmp_path: Path
) -> None:
    run_dir = RunDir(tmp_path / "clone")
    run_dir.open(clone_config)
    columns = "metric,grad_steps,value"
    rows = (f"{name},4,8.0" for name in ("env_steps_per_s", "updates_per_s"))
    run_dir.metrics.write_text("\n".join([columns, *rows, ""]))
    (speed,) = estimate.measure(tmp_path)
    assert (speed.env_steps_per_s, speed.updates_per_s) == (8.0, 8.0)
    for config, basis in ((clone_config, "measured"), (stand_config, "default")):
        cell = plan.Cell("a", "arm", "debug", config, "")
        assert estimate.estimate(cell, tmp_path, [speed]).basis == basis
    assert estimate.default_rate(clone_config) > 0.0
