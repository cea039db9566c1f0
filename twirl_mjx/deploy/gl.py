"""Which headless OpenGL works here.

PyOpenGL fixes its platform once per process, so a program chooses before it imports MuJoCo:
``probe_gl`` says what works, and the command line sets ``MUJOCO_GL`` from it.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Mapping, Sequence

GL_BACKENDS = ("egl", "osmesa")
"""Headless OpenGL backends in the order they are tried."""

_FIX = (
    "on Debian and Ubuntu: `apt-get install libegl1 libgl1-mesa-dri` (EGL) or "
    "`apt-get install libosmesa6` (OSMesa)"
)


class RenderError(RuntimeError):
    """No way to draw on this machine; the message names what was tried and the fix."""


def probe_gl(environ: Mapping[str, str]) -> str:
    """Return the first headless backend that works, tried in processes of their own.

    Args:
        environ: environment of the caller; ``MUJOCO_GL`` in it is replaced for the trials.

    Returns:
        The value for ``MUJOCO_GL``.

    Raises:
        RenderError: none works.
    """
    code = "import mujoco; mujoco.GLContext(64, 64).make_current()"
    failures = []
    for backend in GL_BACKENDS:
        base = {k: v for k, v in environ.items() if k != "PYOPENGL_PLATFORM"}
        trial = subprocess.run(
            [sys.executable, "-c", code],
            env={**base, "MUJOCO_GL": backend},
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


def no_backend(failures: Sequence[str]) -> str:
    """Return what was tried, and what to install."""
    return f"cannot draw without a display. Tried {'; '.join(failures)}. Fix: {_FIX}"
