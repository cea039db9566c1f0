"""Small training runs shared by the tests of this folder."""

from __future__ import annotations

import dataclasses

import pytest

from twirl_mjx.training.config import TrainConfig
from twirl_mjx.training.presets import make_config


@pytest.fixture(scope="session")
def stand_config() -> TrainConfig:
    """A stand run of three epochs of 32 transitions, updates after the first."""
    return make_config("stand", "debug")


@pytest.fixture(scope="session")
def short_stand_config(stand_config: TrainConfig) -> TrainConfig:
    """The same run, stopped after two epochs."""
    return dataclasses.replace(stand_config, total_env_steps=64)
