"""twirl_mjx: transfer experience between agile locomotion skills (TWiRL) on MuJoCo MJX.

Importing this package starts no device and reads no file; everything heavy is loaded on first
use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from twirl_mjx.policies.learned import load_policy as load_policy
    from twirl_mjx.worlds.adapters import to_brax as to_brax
    from twirl_mjx.worlds.adapters import to_gymnasium as to_gymnasium
    from twirl_mjx.worlds.make import make as make

__version__ = "0.1.0"
__all__ = ["load_policy", "make", "to_brax", "to_gymnasium"]

_HOMES = {
    "make": "twirl_mjx.worlds.make",
    "load_policy": "twirl_mjx.policies.learned",
    "to_gymnasium": "twirl_mjx.worlds.adapters",
    "to_brax": "twirl_mjx.worlds.adapters",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'twirl_mjx' has no attribute {name!r}")
    import importlib

    return getattr(importlib.import_module(_HOMES[name]), name)
