"""MuJoCo's MJX, imported when it is first used, and quietly.

Importing it takes longer than everything else that a help text or a refusal needs, and it prints
that it could not import warp, which nothing here uses. ``from twirl_mjx.sim import mjx`` is the
only way in; names are those of ``mujoco.mjx``.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
import io
from types import ModuleType
from typing import TYPE_CHECKING, Any

import jax

if TYPE_CHECKING:
    from mujoco.mjx import Data as Data
    from mujoco.mjx import Model as Model
    from mujoco.mjx import forward as forward
    from mujoco.mjx import make_data as make_data
    from mujoco.mjx import put_model as put_model
    from mujoco.mjx import step as step


@functools.cache
def load() -> ModuleType:
    """Import MJX now, quietly, and return it."""
    # Constants of its modules are arrays, not tracers, though the first use may be under a trace.
    with jax.ensure_compile_time_eval(), contextlib.redirect_stdout(io.StringIO()):
        return importlib.import_module("mujoco.mjx")


def __getattr__(name: str) -> Any:
    if name.startswith("__"):
        raise AttributeError(name)
    return getattr(load(), name)
