"""Worlds multiply in full float32, whatever precision of products jax was told to use."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp

from twirl_mjx.worlds.make import make

HIGHEST = (jax.lax.Precision.HIGHEST, jax.lax.Precision.HIGHEST)


def equations(jaxpr: Any) -> Iterator[Any]:
    """Yield every equation of a jaxpr and of those inside it."""
    for equation in jaxpr.eqns:
        yield equation
        for value in equation.params.values():
            for inner in value if isinstance(value, tuple | list) else [value]:
                inner = getattr(inner, "jaxpr", inner)
                if hasattr(inner, "eqns"):
                    yield from equations(inner)


def precisions(function: Any, *args: Any) -> list[Any]:
    """Return the precision of every product of a function that is traced where TF32 would do."""
    with jax.default_matmul_precision("tensorfloat32"):
        jaxpr = jax.make_jaxpr(function)(*args)
    found = equations(jaxpr.jaxpr)
    return [e.params["precision"] for e in found if e.primitive.name == "dot_general"]


def test_every_product_of_a_step_is_in_full_precision() -> None:
    """Those of MJX: the step around it has none, and the native engine multiplies on the host."""
    env = make("stand", num_envs=2, engine="mjx")
    state = jax.eval_shape(env.reset, jax.random.key(0))
    found = precisions(env.step, state, jnp.zeros((2, 12)))
    assert len(found) > 50
    assert set(found) == {HIGHEST}


def test_the_test_sees_products_of_lower_precision() -> None:
    def loop(x: jax.Array) -> Any:
        return jax.lax.scan(lambda c, _: (c @ c, None), x, length=2)

    assert HIGHEST not in precisions(loop, jnp.eye(2))
