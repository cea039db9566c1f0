"""What stops a training run: numbers that are not finite."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp


class DivergedError(RuntimeError):
    """The learner produced a number that is not finite; the last good checkpoint is kept."""


FINITE, INSERTED = "finite", "inserted"
"""What an epoch tells the guards, beside its metrics: whether every number of the learner is
finite, and how many transitions were kept since the run began."""


def _finite(tree: Any) -> Any:
    return jax.tree.map(lambda x: jnp.all(jnp.isfinite(x)), tree)


def all_finite(learner: Any) -> jax.Array:
    """Return whether every number of the learner is finite."""
    return jnp.all(jnp.stack(jax.tree.leaves(_finite(learner))))


def check_finite(learner: Any) -> None:
    """Check that every number of the learner is finite.

    Raises:
        DivergedError: Naming the first tensor that is not.
    """
    for path, good in jax.tree_util.tree_flatten_with_path(jax.jit(_finite)(learner))[0]:
        if not bool(good):
            name = jax.tree_util.keystr(path, simple=True, separator=".")
            raise DivergedError(
                f"the learner diverged: {name} is not finite. The last good checkpoint is kept;"
                " start from its policy with a smaller droq.learning_rate: another --name,"
                " --variant weights and --source this run"
            )


MAX_DROPPED = 0.01
"""Largest share of the transitions of a run that may be dropped."""


def check_experience(inserted: int, env_steps: int, budget: int, cause: str) -> None:
    """Check that the worlds give transitions to learn from.

    Args:
        inserted: Transitions kept so far.
        env_steps: Transitions gathered so far.
        budget: Transitions of the whole run.
        cause: Why the first one was dropped, if that is known.

    Raises:
        DivergedError: Every transition so far was dropped, or more of them than ``MAX_DROPPED`` of
            the budget.
    """
    dropped = env_steps - inserted
    first = f"; the first one because {cause}" if cause else ""
    if env_steps and not inserted:
        raise DivergedError(
            f"none of {env_steps:,} transitions was finite{first}: the worlds diverge"
            " from the start; look at the task's options and at the dynamics"
        )
    if dropped > MAX_DROPPED * budget:
        raise DivergedError(
            f"{dropped:,} of {env_steps:,} transitions were dropped, more than {MAX_DROPPED:.0%} of"
            f" the {budget:,} of this run{first}: what is learned from the rest is not the task;"
            " look at its reward, its clip and the dynamics"
        )
