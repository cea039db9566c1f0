"""Numbers that every machine must agree on: learner, physics, a whole epoch.

``python -m twirl_mjx.bench.parity FILE.npz ENGINE...`` writes them for the device that jax chooses,
so ``JAX_PLATFORMS=cpu`` makes the reference that a GPU is compared with (``make test-gpu``,
``make gpu-proof``). Products are in full float32 throughout: what is left is the order of sums.
"""

from __future__ import annotations

import dataclasses
import functools
import os
import subprocess
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from twirl_mjx import array_files
from twirl_mjx.bench.options import DEFAULT_TASK
from twirl_mjx.droq import forms, learner
from twirl_mjx.droq.config import DroqConfig, settings_of
from twirl_mjx.training import state as training
from twirl_mjx.training.presets import make_config
from twirl_mjx.types import Transition
from twirl_mjx.worlds.make import make, make_env

ENGINES = ("native", "mjx")
FAILED = "parity: failed,"
"""Begins the lines on stderr around the reason why some numbers are missing."""
UPDATES, ROWS, OBS, ACTION = 4, 64, 31, 12
WORLDS, STEPS = 8, 4

TOLERANCE = {"learner": 1e-3, "native": 1e-4, "mjx": 1e-4, "epoch": 5e-2}
"""Part -> largest error (see ``errors``) of any of its arrays between two machines. Adam divides
small gradients by their own size, hence no smaller ones."""

Numbers = dict[str, np.ndarray]
"""``part.name`` -> values."""


def learner_numbers() -> Numbers:
    """Return what a few updates change in every form, with the metrics of the block."""
    rng = np.random.default_rng(7)

    def normal(*shape: int) -> jax.Array:
        return jnp.asarray(rng.standard_normal(shape, np.float32))

    minibatches = Transition(
        obs=normal(UPDATES, ROWS, OBS),
        action=jnp.tanh(normal(UPDATES, ROWS, ACTION)),
        reward=jnp.abs(normal(UPDATES, ROWS)),
        terminated=normal(UPDATES, ROWS) > 1.0,
        next_obs=normal(UPDATES, ROWS, OBS),
    )
    out: Numbers = {}
    for form in forms.FORMS:
        out |= _attempt(f"form {form}", functools.partial(_form_numbers, form, minibatches))
    return out


def _form_numbers(form: str, minibatches: Transition) -> Numbers:
    config = DroqConfig(hidden_sizes=(64, 64), batch_size=ROWS, updates_per_block=UPDATES)
    config = dataclasses.replace(config, **settings_of(form))
    old = learner.init(jax.random.key(0), config, OBS, ACTION)
    update = jax.jit(learner.update, static_argnums=1)
    new, metrics = update(old, config, minibatches, jax.random.key(1))
    out: Numbers = {}
    for name in ("actor", "critic", "target_critic"):
        change = jax.tree.map(jnp.subtract, getattr(new, name), getattr(old, name))
        leaves = [np.ravel(leaf) for leaf in jax.tree.leaves(change)]
        out[f"learner.{form}.{name}"] = np.concatenate(leaves)
    return out | {f"learner.{form}.{name}": np.asarray(value) for name, value in metrics.items()}


def _attempt(what: str, make: Callable[[], Numbers]) -> Numbers:
    """Return numbers, or none where making them fails: ``errors`` then shows them as missing."""
    try:
        return make()
    except Exception:  # a new device may refuse one form; what the others give is worth knowing
        print(f"{FAILED} {what}\n{traceback.format_exc()}{FAILED} end", file=sys.stderr)
        return {}


def physics_numbers(engine: str) -> Numbers:
    """Return a few control steps of ``stand`` under the same actions."""
    env = make(DEFAULT_TASK, num_envs=WORLDS, engine=engine)
    actions = np.random.default_rng(5).uniform(-1, 1, (STEPS, WORLDS, ACTION)).astype(np.float32)

    def step(state: Any, action: jax.Array) -> Any:
        state = env.step(state, action)
        return state, (state.data.qpos, state.data.qvel, state.next_obs, state.reward)

    def run(key: jax.Array) -> Any:
        return jax.lax.scan(step, env.reset(key), jnp.asarray(actions))[1]

    names = ("qpos", "qvel", "next_obs", "reward")
    found = jax.jit(run)(jax.random.key(3))
    return {f"{engine}.{n}": np.asarray(v) for n, v in zip(names, found, strict=True)}


def epoch_numbers() -> Numbers:
    """Return the metrics of a first epoch with updates: warm-up, acting, rings, learner."""
    base = dataclasses.replace(make_config(DEFAULT_TASK, "debug"), variant="scratch")
    config = dataclasses.replace(base, engine="native", warmup_env_steps=8)
    env = make_env(config)
    state = training.init(config, env, jax.random.key(0), None)
    _, metrics = training.compile_epoch(config, env)(state)
    return {f"epoch.{name}": np.asarray(value) for name, value in metrics.items()}


def numbers(engines: Sequence[str] = ENGINES) -> Numbers:
    """Return all numbers, made on the device that jax uses."""
    with jax.default_matmul_precision("highest"):
        out = learner_numbers()
        for engine in engines:
            out |= _attempt(f"engine {engine}", functools.partial(physics_numbers, engine))
        return out | _attempt("an epoch", epoch_numbers)


def is_complete(found: Mapping[str, np.ndarray], engines: Sequence[str] = ENGINES) -> bool:
    """Return whether numbers have every form, engine and an epoch."""
    parts = [f"learner.{form}." for form in forms.FORMS] + [f"{e}." for e in engines] + ["epoch."]
    return all(any(name.startswith(part) for name in found) for part in parts)


def errors(found: Mapping[str, np.ndarray], want: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Return the relative error of every array; infinite where one is missing or not finite.

    It is the norm of the difference over the norm wanted: of the whole array, or, for physics, of
    each world, and then the median over worlds. A start that differs in the last digit of one
    position takes some worlds several per cent apart within a control step, when a foot touches
    down on one side only; most worlds stay together to rounding.
    """
    out = {}
    for name in {**want, **found}:
        if name not in want or name not in found or found[name].shape != want[name].shape:
            out[name] = float("inf")
            continue
        a, b = (_parts(name, values[name]) for values in (found, want))
        both = np.isnan(a) & np.isnan(b)  # what was not measured on either
        a, b = np.where(both, 0.0, a), np.where(both, 0.0, b)
        each = np.linalg.norm(a - b, axis=1) / (np.linalg.norm(b, axis=1) + 1e-9)
        error = float(np.median(each))
        out[name] = error if np.isfinite(error) else float("inf")
    return out


def _parts(name: str, values: np.ndarray) -> np.ndarray:
    """Return a row for each world, or one for an array of anything else."""
    values = np.asarray(values, np.float64)
    if name.split(".")[0] in ENGINES:  # [STEPS, WORLDS, ...]
        return np.moveaxis(values, 1, 0).reshape(values.shape[1], -1)
    return values.reshape(1, -1)


def failures(found: Mapping[str, float]) -> list[str]:
    """Return a line for every array whose error is above that of its part."""
    return [
        f"{name}: {error:.1e} > {TOLERANCE[name.split('.')[0]]:.0e}"
        for name, error in found.items()
        if not error <= TOLERANCE[name.split(".")[0]]
    ]


def write(
    path: Path,
    environment: Mapping[str, str],
    timeout: float | None = None,
    engines: Sequence[str] = ENGINES,
) -> Numbers:
    """Return the numbers of a process of their own, which leaves them in a file.

    Args:
        path: The file, ``.npz``.
        environment: Variables that the process sees beside ours (``JAX_PLATFORMS``).
        timeout: s, after which it is ended.
        engines: Whose physics are among them.

    Raises:
        RuntimeError: It failed; the message has the end of its output.
        subprocess.TimeoutExpired: It took too long.
    """
    command = [sys.executable, "-m", "twirl_mjx.bench.parity", str(path), *engines]
    done = subprocess.run(
        command,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=timeout,
        check=False,
    )
    if done.returncode:
        raise RuntimeError(f"the numbers of parity failed: {done.stderr.strip()[-500:]}")
    for number, part in enumerate(done.stderr.split(FAILED)):
        if number % 2:  # between two marks
            print(f"{FAILED}{part.rstrip()}", file=sys.stderr)
    return array_files.read_npz(path, "numbers of parity")


if __name__ == "__main__":
    array_files.write_npz(sys.argv[1], numbers(sys.argv[2:]), compressed=True)
