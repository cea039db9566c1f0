"""GPU operations of blocks, epochs and worlds, counted without a GPU (``gpu_target``).

One learner on a GPU waits for launches, not for arithmetic: operations per critic update say what
a form costs before any card is there to measure it on.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from twirl_mjx.bench.gpu_target import compile_for, compiler_missing
from twirl_mjx.bench.measure import Record, machine, progress
from twirl_mjx.bench.options import GpuCompileBench
from twirl_mjx.bench.thunks import Block
from twirl_mjx.droq import forms, learner
from twirl_mjx.droq.config import DroqConfig, settings_of
from twirl_mjx.droq.state import CriticState
from twirl_mjx.replay import ring
from twirl_mjx.sim import mjx
from twirl_mjx.sim.actuation import MotorCommand
from twirl_mjx.sim.dynamics import Dynamics
from twirl_mjx.sim.engine import Trace
from twirl_mjx.training import seeds as batch
from twirl_mjx.training import state as training
from twirl_mjx.training.config import TrainConfig
from twirl_mjx.training.presets import make_config
from twirl_mjx.types import Transition
from twirl_mjx.worlds.make import make_env
from twirl_mjx.worlds.vector import VectorEnv

BLOCK, ROWS, OBS, ACTION = 20, 256, 101, 12
"""Critic updates of a block, rows of a minibatch, sizes of ``biped``: the paper's."""
STEPS = 20
"""Control steps of the worlds."""

Task = tuple[Callable[..., Any], tuple[Any, ...], tuple[int, ...]]
"""Function, shapes of its arguments, arguments it may overwrite."""


class Still:
    """An engine without physics: joints jump to their targets. To compile the rest of an epoch."""

    def __init__(self, substeps: int) -> None:
        """Keep the number of substeps of a trace."""
        self._substeps = substeps

    def step(
        self, data: mjx.Data, command: MotorCommand, dynamics: Dynamics
    ) -> tuple[mjx.Data, Trace]:
        """Advance nothing but the joints; see ``sim.engine.Engine``."""
        del dynamics
        qpos = data.qpos.at[:, 7:].set(command.target)
        qpos_trace, qvel_trace = (
            jnp.repeat(leaf[:, None], self._substeps, axis=1) for leaf in (qpos, data.qvel)
        )
        return data.replace(qpos=qpos, ctrl=command.target), Trace(qpos_trace, qvel_trace)


def learner_program(program: str, form: str, seeds: int) -> Task:
    """Return a block of critic updates, or a whole update, of one learner or of several."""
    config = DroqConfig(**settings_of(form))

    def spec(*shape: int, dtype: Any = jnp.float32) -> Any:
        return jax.ShapeDtypeStruct(shape, dtype)

    minibatches = Transition(
        obs=spec(BLOCK, ROWS, OBS),
        action=spec(BLOCK, ROWS, ACTION),
        reward=spec(BLOCK, ROWS),
        terminated=spec(BLOCK, ROWS, dtype=jnp.bool_),
        next_obs=spec(BLOCK, ROWS, OBS),
    )
    key = jax.eval_shape(jax.random.key, 0)
    state = jax.eval_shape(lambda k: learner.init(k, config, OBS, ACTION), key)

    def block(state: Any, rows: Transition, key: jax.Array) -> Any:
        critics = CriticState(state.critic, state.target_critic, state.critic_opt)
        temperature = jnp.exp(state.log_temperature)
        form = forms.form_of(config)
        return form.critic_block(critics, state.actor, temperature, config, rows, rows.action, key)

    def update(state: Any, rows: Transition, key: jax.Array) -> Any:
        return learner.update(state, config, rows, key)

    function, args = (block if program == "block" else update), (state, minibatches, key)
    if seeds > 1:
        function = jax.vmap(function)
        args = jax.tree.map(lambda x: spec(seeds, *x.shape, dtype=x.dtype), args)
    return function, args, ((0,) if program == "update" else ())


def epoch_program(options: GpuCompileBench, form: str, seeds: int) -> Task:
    """Return an epoch of the paper's preset with everything but physics."""
    base = make_config(options.task, "paper")
    config = dataclasses.replace(base, engine="mjx", droq=DroqConfig(**settings_of(form)))
    env = make_env(config)
    env.engine = Still(env.scene.options.n_substeps)
    source = None
    if config.uses_source_data:
        sizes = (config.replay.source_size, env.observation_size, env.action_size)
        source = jax.eval_shape(lambda: ring.init(*sizes))
    epoch, state = _epoch(config, env, seeds)
    return epoch, (state.replace(replay=state.replay.replace(source=source)),), (0,)


def _epoch(config: TrainConfig, env: VectorEnv, seeds: int) -> tuple[Callable[..., Any], Any]:
    if seeds > 1:
        state = jax.eval_shape(lambda: batch.init_seeds(config, env, range(seeds), None))
        return batch.batch_epoch(config, env), state
    state = jax.eval_shape(lambda k: training.init(config, env, k, None), jax.random.key(0))
    return functools.partial(training.train_epoch, config, env), state


def worlds_program(options: GpuCompileBench) -> Task:
    """Return control steps of MJX worlds with random actions."""
    config = dataclasses.replace(
        make_config(options.task, "paper").evaluation, engine="mjx", num_envs=options.num_envs
    )
    env = make_env(config)
    key = jax.eval_shape(jax.random.key, 0)

    def steps(state: Any, key: jax.Array) -> Any:
        def step(carry: Any, _: None) -> tuple[Any, None]:
            state, key = carry
            key, act_key = jax.random.split(key)
            shape = (env.num_envs, env.action_size)
            action = jax.random.uniform(act_key, shape, minval=-1.0, maxval=1.0)
            return (env.step(state, action), key), None

        return jax.lax.scan(step, (state, key), length=STEPS)[0]

    return steps, (jax.eval_shape(env.reset, key), key), (0,)


def measure_row(options: GpuCompileBench, program: str, form: str, seeds: int) -> Record:
    """Compile one program and count it."""
    progress(f"bench gpu-compile: {program}, {form or 'MJX'}, {seeds} at once")
    if program == "worlds":
        function, args, donate = worlds_program(options)
    elif program == "epoch":
        function, args, donate = epoch_program(options, form, seeds)
    else:
        function, args, donate = learner_program(program, form, seeds)
    found = compile_for(options.card, function, args, donate, options.options)
    return {
        "program": program,
        "form": form,
        "seeds": seeds,
        "in_loop": found.loops.innermost().count,
        "loops": [_plain(depth, block) for depth, block in found.loops.walk()],
        "compile_s": found.compile_s,
        "temporary_mb": found.temporary_mb,
        "argument_mb": found.argument_mb,
        "aliased_mb": found.aliased_mb,
    }


def _plain(depth: int, block: Block) -> Record:
    return {
        "depth": depth,
        "name": block.name,
        "operations": dict(block.operations),
        "count": block.count,
        "graphs": block.graphs,
    }


def measure(options: GpuCompileBench) -> Record:
    """Compile and count everything that is asked for.

    Raises:
        RuntimeError: This environment has no GPU compiler.
    """
    if (reason := compiler_missing()) is not None:
        raise RuntimeError(reason)
    jax.config.update("jax_enable_compilation_cache", False)  # it cannot load what runs elsewhere
    cells = [
        (program, form, seeds)
        for program in options.programs
        if program != "worlds"
        for seeds in options.seeds
        for form in options.forms
    ]
    cells += [("worlds", "", 1)] if "worlds" in options.programs else []
    return {
        "part": "gpu-compile",
        "card": options.card,
        "task": options.task,
        "num_envs": options.num_envs,
        "flags": list(options.flags),
        "rows": [measure_row(options, *cell) for cell in cells],
        "machine": machine(),
    }
