from __future__ import annotations

import csv
import io
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from twirl_mjx.training.logger import RunLogger
from twirl_mjx.training.sinks.base import RunInfo, Sink
from twirl_mjx.training.sinks.table import COLUMNS
from twirl_mjx.training.sinks.terminal import format_count, format_seconds
from twirl_mjx.types import MetricInfo

IDENTITY = {"run": "biped-0", "task": "biped", "shift": "none", "variant": "twirl", "seed": "0"}
MEASURES = {
    "return": MetricInfo("undiscounted return", "1"),
    "standing_time": MetricInfo("time on the hind legs", "s"),
    "min_distance": MetricInfo("closest approach", "m"),
    "hops": MetricInfo("hops in an episode", "hops"),
    "late": MetricInfo("the fourth of its own measures", "1"),
}
LEARNING = {name: MetricInfo(f"the {name}", "1") for name in ("critic_loss", "q_mean")}


class FakeTime:
    """A clock that moves when told to."""

    def __init__(self) -> None:
        self.now = 100.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> FakeTime:
    fake = FakeTime()
    monkeypatch.setattr("twirl_mjx.training.logger.time", fake)
    monkeypatch.setattr("twirl_mjx.training.sinks.terminal.time", fake)
    return fake


def make_info(run_dir: Path, **changes: Any) -> RunInfo:
    settings = {"total_env_steps": 1000, "measures": MEASURES, "learning": LEARNING} | changes
    return RunInfo(run_dir, IDENTITY, **settings)


def make_logger(
    run_dir: Path, text: io.StringIO | None = None, sinks: tuple[Sink, ...] = (), **changes: Any
) -> RunLogger:
    console = Console(file=text or io.StringIO(), width=200)
    return RunLogger([make_info(run_dir, **changes)], [sinks], console=console)


def read_rows(run_dir: Path) -> list[dict[str, str]]:
    with (run_dir / "metrics.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_rows_are_tidy(tmp_path: Path, clock: FakeTime) -> None:
    with make_logger(tmp_path) as logger:
        clock.now += 2.5
        logger.log(100, 200, {"return": np.float32(1.25), "world/upright": 0.5})
    rows = read_rows(tmp_path)
    assert tuple(rows[0]) == COLUMNS
    by_name = {row["metric"]: row for row in rows}
    assert by_name["return"] == {
        "run": "biped-0", "task": "biped", "shift": "none", "variant": "twirl", "seed": "0",
        "metric": "return", "env_steps": "100", "grad_steps": "200", "wall_s": "2.500",
        "value": "1.25",
    }  # fmt: skip
    assert float(by_name["env_steps_per_s"]["value"]) == pytest.approx(40.0)
    assert float(by_name["updates_per_s"]["value"]) == pytest.approx(80.0)
    assert len(rows) == 4


def test_undefined_metrics_write_no_row(tmp_path: Path) -> None:
    with make_logger(tmp_path) as logger:
        logger.log(1, 1, {"return": float("nan"), "q_mean": 2.0})
    names = [row["metric"] for row in read_rows(tmp_path)]
    assert "return" not in names
    assert "q_mean" in names


def test_rows_are_on_disk_before_the_run_ends(tmp_path: Path) -> None:
    logger = make_logger(tmp_path)
    logger.log(10, 0, {"reward": 1.0})
    assert [row["metric"] for row in read_rows(tmp_path)][-1] == "reward"
    logger.close()
    logger.close()


def values_of(run_dir: Path, metric: str) -> list[float]:
    return [float(row["value"]) for row in read_rows(run_dir) if row["metric"] == metric]


def test_compilation_is_announced_and_not_in_the_rates(tmp_path: Path, clock: FakeTime) -> None:
    text = io.StringIO()
    with make_logger(tmp_path, text) as logger:
        with logger.compiling("train_epoch"):
            clock.now += 23.0
        logger.log(100, 50, {})
        clock.now += 4.0
        logger.log(200, 150, {})
    assert "compiling train_epoch ...\n" in text.getvalue()
    assert "compiling train_epoch ... 23 s\n" in text.getvalue()
    assert values_of(tmp_path, "env_steps_per_s") == pytest.approx([25.0])
    assert values_of(tmp_path, "updates_per_s") == pytest.approx([25.0])
    assert values_of(tmp_path, "compile_s") == pytest.approx([23.0])
    assert "eta 0:00:32" in text.getvalue()  # 800 steps at 25 a second


def test_evaluation_time_is_not_in_the_rates(tmp_path: Path, clock: FakeTime) -> None:
    with make_logger(tmp_path) as logger:
        clock.now += 2.0
        with logger.aside("evaluating ..."):
            clock.now += 50.0
        logger.log(100, 50, {})
        clock.now += 2.0
        logger.log(100, 50, {"eval/final_return": 1.0})  # steps nowhere, so it has no rate
    assert values_of(tmp_path, "env_steps_per_s") == pytest.approx([50.0])
    assert values_of(tmp_path, "compile_s") == []


def test_resume_drops_rows_after_the_checkpoint(tmp_path: Path, clock: FakeTime) -> None:
    with make_logger(tmp_path) as logger:
        for steps in (100, 200, 300):
            clock.now += 10.0
            logger.log(steps, 2 * steps, {"q_mean": steps})
    path = tmp_path / "metrics.csv"
    path.write_text(
        path.read_text() + "biped-0,biped,none,twirl,0,q_mean,150,3"
    )  # cut off by a crash
    clock.now += 1000.0
    with make_logger(tmp_path, resume_env_steps=200) as logger:
        clock.now += 5.0
        logger.log(300, 600, {"q_mean": 3.5})
    rows = [row for row in read_rows(tmp_path) if row["metric"] == "q_mean"]
    assert [row["env_steps"] for row in rows] == ["100", "200", "300"]
    assert [float(row["value"]) for row in rows] == [100.0, 200.0, 3.5]
    assert [float(row["wall_s"]) for row in rows] == pytest.approx([10.0, 20.0, 25.0])


def test_fresh_run_starts_the_file_anew(tmp_path: Path) -> None:
    for value in (1.0, 2.0):
        with make_logger(tmp_path) as logger:
            logger.log(10, 0, {"q_mean": value})
    assert [row["value"] for row in read_rows(tmp_path) if row["metric"] == "q_mean"] == ["2"]


def test_a_run_stopped_before_its_first_epoch_keeps_its_rows(tmp_path: Path) -> None:
    with make_logger(tmp_path) as logger:
        logger.log(0, 0, {"eval/return": 7.0})
    with make_logger(tmp_path, resume_env_steps=0) as logger:
        logger.log(10, 0, {"q_mean": 1.0})
    assert values_of(tmp_path, "eval/return") == [7.0]
    assert values_of(tmp_path, "q_mean") == [1.0]


def test_foreign_csv_is_refused(tmp_path: Path) -> None:
    (tmp_path / "metrics.csv").write_text("a,b\n1,2\n")
    with pytest.raises(ValueError, match="line 1: there is no column 'env_steps'"):
        make_logger(tmp_path, resume_env_steps=10)


def test_unknown_names_are_refused(tmp_path: Path) -> None:
    with make_logger(tmp_path) as logger:
        with pytest.raises(ValueError, match=r"unknown metric 'critic_los'.*'critic_loss'"):
            logger.log(1, 1, {"critic_los": 1.0})
        with pytest.raises(ValueError, match="unknown metric 'world/'"):
            logger.log(1, 1, {"world/": 1.0})
    assert read_rows(tmp_path) == []
    with pytest.raises(ValueError, match="identity needs exactly"):
        RunInfo(tmp_path, {"run": "x"}, 1)


def test_plain_lines_tell_the_state(tmp_path: Path, clock: FakeTime) -> None:
    text = io.StringIO()
    with make_logger(tmp_path, text, total_env_steps=50_000) as logger:
        logger.announce("collecting [50k] transitions")
        clock.now += 10.0
        values = {"return": 12.34, "standing_time": 3.21, "min_distance": 0.444, "q_mean": 7.0}
        values |= {"hops": 2.0, "late": 1.0, "eval/standing_time": 9.87}
        logger.log(12_500, 250_000, values)
    lines = text.getvalue().splitlines()
    assert lines[0] == "train biped-0: to 50k"
    assert lines[1] == "collecting [50k] transitions"
    assert lines[2] == (
        "train biped-0  25.0 % | env 12.5k | updates 250k | eta 0:00:30 | env steps/s 1250 | "
        "updates/s 25000 | return 12.3 | standing time 3.2 s | min distance 0.44 m | hops 2 hops | "
        "q mean 7 | eval standing time 9.9 s"
    )


def test_terminal_shows_a_live_panel(tmp_path: Path) -> None:
    text = io.StringIO()
    console = Console(file=text, force_terminal=True, width=120)
    with RunLogger([make_info(tmp_path)], console=console) as logger:
        with logger.compiling("train_epoch"):
            logger._terminal._live.refresh()  # type: ignore[union-attr]
        logger.log(500, 1000, {"return": 42.0, "critic_loss": 0.125})
    shown = text.getvalue()
    assert "compiling train_epoch ... 0 s" in shown
    for part in ("biped-0", "500 / 1k env steps", "42.0", "0.125", "ETA"):
        assert part in shown


def test_the_last_panel_of_a_run_of_one_epoch_shows_a_rate(tmp_path: Path, clock: FakeTime) -> None:
    """Its only epoch is the one that was compiled, which has no rate of its own."""
    text = io.StringIO()
    console = Console(file=text, force_terminal=True, width=120)
    with RunLogger([make_info(tmp_path)], console=console) as logger:
        with logger.compiling("train_epoch"):
            clock.now += 20.0
        logger.log(500, 1000, {"return": 42.0})
        assert "with compilation" not in text.getvalue()
    assert "env steps/s with compilation 25" in re.sub(r"\x1b\[[0-9;]*m", "", text.getvalue())


class Recorder:
    """A sink that keeps what it is told, and fails when asked to."""

    def __init__(self, fails_in: str = "") -> None:
        self.calls: list[Any] = []
        self.fails_in = fails_in

    def _note(self, name: str, *args: Any) -> None:
        self.calls.append((name, *args))
        if name == self.fails_in:
            raise RuntimeError("no\nnetwork")

    def open(self, run: RunInfo) -> None:
        self._note("open", run.resume_env_steps)

    def log(self, *args: Any) -> None:
        self._note("log", *args)

    def close(self) -> None:
        self._note("close")


def test_a_chosen_sink_gets_what_the_table_gets(tmp_path: Path, clock: FakeTime) -> None:
    sink = Recorder()
    with make_logger(tmp_path, sinks=(sink,), resume_env_steps=100) as logger:
        clock.now += 3.0
        logger.log(200, 400, {"standing_time": 2.0, "q_mean": float("nan")})
    (_, steps, updates, wall_s, values) = sink.calls[1]
    assert [call[0] for call in sink.calls] == ["open", "log", "close"]
    assert sink.calls[0] == ("open", 100)
    assert (steps, updates, wall_s) == (200, 400, 3.0)
    assert dict(values) == {"standing_time": 2.0}
    with pytest.raises(TypeError):
        values["standing_time"] = 1.0


@pytest.mark.parametrize(
    ("fails_in", "calls"),
    [("open", ["open"]), ("log", ["open", "log"]), ("close", ["open", "log", "log", "close"])],
)
def test_a_sink_that_fails_is_announced_once_and_dropped(
    fails_in: str, calls: list[str], tmp_path: Path
) -> None:
    text = io.StringIO()
    bad, good = Recorder(fails_in), Recorder()
    with make_logger(tmp_path, text, (bad, good)) as logger:
        logger.log(10, 0, {"q_mean": 1.0})
        logger.log(20, 0, {"q_mean": 2.0})
    said = "sink Recorder failed and is dropped: RuntimeError: no network\n"
    assert text.getvalue().count(said) == 1
    assert [call[0] for call in bad.calls] == calls
    assert [call[0] for call in good.calls] == ["open", "log", "log", "close"]
    assert values_of(tmp_path, "q_mean") == [1.0, 2.0]


def test_names_of_a_run_may_hold_any_line_separator(tmp_path: Path) -> None:
    info = make_info(tmp_path)
    odd = {**IDENTITY, "run": "a\u2028b"}
    for resume, value in ((None, 1.0), (10, 2.0)):
        changed = RunInfo(tmp_path, odd, info.total_env_steps, "train", resume, MEASURES, LEARNING)
        with RunLogger([changed], console=Console(file=io.StringIO())) as logger:
            logger.log(10 * int(value), 0, {"q_mean": value})
    assert values_of(tmp_path, "q_mean") == [1.0, 2.0]
    assert {row["run"] for row in read_rows(tmp_path)} == {"a\u2028b"}


@pytest.mark.parametrize(
    ("number", "text"), [(0, "0"), (950, "950"), (12_345, "12.3k"), (1_250_000, "1.25M")]
)
def test_counts(number: int, text: str) -> None:
    assert format_count(number) == text


def test_durations() -> None:
    assert format_seconds(3723.4) == "1:02:03"
    assert format_seconds(None) == "-:--:--"
