"""The matrix products of one critic update and nothing else: what no learner can be faster than.

One update multiplies its way through the target critics (forward), the online critics (forward
and backward) and the actor (forward, at the next observations). Dropout, layer norm, Adam, Polyak
averaging, random numbers and sampling are left out, and so are the products of the actor's own
update, one in ``utd`` updates.
"""

from __future__ import annotations

import dataclasses
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

Layout = Literal["batch first", "batch last"]
LAYOUTS: tuple[Layout, ...] = ("batch first", "batch last")


@dataclasses.dataclass(frozen=True)
class Shapes:
    """Sizes of the networks and of a block of updates."""

    obs: int
    action: int
    batch: int
    hidden: int
    updates: int
    """Updates in a block; the actor covers the minibatches of a block at once."""
    critics: int = 2


def flops(shapes: Shapes) -> float:
    """Return the floating-point operations of the products of one update."""
    first, second = (shapes.obs + shapes.action) * shapes.hidden, shapes.hidden**2
    forward = first + second + shapes.hidden
    backward = first + 2 * second  # no gradient flows to the inputs
    actor = shapes.obs * shapes.hidden + second + 2 * shapes.action * shapes.hidden
    return 2.0 * shapes.batch * (shapes.critics * (2 * forward + backward) + actor)


def inputs(shapes: Shapes) -> dict[str, jax.Array]:
    """Draw minibatches and kernels, batch first and [in, out]."""
    size = shapes.obs + shapes.action
    sizes = {
        "next_obs": (shapes.updates * shapes.batch, shapes.obs),
        "rows": (shapes.updates, shapes.batch, size),
        "next_rows": (shapes.updates, shapes.batch, size),
        "actor_0": (shapes.obs, shapes.hidden),
        "actor_1": (shapes.hidden, shapes.hidden),
        "actor_2": (shapes.hidden, 2 * shapes.action),
        "first": (shapes.critics, size, shapes.hidden),
        "second": (shapes.critics, shapes.hidden, shapes.hidden),
        "out": (shapes.critics, shapes.hidden, 1),
    }
    rng = np.random.default_rng(1)
    return {
        name: jnp.asarray(rng.standard_normal(size, np.float32) / np.sqrt(size[-2]), jnp.float32)
        for name, size in sizes.items()
    }


def to_layout(tensors: dict[str, jax.Array], layout: Layout) -> dict[str, jax.Array]:
    """Transpose every matrix for the batch-last layout."""
    if layout == "batch first":
        return tensors
    return {name: jnp.swapaxes(x, -1, -2) for name, x in tensors.items()}


def block(tensors: dict[str, jax.Array], layout: Layout, dtype: str) -> Any:
    """Multiply through a block of updates; returns every gradient, so that none is left out.

    Args:
        tensors: From ``to_layout``.
        layout: Where the batch axis is.
        dtype: Number format of the operands; sums are float32.
    """
    last = layout == "batch last"
    narrow = jnp.dtype(dtype)

    def product(a: jax.Array, b: jax.Array) -> jax.Array:
        """Return a b, or the transposed product with the batch last."""
        left, right = (b, a) if last else (a, b)
        return jnp.matmul(
            left.astype(narrow), right.astype(narrow), preferred_element_type=jnp.float32
        )

    def flip(a: jax.Array) -> jax.Array:
        return jnp.swapaxes(a, -1, -2)

    t = tensors
    hidden = product(product(t["next_obs"], t["actor_0"]), t["actor_1"])
    actor = product(hidden, t["actor_2"])

    def update(carry: jax.Array, step: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, Any]:
        rows, next_rows = step
        target = product(product(next_rows, t["first"]), t["second"])
        first = product(rows, t["first"])
        second = product(first, t["second"])
        # The target's activations stand for the gradient that comes back from the output.
        gradients = (
            product(flip(rows), product(target, flip(t["second"]))),
            product(flip(first), target),
        )
        return carry, (gradients, product(second, t["out"]), product(target, t["out"]))

    _, results = jax.lax.scan(update, jnp.zeros(()), (t["rows"], t["next_rows"]))
    return actor, results
