"""Named settings: the paper's numbers, two CPU cores, and seconds for tests."""

from __future__ import annotations

import dataclasses

from twirl_mjx.checks import check_choice
from twirl_mjx.config import (
    SOURCE_OF,
    TASKS,
    DroqConfig,
    EnvConfig,
    EvalConfig,
    ImitateConfig,
    ReplayConfig,
    StandConfig,
    TrainConfig,
)

PRESETS = ("paper", "cpu", "debug")


def _paper(task: str) -> TrainConfig:
    sourced = task in SOURCE_OF
    return TrainConfig(
        task=task,
        variant="twirl" if sourced else "scratch",
        stand=StandConfig(height_of="front_feet", risen_fraction=0.0),
        imitate=ImitateConfig(standing_fraction=0.2),
    )


CPU_ENV_STEPS = {"stand": 1_200_000, "biped": 800_000, "imitate": 1_600_000, "hurdles": 1_200_000}
"""Transitions per task that fit two CPU cores in about an hour each."""


CPU_DISCOUNT = {"stand": 0.97, "biped": 0.97, "imitate": 0.95, "hurdles": 0.97}
"""Discounts: 0.97 leaves the safe poor optimum of sitting, 0.95 is that of Peng et al. 2020."""


def _cpu(task: str) -> TrainConfig:
    """The same method, sized for two cores (docs/lab-notes.md has the run behind each choice)."""
    base = _paper(task)
    if task == "imitate":  # random actions hardly ever track the clip: it starts from planned ones
        base = dataclasses.replace(base, variant="twirl", source="clip")
    return dataclasses.replace(
        base,
        total_env_steps=CPU_ENV_STEPS[task],
        warmup_env_steps=6400,
        epoch_env_steps=3200,
        env=EnvConfig(num_envs=64, train_episode_length=100 if task == "stand" else None),
        droq=DroqConfig(
            hidden_sizes=(128, 128),
            utd=0.5,
            updates_per_block=8,
            initial_temperature=0.1,
            discount=CPU_DISCOUNT[task],
        ),
        eval=EvalConfig(every=96_000, episodes=32),
        stand=StandConfig(height_of="front_feet", risen_fraction=0.9),
    )


def _debug(task: str) -> TrainConfig:
    base = _paper(task)
    return dataclasses.replace(
        base,
        total_env_steps=96,
        warmup_env_steps=32,
        epoch_env_steps=32,
        env=EnvConfig(num_envs=4, episode_length=20),
        droq=DroqConfig(utd=1.0, updates_per_block=4, batch_size=16, hidden_sizes=(32, 32)),
        replay=ReplayConfig(capacity=1000, source_size=64),
        eval=EvalConfig(every=64, episodes=2, final_episodes=4),
        checkpoint_minutes=0.0,
    )


def source_task_of(config: TrainConfig) -> str:
    """Return the task whose policy is the source of a run that names none.

    Raises:
        ValueError: The task has no such source.
    """
    if config.task not in SOURCE_OF:
        raise ValueError(
            f"task {config.task} has no source policy of its own, so variant {config.variant!r}"
            " needs one named with --source (nearest variant without: 'scratch')"
        )
    return SOURCE_OF[config.task]


def starts_from_nominal_run(config: TrainConfig, preset: str) -> bool:
    """Return whether a run adapts a finished run of its own task to a shift.

    It does unless it names another source than the preset would without the shift.
    """
    plain = make_config(config.task, preset).source
    return config.shift != "none" and config.source in ("auto", "train", plain)


def make_config(task: str, preset: str = "paper") -> TrainConfig:
    """Return the config of a task under a preset.

    Args:
        task: One of ``TASKS``.
        preset: ``paper`` (the paper's numbers), ``cpu`` (the same method, settings for two CPU
            cores) or ``debug`` (seconds, for tests).

    Raises:
        ValueError: Unknown task or preset, with the nearest valid name.
    """
    check_choice("task", task, TASKS)
    check_choice("preset", preset, PRESETS)
    return {"paper": _paper, "cpu": _cpu, "debug": _debug}[preset](task)
