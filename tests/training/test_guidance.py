"""Guidance: who acts when, by hand and in a probe whose best action is known; resume, refusals."""

from __future__ import annotations

import csv
import dataclasses
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from twirl_mjx.droq import learner as droq
from twirl_mjx.policies.resolve import Source
from twirl_mjx.training import loop, pipeline, source_rules, state
from twirl_mjx.training.config import TrainConfig
from twirl_mjx.training.guidance import Guide
from twirl_mjx.training.learners import learner_of
from twirl_mjx.training.presets import make_config
from twirl_mjx.training.run import Part
from twirl_mjx.training.rundir import RunDir
from twirl_mjx.types import Transition

WORLDS, LENGTH, BEST = 8, 10, 0.6


class Clock(flax.struct.PyTreeNode):
    """What a guide reads of a world."""

    episode_step: jax.Array


class ProbeState(flax.struct.PyTreeNode):
    """As much of an ``EnvState`` as training reads."""

    obs: jax.Array
    next_obs: jax.Array
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    invalid: jax.Array
    metrics: Mapping[str, jax.Array]
    world: Clock

    @property
    def done(self) -> jax.Array:
        return self.truncated


class Probe:
    """Worlds that pay 1 for the action (0.6, 0.6) and less for any other, in episodes of 10."""

    num_envs, observation_size, action_size = WORLDS, 2, 2
    task: Any = SimpleNamespace(
        measures={},
        robot=SimpleNamespace(control_dt=0.05),
        success=lambda measures: measures["return"] > 5.0,
    )

    def reset(self, key: jax.Array) -> ProbeState:
        del key
        return self._state(jnp.zeros(WORLDS), jnp.zeros(WORLDS, bool), jnp.zeros(WORLDS, jnp.int32))

    def _state(self, reward: jax.Array, done: jax.Array, steps: jax.Array) -> ProbeState:
        obs, never = jnp.ones((WORLDS, 2)), jnp.zeros(WORLDS, bool)
        return ProbeState(obs, obs, reward, never, done, never, {}, Clock(steps))

    def step_and_fault(self, state: ProbeState, action: jax.Array) -> tuple[ProbeState, jax.Array]:
        reward = 1.0 - jnp.mean(jnp.abs(action - BEST), axis=-1)
        steps = state.world.episode_step + 1
        done = steps == LENGTH
        after = self._state(reward, done, jnp.where(done, 0, steps))
        return after, jnp.zeros(WORLDS, jnp.int32)


PROBE: Any = Probe()


class Constant:
    """A source that always does the same, and counts how often it was asked."""

    def __init__(self, action: float) -> None:
        self._action = action

    def init(self, state: Any) -> jax.Array:
        return jnp.zeros(state.obs.shape[0], jnp.int32)

    def act(self, memory: jax.Array, state: Any, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        del state, key
        return jnp.full((WORLDS, 2), self._action), memory + 1


def probe_config(guide: str) -> TrainConfig:
    config = make_config("biped", "debug")
    droq = dataclasses.replace(
        config.droq, discount=0.5, hidden_sizes=(16, 16), learning_rate=3e-3, dropout_rate=0.0
    )
    return dataclasses.replace(
        config,
        guide=guide,
        variant="twirl",
        replay=dataclasses.replace(config.replay, phi=0.0, capacity=10_000),
        droq=droq,
        num_envs=WORLDS,
        episode_length=LENGTH,
        warmup_env_steps=160,
        epoch_env_steps=1600,
    )


def fresh(config: TrainConfig, guide: Guide | None) -> Any:
    """Return the state before the first step in the probe."""
    make = jax.jit(lambda key: state.init(config, PROBE, key, None, guide))
    return make(jax.random.key(0))


def run_probe(epochs: int) -> tuple[Any, list[dict[str, float]]]:
    """Train beside a source that does the best; return the last state and metrics by epoch."""
    config, env = probe_config("best-of"), PROBE
    guide = Guide(config, Constant(BEST))
    epoch = state.compile_epoch(config, env, guide)
    now, told = fresh(config, guide), []
    for _ in range(epochs):
        now, metrics = epoch(now)
        told.append({name: float(value) for name, value in metrics.items()})
    return now, told


def test_the_critic_takes_a_good_source_and_leaves_a_bad_one() -> None:
    now, told = run_probe(2)
    assert int(now.guide.memory[0]) == 400  # asked at every step: 2 epochs of 1600 / 8
    assert told[-1]["guided"] > 0.6
    assert told[-1]["reward"] > 0.9
    config = probe_config("best-of")

    def value(action: jax.Array) -> jax.Array:
        return droq.value(now.learner, config.droq, now.env.obs, action)

    own = droq.sample_action(now.learner.actor, now.env.obs, jax.random.key(1))
    for action, share in ((BEST, 0.5), (-1.0, 0.0)):
        guide = Guide(config, Constant(action))
        after, _ = guide.choose(now.guide, now.env, now.env_steps, own, value, jax.random.key(0))
        assert (float(after.share) > share) is (action == BEST)


def test_without_a_guide_nothing_is_kept_or_logged() -> None:
    config, env = probe_config("none"), PROBE
    first = jax.eval_shape(lambda: fresh(config, None))
    after, metrics = jax.eval_shape(
        lambda now: state.train_epoch(config, env, now),
        first,
    )
    assert first.guide == after.guide == ()
    assert "guided" not in metrics


def ask(source: float, values: Any, env_steps: int = 1000) -> Any:
    """Return the state and the actions of one step; the learner's own action is 0.1."""
    guide = Guide(probe_config("best-of"), Constant(source))
    env: Any = SimpleNamespace(obs=jnp.ones((WORLDS, 2)))
    own = jnp.full((WORLDS, 2), 0.1)
    count = jnp.asarray(env_steps)
    return guide.choose(guide.init(env), env, count, own, values, jax.random.key(0))


def test_best_of_takes_the_action_of_the_higher_value() -> None:
    wants = jnp.array([1.0, -1.0, 0.0, jnp.nan, 1.0, 1.0, 1.0, 1.0])

    def value(action: jax.Array) -> jax.Array:
        return wants * action[:, 0]

    _, action = ask(0.5, value)
    np.testing.assert_allclose(action[:4, 0], [0.5, 0.1, 0.1, 0.1])  # no better: its own
    _, action = ask(3.0, value)
    assert float(action[0, 0]) == 1.0  # clipped, as the worlds would
    _, action = ask(0.5, value, env_steps=160)
    np.testing.assert_allclose(action, 0.1, rtol=1e-6)  # the critic has not been updated yet


def test_the_value_is_the_least_of_the_target_critics() -> None:
    config = make_config("stand", "debug").droq
    learner = droq.init(jax.random.key(0), config, 3, 2)
    obs, action = jnp.ones((5, 3)), jnp.linspace(-1.0, 1.0, 10).reshape(5, 2)
    got = droq.value(learner, config, obs, action)
    np.testing.assert_array_equal(got, droq.value(learner, config, obs, action))  # no dropout

    def of(member: int) -> jax.Array:
        same = jax.tree.map(
            lambda leaf: jnp.stack([leaf[member]] * config.num_critics), learner.target_critic
        )
        return droq.value(learner.replace(target_critic=same), config, obs, action)

    np.testing.assert_allclose(got, jnp.minimum(of(0), of(1)), rtol=1e-5)
    assert float(jnp.ptp(of(0) - of(1))) > 1e-3


def test_guides_that_cannot_work_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    config = make_config("biped", "debug")
    with pytest.raises(ValueError, match=r"guide 'bestof': .*nearest: 'best-of'"):
        dataclasses.replace(config, guide="bestof")
    for variant in ("scratch", "weights", "zero-shot"):
        with pytest.raises(
            ValueError, match=rf"variant {variant} has not \(nearest: variant twirl"
        ):
            dataclasses.replace(config, variant=variant, guide="best-of")
    guided = dataclasses.replace(config, guide="best-of")
    rows = Transition(*[jnp.zeros((1, 1))] * 5)
    data: Any = Source(Constant(0.0), "mine.npz", "d", data=rows)
    with pytest.raises(ValueError, match=r"mine\.npz is recorded data, which does not act"):
        source_rules.check_guide(guided, data)
    source_rules.check_guide(config, data)
    trained = dataclasses.replace(guided, source="train")
    with pytest.raises(ValueError, match=r"one source for all runs .*nearest: --seed 3"):
        source_rules.check_one_guide(
            [dataclasses.replace(trained, seed=s) for s in (3, 4)], "debug"
        )
    trot = dataclasses.replace(guided, source="trot")
    source_rules.check_one_guide([trot, dataclasses.replace(trot, seed=4)], "debug")
    with pytest.raises(ValueError, match="one source for all runs"):
        source_rules.check_one_guide([trot, dataclasses.replace(trot, source="bound")], "debug")
    with pytest.raises(ValueError, match="guide best-of needs a source, one for all seeds"):
        loop.guide_of([Part(guided, RunDir("x"), policy=Constant(i)) for i in range(2)])
    plain = dataclasses.replace(learner_of(config.droq), value=None)
    monkeypatch.setattr(source_rules, "learner_of", lambda settings: plain)
    with pytest.raises(ValueError, match=r"learner droq has no value \(nearest: guide none"):
        source_rules.check_guide(dataclasses.replace(guided, source="trot"), None)


@pytest.mark.slow
def test_a_guided_run_resumes_bit_for_bit(tmp_path: Path) -> None:
    config = dataclasses.replace(
        make_config("stand", "debug"),
        variant="twirl",
        guide="best-of",
        source="trot",
        engine="native",
    )

    def train(config: TrainConfig, name: str) -> Any:
        pipeline.run(config, "debug", tmp_path, name, lambda _: None)
        policy = pipeline.find_source(config, "debug", tmp_path, print).policy
        batch = loop.Batch([Part(config, RunDir(tmp_path / name), policy=policy)], "test")
        try:
            return batch.start()
        finally:
            batch.close()

    whole = train(config, "whole")
    train(dataclasses.replace(config, total_env_steps=64), "parts")
    parts = train(config, "parts")
    for a, b in zip(jax.tree.leaves(whole), jax.tree.leaves(parts), strict=True):
        if jnp.issubdtype(a.dtype, jax.dtypes.prng_key):
            a, b = jax.random.key_data(a), jax.random.key_data(b)
        np.testing.assert_array_equal(np.asarray(a), np.asarray(b))
    with (tmp_path / "parts" / "metrics.csv").open(newline="") as file:
        shares = [float(r["value"]) for r in csv.DictReader(file) if r["metric"] == "guided"]
    assert len(shares) == 3
    assert shares[0] == 0.0 and shares[-1] > 0.0
