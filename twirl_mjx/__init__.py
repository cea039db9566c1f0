"""twirl_mjx: transfer experience between agile locomotion skills (TWiRL) on MuJoCo MJX.

Importing this package starts no device and reads no file; everything heavy is loaded on first
use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from twirl_mjx.policies.learned import load_policy as load_policy
    from twirl_mjx.sim.leaves import Shift as Shift
    from twirl_mjx.sim.robot import Robot as Robot
    from twirl_mjx.tasks.base import Outcome as Outcome
    from twirl_mjx.tasks.base import Start as Start
    from twirl_mjx.tasks.task import Measure as Measure
    from twirl_mjx.tasks.task import Task as Task
    from twirl_mjx.training.api import RunResult as RunResult
    from twirl_mjx.training.api import train as train
    from twirl_mjx.worlds.adapters import register_gymnasium as register_gymnasium
    from twirl_mjx.worlds.adapters import to_brax as to_brax
    from twirl_mjx.worlds.adapters import to_gymnasium as to_gymnasium
    from twirl_mjx.worlds.adapters import to_gymnasium_vector as to_gymnasium_vector
    from twirl_mjx.worlds.config import WorldConfig as WorldConfig
    from twirl_mjx.worlds.make import make as make

__version__ = "0.2.0"

_HOMES = {
    "Measure": "twirl_mjx.tasks.task",
    "Outcome": "twirl_mjx.tasks.base",
    "Robot": "twirl_mjx.sim.robot",
    "RunResult": "twirl_mjx.training.api",
    "Shift": "twirl_mjx.sim.leaves",
    "Start": "twirl_mjx.tasks.base",
    "Task": "twirl_mjx.tasks.task",
    "WorldConfig": "twirl_mjx.worlds.config",
    "load_policy": "twirl_mjx.policies.learned",
    "make": "twirl_mjx.worlds.make",
    "register_gymnasium": "twirl_mjx.worlds.adapters",
    "to_brax": "twirl_mjx.worlds.adapters",
    "to_gymnasium": "twirl_mjx.worlds.adapters",
    "to_gymnasium_vector": "twirl_mjx.worlds.adapters",
    "train": "twirl_mjx.training.api",
}
__all__ = sorted(_HOMES)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'twirl_mjx' has no attribute {name!r}")
    import importlib

    return getattr(importlib.import_module(_HOMES[name]), name)
