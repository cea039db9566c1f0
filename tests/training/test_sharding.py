"""Seeds and worlds on a mesh: what goes where, and two simulated devices against one.

Two devices need a child process, because XLA fixes its devices when it starts.
"""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap
from pathlib import Path

import jax
import pytest

from twirl_mjx.training import seeds, sharding, state
from twirl_mjx.training.config import TrainConfig
from twirl_mjx.training.state import TrainState
from twirl_mjx.worlds.make import make_env
from twirl_mjx.worlds.vector import VectorEnv

CHILD = """
    import dataclasses
    import jax
    import jax.numpy as jnp
    import numpy as np
    import pytest
    from twirl_mjx.training.presets import make_config
    from twirl_mjx.worlds.make import make_env
    from twirl_mjx.training import seeds, sharding, state

    assert jax.device_count() == 2
    base = make_config("stand", "debug")
    config = dataclasses.replace(  # epochs of two vector steps, updates after the first of all
        base,
        engine="ENGINE", num_envs=4,
        droq=dataclasses.replace(base.droq, hidden_sizes=(32,)),
        warmup_env_steps=4,
        epoch_env_steps=8,
    )
    env = make_env(config, threads=1)

    def single():
        init = jax.jit(lambda key: state.init(config, env, key, None))
        return init(jax.random.key(5))

    def batch():
        return seeds.init_seeds(config, env, [3, 5], None)

    def values(tree):
        is_key = lambda x: jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
        leaves = jax.tree.leaves(tree)
        return [np.asarray(jax.random.key_data(x) if is_key(x) else x) for x in leaves]

    def check(one, two, epoch_one, epoch_two, axis):
        assert len(two.env.reward.sharding.device_set) == 2
        for number in range(2):
            one, metrics_one = epoch_one(one)
            two, metrics_two = epoch_two(two)
            for name in metrics_one:
                np.testing.assert_allclose(
                    metrics_two[name], metrics_one[name], rtol=ERROR, atol=ERROR, err_msg=name
                )
            for a, b in zip(values(one), values(two), strict=True):
                np.testing.assert_allclose(b, a, rtol=ERROR, atol=ERROR)
            assert two.env.reward.sharding.spec == jax.sharding.PartitionSpec(axis)
        assert epoch_two._cache_size() == 1
        assert (np.asarray(one.learner.grad_steps) == 12).all()
"""

SEEDS = """
    mesh = sharding.device_mesh("seeds")
    epoch, place = sharding.spread_seeds(config, env, mesh)
    check(batch(), place(batch()), seeds.compile_epoch_seeds(config, env), epoch, "seeds")
    three = jax.eval_shape(lambda: seeds.init_seeds(config, env, [0, 1, 2], None))
    with pytest.raises(ValueError, match="seeds is 3, not a multiple of the 2 devices"):
        place(three)
    print("the same")
"""

WORLDS = """
    mesh = sharding.device_mesh("worlds")
    epoch, place = sharding.spread_worlds(config, env, mesh)
    check(single(), place(single()), state.compile_epoch(config, env), epoch, "worlds")
    odd = make_env(config, num_envs=3)
    with pytest.raises(ValueError, match=r"num_envs is 3.*nearest: 4"):
        sharding.ShardedEnv(odd, mesh)
    print("the same")
"""


PROGRAM = """
    from twirl_mjx import cli
    from twirl_mjx.training.program import Program

    sharding.worlds_pay = lambda: True  # as on accelerators
    words = "train --task stand --preset debug --variant scratch --num-envs 4"
    words += " --droq.hidden-sizes 32 --warmup-env-steps 64 --epoch-env-steps 64 --runs FOLDER"
    for count in (1, 2, 3):
        chosen = ["--name", f"run{count}", "--seeds", *map(str, range(count))]
        for total in ("128", "256"):  # the second call resumes
            assert cli.main([*words.split(), *chosen, "--total-env-steps", total]) == 0
    assert [Program([config] * count).idle_devices for count in (1, 2)] == [None, None]
    print("the same")
"""


CORES = """
    from pathlib import Path

    import jax
    import numpy as np
    from twirl_mjx import cli
    from twirl_mjx.machine import usable_cores
    from twirl_mjx.training import sharding

    words = "train --task stand --preset debug --variant scratch --droq.hidden-sizes 32"
    words += " --warmup-env-steps 64 --epoch-env-steps 64 --runs FOLDER"

    def train(name, total, *seeds):
        chosen = ["--name", name, "--total-env-steps", str(total), "--seeds", *map(str, seeds)]
        assert cli.main([*words.split(), *chosen]) == 0

    def weights(name):
        with np.load(Path("FOLDER") / name / "policy_last.npz") as file:
            return {key: file[key] for key in file.files if file[key].dtype == np.float32}

    train("parts", 128, 3, 5)
    assert jax.device_count() == sharding.num_cpu_devices(2, len(usable_cores()))
    train("parts", 256, 3, 5)
    train("whole", 256, 3, 5)
    train("alone", 256, 5)
    for seed in (3, 5):
        parts, whole = weights(f"parts-s{seed}"), weights(f"whole-s{seed}")
        assert parts.keys() == whole.keys() and len(parts) >= 4
        for key in whole:
            np.testing.assert_array_equal(parts[key], whole[key], err_msg=key)
    for key, value in weights("alone-s5").items():  # whole is that of seed 5
        np.testing.assert_allclose(whole[key], value, atol=1e-4, err_msg=key)
    print("the same")
"""


def run_child(body: str, engine: str, error: float) -> str:
    """Run a comparison in which numbers may differ by ``error``, relative and absolute.

    A device computes for a part of the seeds or worlds; compiled for other sizes, sums round
    differently, and contacts amplify that, so the comparison covers 0.2 s of simulated time.
    """
    code = textwrap.dedent(CHILD) + textwrap.dedent(body)
    flag = " --xla_force_host_platform_device_count=2"
    return run_python(code.replace("ENGINE", engine).replace("ERROR", str(error)), flag)


def run_python(code: str, flag: str = "") -> str:
    """Run a program in a process of its own that may choose its devices; returns its output."""
    child = {name: value for name, value in os.environ.items() if name != "JAX_NUM_CPU_DEVICES"}
    child["XLA_FLAGS"] += flag  # conftest has set it
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=child,
        capture_output=True,
        text=True,
        timeout=1800,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert done.stdout.endswith("the same\n")
    return done.stdout


@pytest.fixture(scope="module")
def env(stand_config: TrainConfig) -> VectorEnv:
    return make_env(stand_config, threads=1)


def test_epochs_keep_the_shapes_of_their_state(stand_config: TrainConfig, env: VectorEnv) -> None:
    """On a mesh of the devices there are; traced, not compiled."""
    single = jax.eval_shape(lambda key: state.init(stand_config, env, key, None), jax.random.key(0))
    epoch, _ = sharding.spread_worlds(stand_config, env, sharding.device_mesh("worlds"))
    after, metrics = jax.eval_shape(epoch, single)
    assert shapes(after) == shapes(single)
    assert {value.shape for value in metrics.values()} == {()}

    chosen = list(range(2 * jax.device_count()))
    batch = jax.eval_shape(lambda: seeds.init_seeds(stand_config, env, chosen, None))
    epoch, _ = sharding.spread_seeds(stand_config, env, sharding.device_mesh("seeds"))
    after, metrics = jax.eval_shape(epoch, batch)
    assert shapes(after) == shapes(batch)
    assert {value.shape for value in metrics.values()} == {(len(chosen),)}


def shapes(tree: TrainState) -> list[tuple[tuple[int, ...], str]]:
    return [(leaf.shape, str(leaf.dtype)) for leaf in jax.tree.leaves(tree)]


@pytest.mark.parametrize(
    ("num_seeds", "on_1_2_4_16_cores"),
    [
        (1, [1, 1, 1, 1]),
        (2, [1, 2, 2, 2]),
        (3, [1, 3, 3, 3]),  # three devices on two cores, which share them
        (4, [1, 2, 4, 4]),
        (5, [1, 1, 5, 5]),  # five on two cores would be too many
        (6, [1, 2, 6, 6]),
        (8, [1, 2, 4, 8]),
        (32, [1, 2, 4, 16]),
    ],
)
def test_cpu_devices_fill_the_cores(num_seeds: int, on_1_2_4_16_cores: list[int]) -> None:
    assert [sharding.num_cpu_devices(num_seeds, c) for c in (1, 2, 4, 16)] == on_1_2_4_16_cores


@pytest.mark.parametrize(("devices", "threads"), [(1, 4), (2, 2), (3, 1), (8, 1)])
def test_devices_share_the_cores_for_their_worlds(
    devices: int, threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sharding, "usable_cores", lambda: [0, 1, 2, 3])
    monkeypatch.setattr(sharding, "devices_for", lambda num_seeds: devices)
    assert sharding.threads_for(24) == threads


def test_a_number_of_cpu_devices_that_was_set_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []
    monkeypatch.setattr(jax.config, "update", lambda _, value: asked.append(value))
    sharding.make_cpu_devices(4)  # conftest sets JAX_NUM_CPU_DEVICES
    assert asked == []


@pytest.mark.slow
@pytest.mark.timeout(1900)
def test_a_batch_of_seeds_has_a_device_a_core(tmp_path: Path) -> None:
    said = run_python(textwrap.dedent(CORES.replace("FOLDER", str(tmp_path))))
    assert "device is used" not in said and said.endswith("the same\n")


@pytest.mark.slow
@pytest.mark.timeout(1900)
@pytest.mark.parametrize("body", [SEEDS, WORLDS], ids=["seeds", "worlds"])
def test_native_on_two_devices(body: str) -> None:
    run_child(body, "native", 1e-3)


@pytest.mark.slow
@pytest.mark.timeout(1900)
@pytest.mark.parametrize("body", [SEEDS, WORLDS], ids=["seeds", "worlds"])
def test_mjx_on_two_devices(body: str) -> None:
    run_child(body, "mjx", 1e-2)


@pytest.mark.slow
@pytest.mark.timeout(1900)
def test_a_command_uses_the_devices_there_are(tmp_path: Path) -> None:
    said = run_child(PROGRAM.replace("FOLDER", str(tmp_path)), "native", 1e-3)
    refusal = "one device is used: seeds is 3, not a multiple of the 2 devices (nearest: 4)"
    assert said.count(refusal) == 2  # both calls, of this batch alone
    assert "one device is used" not in said.replace(refusal, "")
