"""Control steps per second of whole environments, and of their bare physics.

The bare engine replays the joint targets that random actions gave, from the same states and with
the same model: what an environment takes longer is observations, rewards, filters, motors, guards
and auto-resets.
"""

from __future__ import annotations

import functools
import importlib.util
import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco.rollout
import numpy as np

from twirl_mjx import files
from twirl_mjx.bench.measure import (
    Chain,
    Record,
    machine,
    progress,
    sample_in_turn,
    sample_rates,
    summary,
)
from twirl_mjx.bench.options import WorldsBench
from twirl_mjx.machine import usable_cores
from twirl_mjx.sim import mjx
from twirl_mjx.sim.engine import resolve_engine
from twirl_mjx.worlds.make import make
from twirl_mjx.worlds.vector import EnvState, VectorEnv

STEPS = 20
"""Control steps in one compiled call."""
WARMUP_CALLS = 3
"""Calls before anything is timed, after which episodes end at different times."""
HEADLINE_WORLDS = 128
"""The row whose numbers stand at the top of the record, of the engine that ``auto`` chooses."""


def random_steps(env: VectorEnv, state: tuple[EnvState, jax.Array]) -> Any:
    """Take ``STEPS`` control steps with uniformly random actions.

    Returns:
        The new state, and the joint targets [STEPS, N, A] in rad.
    """

    def step(carry: tuple[EnvState, jax.Array], _: None) -> tuple[Any, jax.Array]:
        env_state, key = carry
        key, action_key = jax.random.split(key)
        shape = (env.num_envs, env.action_size)
        action = jax.random.uniform(action_key, shape, minval=-1.0, maxval=1.0)
        env_state = env.step(env_state, action)
        return (env_state, key), env_state.data.ctrl

    return jax.lax.scan(step, state, length=STEPS)


def bare_mjx(env: VectorEnv, data: mjx.Data, targets: jax.Array) -> Callable[[], object]:
    """Compile ``mjx.step`` of the env's model over joint targets [STEPS, N, A]."""
    step = jax.vmap(functools.partial(mjx.step, env.scene.mjx_model))
    substeps = env.scene.options.n_substeps

    def control_step(d: mjx.Data, target: jax.Array) -> tuple[mjx.Data, None]:
        d = d.replace(ctrl=target)
        return jax.lax.scan(lambda x, _: (step(x), None), d, length=substeps)[0], None

    def run(d: mjx.Data, given: jax.Array) -> mjx.Data:
        return jax.lax.scan(control_step, d, given)[0]

    compiled = jax.jit(run).lower(data, targets).compile()
    return lambda: jax.block_until_ready(compiled(data, targets))


def bare_native(env: VectorEnv, data: mjx.Data, targets: jax.Array) -> Callable[[], object]:
    """Return ``mujoco.rollout`` of the env's model over joint targets, a control step a call."""
    substeps, threads = env.scene.options.n_substeps, len(usable_cores())
    pool = mujoco.rollout.Rollout(nthread=threads)
    datas = [mujoco.MjData(env.mj_model) for _ in range(threads)]
    models = [env.mj_model] * env.num_envs
    start = np.concatenate(
        [np.zeros((env.num_envs, 1)), np.asarray(data.qpos), np.asarray(data.qvel)], axis=1
    ).astype(np.float64)
    control = np.repeat(np.asarray(targets, np.float64)[:, :, None], substeps, axis=2)
    out = np.empty((env.num_envs, substeps, start.shape[1]))

    def run() -> np.ndarray:
        state = start
        for given in control:
            pool.rollout(models, datas, state, given, skip_checks=True, nstep=substeps, state=out)
            state = out[:, -1].copy()
        return state

    return run


def make_chain(task: str, engine: str, num_envs: int) -> tuple[Chain, int]:
    """Compile random control steps of worlds.

    Returns:
        The chain, whose state is that of :func:`random_steps` with the last joint targets, and the
        control steps of all worlds that one call takes.
    """
    env = make(task, num_envs=num_envs, engine=engine)
    state = jax.jit(env.reset)(jax.random.key(0))

    def run(carry: Any) -> Any:
        return random_steps(env, carry[0])

    targets = jnp.zeros((STEPS, num_envs, env.action_size))
    chain = Chain(run, ((state, jax.random.key(1)), targets), donate=False)
    return chain, STEPS * num_envs


def measure_row(task: str, engine: str, num_envs: int, seconds: float) -> Record:
    """Measure one number of worlds on one engine.

    Args:
        task: Task.
        engine: ``mjx`` or ``native``.
        num_envs: N.
        seconds: Length of both measurements together in s.
    """
    progress(f"bench worlds: {engine}, {num_envs} worlds")
    env = make(task, num_envs=num_envs, engine=engine)
    chain, work = make_chain(task, engine, num_envs)
    for _ in range(WARMUP_CALLS - 1):
        chain()
    before = chain.state[0][0].data
    chain()
    targets = chain.state[1]
    began = time.perf_counter()
    bare_call = (bare_mjx if engine == "mjx" else bare_native)(env, before, targets)
    bare_compile_s = time.perf_counter() - began
    whole_samples, bare_samples = sample_in_turn([chain, bare_call], work, seconds)
    rates, bare = summary(whole_samples), summary(bare_samples)
    ratios = [b / whole for whole, b in zip(whole_samples, bare_samples, strict=True)]
    substeps = env.scene.options.n_substeps
    return {
        "task": task,
        "engine": engine,
        "num_envs": num_envs,
        "control_steps_per_s": rates["median"],
        "physics_steps_per_s": rates["median"] * substeps,
        "bare_physics_steps_per_s": bare["median"] * substeps,
        "environment_overhead": statistics.median(ratios) - 1.0,
        "control_steps_spread": rates["spread"],
        "bare_spread": bare["spread"],
        "samples": rates["samples"],
        "bare_samples": bare["samples"],
        "compile_s": chain.compile_s,
        "bare_compile_s": bare_compile_s,
    }


def envpool_rate(num_envs: int, seconds: float) -> tuple[float | None, str | None]:
    """Return control steps per second of EnvPool's quadruped, or None and the reason."""
    if importlib.util.find_spec("envpool") is None:
        return None, "envpool is not installed"
    import envpool  # pyright: ignore[reportMissingImports]

    name = "QuadrupedWalk-v1"
    if name not in envpool.list_all_envs():
        return None, f"this envpool has no {name}"
    env = envpool.make(
        name, env_type="gymnasium", num_envs=num_envs, num_threads=len(usable_cores())
    )
    env.reset()
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (64, num_envs, *env.action_space.shape)).astype(np.float64)

    def run() -> None:
        for action in actions:
            env.step(action)

    rate = summary(sample_rates(run, len(actions) * num_envs, seconds))["median"]
    return rate, None


def measure(options: WorldsBench) -> Record:
    """Measure every number of worlds on every engine; the headline's number of worlds first."""
    began = time.perf_counter()
    record_machine = machine()
    each = options.seconds / (len(options.num_envs) * len(options.engines))
    order = sorted(set(options.num_envs), key=lambda n: (n != HEADLINE_WORLDS, n))
    todo = [(engine, num_envs) for engine in options.engines for num_envs in order]
    rows: list[Record] = []
    for index, (engine, num_envs) in enumerate(todo):
        if time.perf_counter() - began > options.limit:
            reason = f"not started after {options.limit:g} s (--limit)"
            skipped = left_out(todo[index:], reason)
            break
        rows.append(measure_row(options.task, engine, num_envs, each))
        if options.keep is not None:
            rest = left_out(todo[index + 1 :], "not done when the part was stopped")
            given = rows, rest, (None, "not reached"), record_machine
            files.write_json(options.keep, record_of(options, *given))
    else:
        skipped = []
    pool = envpool_rate(HEADLINE_WORLDS, each)
    return record_of(options, rows, skipped, pool, record_machine)


def left_out(todo: Sequence[tuple[str, int]], reason: str) -> list[Record]:
    """Return why rows (engine, worlds) are not there."""
    return [{"engine": engine, "num_envs": n, "reason": reason} for engine, n in todo]


def record_of(
    options: WorldsBench,
    measured: Sequence[Record],
    skipped: list[Record],
    pool: tuple[float | None, str | None],
    record_machine: Record,
) -> Record:
    """Return the record of the rows that are measured, see ``measure``.

    Args:
        options: What was asked for.
        measured: The rows.
        skipped: The rows that are not there.
        pool: Rate of EnvPool's quadruped, or why there is none.
        record_machine: The machine before the start.
    """
    rows = sorted(measured, key=lambda row: (row["engine"], row["num_envs"]))
    head = headline(rows, options)
    speedups = {
        str(row["num_envs"]): row["control_steps_per_s"] / other["control_steps_per_s"]
        for row in rows
        for other in rows
        if (row["engine"], other["engine"]) == ("native", "mjx")
        and row["num_envs"] == other["num_envs"]
    }
    return {
        "part": "worlds",
        **head,
        "rows": rows,
        "skipped": skipped,
        "native_over_mjx": speedups,
        "envpool_quadruped_steps_per_s": pool[0],
        "envpool_reason": pool[1],
        "machine": record_machine,
    }


def headline(rows: list[Record], options: WorldsBench) -> Record:
    """Return the row to show first: the default engine at 128 worlds, or the nearest to it."""
    default = resolve_engine("auto", HEADLINE_WORLDS)
    if not rows:
        return {"task": options.task, "control_steps_per_s": None}
    return min(
        rows,
        key=lambda row: (row["engine"] != default, abs(row["num_envs"] - HEADLINE_WORLDS)),
    )
