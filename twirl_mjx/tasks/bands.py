"""Geometry of hurdle bands: where they lie, what touches them, who crossed them in one flight.

A band is endless in y, so the distance from a capsule to it is the distance in the (x, height)
plane from the capsule's axis, a segment, to the band's cross-section, a rectangle, less the
radius. Heights are over the local ground, on which the rectangle stands.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np

from twirl_mjx.sim.kinematics import reach_limits
from twirl_mjx.sim.robot import Robot
from twirl_mjx.sim.scene import HURDLE_LENGTH


def reach(robot: Robot) -> float:
    """Return the distance in m along x to the centre of the farthest band the robot can touch.

    Hip, stretched leg, foot radius and half a band, rounded up to decimetres (A1: 0.7).
    """
    hip = float(np.abs(robot.hip_offsets[:, 0]).max())
    stretched = hip + reach_limits(robot)[1] + robot.foot_radius + HURDLE_LENGTH / 2
    return math.ceil(10 * stretched) / 10


def min_gap(robot: Robot) -> float:
    """Return the distance in m between bands from which on only the nearest can be touched."""
    return 2 * reach(robot)


def draw(key: jax.Array, count: int, min_gap: float, max_gap: float) -> jax.Array:
    """Return band centres [count] in m from the start; gaps, and the first, U(min_gap, max_gap)."""
    return jnp.cumsum(jax.random.uniform(key, (count,), minval=min_gap, maxval=max_gap))


def nearest(positions: jax.Array, x: jax.Array) -> jax.Array:
    """Return the entry [...] of ``positions`` [H] that is nearest to ``x`` [...]."""
    return positions[jnp.argmin(jnp.abs(x[..., None] - positions), axis=-1)]


def rectangle_distance(start: jax.Array, end: jax.Array, height: float) -> jax.Array:
    """Return the exact distance from segments to a band's cross-section.

    Args:
        start: [..., 2] m, x from the band's centre and height over the ground.
        end: [..., 2] m, the other end; equal to ``start`` for a sphere.
        height: m, of the band.

    Returns:
        [...] m, 0 where they meet.
    """
    half = HURDLE_LENGTH / 2
    (x0, h0), (x1, h1) = jnp.moveaxis(start, -1, 0), jnp.moveaxis(end, -1, 0)
    dx, dh = x1 - x0, h1 - h0
    length_sq = jnp.maximum(dx * dx + dh * dh, 1e-12)

    def point_sq(x: jax.Array, h: jax.Array) -> jax.Array:
        gap_x = jnp.maximum(jnp.abs(x) - half, 0.0)
        gap_h = jnp.maximum(jnp.maximum(h - height, -h), 0.0)
        return gap_x * gap_x + gap_h * gap_h

    # The squared distance along the segment is convex and smooth: its least value lies at an end,
    # at the point nearest to a corner, or is 0.
    least = jnp.minimum(point_sq(x0, h0), point_sq(x1, h1))
    for corner_x in (-half, half):
        for corner_h in (0.0, height):
            t = ((corner_x - x0) * dx + (corner_h - h0) * dh) / length_sq
            t = jnp.clip(t, 0.0, 1.0)
            least = jnp.minimum(least, point_sq(x0 + t * dx, h0 + t * dh))
    # Convex shapes are apart exactly if an axis separates them: x, height, or the segment's normal.
    middle = height / 2
    side = jnp.abs(dx * (middle - h0) + dh * x0)
    apart = (
        (jnp.minimum(x0, x1) > half)
        | (jnp.maximum(x0, x1) < -half)
        | (jnp.minimum(h0, h1) > height)
        | (jnp.maximum(h0, h1) < 0.0)
        | (side > half * jnp.abs(dh) + middle * jnp.abs(dx))
    )
    return jnp.where(apart, jnp.sqrt(least), 0.0)


def shape_distance(
    x: jax.Array,
    height: jax.Array,
    radii: jax.Array,
    band: jax.Array,
    band_height: float,
) -> jax.Array:
    """Return the distance from capsules to a band.

    Args:
        x: [..., G, 2] m, world x of the axis ends.
        height: [..., G, 2] m, of the axis ends over the local ground.
        radii: [G] m.
        band: [...] m, world x of the band's centre.
        band_height: m.

    Returns:
        [..., G] m, at most 0 where they touch; below 0 it is not the depth of penetration.
    """
    ends = jnp.stack([x - band[..., None, None], height], axis=-1)
    return rectangle_distance(ends[..., 0, :], ends[..., 1, :], band_height) - radii


def stepped_in(positions: jax.Array, feet_x: jax.Array, contact: jax.Array) -> jax.Array:
    """Return over which bands a foot was on the ground while they were being crossed.

    The crossing of a band lasts from when the first foot is beyond its near edge until the last
    foot is beyond its far edge.

    Args:
        positions: [H] m, world x of the centres.
        feet_x: [S, 4] m, world x of the feet.
        contact: [S, 4] bool, which feet touch the ground.

    Returns:
        [H] bool.
    """
    first, last = jnp.max(feet_x, axis=1)[:, None], jnp.min(feet_x, axis=1)[:, None]
    half = HURDLE_LENGTH / 2
    crossing = (first > positions - half) & (last <= positions + half)
    return jnp.any(crossing & jnp.any(contact, axis=1)[:, None], axis=0)
