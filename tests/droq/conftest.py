"""Small learners and random minibatches for the tests of the learner."""

from __future__ import annotations

from collections.abc import Callable

import jax
import pytest

from twirl_mjx.droq.config import DroqConfig
from twirl_mjx.types import Transition

OBS_SIZE, ACTION_SIZE = 5, 2


def random_transitions(key: jax.Array, *shape: int) -> Transition:
    """Draw transitions [*shape, ...]; a fifth of them terminate."""
    keys = jax.random.split(key, 5)
    return Transition(
        obs=jax.random.normal(keys[0], (*shape, OBS_SIZE)),
        action=jax.random.uniform(keys[1], (*shape, ACTION_SIZE), minval=-1.0),
        reward=jax.random.normal(keys[2], shape),
        terminated=jax.random.bernoulli(keys[3], 0.2, shape),
        next_obs=jax.random.normal(keys[4], (*shape, OBS_SIZE)),
    )


@pytest.fixture
def transitions() -> Callable[..., Transition]:
    """The function above."""
    return random_transitions


@pytest.fixture
def small_config() -> DroqConfig:
    """A learner of two small critics with enough dropout to matter in every step."""
    return DroqConfig(hidden_sizes=(32, 16), batch_size=16, dropout_rate=0.25, learning_rate=1e-2)
