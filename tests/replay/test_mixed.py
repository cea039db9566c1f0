"""Every minibatch holds exactly round(phi * B) source rows, drawn from filled rows only."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from twirl_mjx.replay import ring as ring_lib
from twirl_mjx.replay.mixed import MixedReplay, sample, sample_counted, source_rows

SOURCE_START = 1000
"""Ids of source rows start here, ids of online rows at 0."""


@pytest.fixture
def replay(transition_code):
    """Source of 5 rows, online ring of 9 rows of which 6 are filled."""
    encode, _ = transition_code
    online = ring_lib.init(9, 3, 2)
    online = ring_lib.insert(online, encode(np.arange(6)), jnp.ones(6, bool))
    return MixedReplay(ring_lib.from_transitions(encode(SOURCE_START + np.arange(5))), online)


@pytest.mark.parametrize("batch_size", [1, 7, 16, 31])
@pytest.mark.parametrize("phi", [0.0, 0.25, 0.5, 0.75, 1.0])
def test_exact_share_in_every_minibatch(replay, transition_code, phi, batch_size):
    _, decode = transition_code
    batch = sample(replay, jax.random.key(1), num_minibatches=6, batch_size=batch_size, phi=phi)
    ids = decode(batch)
    assert ids.shape == (6, batch_size)
    np.testing.assert_array_equal((ids >= SOURCE_START).sum(1), round(phi * batch_size))


def test_a_count_that_is_data_draws_what_the_same_share_draws(replay, transition_code):
    """Row for row: exact counts, source rows first, none from the wrong ring."""
    _, decode = transition_code
    sizes = {"num_minibatches": 5, "batch_size": 8}
    counted = jax.jit(lambda n: sample_counted(replay, jax.random.key(3), num_source=n, **sizes))
    for rows in (0, 3, 8):
        ids = decode(counted(jnp.int32(rows)))
        np.testing.assert_array_equal((ids >= SOURCE_START).sum(1), rows)
        fixed = sample(replay, jax.random.key(3), phi=rows / 8, **sizes)
        np.testing.assert_array_equal(ids, decode(fixed))


def test_counts_may_differ_within_a_batch(replay, transition_code):
    _, decode = transition_code
    sizes = {"num_minibatches": 3, "batch_size": 16}
    keys, counts = jax.random.split(jax.random.key(0), 2), [5, 16]

    def draw(key, count):
        return sample_counted(replay, key, num_source=count, **sizes)

    batch = jax.jit(jax.vmap(draw))(keys, jnp.asarray(counts))
    for index, count in enumerate(counts):
        alone = sample(replay, keys[index], phi=count / 16, **sizes)
        found = decode(jax.tree.map(lambda leaf, i=index: leaf[i], batch))
        np.testing.assert_array_equal(found, decode(alone))


def test_paper_numbers():
    assert [source_rows(phi, 256) for phi in (0, 0.25, 0.5, 0.75, 1)] == [0, 64, 128, 192, 256]


def test_all_filled_rows_and_no_other_are_drawn_evenly(replay, transition_code):
    _, decode = transition_code
    draw = jax.jit(lambda key: sample(replay, key, num_minibatches=300, batch_size=40, phi=0.5))
    ids = decode(draw(jax.random.key(0))).ravel()
    counts = np.unique(ids, return_counts=True)
    expected = [*range(6), *(SOURCE_START + np.arange(5))]
    assert counts[0].tolist() == expected
    # 6000 draws a side; a fair sampler fails at this level once in a million keys.
    assert scipy.stats.chisquare(counts[1][:6]).pvalue > 1e-6
    assert scipy.stats.chisquare(counts[1][6:]).pvalue > 1e-6


def test_minibatches_and_rows_are_independent_draws(replay, transition_code):
    _, decode = transition_code
    batch = sample(replay, jax.random.key(0), num_minibatches=50, batch_size=40, phi=0.5)
    ids = decode(batch)
    assert len({tuple(row) for row in ids.tolist()}) == 50
    other = decode(sample(replay, jax.random.key(1), num_minibatches=50, batch_size=40, phi=0.5))
    assert not np.array_equal(ids, other)


def test_unused_side_may_be_empty(replay, transition_code):
    _, decode = transition_code
    empty = ring_lib.init(9, 3, 2)
    kwargs = {"num_minibatches": 2, "batch_size": 8}
    only_source = sample(MixedReplay(replay.source, empty), jax.random.key(0), phi=1.0, **kwargs)
    assert decode(only_source).min() >= SOURCE_START
    only_online = sample(MixedReplay(None, replay.online), jax.random.key(0), phi=0.0, **kwargs)
    assert decode(only_online).max() < 6


def test_source_is_never_written(replay, transition_code):
    encode, decode = transition_code
    before = np.array(replay.source.rows)

    @jax.jit
    def step(replay, batch, key):
        online = ring_lib.insert(replay.online, batch, jnp.ones(4, bool))
        replay = replay.replace(online=online)
        return replay, sample(replay, key, num_minibatches=2, batch_size=8, phi=0.5)

    for i in range(8):
        replay, batch = step(replay, encode(np.arange(4) + 10 * i), jax.random.key(i))
        decode(batch)
    np.testing.assert_array_equal(replay.source.rows, before)


def test_bad_requests_are_refused_with_the_numbers(replay, transition_code):
    encode, _ = transition_code
    with pytest.raises(ValueError, match=r"phi is 1.5.*\[0, 1\]"):
        source_rows(1.5, 256)
    with pytest.raises(ValueError, match="batch_size is 0"):
        source_rows(0.5, 0)
    key, kwargs = jax.random.key(0), {"num_minibatches": 1, "batch_size": 8}
    with pytest.raises(ValueError, match="4 of 8 rows from the source"):
        sample(MixedReplay(None, replay.online), key, phi=0.5, **kwargs)
    with pytest.raises(ValueError, match="the online ring is empty"):
        empty = MixedReplay(replay.source, ring_lib.init(9, 3, 2))
        sample(empty, key, phi=0.5, **kwargs)
    other = ring_lib.from_transitions(encode(np.arange(3), obs_size=4))
    with pytest.raises(ValueError, match=r"\(4, 2\).*\(3, 2\)"):
        sample(MixedReplay(other, replay.online), key, phi=0.5, **kwargs)
    with pytest.raises(ValueError, match="needs a source ring"):
        sample_counted(MixedReplay(None, replay.online), key, num_source=jnp.int32(4), **kwargs)
