"""Types shared by every package: transitions, metrics, what a policy and what a learner is."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol

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
        """Return actions [N, A] and the next memory.

        Actions are in [-1, 1]; the worlds clip what is outside, and a recording counts it.
        Worlds that were just auto-reset have ``state.world.episode_step == 0``; their memory must
        be started afresh.
        """
        ...


class MetricInfo(NamedTuple):
    """Meaning of a metric."""

    about: str
    """What is measured, over what."""
    unit: str
    """Unit, ``1`` for a plain number."""


class LearnerConfig(Protocol):
    """What training reads of a learner's settings; the class may have any other field.

    It is a frozen dataclass with a default for every field: hashable, static under jit.
    """

    @property
    def utd(self) -> float:
        """Critic updates per environment transition; may be below 1."""
        ...

    @property
    def updates_per_block(self) -> int:
        """U, minibatches handed to one call of ``update``; divides ``utd * num_envs``."""
        ...

    @property
    def batch_size(self) -> int:
        """B, rows of one minibatch."""
        ...


@dataclasses.dataclass(frozen=True)
class Learner:
    """A learner as a value; ``droq.learner.LEARNER`` is the first.

    The functions are pure, traceable by jax and closed under ``vmap`` over a leading axis of
    seeds. O is the size of an observation, A that of an action; arrays are float32.

    The *state* is a pytree whose structure, shapes and dtypes never change. Two of its attributes
    are read: ``actor``, parameters with the layers ``hidden_0`` ... ``hidden_n``, ``mean`` and
    ``log_std`` of ``droq.networks``, because that is what a policy file holds; and ``grad_steps``,
    an int32 scalar, which each ``update`` raises by U.
    """

    name: str
    """How errors call it."""
    Config: type
    """Class of its settings, see ``LearnerConfig``; decides which learner trains a run."""
    init: Callable[[jax.Array, Any, int, int], Any]
    """(key, config, O, A) -> state before the first update."""
    sample: Callable[[Any, jax.Array, jax.Array], jax.Array]
    """(actor, obs [..., O], key) -> exploring actions [..., A] in [-1, 1]."""
    mean: Callable[[Any, jax.Array], jax.Array]
    """(actor, obs [..., O]) -> the deterministic actions [..., A] that are evaluated."""
    update: Callable[[Any, Any, Transition, jax.Array], tuple[Any, Metrics]]
    """(state, config, transitions [U, B, ...], key) -> (state, float32 scalars by name)."""
    metrics: Mapping[str, MetricInfo]
    """Meaning of every scalar that ``update`` reports."""
    value: Callable[[Any, Any, jax.Array, jax.Array], jax.Array] | None = None
    """(state, config, obs [B, O], actions [B, A]) -> their values [B]; asked by a guide only."""
