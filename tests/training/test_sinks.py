"""TensorBoard's files, sinks by name and by file, experiment trackers."""

from __future__ import annotations

import importlib.util
import io
import os
import signal
import struct
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console
from tensorboardX.proto.event_pb2 import Event, SessionLog

from twirl_mjx.training import pipeline
from twirl_mjx.training.logger import RunLogger
from twirl_mjx.training.presets import make_config
from twirl_mjx.training.sinks import tensorboard
from twirl_mjx.training.sinks.base import RunInfo, Sink
from twirl_mjx.training.sinks.registry import resolve
from twirl_mjx.types import MetricInfo

IDENTITY = {"run": "r", "task": "stand", "shift": "none", "variant": "scratch", "seed": "0"}
LEARNING = {"q_mean": MetricInfo("critic value", "1"), "entropy": MetricInfo("entropy", "nat")}


def make_info(run_dir: Path, resume: int | None = None) -> RunInfo:
    config = {"droq.utd": 2.0}
    return RunInfo(run_dir, IDENTITY, 1000, "train", resume, learning=LEARNING, config=config)


def open_logger(
    run_dir: Path, resume: int | None = None, sinks: tuple[Sink, ...] = ()
) -> RunLogger:
    info = make_info(run_dir, resume)
    return RunLogger([info], [sinks], console=Console(file=io.StringIO()))


def read_events(run_dir: Path) -> list[Event]:
    """Read all event files as TensorBoard does: by name, records until the first torn one."""
    events = []
    for path in sorted((run_dir / tensorboard.TENSORBOARD_DIR).iterdir()):
        data = path.read_bytes()
        while len(data) >= 12:
            (size,) = struct.unpack("<Q", data[:8])
            if len(data) < 16 + size:
                break
            events.append(Event.FromString(data[12 : 12 + size]))
            data = data[16 + size :]
    return events


def shown(run_dir: Path, tag: str) -> list[tuple[int, float]]:
    """Return (step, value) of a tag as TensorBoard shows them: a start voids its step and later."""
    points: list[tuple[int, float]] = []
    for event in read_events(run_dir):
        if event.HasField("session_log") and event.session_log.status == SessionLog.START:
            points = [point for point in points if point[0] < event.step]
        points += [(event.step, v.simple_value) for v in event.summary.value if v.tag == tag]
    return points


def test_tensorboard_gets_the_same_values(tmp_path: Path) -> None:
    with open_logger(tmp_path) as logger:
        logger.log(64, 10, {"q_mean": 2.5, "entropy": float("nan")})
    assert shown(tmp_path, "q_mean") == [(64, 2.5)]
    assert shown(tmp_path, "entropy") == []


def test_resumed_events_replace_those_after_the_checkpoint(tmp_path: Path) -> None:
    for resume, steps in ((None, (100, 200, 300)), (200, (300, 400)), (200, (300,)), (0, (100,))):
        with open_logger(tmp_path, resume) as logger:
            for step in steps:
                logger.log(step, 0, {"q_mean": step})
        if resume == 200:
            assert shown(tmp_path, "q_mean") == [(s, s) for s in (100, 200, *steps)]
    assert shown(tmp_path, "q_mean") == [(100, 100.0)]


def test_a_run_that_crashed_before_its_first_checkpoint_is_not_doubled(tmp_path: Path) -> None:
    for value in (1.0, 2.0):
        with open_logger(tmp_path) as logger:
            logger.log(32, 0, {"q_mean": value})
    assert shown(tmp_path, "q_mean") == [(32, 2.0)]
    values = [v.simple_value for event in read_events(tmp_path) for v in event.summary.value]
    assert 1.0 not in values


def test_a_later_file_sorts_last_whatever_the_clock_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "events.out.tfevents.1700000007.host").touch()
    monkeypatch.setattr(tensorboard.time, "time", lambda: 1_600_000_000.0)
    assert tensorboard.next_name(tmp_path).startswith("events.out.tfevents.1700000008.")
    monkeypatch.setattr(tensorboard.time, "time", lambda: 1_800_000_000.9)
    assert tensorboard.next_name(tmp_path).startswith("events.out.tfevents.1800000000.")


KILLED = """
import os, signal, sys
from pathlib import Path
sys.path.insert(0, {folder!r})
import test_sinks
logger = test_sinks.open_logger(Path({run_dir!r}))
for step in range(1, 51):
    logger.log(step, step, {{"q_mean": step, "entropy": -step}})
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_killed_run_loses_no_event(tmp_path: Path) -> None:
    code = KILLED.format(folder=str(Path(__file__).parent), run_dir=str(tmp_path))
    environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
    done = subprocess.run([sys.executable, "-c", code], env=environment, check=False, timeout=120)
    assert done.returncode == -signal.SIGKILL
    assert shown(tmp_path, "q_mean") == [(step, float(step)) for step in range(1, 51)]
    assert shown(tmp_path, "entropy") == [(step, -float(step)) for step in range(1, 51)]


OWN = """
class Mine:
    def __init__(self): self.seen = []
    def open(self, run): self.seen.append(run.identity["run"])
    def log(self, env_steps, grad_steps, wall_s, values): self.seen.append(dict(values))
    def close(self): self.seen.append("closed")

MADE = Mine()
NO_SINK = 3

class Needy(Mine):
    def __init__(self, address): ...

class Half:
    def open(self, run): ...
"""


@pytest.fixture
def own_file(tmp_path: Path) -> Path:
    path = tmp_path / "my sink.py"
    path.write_text(OWN)
    return path


def test_a_sink_of_a_file_is_made_and_used(own_file: Path, tmp_path: Path) -> None:
    made, given = resolve([f"{own_file}:Mine", f"{own_file}:MADE"])
    assert resolve([given]) == (given,)
    with open_logger(tmp_path / "run", sinks=(made, given)) as logger:
        logger.log(10, 0, {"q_mean": 1.0})
    for sink in (made, given):
        name, values, end = sink.seen  # type: ignore[attr-defined]
        assert (name, values["q_mean"], end) == ("r", 1.0, "closed")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("wandbb", r"unknown sink 'wandbb': choose one of wandb, .* \(nearest: 'wandb'\)"),
        ("{file}:NO_SINK", "NO_SINK is int without open, log, close: expected a class"),
        ("{file}:Half", "Half is Half without log, close"),
        ("{file}:Needy", r"Needy\(\) fails with .* missing 1 required positional argument"),
        ("{file}:Mime", r"my sink.py has no object 'Mime' \(nearest: 'Mine'\)"),
    ],
)
def test_what_is_no_sink_is_refused_before_anything_starts(
    name: str, message: str, own_file: Path, tmp_path: Path
) -> None:
    config = make_config("stand", "debug")
    chosen = (name.format(file=own_file),)
    with pytest.raises(ValueError, match=message) as refusal:
        pipeline.run(config, "debug", tmp_path / "runs", None, print, sinks=chosen)
    assert "\n" not in str(refusal.value)
    assert not (tmp_path / "runs").exists()


def test_a_sink_is_named_once() -> None:
    with pytest.raises(ValueError, match="--log names 'wandb' 2 times"):
        resolve(["wandb", "wandb"])


@pytest.mark.parametrize("package", ["wandb", "trackio"])
def test_a_tracker_that_is_not_installed_says_what_to_install(
    package: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ValueError, match=rf"pip install 'twirl-mjx\[{package}\]'"):
        resolve([package])


class FakeTracker:
    """Stands for both packages: ``init`` returns a run that logs and finishes, as does it."""

    def __init__(self) -> None:
        self.calls: list[Any] = []

    def init(self, **settings: Any) -> FakeTracker:
        self.calls.append(settings)
        return self

    def log(self, values: dict[str, float], step: int) -> None:
        self.calls.append((step, values))

    def finish(self) -> None:
        self.calls.append("finished")


@pytest.mark.parametrize("package", ["wandb", "trackio"])
@pytest.mark.parametrize(("resume", "name"), [(None, "r"), (50, "r from 50")])
def test_a_tracker_gets_run_settings_and_values(
    package: str, resume: int | None, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fake = FakeTracker()
    module = SimpleNamespace(init=fake.init, log=fake.log, finish=fake.finish)
    monkeypatch.setitem(sys.modules, package, module)
    with open_logger(tmp_path, resume, resolve([package])) as logger:
        logger.log(100, 7, {"q_mean": 2.5})
    settings, (step, values), end = fake.calls
    assert (settings["project"], settings["group"], settings["name"]) == ("twirl_mjx", "r", name)
    assert settings["config"] == {**IDENTITY, "droq.utd": 2.0}
    assert (step, values["q_mean"], values["grad_steps"], end) == (100, 2.5, 7, "finished")


@pytest.mark.parametrize("package", ["wandb", "trackio"])
def test_a_real_tracker_works_offline(package: str, tmp_path: Path) -> None:
    """In a process of its own: trackers start threads and keep state in their modules."""
    if importlib.util.find_spec(package) is None:
        pytest.skip(f"{package} is not installed (pip install 'twirl-mjx[{package}]')")
    code = (
        f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
        "import test_sinks; from pathlib import Path\n"
        f"(sink,) = test_sinks.resolve([{package!r}])\n"
        f"sink.open(test_sinks.make_info(Path({str(tmp_path / 'run')!r}), None))\n"
        "sink.log(10, 5, 0.1, {'q_mean': 2.5}); sink.close()\n"
    )
    (tmp_path / "run").mkdir()
    kept = tmp_path / "trackio"
    environment = {
        **os.environ, "WANDB_MODE": "offline", "HF_HUB_OFFLINE": "1", "TRACKIO_DIR": str(kept),
    }  # fmt: skip
    subprocess.run([sys.executable, "-c", code], env=environment, check=True, timeout=120)
    stored = {"wandb": "run/wandb/offline-run-*/run-*.wandb", "trackio": "trackio/twirl_mjx.db"}
    assert len(list(tmp_path.glob(stored[package]))) == 1
