from __future__ import annotations

import numpy as np
import pytest

from twirl_mjx.deploy.conditions import IDEAL
from twirl_mjx.view.stage import Actor, Stage


class Still:
    """Holds the default pose: four feet on the ground."""

    def act(self, obs: np.ndarray) -> np.ndarray:
        del obs
        return np.zeros(12, np.float32)


@pytest.fixture
def still() -> Stage:
    """A robot that stands still in task biped, in the ideal loop."""
    return Stage({"still": Actor(Still(), "biped")}, config=IDEAL)
