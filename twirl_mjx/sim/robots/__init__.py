"""Robots by name; ``register_robot`` adds one from anywhere."""

from __future__ import annotations

from twirl_mjx.checks import check_choice
from twirl_mjx.sim.robot import Robot
from twirl_mjx.sim.robots.a1 import A1

__all__ = ["A1", "ROBOTS", "get_robot", "register_robot"]

ROBOTS: dict[str, Robot] = {A1.name: A1}
"""Registered robots by name."""


def register_robot(robot: Robot) -> Robot:
    """Add a robot to ``ROBOTS`` and return it; adding the same one again changes nothing.

    Raises:
        ValueError: Another robot has this name.
    """
    if ROBOTS.setdefault(robot.name, robot) is not robot:
        raise ValueError(
            f"there is another robot called {robot.name!r}: choose a name that is none of"
            f" {', '.join(ROBOTS)}"
        )
    return robot


def get_robot(name: str) -> Robot:
    """Return a registered robot.

    Raises:
        ValueError: Unknown name, with the nearest valid one.
    """
    check_choice("robot", name, tuple(ROBOTS))
    return ROBOTS[name]
