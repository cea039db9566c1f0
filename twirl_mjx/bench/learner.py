"""Critic updates per second: one learner, a batch of seeds, pinned workers, beside SBX's DroQ.

A minibatch is drawn for every update, as in training and as SBX does. All rates come from one
run, measured in turn (ours, SBX, ours, SBX ...), so that a machine that slows down slows them all.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import NamedSharding, PartitionSpec

from twirl_mjx.bench import matmuls
from twirl_mjx.bench.measure import (
    Chain,
    Record,
    machine,
    progress,
    sample_rates,
    summary,
)
from twirl_mjx.bench.options import LearnerBench
from twirl_mjx.bench.worker import Worker, pinning_missing
from twirl_mjx.droq import forms
from twirl_mjx.droq import learner as droq
from twirl_mjx.machine import usable_cores
from twirl_mjx.replay import mixed, ring
from twirl_mjx.training import sharding

ROWS = 50_000
"""Transitions in the replay, as in the SBX peer."""
BLOCKS = 32
"""Blocks of updates in one compiled call, after which seeds wait for each other.

With few, that waiting is measured: an epoch of training is longer still."""


def random_ring(options: LearnerBench, seeds: int) -> ring.RingBuffer:
    """Return full replays of random rows, of the ranges that the SBX peer uses too.

    Drawn by numpy, which compiles nothing. With more than one seed, leaves are [S, ...] and all
    seeds have the same rows: drawing those of 128 on the host would take 5.5 GB of it.
    """
    rng = np.random.default_rng(0)

    def normal() -> np.ndarray:
        return rng.standard_normal((ROWS, options.obs), np.float32)

    ends = rng.uniform(size=(ROWS, 1)) < 0.01
    reward = rng.uniform(0, 2, (ROWS, 1))
    action = rng.uniform(-1, 1, (ROWS, options.action))
    rows = np.concatenate([normal(), action, reward, ends, normal()], axis=-1, dtype=np.float32)
    one = ring.from_rows(jnp.asarray(rows), options.obs, options.action)
    if seeds == 1:
        return one
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (seeds, *leaf.shape)), one)


def make_learner(options: LearnerBench, seeds: int) -> tuple[Chain, int]:
    """Compile sampling and updates of a batch of learners.

    Returns:
        The compiled chain, and the updates that one call does (of all seeds together).
    """
    config = options.droq

    def init(key: jax.Array) -> droq.DroqState:
        return droq.init(key, config, options.obs, options.action)

    def block(carry: Any, replay: mixed.MixedReplay) -> Any:
        learner, key = carry
        key, sample_key, update_key = jax.random.split(key, 3)
        minibatches = mixed.sample(
            replay, sample_key, num_minibatches=options.utd, batch_size=options.batch, phi=0.0
        )
        return droq.update(learner, config, minibatches, update_key)[0], key

    def run(carry: Any, online: ring.RingBuffer) -> Any:
        replay = mixed.MixedReplay(source=None, online=online)
        return jax.lax.scan(lambda c, _: (block(c, replay), None), carry, length=BLOCKS)[0]

    learner, online = jax.jit(init)(jax.random.key(0)), random_ring(options, seeds)
    if seeds == 1:
        return Chain(run, (learner, jax.random.key(1)), online), BLOCKS * options.utd
    # One first state for all seeds: what they draw differs, and only the time matters.
    learners = jax.tree.map(lambda x: jnp.asarray(np.stack([np.asarray(x)] * seeds)), learner)
    state = learners, jax.random.split(jax.random.key(1), seeds)
    work = BLOCKS * options.utd * seeds
    devices = sharding.devices_for(seeds)
    if devices == 1:
        return Chain(jax.vmap(run), state, online), work
    mesh = sharding.device_mesh(sharding.SEEDS, devices)
    spec = PartitionSpec(sharding.SEEDS)
    local = _alone(run) if devices == seeds else jax.vmap(run)  # as seeds.batch_epoch does
    spread = jax.shard_map(local, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False)
    return Chain(spread, *jax.device_put((state, online), NamedSharding(mesh, spec))), work


def _alone(run: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """Return ``run`` for a batch of one, without a batch axis inside."""

    def of_one(carry: Any, online: Any) -> Any:
        carry, online = jax.tree.map(lambda leaf: leaf[0], (carry, online))
        return jax.tree.map(lambda leaf: leaf[None], run(carry, online))

    return of_one


def make_bound(options: LearnerBench, layout: matmuls.Layout) -> tuple[Chain, int]:
    """Compile the bare matrix products; returns the chain and the updates of one call."""
    shapes = matmuls.Shapes(options.obs, options.action, options.batch, options.hidden, options.utd)
    tensors = matmuls.to_layout(matmuls.inputs(shapes), layout)

    def run(_: Any, given: dict[str, jax.Array]) -> Any:
        return matmuls.block(given, layout, options.matmul_dtype)

    shape = jax.eval_shape(run, None, tensors)
    first = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shape)
    return Chain(run, first, tensors, donate=False), options.utd


def make_bounds(options: LearnerBench) -> dict[matmuls.Layout, tuple[Chain, int]]:
    """Compile the bare products in every layout that runs: on a CPU one lacks bfloat16.

    Raises:
        jax.errors.JaxRuntimeError: None runs.
    """
    bounds: dict[matmuls.Layout, tuple[Chain, int]] = {
        layout: make_bound(options, layout) for layout in matmuls.LAYOUTS
    }
    refusals = []
    for layout, (chain, _) in list(bounds.items()):
        try:
            chain()
        except jax.errors.JaxRuntimeError as refusal:
            refusals.append(refusal)
            del bounds[layout]
    if not bounds:
        raise refusals[0]
    return bounds


def sbx_missing(options: LearnerBench) -> str | None:
    """Return why SBX cannot be measured, or None."""
    if not options.sbx:
        return "switched off (--no-sbx)"
    if not _sbx_python().is_file():
        return "no environment .venv-bench (make bench-setup)"
    if options.hidden != 256:
        return f"the SBX peer has 256 hidden units, not {options.hidden}"
    return None


def _sbx_python() -> Path:
    return Path(__file__).resolve().parents[2] / ".venv-bench" / "bin" / "python"


def sbx_samples(options: LearnerBench, seconds: float) -> list[float]:
    """Run SBX's DroQ in a process of its own; returns critic updates per second.

    Raises:
        RuntimeError: It failed; the message has the end of its output.
    """
    sizes = {
        "obs-size": options.obs,
        "action-size": options.action,
        "batch-size": options.batch,
        "utd": options.utd,
        "rows": ROWS,
        "seconds": seconds,
    }
    script = Path(__file__).with_name("sbx_peer.py")
    command = [str(_sbx_python()), "-W", "ignore", "-P", str(script)]
    command += [text for name, value in sizes.items() for text in (f"--{name}", str(value))]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    if done.returncode:
        raise RuntimeError(f"the SBX peer failed: {done.stderr.strip()[-500:]}")
    return json.loads(done.stdout.splitlines()[-1])["samples"]


def measure(options: LearnerBench) -> Record:
    """Measure everything in turn, ``options.rounds`` times."""
    jax.config.update("jax_enable_compilation_cache", False)  # compile_s is cold
    sharding.make_cpu_devices(options.num_seeds)
    record_machine = machine()
    reasons = {"sbx": sbx_missing(options), "workers": pinning_missing(options.num_workers)}
    progress("bench learner: compiling")
    single, updates = make_learner(options, 1)
    batch, batch_updates = single, updates
    if options.num_seeds > 1:
        batch, batch_updates = make_learner(options, options.num_seeds)
    bounds = make_bounds(options)
    kinds = 3 + sum(reason is None for reason in reasons.values())
    turn = options.seconds / options.rounds / kinds
    found: dict[str, list[float]] = {}

    with contextlib.ExitStack() as stack:
        workers: list[Worker] = []
        if reasons["workers"] is None:
            cpus = usable_cores()[: options.num_workers]
            alone = dataclasses.replace(options, workers=0)  # a worker sees one CPU only
            given = dataclasses.asdict(alone)
            workers = [stack.enter_context(Worker("learner", given, cpu=cpu)) for cpu in cpus]
        for worker in workers:
            worker.wait_until_ready()
        for number in range(options.rounds):
            progress(f"bench learner: round {number + 1} of {options.rounds}")
            found.setdefault("single", []).extend(sample_rates(single, updates, turn))
            if reasons["sbx"] is None:
                found.setdefault("sbx", []).extend(sbx_samples(options, turn))
            found.setdefault("seeds", []).extend(sample_rates(batch, batch_updates, turn))
            for worker in workers:
                worker.start(turn)
            for i, worker in enumerate(workers):
                found.setdefault(f"worker {i}", []).extend(worker.samples())
            for layout, (chain, work) in bounds.items():
                found.setdefault(layout, []).extend(sample_rates(chain, work, turn / len(bounds)))
    return _record(options, found, reasons, single.compile_s, batch.compile_s) | {
        "machine": record_machine
    }


def _record(
    options: LearnerBench,
    found: dict[str, list[float]],
    reasons: dict[str, str | None],
    compile_s: float,
    seeds_compile_s: float,
) -> Record:
    """Arrange the samples; a rate that was not measured is None and has a reason."""
    detail = {name: summary(samples) for name, samples in found.items()}
    median = {name: part["median"] for name, part in detail.items()}
    sbx = median.get("sbx")
    workers = [rate for name, rate in median.items() if name.startswith("worker ")]
    together = {"vmap": median["seeds"]} | ({"workers": sum(workers)} if workers else {})
    best = max(together, key=lambda name: together[name])
    layout = max((name for name in matmuls.LAYOUTS if name in median), key=lambda n: median[n])
    shapes = matmuls.Shapes(options.obs, options.action, options.batch, options.hidden, options.utd)
    return {
        "part": "learner",
        "critic_updates_per_s": median["single"],
        **detail["single"],
        "matmul_bound_updates_per_s": median[layout],
        "matmul_bound_layout": layout,
        "matmul_gflop_per_update": matmuls.flops(shapes) / 1e9,
        "share_of_matmul_bound": median["single"] / median[layout],
        "seeds": options.num_seeds,
        "seeds_devices": sharding.devices_for(options.num_seeds),
        "seeds_updates_per_s": together["vmap"],
        "workers": len(workers),
        "workers_updates_per_s": together.get("workers"),
        "workers_reason": reasons["workers"],
        "aggregate_updates_per_s": together[best],
        "aggregate_by": best,
        "sbx_updates_per_s": sbx,
        "sbx_reason": reasons["sbx"],
        "ratio_to_sbx": None if sbx is None else median["single"] / sbx,
        "aggregate_ratio_to_sbx": None if sbx is None else together[best] / sbx,
        "compile_s": compile_s,
        "seeds_compile_s": seeds_compile_s,
        "form": forms.name_of(options.droq),
        "detail": detail,
        **{name: getattr(options, name) for name in ("obs", "action", "batch", "utd", "hidden")},
        "matmul_dtype": options.matmul_dtype,
    }
