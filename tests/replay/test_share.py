"""The rule by which phi chooses itself, in numbers worked out by hand."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from twirl_mjx.replay import ring as ring_lib
from twirl_mjx.replay import share as share_lib
from twirl_mjx.types import Transition

LIMIT = 10
"""Limit of an episode."""


def source(rewards: list[float], ends: list[bool], *, padding: int = 0) -> ring_lib.RingBuffer:
    """A source ring of given rewards; rows of padding behind them earn 1000 each."""
    rewards, ends = rewards + [1000.0] * padding, ends + [True] * padding
    count = len(rewards)
    batch = Transition(
        obs=jnp.zeros((count, 3)),
        action=jnp.zeros((count, 2)),
        reward=jnp.asarray(rewards),
        terminated=jnp.asarray(ends),
        next_obs=jnp.zeros((count, 3)),
    )
    ring = ring_lib.from_transitions(batch)
    return ring.replace(size=jnp.int32(count - padding))


move = jax.jit(functools.partial(share_lib.move, batch_size=256, episode_length=LIMIT))


def test_the_start_and_the_bounds():
    share = share_lib.init("auto", 256)
    assert [float(x) for x in (share.rows, share.low, share.high)] == [128, 13, 192]
    fixed = share_lib.init(0.3, 10)
    assert [float(x) for x in (fixed.rows, fixed.low, fixed.high)] == [3, 3, 3]
    least = share_lib.init("auto", 2)  # a row of each side
    assert [float(x) for x in (least.rows, least.low, least.high)] == [1, 1, 1]


def test_an_epoch_by_hand():
    """Source: 4 rows of mean 0.5, one of which ends: worth 0.5 / (0.25 + 0.1)."""
    ring = source([0.5, 0.25, 0.25, 1.0], [False, True, False, False], padding=3)
    share, told = move(share_lib.init("auto", 256), ring, 0.3, 0.1)
    assert float(told["phi"]) == 0.5
    assert float(told["source_worth"]) == pytest.approx(0.5 / 0.35)
    assert float(told["online_worth"]) == pytest.approx(0.3 / 0.2)  # the better one
    assert float(share.rows) == pytest.approx(128 + 0.05 * (13 - 128))
    share, told = move(share, ring, -0.7, 0.5)
    assert float(share.reward) == pytest.approx(0.3 + 0.05 * (-0.7 - 0.3))
    assert float(told["online_worth"]) == pytest.approx(0.25 / (0.12 + 0.1))
    assert float(told["phi"]) == 122 / 256  # 122.25 rows
    assert float(share.rows) == pytest.approx(122.25 + 0.05 * (192 - 122.25))


def test_phi_falls_where_the_source_is_useless_and_stays_where_it_is_good():
    shares = {}
    for name, reward in (("useless", 0.1), ("good", 0.9)):
        ring = source([reward] * 5, [False] * 5)
        share = share_lib.init("auto", 256)
        for epoch in range(200):
            share, _ = move(share, ring, 0.2 + 0.001 * epoch, 0.0)
        shares[name] = int(share.num_source)
    assert shares == {"useless": 13, "good": 192}


def test_it_falls_once_the_learner_is_better():
    ring, share, counts = source([0.5] * 5, [False] * 5), share_lib.init("auto", 256), []
    for epoch in range(300):
        share, _ = move(share, ring, epoch / 200, 0.0)  # overtakes at 100
        counts.append(int(share.num_source))
    peak = max(epoch for epoch, count in enumerate(counts) if count == max(counts))
    assert 110 < peak < 130  # the average comes some 20 epochs later
    assert counts[peak] > 185
    assert counts[-1] < 20


def test_a_number_stays_and_reports_nothing():
    ring, share = source([9.0], [False]), share_lib.init(0.3, 256)
    for _ in range(50):
        share, told = move(share, ring, 0.0, 1.0)
        assert all(np.isnan(value) for value in told.values())
    assert int(share.num_source) == 77


def test_it_runs_for_seeds_side_by_side():
    rings = [source([0.9] * 3, [False] * 3), source([0.1] * 3, [False] * 3)]
    ring = jax.tree.map(lambda *leaves: jnp.stack(leaves), *rings)
    shares = jax.tree.map(
        lambda *leaves: jnp.stack(leaves), share_lib.init("auto", 256), share_lib.init(0.25, 256)
    )
    step = jax.vmap(lambda s, r: move(s, r, 0.5, 0.0))
    moved, told = step(shares, ring)
    np.testing.assert_array_equal(moved.rows > shares.rows, [True, False])
    np.testing.assert_array_equal(moved.num_source, [131, 64])
    assert float(told["phi"][0]) == 0.5
