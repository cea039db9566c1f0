"""Robots by name; ``register_robot`` adds one from anywhere."""

from __future__ import annotations

from typing import Any

from twirl_mjx.plugins import Registry
from twirl_mjx.sim.robot import Robot
from twirl_mjx.sim.robots.a1 import A1

__all__ = ["A1", "DEFAULT_ROBOT", "ROBOTS", "get_robot", "register_robot"]


def _accept(item: Any) -> Robot:
    if not isinstance(item, Robot):
        raise ValueError(f"{item!r} is no robot: expected an object of Robot")
    return item


ROBOTS: Registry[Robot] = Registry("robot", accept=_accept, group="twirl_mjx.robots")
"""The one list of robots."""

register_robot = ROBOTS.register
get_robot = ROBOTS.get

DEFAULT_ROBOT = register_robot(A1)
"""The robot of the paper."""
