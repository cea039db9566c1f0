"""Physical parameters of a world as arrays: one value of every leaf for every world.

So any mixture of conditions runs in one compiled call (paper, section "Transfer to New
Environments"). A new leaf is a field of the struct and a row of ``leaves.LEAVES``.
"""

from __future__ import annotations

import dataclasses
import operator
from collections.abc import Callable, Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from twirl_mjx.sim.leaves import LEAF, Place, leaf_values

if TYPE_CHECKING:
    from twirl_mjx.sim.ranges import Ranges
    from twirl_mjx.sim.scene import Scene


class Dynamics(flax.struct.PyTreeNode):
    """Physical parameters, float32 scalars for one world or ``[N]`` for a batch; see ``LEAVES``.

    None is nominal: what a leaf that is None would do is not compiled at all, and worlds without
    it are bit for bit those of before it existed. Which leaves are None is part of the tree's
    structure, so a compiled function is compiled anew for other ones, and none is ever ignored.
    """

    gravity: jax.Array
    friction: jax.Array
    leg_strength_min: jax.Array
    heat_rate: jax.Array
    bump_height: jax.Array
    incline: jax.Array
    payload: jax.Array | None = None
    com_x: jax.Array | None = None
    com_y: jax.Array | None = None
    com_z: jax.Array | None = None
    motor_strength: jax.Array | None = None
    kp_scale: jax.Array | None = None
    kd_scale: jax.Array | None = None
    latency: jax.Array | None = None
    obs_noise: jax.Array | None = None
    push: jax.Array | None = None
    push_interval: jax.Array | None = None


def leaf_value(dynamics: Dynamics, name: str) -> jax.Array:
    """Return a leaf, its nominal value (a scalar) where it is None."""
    value = getattr(dynamics, name)
    return jnp.asarray(LEAF[name].nominal, jnp.float32) if value is None else value


class Target(NamedTuple):
    """A place in the models of one scene."""

    name: str
    """Name of the value that goes there."""
    place: Place
    field: Callable[[Any], Any]
    """Model of C or MJX -> the field."""
    index: Any
    """Numpy index of the entries, ``...`` for the whole field."""
    base: Any
    """The scene's own entries, which are nominal."""


def targets(
    scene: Scene, places: Mapping[str, Sequence[Place]], names: Iterable[str]
) -> list[Target]:
    """Return where the values called ``names`` go in the models of a scene."""
    found = []
    for name in names:
        for place in places[name]:
            index = ... if place.index is None else place.index(scene)
            field = operator.attrgetter(place.field)
            found.append(Target(name, place, field, index, field(scene.mj_model)[index]))
    return found


def make_dynamics(
    shift: str = "none",
    strength: float = 1.0,
    overrides: Mapping[str, float] = MappingProxyType({}),
) -> Dynamics:
    """Return :func:`leaf_values` as parameters (scalars); those of no effect are left out."""
    values = leaf_values(shift, strength, overrides)
    always = {f.name for f in dataclasses.fields(Dynamics) if f.default is dataclasses.MISSING}  # type: ignore[arg-type]
    active = {k: v for k, v in values.items() if k in always or v != LEAF[k].nominal}
    return Dynamics(**{k: jnp.asarray(np.float32(v)) for k, v in active.items()})


def broadcast(dynamics: Dynamics, num_envs: int) -> Dynamics:
    """Repeat scalar parameters for every world: leaves [N]; leaves already [N] are kept.

    Raises:
        ValueError: A leaf is neither a scalar nor of length ``num_envs``.
    """

    def expand(leaf: jax.Array) -> jax.Array:
        leaf = jnp.asarray(leaf, jnp.float32)
        if leaf.shape not in ((), (num_envs,)):
            raise ValueError(f"dynamics leaf of shape {leaf.shape}: need () or ({num_envs},)")
        return jnp.broadcast_to(leaf, (num_envs,))

    return jax.tree.map(expand, dynamics)


def stack(items: list[Dynamics], repeats: int) -> Dynamics:
    """Concatenate scalar parameter sets, each repeated for ``repeats`` worlds: leaves [S * E].

    A leaf that is None in some of them only is nominal there.
    """
    used = [name for name in LEAF if any(getattr(item, name) is not None for item in items)]
    filled = [item.replace(**{name: leaf_value(item, name) for name in used}) for item in items]
    return jax.tree.map(lambda *leaves: jnp.repeat(jnp.stack(leaves), repeats), *filled)


def draw(key: jax.Array, dynamics: Dynamics, ranges: Ranges) -> Dynamics:
    """Return one world's parameters with the leaves of ``ranges`` drawn uniformly.

    Args:
        key: PRNG key; a leaf's draw depends on no other leaf.
        dynamics: Scalars, kept where nothing is drawn.
        ranges: What to draw.
    """
    order = list(LEAF)
    return dynamics.replace(
        **{
            name: jax.random.uniform(
                jax.random.fold_in(key, order.index(name)), minval=low, maxval=high
            )
            for name, low, high in ranges.bounds
        }
    )
