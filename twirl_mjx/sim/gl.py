"""Which headless OpenGL works here, and a context of it.

PyOpenGL fixes its platform once per process. The command line asks ``probe_gl`` before it imports
MuJoCo and sets ``MUJOCO_GL``; ``open_context`` asks it when nothing was chosen, as from Python.
"""

from __future__ import annotations

import importlib
import subprocess
import sys
from collections.abc import Mapping, Sequence
from typing import Any

GL_BACKENDS = ("egl", "osmesa")
"""Headless OpenGL backends in the order they are tried."""

_TRIAL = """
import os, sys
os.environ.pop("PYOPENGL_PLATFORM", None)
os.environ["MUJOCO_GL"] = sys.argv[1]
import mujoco
mujoco.GLContext(64, 64).make_current()
"""
_FIX = (
    "on Debian and Ubuntu: `apt-get install libegl1 libgl1-mesa-dri` (EGL) or "
    "`apt-get install libosmesa6` (OSMesa)"
)


class RenderError(RuntimeError):
    """No way to draw on this machine; the message names what was tried and the fix."""


def probe_gl(environ: Mapping[str, str] | None = None) -> str:
    """Return the first headless backend that works, tried in processes of their own.

    Args:
        environ: Environment of the trials, this process's by default; ``MUJOCO_GL`` in it is
            replaced.

    Returns:
        The value for ``MUJOCO_GL``.

    Raises:
        RenderError: None works.
    """
    failures = []
    for backend in GL_BACKENDS:
        trial = subprocess.run(
            [sys.executable, "-c", _TRIAL, backend],
            env=None if environ is None else dict(environ),
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )
        if trial.returncode == 0:
            return backend
        lines = trial.stderr.strip().splitlines() or [f"exit code {trial.returncode}"]
        failures.append(f"{backend}: {lines[-1]}")
    raise RenderError(no_backend(failures))


def open_context(width: int, height: int) -> Any:
    """Return a current OpenGL context from the first backend that works in this process.

    Raises:
        RenderError: None works; names each attempt.
    """
    is_fixed = "OpenGL" in sys.modules  # PyOpenGL has its platform, for better or worse
    failures = []
    for backend in GL_BACKENDS if is_fixed else (probe_gl(),):
        try:
            context = importlib.import_module(f"mujoco.{backend}").GLContext(width, height)
            context.make_current()
        except Exception as error:  # drivers and PyOpenGL fail in many types
            failures.append(f"{backend}: {type(error).__name__}: {error}")
        else:
            return context
    raise RenderError(no_backend(failures))


def no_backend(failures: Sequence[str]) -> str:
    """Return what was tried, and what to install."""
    return f"cannot draw without a display. Tried {'; '.join(failures)}. Fix: {_FIX}"
