"""Named settings: the paper's numbers, two CPU cores, one GPU full of worlds, seconds for tests."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from twirl_mjx import files, machine
from twirl_mjx.checks import check_choice
from twirl_mjx.tasks.registry import TASKS
from twirl_mjx.training.config import TrainConfig
from twirl_mjx.training.config_json import flatten, settle

SETTINGS: dict[str, Mapping[str, Any]] = {
    "paper": {},
    "cpu": {  # sized for two cores (docs/lab-notes.md has the run behind each choice)
        "total_env_steps": 1_200_000,
        "warmup_env_steps": 6400,
        "epoch_env_steps": 3200,
        "num_envs": 64,
        "droq.hidden_sizes": (128, 128),
        "droq.utd": 0.5,
        "droq.updates_per_block": 8,
        "droq.initial_temperature": 0.1,
        "droq.discount": 0.97,  # leaves the safe poor optimum of sitting
        "eval.every": 96_000,
        "eval.episodes": 32,
    },
    "massive": {  # few updates of large batches per transition; not tuned (docs/lab-notes.md)
        "total_env_steps": 40_960_000,
        "warmup_env_steps": 40_960,
        "epoch_env_steps": 204_800,
        "num_envs": 2048,
        "droq.utd": 32 / 2048,
        "droq.updates_per_block": 8,
        "droq.batch_size": 8192,
        "droq.initial_temperature": 0.1,
        "droq.discount": 0.97,
        "replay.capacity": 2_048_000,
        "eval.every": 2_048_000,
        "eval.episodes": 128,
    },
    "debug": {
        "total_env_steps": 96,
        "warmup_env_steps": 32,
        "epoch_env_steps": 32,
        "num_envs": 4,
        "episode_length": 20,
        "droq.utd": 1.0,
        "droq.updates_per_block": 4,
        "droq.batch_size": 16,
        "droq.hidden_sizes": (32, 32),
        "replay.capacity": 1000,
        "replay.source_size": 64,
        "eval.every": 64,
        "eval.episodes": 4,
        "eval.final_episodes": 4,
        "eval.episode_length": 20,
        "checkpoint_minutes": 0.0,
    },
}
"""Preset -> what departs from the defaults in every task; tasks have more (``Task.presets``)."""
PRESETS = tuple(SETTINGS)

CPU_FLAGS = Path("/proc/cpuinfo")
"""What Linux knows of the CPU."""


def default_preset() -> str:
    """Return ``paper`` where jax has an accelerator, else ``cpu``."""
    if not machine.may_have_accelerator():
        return "cpu"
    import jax

    return "cpu" if jax.default_backend() == "cpu" else "paper"


@functools.cache
def multiplies_bfloat16() -> bool:
    """Return whether the CPU has instructions for products of bfloat16 (``avx512_bf16``).

    Linux says so in ``/proc/cpuinfo``; elsewhere nobody has measured whether they help.
    """
    try:
        text = files.read_text(CPU_FLAGS, "what Linux knows of the CPU")
    except (OSError, ValueError):
        return False
    return "avx512_bf16" in text.split()


def _of_machine(preset: str) -> dict[str, Any]:
    """Return what a preset holds on this machine only: bfloat16 products where the CPU has them.

    They are faster there, and training was not seen to be worse (docs/performance_learner.md).
    """
    fits = preset == "cpu" and multiplies_bfloat16() and not machine.may_have_accelerator()
    return {"droq.matmul_dtype": "bfloat16"} if fits else {}


def make_config(
    task: str, preset: str = "paper", learner: str = TrainConfig.learner
) -> TrainConfig:
    """Return the config of a task under a preset.

    Args:
        task: Name of a task, or ``file.py:Name``.
        preset: ``paper`` (the paper's numbers), ``cpu`` (the same method, settings for two CPU
            cores), ``massive`` (thousands of worlds on one GPU) or ``debug`` (seconds, for tests).
        learner: Name of the learner, or ``file.py:NAME``; of DroQ's settings in a preset it takes
            those that it has too.

    Raises:
        ValueError: Unknown task, preset or learner, with the nearest valid name.
    """
    name = TASKS.admit(task)
    check_choice("preset", preset, PRESETS)
    kind = TASKS.get(name)
    variant = "twirl" if kind.source else "scratch"
    config = TrainConfig(task=name, variant=variant, learner=learner)
    if kind.source:
        source = make_config(kind.source, preset, learner)
        config = settle(config, {f"{kind.source}.{k}": v for k, v in vars(source.options).items()})
    own = dict(kind.presets.get("paper", {})) | dict(kind.presets.get(preset, {}))
    settings = dict(SETTINGS[preset]) | _of_machine(preset) | own
    if config.learner != TrainConfig.learner:
        settings = _of_learner(config, settings)
    return settle(config, settings)


def _of_learner(config: TrainConfig, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings with DroQ's handed to another learner, as far as it has them."""
    known, own = flatten(config), f"{TrainConfig.learner}."
    renamed = {
        f"{config.learner}.{name.removeprefix(own)}" if name.startswith(own) else name: value
        for name, value in settings.items()
    }
    return {name: value for name, value in renamed.items() if name in known}


def source_task_of(config: TrainConfig) -> str:
    """Return the task whose policy is the source of a run that names none.

    Raises:
        ValueError: The task has no such source.
    """
    if config.task_type.source is None:
        raise ValueError(
            f"task {config.task} has no source policy of its own, so variant {config.variant!r}"
            " needs one named with --source (nearest variant without: 'scratch')"
        )
    return config.task_type.source


def starts_from_nominal_run(config: TrainConfig, preset: str) -> bool:
    """Return whether a run adapts a finished run of its own task to a shift.

    It does unless it names another source than the preset would without the shift.
    """
    plain = make_config(config.task, preset).source
    return config.shift != "none" and config.source in ("auto", "train", plain)
