"""The share of source rows as data: of runs that differ in it, and of ``phi`` that chooses itself.

The rule of ``--replay.phi auto``, once an epoch:

- An episode is worth ``reward / (terminated + 1 / L)``: the mean reward of a transition times the
  mean length of an episode that ends with the measured probability, or by its limit of L steps.
- While an episode of the source data is worth more than one of the last epochs, phi goes towards
  ``HIGH``, else towards ``LOW``.
- It goes a share ``RATE`` of the way, and what is measured online is averaged as slowly.

So source data are used as long as the learner does not do better than they do, and hardly when they
never were good. Nothing of the learner is asked: values of a critic favour the actor that was
trained against it, rewards do not. What this cannot see is that poor data may show the way.
"""

from __future__ import annotations

import flax.struct
import jax
import jax.numpy as jnp

from twirl_mjx.replay.config import AUTO, Phi
from twirl_mjx.replay.mixed import source_rows
from twirl_mjx.replay.ring import RingBuffer
from twirl_mjx.types import Metrics

START = 0.5
"""Phi of the first epoch, the paper's."""
LOW = 0.05
"""Least share: what is not seen any more cannot be kept in mind."""
HIGH = 0.75
"""Largest share: the paper's largest, which leaves room for what is new."""
RATE = 0.05
"""Share of the way that phi goes in an epoch."""


class Share(flax.struct.PyTreeNode):
    """Source rows of a minibatch, and what moves them. A leading seed axis is allowed."""

    rows: jax.Array
    """[] float32, source rows of a minibatch; a minibatch gets the nearest whole number."""
    low: jax.Array
    """[] float32, their least number; that of ``high`` where phi is a number."""
    high: jax.Array
    """[] float32, their largest number."""
    reward: jax.Array
    """[] float32, mean reward of an online transition, averaged over epochs; NaN before the
    first."""
    terminated: jax.Array
    """[] float32, share of online transitions that ended their episode, averaged alike."""

    @property
    def num_source(self) -> jax.Array:
        """[] int32, source rows of a minibatch."""
        return jnp.round(self.rows).astype(jnp.int32)


def init(phi: Phi, batch_size: int) -> Share:
    """Return the share before the first epoch.

    Args:
        phi: A number, which stays, or ``auto``.
        batch_size: B, at least 2 for ``auto``.
    """

    def rows(share: float) -> float:
        return float(min(max(source_rows(share, batch_size), 1), batch_size - 1))

    if phi == AUTO:
        bounds = (rows(START), rows(LOW), rows(HIGH))
    else:
        bounds = (float(source_rows(phi, batch_size)),) * 3
    return Share(*(jnp.float32(value) for value in (*bounds, jnp.nan, jnp.nan)))


def worth(reward: jax.Array, terminated: jax.Array, episode_length: int) -> jax.Array:
    """Return what an episode earns.

    Args:
        reward: Mean reward of a transition.
        terminated: Share of transitions that end their episode.
        episode_length: Limit of an episode in control steps.
    """
    return reward / (terminated + 1.0 / episode_length)


def move(
    share: Share,
    source: RingBuffer,
    reward: jax.Array,
    terminated: jax.Array,
    *,
    batch_size: int,
    episode_length: int,
) -> tuple[Share, Metrics]:
    """Let an epoch move the share; it stays where phi is a number.

    Args:
        share: As it was in the epoch.
        source: Source experience.
        reward: [] mean reward of the epoch's transitions.
        terminated: [] share of the epoch's transitions that ended their episode.
        batch_size: B.
        episode_length: Limit of an episode in control steps.

    Returns:
        The share of the next epoch; and phi of this one with both worths, NaN where phi is a
        number.
    """
    online = _average(share.reward, reward), _average(share.terminated, terminated)
    source_worth = worth(*_means(source), episode_length)
    online_worth = worth(*online, episode_length)
    goal = jnp.where(source_worth > online_worth, share.high, share.low)
    moves = share.low < share.high
    metrics = {
        "phi": share.num_source / batch_size,
        "source_worth": source_worth,
        "online_worth": online_worth,
    }
    rows = share.rows + RATE * (goal - share.rows)
    share = share.replace(rows=rows, reward=online[0], terminated=online[1])
    return share, {name: jnp.where(moves, value, jnp.nan) for name, value in metrics.items()}


def _average(old: jax.Array, new: jax.Array) -> jax.Array:
    """Return a running mean after an epoch; NaN is none yet."""
    return jnp.where(jnp.isnan(old), new, old + RATE * (new - old))


def _means(ring: RingBuffer) -> tuple[jax.Array, jax.Array]:
    """Return the mean reward and the share of terminated transitions of a ring's filled rows."""
    column = ring.obs_size + ring.action_size
    is_filled = jnp.arange(ring.capacity)[:, None] < ring.size
    sums = jnp.sum(jnp.where(is_filled, ring.rows[:, column : column + 2], 0.0), axis=0)
    reward, terminated = sums / jnp.maximum(ring.size, 1)
    return reward, terminated
