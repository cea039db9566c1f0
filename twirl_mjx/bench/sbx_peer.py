"""Measure SBX's DroQ as the peer of our learner; runs in an environment of its own.

Started by path, as ``.venv-bench/bin/python -P twirl_mjx/bench/sbx_peer.py``, because SBX needs an
older jax than the package: nothing of ours is imported (``-P`` also keeps this folder off the
module path). Prints one JSON object on stdout.

The configuration is the one SBX documents for DroQ (SAC with dropout, layer norm and a delayed
policy), with the paper's sizes. The replay is filled beforehand with random rows, so no
environment is stepped; sampling minibatches from the replay is part of what is timed, as it is
part of every update that SBX makes.
"""

# The locked environment of the package has no SBX.
# pyright: reportMissingImports=false

from __future__ import annotations

import argparse
import importlib.metadata
import json
import os
import platform
import statistics
import sys
import time
from typing import Any

import gymnasium
import numpy as np
import sbx

PACKAGES = ("sbx-rl", "stable_baselines3", "jax", "jaxlib", "flax", "optax", "numpy", "gymnasium")


class Shapes(gymnasium.Env[np.ndarray, np.ndarray]):
    """An environment that only has spaces; it is reset once and never stepped."""

    def __init__(self, obs_size: int, action_size: int) -> None:
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (obs_size,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (action_size,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Return zeros."""
        super().reset(seed=seed)
        return np.zeros(self.observation_space.shape or (), np.float32), {}


def make_model(args: argparse.Namespace) -> sbx.SAC:
    """Return SBX's DroQ with a replay of random rows."""
    model = sbx.SAC(
        "MlpPolicy",
        Shapes(args.obs_size, args.action_size),
        buffer_size=args.rows,
        batch_size=args.batch_size,
        gradient_steps=args.utd,
        policy_delay=args.utd,
        learning_rate=3e-4,
        tau=0.005,
        gamma=0.99,
        ent_coef="auto_1.0",
        target_entropy=-args.action_size / 2,
        policy_kwargs={
            "net_arch": [256, 256],
            "n_critics": 2,
            "dropout_rate": 0.01,
            "layer_norm": True,
        },
        seed=args.seed,
    )
    model.learn(total_timesteps=0)  # sets up the logger, steps nothing
    rng = np.random.default_rng(args.seed)
    buffer = model.replay_buffer
    for _ in range(args.rows):
        buffer.add(
            rng.standard_normal((1, args.obs_size), np.float32),
            rng.standard_normal((1, args.obs_size), np.float32),
            rng.uniform(-1, 1, (1, args.action_size)).astype(np.float32),
            rng.uniform(0, 2, 1).astype(np.float32),
            rng.uniform(size=1) < 0.01,
            [{}],
        )
    return model


def timed_train(model: sbx.SAC, calls: int, args: argparse.Namespace) -> float:
    """Return the seconds that ``calls`` blocks of ``utd`` critic updates take.

    ``train`` fetches the losses before it returns, so no work is left running.
    """
    start = time.perf_counter()
    for _ in range(calls):
        model.train(gradient_steps=args.utd, batch_size=args.batch_size)
    return time.perf_counter() - start


def measure(args: argparse.Namespace) -> dict[str, Any]:
    """Return critic updates per second, samples of about a second each, compilation apart."""
    model = make_model(args)
    compile_s = timed_train(model, 1, args)
    calls = max(1, round(3 / timed_train(model, 3, args)))
    updates = calls * args.utd
    samples = []
    deadline = time.perf_counter() + args.seconds
    while len(samples) < 3 or time.perf_counter() < deadline:
        samples.append(updates / timed_train(model, calls, args))
    return {
        "critic_updates_per_s": statistics.median(samples),
        "samples": samples,
        "updates_per_sample": updates,
        "compile_s": compile_s,
        "settings": vars(args),
        "cpus": len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count(),
        "versions": {
            "python": platform.python_version(),
            **{name: importlib.metadata.version(name) for name in PACKAGES},
        },
    }


def parse_args() -> argparse.Namespace:
    """Read the command line; the defaults are the sizes of ``biped`` and the paper's DroQ."""
    parser = argparse.ArgumentParser(description="SBX DroQ critic updates per second, as JSON.")
    parser.add_argument("--obs-size", type=int, default=101)
    parser.add_argument("--action-size", type=int, default=12)
    parser.add_argument("--batch-size", type=int, default=256)
    parser.add_argument("--utd", type=int, default=20, help="critic updates per actor update")
    parser.add_argument("--rows", type=int, default=50_000, help="rows in the replay")
    parser.add_argument("--seconds", type=float, default=20.0, help="length of the measurement")
    parser.add_argument("--seed", type=int, default=0)
    return parser.parse_args()


if __name__ == "__main__":
    print(json.dumps(measure(parse_args())))
