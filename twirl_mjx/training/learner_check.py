"""What every function of a learner returns, checked by tracing it: nothing is compiled or run."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from twirl_mjx.policies.learned import check_params
from twirl_mjx.training.learners import learner_of
from twirl_mjx.types import LearnerConfig, Transition


def check_learner(config: LearnerConfig, observation_size: int, action_size: int) -> None:
    """Check what every function of a learner returns, before anything is compiled.

    Args:
        config: Settings of the learner.
        observation_size: O.
        action_size: A.

    Raises:
        ValueError: One line that names learner, function, what it returned and what was expected.
    """
    learner, key = learner_of(config), jax.eval_shape(jax.random.key, 0)
    minibatches = jax.eval_shape(lambda: _minibatches(config, observation_size, action_size))
    obs, at = minibatches.obs, "init"
    try:
        state = jax.eval_shape(
            lambda k: learner.init(k, config, observation_size, action_size), key
        )
        at = "init, state.grad_steps"
        _expect(state.grad_steps, jax.ShapeDtypeStruct((), jnp.int32))
        at = "init, state.actor"
        zeros = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), state.actor)
        check_params(zeros, observation_size, action_size)
        at = "sample"
        _expect(jax.eval_shape(learner.sample, state.actor, obs, key), minibatches.action)
        at = "mean"
        _expect(jax.eval_shape(learner.mean, state.actor, obs), minibatches.action)
        if (value := learner.value) is not None:
            at = "value"
            found = jax.eval_shape(
                lambda s, m: value(s, config, m.obs[0], m.action[0]), state, minibatches
            )
            _expect(found, jax.ShapeDtypeStruct(minibatches.reward.shape[1:], jnp.float32))
        at = "update"
        after, metrics = jax.eval_shape(
            lambda s, m, k: learner.update(s, config, m, k), state, minibatches, key
        )
        at = "update, the state after it"
        _expect(after, state)
        at = "update, its metrics (named in Learner.metrics)"
        scalar = jax.ShapeDtypeStruct((), jnp.float32)
        _expect(metrics, dict.fromkeys(learner.metrics, scalar))
    except Exception as error:
        kind = "" if isinstance(error, ValueError) else f"{type(error).__name__}: "
        why = kind + " ".join(str(error).split())
        raise ValueError(f"learner {learner.name}: {at}: {why}") from error


def _minibatches(config: LearnerConfig, observation_size: int, action_size: int) -> Transition:
    """Return what ``update`` is given."""
    rows = (config.updates_per_block, config.batch_size)
    obs = jnp.zeros((*rows, observation_size))
    action = jnp.zeros((*rows, action_size))
    return Transition(obs, action, jnp.zeros(rows), jnp.zeros(rows, bool), obs)


def _expect(found: Any, expected: Any) -> None:
    """Compare two trees of shapes, leaf by leaf.

    Raises:
        ValueError: Naming the first leaf that differs, what it is and what was expected.
    """
    has, needs = (
        {
            jax.tree_util.keystr(path, simple=True, separator="."): f"{leaf.dtype}{[*leaf.shape]}"
            for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]
        }
        for tree in (found, expected)
    )
    for name in needs | has:
        if has.get(name) != needs.get(name):
            raise ValueError(
                f"{name or 'the array'} is {has.get(name, 'missing')}, expected"
                f" {needs.get(name, 'none of that name')}"
            )
