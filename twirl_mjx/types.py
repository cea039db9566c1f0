"""Types shared by every package: transitions, metrics and the policy protocols."""

from __future__ import annotations

from typing import Any, Protocol

import flax.struct
import jax
import numpy as np

Metrics = dict[str, jax.Array]
"""Scalar (or one value per world) diagnostics by name."""


class Transition(flax.struct.PyTreeNode):
    """One step of experience, or any number of them along leading axes.

    ``next_obs`` is the observation *before* any auto-reset and ``terminated`` excludes time
    limits, so a learner bootstraps correctly through truncation.
    """

    obs: jax.Array
    """[..., O] observation the action was chosen from."""
    action: jax.Array
    """[..., A] raw policy action in [-1, 1]."""
    reward: jax.Array
    """[...] reward of the step."""
    terminated: jax.Array
    """[...] bool, the MDP ended: no bootstrap."""
    next_obs: jax.Array
    """[..., O] true successor observation."""


class Policy(Protocol):
    """A deployable policy: numpy in, numpy out, no simulator."""

    def act(self, obs: np.ndarray) -> np.ndarray:
        """Map observations [..., O] to actions [..., A] in [-1, 1]."""
        ...


class SourcePolicy(Protocol):
    """A black box that acts in the worlds of any task (paper Alg. 1, line 4).

    It sees the batched world state, keeps a memory of its own (a pytree, e.g. a phase clock and
    an observation history), and only its actions are used. Both methods are traceable by jax;
    wrap host code in ``jax.pure_callback`` (see ``policies.function``).
    """

    def init(self, state: Any) -> Any:
        """Return the memory for the freshly reset worlds of ``state`` (an ``EnvState``)."""
        ...

    def act(self, memory: Any, state: Any, key: jax.Array) -> tuple[jax.Array, Any]:
        """Return actions [N, A] in [-1, 1] and the next memory.

        Worlds that were just auto-reset have ``state.world.episode_step == 0``; their memory must
        be started afresh.
        """
        ...
