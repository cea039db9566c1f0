"""Robots by name; ``register_robot`` adds one from anywhere."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from twirl_mjx.plugins import Registry
from twirl_mjx.sim.robot import Robot

if TYPE_CHECKING:
    from twirl_mjx.sim.robots.a1 import A1 as A1

__all__ = ["A1", "DEFAULT_ROBOT", "ROBOTS", "get_robot", "register_robot"]


def _accept(item: Any) -> Robot:
    if not isinstance(item, Robot):
        raise ValueError(f"{item!r} is no robot: expected an object of Robot")
    return item


DEFAULT_ROBOT = "a1"
"""Name of the robot of the paper."""

ROBOTS: Registry[Robot] = Registry(
    "robot",
    accept=_accept,
    group="twirl_mjx.robots",
    shipped={DEFAULT_ROBOT: "twirl_mjx.sim.robots.a1:A1"},
)
"""The one list of robots."""

register_robot = ROBOTS.register
get_robot = ROBOTS.get


def __getattr__(name: str) -> Any:
    """Return the A1 when it is first asked for: its arrays need numpy, which options do not."""
    if name == "A1":
        return get_robot(DEFAULT_ROBOT)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
