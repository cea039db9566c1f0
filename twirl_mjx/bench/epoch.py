"""Where the time of a training epoch goes: its parts, compiled and timed one by one.

Parts are timed on the states that a trained-on epoch left behind, at the shapes of the epoch. The
compiler may fuse or overlap across their borders inside the whole epoch, so the parts need not
add up to it; ``unaccounted_s`` is the difference.
"""

from __future__ import annotations

import functools
import resource
import sys
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from twirl_mjx.bench.measure import (
    Chain,
    Record,
    machine,
    progress,
    sample_rates,
    summary,
)
from twirl_mjx.bench.options import EpochBench
from twirl_mjx.droq import learner as droq
from twirl_mjx.droq.config import DroqConfig
from twirl_mjx.replay import mixed, ring
from twirl_mjx.sim import actuation
from twirl_mjx.sim.engine import resolve_engine
from twirl_mjx.training import state as training
from twirl_mjx.training.config import TrainConfig
from twirl_mjx.training.state import TrainState
from twirl_mjx.worlds.make import make_env
from twirl_mjx.worlds.vector import VectorEnv, make_transition

REPEATS = 20
"""Times that a part runs in one compiled call."""

Part = Callable[[Any], Any]
"""A function of its own last result."""


def repeat(part: Part) -> Part:
    """Return a function that applies ``part`` ``REPEATS`` times."""
    return lambda state: jax.lax.fori_loop(0, REPEATS, lambda _, s: part(s), state)


def make_parts(config: TrainConfig, env: VectorEnv, state: TrainState) -> dict[str, Any]:
    """Return the parts of one vector step, each as (function, first state).

    Every state is a pair of what the part changes and a key it draws from.
    """
    return _world_parts(env, state) | _learner_parts(config.droq, state)


def _world_parts(env: VectorEnv, state: TrainState) -> dict[str, Any]:
    """Return the parts that move the worlds and store what happened."""
    shape = (env.num_envs, env.action_size)
    command = jax.jit(jax.vmap(functools.partial(actuation.motor_command, env.scene.robot)))(
        state.env.world.motors, state.env.data.ctrl, state.env.world.dynamics
    )
    result = jax.jit(env.step)(state.env, jnp.zeros(shape))
    transition = make_transition(state.env, jnp.zeros(shape), result)

    def physics(carry: Any) -> Any:
        data, key = carry
        return env.engine.step(data, command, state.env.world.dynamics)[0], key

    def worlds(carry: Any) -> Any:
        env_state, key = carry
        key, act_key = jax.random.split(key)
        action = jax.random.uniform(act_key, shape, minval=-1.0, maxval=1.0)
        return env.step(env_state, action), key

    def act(carry: Any) -> Any:
        obs, key = carry
        key, act_key = jax.random.split(key)
        action = droq.sample_action(state.learner.actor, obs, act_key)
        return obs.at[:, : env.action_size].add(1e-3 * action), key

    def insert(carry: Any) -> Any:
        online, key = carry
        return ring.insert(online, transition, jnp.ones(env.num_envs, bool)), key

    return {
        "physics": (physics, state.env.data),
        "worlds": (worlds, state.env),
        "act": (act, state.env.obs),
        "insert": (insert, state.replay.online),
    }


def _learner_parts(config: DroqConfig, state: TrainState) -> dict[str, Any]:
    """Return the parts that draw minibatches and learn from them."""

    def minibatches(replay: mixed.MixedReplay, key: jax.Array) -> Any:
        count, rows = config.updates_per_block, config.batch_size
        return mixed.sample(replay, key, num_minibatches=count, batch_size=rows, phi=0.0)

    fixed = jax.jit(minibatches)(state.replay, jax.random.key(1))

    def sample(carry: Any) -> Any:
        _, key = carry
        key, sample_key = jax.random.split(key)
        return minibatches(state.replay, sample_key), key

    def update(carry: Any) -> Any:
        learner, key = carry
        key, update_key = jax.random.split(key)
        return droq.update(learner, config, fixed, update_key)[0], key

    def actor(carry: Any) -> Any:
        learner, key = carry
        key, noise_key, actor_key = jax.random.split(key, 3)
        noise = jax.random.normal(noise_key, fixed.action.shape[1:])
        return droq.actor_step(learner, config, fixed.obs[-1], noise, actor_key)[0], key

    return {
        "sample": (sample, fixed),
        "update": (update, state.learner),
        "actor": (actor, state.learner),
    }


def split(config: TrainConfig, rates: dict[str, float], epoch_s: float) -> Record:
    """Return the seconds that every part takes in one epoch.

    ``environment`` and ``critic`` are differences of two measurements: noise may leave the smaller
    one below zero.

    Args:
        config: The run.
        rates: Runs per second of the parts of ``make_parts``.
        epoch_s: Length of the whole epoch in s.
    """
    steps = config.steps_per_epoch
    blocks = steps * config.blocks_per_step
    physics = steps / rates["physics"]
    actor = blocks / rates["actor"]
    seconds = {
        "physics": physics,
        "environment": steps / rates["worlds"] - physics,
        "act": steps / rates["act"],
        "insert": steps / rates["insert"],
        "sample": blocks / rates["sample"],
        "critic": blocks / rates["update"] - actor,
        "actor": actor,
    }
    return {
        "epoch_s": epoch_s,
        "seconds": seconds,
        "shares": {name: value / epoch_s for name, value in seconds.items()},
        "unaccounted_s": epoch_s - sum(seconds.values()),
    }


def peak_memory_mb() -> float:
    """Return the largest resident size of this process so far, in MB."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e6 if sys.platform == "darwin" else peak * 1024 / 1e6


def measure(options: EpochBench) -> Record:
    """Time a whole epoch, then its parts."""
    record_machine = machine()
    config = options.config
    env = make_env(config)
    progress(f"bench epoch: compiling {options.task} with preset {options.preset}")
    init = functools.partial(training.init, config, env, source=None)
    state = jax.jit(init)(jax.random.key(0))
    before_mb = peak_memory_mb()
    chain = Chain(lambda s: training.train_epoch(config, env, s)[0], state)
    chain()  # ends the warm-up
    each = options.seconds / 9
    whole = summary(sample_rates(chain, 1.0, 2 * each))
    peak_mb = peak_memory_mb()
    rates, compile_s = {}, {"epoch": chain.compile_s}
    for name, (part, first) in make_parts(config, env, chain.state).items():
        progress(f"bench epoch: {name}")
        timed = Chain(repeat(part), jax.tree.map(jnp.copy, (first, jax.random.key(2))))
        rates[name] = summary(sample_rates(timed, REPEATS, each))["median"]
        compile_s[name] = timed.compile_s
    epoch_s = 1.0 / whole["median"]
    return {
        "part": "epoch",
        "task": options.task,
        "preset": options.preset,
        "engine": resolve_engine(config.engine, config.num_envs),
        "num_envs": config.num_envs,
        "env_steps": config.steps_per_epoch * env.num_envs,
        "critic_updates": config.steps_per_epoch * config.updates_per_step,
        "env_steps_per_s": config.steps_per_epoch * env.num_envs / epoch_s,
        "critic_updates_per_s": config.steps_per_epoch * config.updates_per_step / epoch_s,
        "spread": whole["spread"],
        **split(config, rates, epoch_s),
        "peak_memory_mb": peak_mb,
        "memory_before_epoch_mb": before_mb,
        "compile_s": compile_s,
        "machine": record_machine,
    }
