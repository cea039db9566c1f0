"""Physical parameters of a world, and the five dynamics shifts as values of them.

Every quantity that a shift, a sweep or a randomisation may change is one leaf of
:class:`Dynamics`, with one value per world, so that any mixture of conditions runs in one
compiled call (paper, section "Transfer to New Environments").
"""

from __future__ import annotations

import dataclasses
import difflib
import math
from typing import Literal

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

SceneKind = Literal["flat", "bumpy", "sloped"]
"""Ground geometry compiled into a scene; see ``sim.scene``."""


class Dynamics(flax.struct.PyTreeNode):
    """Physical parameters, scalars for one world or ``[N]`` for a batch (float32)."""

    gravity: jax.Array
    """m/s^2, magnitude, pointing down the world z-axis."""
    friction: jax.Array
    """Sliding friction coefficient between the feet (calves) and the ground."""
    leg_strength_min: jax.Array
    """Each episode one random leg gets strength U(leg_strength_min, 1); 1 leaves all whole."""
    heat_rate: jax.Array
    """K / (N^2 m^2 s): motor temperature gained per squared joint torque and second."""
    bump_height: jax.Array
    """m, highest point of the heightfield; only acts in a ``bumpy`` scene."""
    incline: jax.Array
    """rad, angle of the hill; only acts in a ``sloped`` scene."""


@dataclasses.dataclass(frozen=True)
class Shift:
    """A named dynamics shift: one parameter moved from nominal, in one kind of scene."""

    scene: SceneKind
    values: tuple[tuple[str, float], ...]
    """(leaf of Dynamics, value at strength 1)."""
    about: str


NOMINAL_VALUES: dict[str, float] = {
    "gravity": 9.81,
    "friction": 1.0,
    "leg_strength_min": 1.0,
    "heat_rate": 0.0,
    "bump_height": 0.0,
    "incline": 0.0,
}

SHIFTS: dict[str, Shift] = {
    "none": Shift("flat", (), "training conditions"),
    "bumpy": Shift("bumpy", (("bump_height", 0.05),), "random heightfield, at most 0.05 m"),
    "icy": Shift("flat", (("friction", 0.4),), "friction 0.4"),
    "weakened": Shift(
        "flat",
        (("leg_strength_min", 0.5), ("heat_rate", 0.02)),
        "one random leg at U(0.5, 1) of its strength, motors derate as they heat",
    ),
    "sloped": Shift("sloped", (("incline", math.radians(8.0)),), "8 degree hill 0.5 m ahead"),
    "gravity": Shift("flat", (("gravity", 3.7),), "gravity 3.7 m/s^2"),
}
"""Spec section 6. ``strength`` interpolates from nominal (0) over the paper's value (1)."""


def nearest(name: str, choices: list[str]) -> str:
    """Return the closest of ``choices`` to ``name`` (the first one when nothing is close)."""
    return (difflib.get_close_matches(name, choices, n=1, cutoff=0.0) or choices[:1])[0]


def get_shift(name: str) -> Shift:
    """Return the shift called ``name``.

    Raises:
        ValueError: Unknown name; the message lists the valid ones and the nearest.
    """
    if name not in SHIFTS:
        names = list(SHIFTS)
        raise ValueError(
            f"unknown shift {name!r}: choose one of {', '.join(names)}"
            f" (nearest: {nearest(name, names)!r})"
        )
    return SHIFTS[name]


def make_dynamics(shift: str = "none", strength: float = 1.0) -> Dynamics:
    """Return the parameters (scalars) of a shift at a given strength.

    Args:
        shift: A key of ``SHIFTS``.
        strength: 0 is nominal, 1 the paper's value, in [0, 2].

    Raises:
        ValueError: Unknown shift, strength outside [0, 2], or a parameter pushed out of its
            physical range (friction, gravity and leg strength must stay above 0).
    """
    if not 0.0 <= strength <= 2.0:
        limit = 0.0 if strength < 0.0 else 2.0
        raise ValueError(f"shift strength {strength} is outside [0, 2] (nearest: {limit})")
    values = dict(NOMINAL_VALUES)
    for leaf, shifted in get_shift(shift).values:
        values[leaf] += strength * (shifted - values[leaf])
    for leaf in ("gravity", "friction"):
        if values[leaf] <= 0.0:
            raise ValueError(f"{shift} at strength {strength} gives {leaf} {values[leaf]:.3g} <= 0")
    values["leg_strength_min"] = max(values["leg_strength_min"], 0.05)
    return Dynamics(**{k: jnp.asarray(np.float32(v)) for k, v in values.items()})


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
    """Concatenate scalar parameter sets, each repeated for ``repeats`` worlds: leaves [S * E]."""
    return jax.tree.map(lambda *leaves: jnp.repeat(jnp.stack(leaves), repeats), *items)
