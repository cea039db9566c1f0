"""The preset for one GPU full of worlds: its balance, and its reduced form on a CPU."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import twirl_mjx
from twirl_mjx.tasks.registry import TASKS
from twirl_mjx.training.presets import make_config


@pytest.mark.parametrize("task", TASKS.names())
def test_few_updates_of_large_batches_follow_a_step_of_many_worlds(task: str) -> None:
    config = make_config(task, "massive")
    assert (config.num_envs, config.droq.batch_size, config.updates_per_step) == (2048, 8192, 32)
    assert config.blocks_per_step == 4
    assert config.steps_per_epoch * config.num_envs == config.epoch_env_steps
    assert config.droq.utd * config.droq.batch_size == 128  # the replay ratio, that of cpu too
    cpu = make_config(task, "cpu").droq
    assert cpu.utd * cpu.batch_size == 128
    assert config.replay.capacity % config.num_envs == 0


@pytest.mark.slow
def test_its_reduced_form_trains_on_a_cpu(tmp_path: Path) -> None:
    """All sizes of a step by 1/128 but the updates: 16 worlds, batch 64, 32 updates a step."""
    result = twirl_mjx.train(
        "stand",
        preset="massive",
        runs=tmp_path,
        total_env_steps=640,
        warmup_env_steps=320,
        epoch_env_steps=320,
        num_envs=16,
        droq={"utd": 2.0, "batch_size": 64, "hidden_sizes": (32, 32)},
        replay={"capacity": 16_000},
        eval={"every": 320, "episodes": 4, "final_episodes": 4, "episode_length": 20},
    )
    steps, loss = result.curves["critic_loss"]
    assert steps[-1] == 640
    assert np.isfinite(loss[-1])
    assert result.curves["replay_ratio"][1][-1] == 128
    assert (result.directory / "policy.npz").is_file()
