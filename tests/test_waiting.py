"""What a terminal shows while commands are loaded, and that options are parsed without the rest."""

from __future__ import annotations

import io
import subprocess
import sys
import time

import pytest

from twirl_mjx.commands.waiting import waiting


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_long_waits_are_explained_and_the_line_is_left_clean(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    screen = Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    with waiting("loading things", patience_s=0.01):
        deadline = time.monotonic() + 30
        while not screen.getvalue() and time.monotonic() < deadline:
            time.sleep(0.01)
    assert screen.getvalue() == f"loading things ...\r{' ' * 18}\r"


def test_short_waits_and_pipes_show_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    for screen, patience in ((Terminal(), 60.0), (io.StringIO(), 0.0)):
        monkeypatch.setattr(sys, "stderr", screen)
        with waiting("loading things", patience_s=patience):
            pass
        assert screen.getvalue() == ""


def test_mjx_is_imported_quietly_even_while_jax_traces() -> None:
    code = """
import jax
from twirl_mjx.sim import mjx
import mujoco
model = mujoco.MjModel.from_xml_string(
    "<mujoco><worldbody><body><freejoint/><geom size='0.1'/></body></worldbody></mujoco>"
)
for _ in range(2):
    shapes = jax.eval_shape(lambda: mjx.step(mjx.put_model(model), mjx.make_data(model)).qpos)
assert shapes.shape == (7,)
assert not hasattr(mjx, "__nothing__")
"""
    done = subprocess.run(
        [sys.executable, "-c", code], timeout=250, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (0, ""), done.stderr
