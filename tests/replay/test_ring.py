"""The ring keeps exactly the last valid rows, in order, whole and in place."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from twirl_mjx.replay import ring as ring_lib
from twirl_mjx.types import Transition

OBS_SIZE, ACTION_SIZE = 3, 2


def stored_ids(ring, decode):
    """Return the ids of the filled rows by age, oldest first."""
    size, capacity = int(ring.size), ring.capacity
    order = (int(ring.insert_index) - size + np.arange(size)) % capacity
    return decode(ring_lib.gather(ring, jnp.asarray(order))).tolist()


@pytest.mark.parametrize("num", [1, 4, 7, 10])
def test_rows_survive_the_wrap_whole_and_in_order(transition_code, num):
    encode, decode = transition_code
    ring = ring_lib.init(10, OBS_SIZE, ACTION_SIZE)
    insert = jax.jit(ring_lib.insert)
    ids = np.arange(6 * num)
    for start in range(0, 6 * num, num):
        ring = insert(ring, encode(ids[start : start + num]), jnp.ones(num, bool))
        assert stored_ids(ring, decode) == ids[: start + num][-10:].tolist()
        assert int(ring.size) == min(start + num, 10)
        assert int(ring.insert_index) == (start + num) % 10


def test_invalid_rows_are_never_stored_and_take_no_room(transition_code):
    encode, decode = transition_code
    generator = np.random.default_rng(0)
    ring, expected = ring_lib.init(11, OBS_SIZE, ACTION_SIZE), []
    insert = jax.jit(ring_lib.insert)
    for step in range(12):
        ids = np.arange(5) + 5 * step
        valid = generator.random(5) < 0.5
        batch = encode(ids)
        # Invalid rows carry NaN, as they do when a simulated world blows up.
        poison = jnp.where(valid, 0.0, jnp.nan)
        batch = batch.replace(reward=batch.reward + poison, obs=batch.obs + poison[:, None])
        ring = insert(ring, batch, jnp.asarray(valid))
        expected += ids[valid].tolist()
        assert stored_ids(ring, decode) == expected[-11:]
    assert bool(jnp.isfinite(ring.rows).all())
    unchanged = insert(ring, encode(np.arange(5)), jnp.zeros(5, bool))
    jax.tree.map(np.testing.assert_array_equal, unchanged, ring)


def test_donated_ring_is_written_in_place(transition_code):
    encode, _ = transition_code
    ring = ring_lib.init(1000, OBS_SIZE, ACTION_SIZE)
    insert = jax.jit(ring_lib.insert, donate_argnums=0)
    ring = insert(ring, encode(np.arange(8)), jnp.ones(8, bool))
    address, rows = ring.rows.unsafe_buffer_pointer(), ring.rows
    ring = insert(ring, encode(np.arange(8)), jnp.ones(8, bool))
    assert rows.is_deleted()
    assert ring.rows.unsafe_buffer_pointer() == address


def test_insert_is_traced_once_and_keeps_types(transition_code, count_traces):
    encode, _ = transition_code
    counter = count_traces(ring_lib.insert)
    insert = jax.jit(counter)
    ring = ring_lib.init(6, OBS_SIZE, ACTION_SIZE)
    for _ in range(3):
        new = insert(ring, encode(np.arange(4)), jnp.ones(4, bool))
        assert jax.tree.map(jax.typeof, new) == jax.tree.map(jax.typeof, ring)
        ring = new
    assert counter.traces == 1


def test_seeds_may_be_vmapped(transition_code):
    encode, decode = transition_code
    rings = jax.vmap(lambda _: ring_lib.init(6, OBS_SIZE, ACTION_SIZE))(jnp.arange(2))
    batch = encode(np.arange(8).reshape(2, 4))
    valid = jnp.asarray([[True] * 4, [True, False, True, False]])
    rings = jax.vmap(ring_lib.insert)(rings, batch, valid)
    first, second = (jax.tree.map(lambda x, i=i: x[i], rings) for i in range(2))
    assert stored_ids(first, decode) == [0, 1, 2, 3]
    assert stored_ids(second, decode) == [4, 6]
    assert rings.capacity == 6


def test_from_transitions_is_full_and_readable(transition_code):
    encode, decode = transition_code
    ring = ring_lib.from_transitions(encode(np.arange(7)))
    assert (int(ring.size), ring.capacity) == (7, 7)
    assert decode(ring_lib.gather(ring, jnp.asarray([[6, 0], [3, 3]]))).tolist() == [[6, 0], [3, 3]]
    gathered = ring_lib.gather(ring, jnp.asarray([2]))
    assert gathered.terminated.dtype == jnp.bool_
    assert gathered.obs.dtype == jnp.float32


def test_wrong_sizes_are_refused_with_the_numbers(transition_code):
    encode, _ = transition_code
    ring = ring_lib.init(4, OBS_SIZE, ACTION_SIZE)
    with pytest.raises(ValueError, match=r"5 transitions .* capacity 4"):
        ring_lib.insert(ring, encode(np.arange(5)), jnp.ones(5, bool))
    with pytest.raises(ValueError, match=r"\(4, 2, 4\).*\(3, 2, 3\)"):
        ring_lib.insert(ring, encode(np.arange(2), obs_size=4), jnp.ones(2, bool))
    with pytest.raises(ValueError, match=r"valid has shape \(3,\)"):
        ring_lib.insert(ring, encode(np.arange(2)), jnp.ones(3, bool))
    with pytest.raises(ValueError, match="capacity is 0"):
        ring_lib.init(0, OBS_SIZE, ACTION_SIZE)
    empty = jax.tree.map(lambda x: x[:0], encode(np.arange(2)))
    with pytest.raises(ValueError, match="C >= 1"):
        ring_lib.from_transitions(empty)


def test_pack_and_unpack_are_inverse():
    batch = Transition(
        obs=jnp.asarray([[1.0, 2.0]]),
        action=jnp.asarray([[3.0]]),
        reward=jnp.asarray([4.0]),
        terminated=jnp.asarray([True]),
        next_obs=jnp.asarray([[5.0, 6.0]]),
    )
    rows = ring_lib.pack(batch)
    np.testing.assert_array_equal(rows, [[1, 2, 3, 4, 1, 5, 6]])
    jax.tree.map(np.testing.assert_array_equal, ring_lib.unpack(rows, 2, 1), batch)
