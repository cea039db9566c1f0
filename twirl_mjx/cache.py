"""Where compiled programs are kept between runs; one rule for the command line and for Python."""

from __future__ import annotations

import functools
import os
from collections.abc import Mapping
from pathlib import Path

LEAST_COMPILE_S = 0.5
"""s, programs that compile faster are not kept."""


def cache_folder(environ: Mapping[str, str]) -> Path | None:
    """Return the folder of compiled programs, which exists and can be written; None for none.

    ``TWIRL_CACHE_DIR`` places it (``~/.cache/twirl_mjx/jax`` by default) or switches it ``off``.
    """
    place = environ.get("TWIRL_CACHE_DIR", "~/.cache/twirl_mjx/jax")
    if place == "off":
        return None
    try:
        folder = Path(place).expanduser()
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # no home, or one that is read only
        return None
    return folder if os.access(folder, os.W_OK | os.X_OK) else None


@functools.cache
def use_cache() -> None:
    """Let jax keep compiled programs, unless it was already told where, or not to."""
    import jax
    from jax.experimental.compilation_cache import compilation_cache

    config = jax.config
    if config.jax_compilation_cache_dir is not None or not config.jax_enable_compilation_cache:
        return
    folder = cache_folder(os.environ)
    if folder is not None:
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", LEAST_COMPILE_S)
        compilation_cache.reset_cache()  # what was compiled before has settled that there is none
