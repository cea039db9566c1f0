"""What a GPU must do as a CPU does; ``make test-gpu`` on a machine with one."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path

import jax
import numpy as np
import pytest

from twirl_mjx.bench import parity
from twirl_mjx.training import state as training
from twirl_mjx.training.presets import make_config
from twirl_mjx.worlds.make import make_env

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(jax.default_backend() == "cpu", reason="jax has no accelerator here"),
]


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> parity.Numbers:
    """The numbers of the CPU of this machine."""
    path: Path = tmp_path_factory.mktemp("parity") / "reference.npz"
    return parity.write(path, {"JAX_PLATFORMS": "cpu"})


@pytest.fixture(scope="module")
def found() -> parity.Numbers:
    return parity.numbers()


@pytest.mark.parametrize("part", parity.TOLERANCE)
def test_parity_with_the_cpu(part: str, found: parity.Numbers, reference: parity.Numbers) -> None:
    errors = {
        name: error
        for name, error in parity.errors(found, reference).items()
        if name.startswith(f"{part}.")
    }
    assert errors
    assert not parity.failures(errors)


def test_deterministic_kernels_give_equal_bits(tmp_path: Path) -> None:
    flags = {"XLA_FLAGS": "--xla_gpu_deterministic_ops=true"}
    first, second = (parity.write(tmp_path / f"{i}.npz", flags) for i in range(2))
    for name in first:
        np.testing.assert_array_equal(first[name], second[name], err_msg=name)


def test_an_epoch_overwrites_its_rings_in_place() -> None:
    base = make_config("stand", "debug")
    replay = dataclasses.replace(base.replay, capacity=1_000_000)
    config = dataclasses.replace(base, replay=replay)
    env = make_env(config)
    init = functools.partial(training.init, config, env, source=None)
    state = jax.eval_shape(init, jax.random.key(0))
    memory = training.compile_epoch(config, env).lower(state).compile().memory_analysis()
    ring = 4 * state.replay.online.rows.size
    assert memory.alias_size_in_bytes >= ring
    assert memory.temp_size_in_bytes < 0.1 * ring
