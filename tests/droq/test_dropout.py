"""Hash bits are uniform and independent; masks depend on everything that must tell them apart."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from twirl_mjx.droq import dropout

SEEDS = dropout.seeds(jax.random.key(7), (2, 3))
NUM = 1 << 16
# Each test below computes fixed numbers; a fair generator would miss this level once in 10^5.
LEVEL = 1e-5


def bits_of(seed, num=NUM):
    return np.asarray(dropout.hash_bits(seed, num))


def test_both_halves_are_uniform():
    bits = bits_of(SEEDS[0, 0])
    for half in (bits & 0xFFFF, bits >> 16):
        counts = np.bincount(half >> 6, minlength=1024)
        assert scipy.stats.chisquare(counts).pvalue > LEVEL


def test_each_bit_is_fair_and_pairs_of_bits_are_independent():
    bits = (bits_of(SEEDS[0, 1])[:, None] >> np.arange(32)) & 1
    signs = 2.0 * bits - 1.0
    correlation = signs.T @ signs / NUM
    np.fill_diagonal(correlation, 0.0)
    bound = scipy.stats.norm.isf(LEVEL / 1000) / np.sqrt(NUM)
    assert np.abs(signs.mean(0)).max() < bound
    assert np.abs(correlation).max() < bound


@pytest.mark.parametrize("lag", [1, 2, 16, 256])
def test_neighbouring_elements_are_independent(lag):
    half = bits_of(SEEDS[1, 0]) >> 12 & 15
    table = np.histogram2d(half[:-lag], half[lag:], bins=(16, 16))[0]
    assert scipy.stats.chi2_contingency(table).pvalue > LEVEL


def test_masks_of_critics_layers_steps_and_networks_are_independent():
    rate = 0.25
    seeds = dropout.seeds(jax.random.key(0), (2, 2, 2))  # steps, networks, layers
    masks = np.stack(
        [
            np.asarray(dropout.keep_mask(seed, (4, 64, 128), rate)).reshape(4, -1)
            for seed in seeds.reshape(-1, 2)
        ]
    ).reshape(32, -1)
    scaled = (masks - (1 - rate)) / np.sqrt(rate * (1 - rate))
    correlation = scaled @ scaled.T / masks.shape[1]
    np.fill_diagonal(correlation, 0.0)
    bound = scipy.stats.norm.isf(LEVEL / 1000) / np.sqrt(masks.shape[1])
    assert np.abs(correlation).max() < bound


@pytest.mark.parametrize("shape", [(1, 4, 6), (2, 3, 5), (3, 8, 7)])
def test_elements_by_themselves_have_the_same_mask(shape):
    seed = SEEDS[1, 1]
    expected = dropout.keep_mask(seed, shape, 0.25)
    assert 0 < int(expected.sum()) < expected.size
    np.testing.assert_array_equal(dropout.keep_mask_by_element(seed, shape, 0.25), expected)


@pytest.mark.parametrize(("rate", "dropped"), [(0.01, 655), (0.25, 16384), (0.0, 0)])
def test_drop_probability_is_the_stated_one(rate, dropped):
    assert dropout.threshold(rate) == dropped
    assert dropout.quantised_rate(rate) == dropped / 65536
    keys = jax.random.split(jax.random.key(1), 8)
    masks = [dropout.keep_mask(dropout.seeds(k, ()), (2, 256, 256), rate) for k in keys]
    kept, total = int(sum(m.sum() for m in masks)), 8 * 2 * NUM
    if rate == 0.0:
        assert kept == total
    else:
        result = scipy.stats.binomtest(total - kept, total, dropped / 65536)
        assert result.pvalue > LEVEL


def test_masks_depend_on_the_key_alone_and_not_on_vmap():
    keys = jax.random.split(jax.random.key(3), 3)

    def mask(key):
        return dropout.keep_mask(dropout.seeds(key, ()), (3, 8, 16), 0.5)

    batched = jax.vmap(mask)(keys)
    for i in range(3):
        np.testing.assert_array_equal(batched[i], jax.jit(mask)(keys[i]))
    assert not jnp.array_equal(batched[0], batched[1])
    assert batched.shape == (3, 3, 8, 16)
    assert not jnp.array_equal(batched[0, 0], batched[0, 2])


def test_rate_outside_its_range_is_refused():
    with pytest.raises(ValueError, match=r"dropout_rate is 1\.0"):
        dropout.threshold(1.0)
