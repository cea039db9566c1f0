"""Where compiled programs are kept: one rule for the command line and for Python."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from twirl_mjx.cache import cache_folder


def test_the_folder_and_how_to_do_without(tmp_path: Path) -> None:
    place = tmp_path / "with blank" / "cache"
    assert cache_folder({"TWIRL_CACHE_DIR": str(place)}) == place
    assert place.is_dir()
    assert cache_folder({"TWIRL_CACHE_DIR": "off"}) is None
    (tmp_path / "file").write_text("")
    assert cache_folder({"TWIRL_CACHE_DIR": str(tmp_path / "file")}) is None
    assert cache_folder({"TWIRL_CACHE_DIR": str(tmp_path / "file" / "below")}) is None


def test_python_keeps_programs_in_the_same_folder(tmp_path: Path) -> None:
    """Also when something was compiled before; what jax was told itself wins."""
    code = """
import sys
import jax, jax.numpy as jnp
if len(sys.argv) > 1:
    jax.config.update("jax_compilation_cache_dir", sys.argv[1])
jax.jit(lambda x: x + 1)(1.0)
from twirl_mjx.cache import use_cache
use_cache()
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
jax.jit(lambda x: jnp.sin(x) * 3)(jnp.ones(3))
"""
    ours, own = tmp_path / "ours", tmp_path / "own"
    for place, words in ((ours, []), (own, [str(own)])):
        environ = {k: v for k, v in os.environ.items() if not k.startswith("JAX_COMPILATION")}
        environ |= {"TWIRL_CACHE_DIR": str(ours)}
        before = set(ours.rglob("*"))
        command = [sys.executable, "-c", code, *words]
        subprocess.run(command, env=environ, timeout=250, check=True)
        assert [p for p in place.rglob("*") if p.is_file()], place
    assert set(ours.rglob("*")) == before
