"""Two simulated devices against one; in a child process, because XLA fixes devices at its start."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap

import pytest

CHILD = """
    import dataclasses
    import jax
    import jax.numpy as jnp
    import numpy as np
    import pytest
    from twirl_mjx.presets import make_config
    from twirl_mjx.tasks.registry import make_env
    from twirl_mjx.training import seeds, sharding, state

    assert jax.device_count() == 2
    base = make_config("stand", "debug")
    config = dataclasses.replace(  # epochs of two vector steps, updates after the first of all
        base,
        env=dataclasses.replace(base.env, engine="ENGINE", num_envs=4),
        droq=dataclasses.replace(base.droq, hidden_sizes=(32,)),
        warmup_env_steps=4,
        epoch_env_steps=8,
    )
    env = make_env(config, training=True, threads=1)

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
    check(
        batch(),
        sharding.shard_seeds(batch(), mesh),
        seeds.compile_epoch_seeds(config, env),
        sharding.compile_epoch_seeds(config, env, mesh),
        "seeds",
    )
    three = jax.eval_shape(lambda: seeds.init_seeds(config, env, [0, 1, 2], None))
    with pytest.raises(ValueError, match="seeds is 3, not a multiple of the 2 devices"):
        sharding.shard_seeds(three, mesh)
    print("the same")
"""

WORLDS = """
    mesh = sharding.device_mesh("worlds")
    check(
        single(),
        sharding.shard_worlds(single(), mesh),
        state.compile_epoch(config, env),
        sharding.compile_epoch_worlds(config, env, mesh),
        "worlds",
    )
    odd = make_env(config, num_envs=3)
    with pytest.raises(ValueError, match=r"env.num_envs is 3.*nearest: 4"):
        sharding.ShardedEnv(odd, mesh)
    print("the same")
"""


def run_child(body: str, engine: str, error: float) -> None:
    """Run a comparison in which numbers may differ by ``error``, relative and absolute.

    A device computes for a part of the seeds or worlds; compiled for other sizes, sums round
    differently, and contacts amplify that, so the comparison covers 0.2 s of simulated time.
    """
    code = textwrap.dedent(CHILD) + textwrap.dedent(body)
    child = dict(os.environ)
    child["XLA_FLAGS"] = "--xla_force_host_platform_device_count=2"
    done = subprocess.run(
        [sys.executable, "-c", code.replace("ENGINE", engine).replace("ERROR", str(error))],
        env=child,
        capture_output=True,
        text=True,
        timeout=1800,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert done.stdout.endswith("the same\n")


def test_seeds_on_two_devices() -> None:
    run_child(SEEDS, "native", 1e-3)


@pytest.mark.slow
@pytest.mark.timeout(1900)
def test_worlds_on_two_devices() -> None:
    run_child(WORLDS, "native", 1e-3)


@pytest.mark.slow
@pytest.mark.timeout(1900)
@pytest.mark.parametrize("body", [SEEDS, WORLDS], ids=["seeds", "worlds"])
def test_mjx_on_two_devices(body: str) -> None:
    run_child(body, "mjx", 1e-2)
