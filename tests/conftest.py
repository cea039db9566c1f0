"""Settings and helpers of all tests: CPU only, a compilation cache, id-coded transitions."""

from __future__ import annotations

import base64
import gc
import io
import json
import os
import select
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

# These are read when jax and matplotlib are first imported, and are inherited by the processes
# that tests start, so they have to stand above every other import.
os.environ["JAX_PLATFORMS"] = os.environ.get("TWIRL_TEST_PLATFORMS", "cpu")
os.environ["MPLBACKEND"] = "Agg"
# Programs that run for a second are not worth half a minute of LLVM's optimisation: compiling
# `train_epoch` of the debug preset takes 12 s of processor time instead of 31.
_LEVEL = "--xla_backend_optimization_level=0"
os.environ["JAX_NUM_CPU_DEVICES"] = "1"  # else the first batch of seeds chooses for all tests
os.environ["XLA_FLAGS"] = f"{_LEVEL} {os.environ.get('XLA_FLAGS', '')}".strip()
_CACHE = os.environ.get("TWIRL_CACHE_DIR", str(Path.home() / ".cache" / "twirl_mjx" / "jax"))
if _CACHE != "off":  # the same place and rule as the command line's
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", _CACHE)
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.5")
# Tracing makes many small objects and little garbage: a tenth of the time went into looking for it.
gc.set_threshold(50_000, 10, 10)

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from twirl_mjx.training import presets, source_rules
from twirl_mjx.types import Transition


class TraceCounter:
    """Wraps a function and counts how often its Python body runs, that is: how often it is traced.

    Use as ``counter = TraceCounter(step); jitted = jax.jit(counter)``, call ``jitted`` several
    times, then assert ``counter.traces == 1``.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function = function
        self.traces = 0

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        self.traces += 1
        return self.function(*args, **kwargs)


@pytest.fixture(autouse=True)
def same_presets_on_every_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let presets hold what they do where a CPU has no instructions for bfloat16."""
    monkeypatch.setattr(presets, "multiplies_bfloat16", lambda: False)


@pytest.fixture
def no_shipped_policies(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let sources be found as if ``assets/policies`` were empty."""

    def missing(*parts: str) -> Path:
        raise FileNotFoundError(parts)

    monkeypatch.setattr(source_rules, "asset_path", missing)


@pytest.fixture
def count_traces() -> type[TraceCounter]:
    """The wrapper above; a fixture because test modules cannot import each other."""
    return TraceCounter


def coded_transitions(ids: Any, *, obs_size: int = 3, action_size: int = 2) -> Transition:
    """Make transitions in which every field tells the id of its row.

    Args:
        ids: [...] whole numbers below 2**20.
        obs_size: O.
        action_size: A.

    Returns:
        Transitions with leading shape [...]: ``reward = id``, ``obs = id + column / 8``,
        ``action = -id - column / 8``, ``next_obs = obs + 0.5``, ``terminated`` for odd ids. All
        values are exact in float32.
    """
    ids = np.asarray(ids)
    if ids.size and not 0 <= ids.min() <= ids.max() < 2**20:
        raise ValueError(f"ids must lie in [0, {2**20}), got {ids.min()} to {ids.max()}")
    row = ids.astype(np.float32)[..., None]
    obs = row + np.arange(obs_size, dtype=np.float32) / 8
    return Transition(
        obs=jnp.asarray(obs),
        action=jnp.asarray(-row - np.arange(action_size, dtype=np.float32) / 8),
        reward=jnp.asarray(row[..., 0]),
        terminated=jnp.asarray(ids % 2 == 1),
        next_obs=jnp.asarray(obs + 0.5),
    )


def decoded_ids(transitions: Transition) -> np.ndarray:
    """Return the ids [...] of coded transitions, after checking that all fields agree on them."""
    ids = np.asarray(transitions.reward).astype(np.int64)
    expected = coded_transitions(
        ids, obs_size=transitions.obs.shape[-1], action_size=transitions.action.shape[-1]
    )
    for (path, want), have in zip(
        jax.tree_util.tree_leaves_with_path(expected), jax.tree.leaves(transitions), strict=True
    ):
        np.testing.assert_array_equal(have, want, err_msg=jax.tree_util.keystr(path))
    return ids


@pytest.fixture
def transition_code() -> tuple[Callable[..., Transition], Callable[[Transition], np.ndarray]]:
    """The pair ``coded_transitions``, ``decoded_ids``."""
    return coded_transitions, decoded_ids


def clipped_texts(figure: Any) -> list[str]:
    """Return the texts of a matplotlib figure that reach over the edge of its canvas."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.text import Text

    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    ticks = {axis: axis.get_ticklabels(which="both") for a in figure.axes for axis in axes_of(a)}
    unseen = [
        label
        for axis, labels in ticks.items()
        for label in labels
        if label not in [tick.label1 for tick in axis._update_ticks()]
    ]
    edge = figure.bbox.padded(1)
    shown = [t for t in figure.findobj(Text) if t.get_visible() and t not in unseen]
    boxes = {t: t.get_window_extent(canvas.get_renderer()) for t in shown if t.get_text().strip()}
    assert boxes
    return [
        text.get_text()
        for text, box in boxes.items()
        if not (edge.contains(box.x0, box.y0) and edge.contains(box.x1, box.y1))
    ]


def axes_of(axes: Any) -> tuple[Any, Any]:
    """Return the two axes of a panel."""
    return axes.xaxis, axes.yaxis


@pytest.fixture
def clipped() -> Callable[[Any], list[str]]:
    """The function above."""
    return clipped_texts


BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
BROWSER_FLAGS = (
    "--headless",
    "--no-sandbox",
    "--use-angle=swiftshader",  # WebGL without a graphics card
    "--enable-unsafe-swiftshader",
    "--window-size=1100,700",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--remote-debugging-pipe",
)
# The browser reads commands from descriptor 3 and writes answers to descriptor 4.
LAUNCH_BROWSER = (
    "import os, sys; os.dup2(int(sys.argv[1]), 3); os.dup2(int(sys.argv[2]), 4);"
    "os.execv(sys.argv[3], sys.argv[3:])"
)


class Browser:
    """Just enough of the DevTools protocol: send a command, read messages up to its answer."""

    def __init__(self, executable, profile):
        to_browser, from_browser = os.pipe(), os.pipe()
        inner = [os.dup(fd) if fd < 10 else fd for fd in (to_browser[0], from_browser[1])]
        command = [
            sys.executable,
            "-c",
            LAUNCH_BROWSER,
            *map(str, inner),
            executable,
            *BROWSER_FLAGS,
        ]
        self.process = subprocess.Popen(
            [*command, f"--user-data-dir={profile}", "about:blank"],
            pass_fds=inner,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        for fd in {*inner, to_browser[0], from_browser[1]}:
            os.close(fd)
        self.writer, self.reader = to_browser[1], from_browser[0]
        self.buffer, self.events, self.count, self.session = b"", [], 0, None

    def message(self, deadline):
        while b"\0" not in self.buffer:
            if not select.select([self.reader], [], [], max(0.0, deadline - time.monotonic()))[0]:
                raise TimeoutError("the browser did not answer")
            chunk = os.read(self.reader, 1 << 20)
            if not chunk:
                raise EOFError(f"the browser ended with code {self.process.wait(10)}")
            self.buffer += chunk
        text, _, self.buffer = self.buffer.partition(b"\0")
        return json.loads(text)

    def send(self, method, **params):
        self.count += 1
        request = {"id": self.count, "method": method, "params": params}
        request |= {"sessionId": self.session} if self.session else {}
        os.write(self.writer, json.dumps(request).encode() + b"\0")
        deadline = time.monotonic() + 60
        while True:
            answer = self.message(deadline)
            if answer.get("id") == self.count:
                assert "error" not in answer, answer
                return answer["result"]
            self.events.append(answer)

    def wait_for(self, event):
        deadline = time.monotonic() + 60
        while not any(e.get("method") == event for e in self.events):
            self.events.append(self.message(deadline))

    def of(self, *methods):
        return [e["params"] for e in self.events if e.get("method") in methods]

    def open(self, url):
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.send(f"{domain}.enable")
        self.events = [e for e in self.events if e.get("method") != "Page.loadEventFired"]
        self.send("Page.navigate", url=url)
        self.wait_for("Page.loadEventFired")

    def run(self, script):
        result = self.send(
            "Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True
        )
        assert "exceptionDetails" not in result, result
        return result["result"].get("value")

    def picture(self):
        png = base64.b64decode(self.send("Page.captureScreenshot")["data"])
        return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"), float)

    def dark_share(self):
        """Share of dark pixels, which only the robot has, in the middle of the picture."""
        picture = self.picture()
        height, width = picture.shape[:2]
        middle = picture[height // 4 : 3 * height // 4, width // 4 : 3 * width // 4]
        return float((middle.max(axis=-1) < 90).mean())

    def wait_until(self, script, seconds=30.0):
        deadline = time.monotonic() + seconds
        while not self.run(script):
            assert time.monotonic() < deadline, script
            time.sleep(0.1)

    def errors(self):
        return self.of("Runtime.exceptionThrown", "Runtime.consoleAPICalled", "Log.entryAdded")

    def close(self):
        self.process.terminate()
        try:
            self.process.wait(20)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        os.close(self.writer)
        os.close(self.reader)


@pytest.fixture
def browser(tmp_path):
    executable = next(filter(None, map(shutil.which, BROWSERS)), None)
    if executable is None:
        pytest.skip(
            f"none of {', '.join(BROWSERS)} is installed; other tests check the files themselves"
        )
    browser = Browser(executable, tmp_path / "profile")
    target = browser.send("Target.createTarget", url="about:blank")["targetId"]
    attached = browser.send("Target.attachToTarget", targetId=target, flatten=True)
    browser.session = attached["sessionId"]
    yield browser
    browser.close()
