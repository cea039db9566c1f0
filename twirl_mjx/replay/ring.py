"""Ring buffer of transitions: one packed row matrix and pure functions over it.

A transition is one float32 row ``obs | action | reward | terminated | next_obs``, so that a random
minibatch costs one gather and an insertion one scatter, whatever the fields are.
"""

from __future__ import annotations

import flax.struct
import jax
import jax.numpy as jnp

from twirl_mjx.types import Transition


class RingBuffer(flax.struct.PyTreeNode):
    """The last ``capacity`` transitions that were inserted.

    Rows ``[0, size)`` are filled; when the buffer is full the oldest row is the next to be
    overwritten.
    """

    rows: jax.Array
    """[C, 2O + A + 2] float32, packed transitions."""
    insert_index: jax.Array
    """[] int32, the row the next valid transition goes to."""
    size: jax.Array
    """[] int32, number of filled rows, at most C."""
    obs_size: int = flax.struct.field(pytree_node=False)
    """O, length of an observation."""
    action_size: int = flax.struct.field(pytree_node=False)
    """A, length of an action."""

    @property
    def capacity(self) -> int:
        """C, the number of rows (static; holds with a leading seed axis too)."""
        return self.rows.shape[-2]


def row_size(obs_size: int, action_size: int) -> int:
    """Return the length 2O + A + 2 of a packed transition."""
    return 2 * obs_size + action_size + 2


def init(capacity: int, obs_size: int, action_size: int) -> RingBuffer:
    """Make an empty buffer of ``capacity`` rows.

    Raises:
        ValueError: If a size is below 1.
    """
    for name, value in (
        ("capacity", capacity),
        ("obs_size", obs_size),
        ("action_size", action_size),
    ):
        if value < 1:
            raise ValueError(f"{name} is {value}; it must be at least 1")
    return RingBuffer(
        rows=jnp.zeros((capacity, row_size(obs_size, action_size)), jnp.float32),
        insert_index=jnp.zeros((), jnp.int32),
        size=jnp.zeros((), jnp.int32),
        obs_size=obs_size,
        action_size=action_size,
    )


def pack(batch: Transition) -> jax.Array:
    """Pack transitions [..., fields] into float32 rows [..., 2O + A + 2]."""
    fields = (
        batch.obs,
        batch.action,
        batch.reward[..., None],
        batch.terminated[..., None],
        batch.next_obs,
    )
    return jnp.concatenate([jnp.asarray(field, jnp.float32) for field in fields], axis=-1)


def unpack(rows: jax.Array, obs_size: int, action_size: int) -> Transition:
    """Split packed rows [..., 2O + A + 2] into a ``Transition``; the inverse of ``pack``."""
    end = obs_size + action_size
    return Transition(
        obs=rows[..., :obs_size],
        action=rows[..., obs_size:end],
        reward=rows[..., end],
        terminated=rows[..., end + 1] > 0.5,
        next_obs=rows[..., end + 2 :],
    )


def insert(ring: RingBuffer, batch: Transition, valid: jax.Array) -> RingBuffer:
    """Append the valid transitions of a batch, in order, over the oldest rows.

    Invalid transitions are never stored and take no room. Rows are written in place when the
    caller donates ``ring``.

    Args:
        ring: Buffer of capacity C.
        batch: N transitions, each field [N, ...], N <= C.
        valid: [N] bool, whether to store the transition.

    Returns:
        The buffer with ``valid.sum()`` more transitions.

    Raises:
        ValueError: If N > C or the field sizes are not those of the buffer.
    """
    num, capacity = batch.obs.shape[0], ring.capacity
    if num > capacity:
        raise ValueError(
            f"cannot insert {num} transitions at once into a ring of capacity {capacity}; "
            f"the capacity must be at least {num}"
        )
    _check_sizes(ring, batch)
    if valid.shape != (num,):
        raise ValueError(f"valid has shape {valid.shape}; it must be ({num},)")
    count = jnp.cumsum(valid.astype(jnp.int32))
    position = (ring.insert_index + count - 1) % capacity
    # An index past the end is dropped by the scatter: invalid rows leave the buffer alone.
    position = jnp.where(valid, position, capacity)
    rows = ring.rows.at[position].set(pack(batch), mode="drop")
    return ring.replace(
        rows=rows,
        insert_index=(ring.insert_index + count[-1]) % capacity,
        size=jnp.minimum(ring.size + count[-1], capacity),
    )


def gather(ring: RingBuffer, indices: jax.Array) -> Transition:
    """Read rows by index.

    Args:
        ring: Buffer of capacity C.
        indices: [...] int32 in [0, C); an index outside is the caller's error.

    Returns:
        Transitions with the leading axes of ``indices``.
    """
    return unpack(gather_rows(ring, indices), ring.obs_size, ring.action_size)


def gather_rows(ring: RingBuffer, indices: jax.Array) -> jax.Array:
    """Read packed rows [..., 2O + A + 2] by index [...]."""
    return ring.rows.at[indices].get(mode="promise_in_bounds")


def from_transitions(batch: Transition) -> RingBuffer:
    """Make a full buffer that holds exactly the C transitions of ``batch`` (fields [C, ...]).

    Raises:
        ValueError: If the batch is empty.
    """
    return from_rows(pack(batch), batch.obs.shape[-1], batch.action.shape[-1])


def from_rows(rows: jax.Array, obs_size: int, action_size: int) -> RingBuffer:
    """Make a full buffer of packed transitions [C, 2O + A + 2].

    Raises:
        ValueError: If there is no row, or the rows are not as long as the sizes say.
    """
    width = row_size(obs_size, action_size)
    if rows.ndim != 2 or rows.shape[0] < 1 or rows.shape[1] != width:
        raise ValueError(f"a ring needs rows of shape [C >= 1, {width}]; got {rows.shape}")
    return RingBuffer(
        rows=jnp.asarray(rows, jnp.float32),
        insert_index=jnp.zeros((), jnp.int32),
        size=jnp.full((), rows.shape[0], jnp.int32),
        obs_size=obs_size,
        action_size=action_size,
    )


def _check_sizes(ring: RingBuffer, batch: Transition) -> None:
    """Raise ``ValueError`` when observations or actions have another length than the rows."""
    sizes = (batch.obs.shape[-1], batch.action.shape[-1], batch.next_obs.shape[-1])
    expected = (ring.obs_size, ring.action_size, ring.obs_size)
    if sizes != expected:
        raise ValueError(f"(obs, action, next_obs) have sizes {sizes}; this ring stores {expected}")
