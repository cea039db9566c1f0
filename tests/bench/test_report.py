"""Tables for every part, the marked section of a page, and the command around them."""

from __future__ import annotations

import json
import os
import signal
import threading
import time
from pathlib import Path
from typing import Any

import psutil
import pytest

from twirl_mjx import cli
from twirl_mjx.bench import report
from twirl_mjx.commands import bench

PAGE = Path(__file__).resolve().parents[2] / "docs" / "performance.md"

MACHINE = {
    "processor": "Fast",
    "cpus": 2,
    "memory_gb": 8.0,
    "devices": ["cpu cpu"],
    "load_before": 0.1,
    "versions": {"jax": "1.2", "commit": "abc", "brax": "0"},
}

LEARNER: dict[str, Any] = {
    "part": "learner",
    "critic_updates_per_s": 500.0,
    "matmul_bound_updates_per_s": 1000.0,
    "matmul_bound_layout": "batch last",
    "share_of_matmul_bound": 0.5,
    "seeds": 2,
    "seeds_updates_per_s": 600.0,
    "workers": 2,
    "workers_updates_per_s": 800.0,
    "workers_reason": None,
    "sbx_updates_per_s": 200.0,
    "sbx_reason": None,
    "compile_s": 6.5,
    "form": "fast",
    "matmul_dtype": "float32",
    "detail": {
        name: {"median": 1.0, "spread": 0.07, "samples": [1.0]}
        for name in ("single", "seeds", "sbx", "batch last")
    },
    "machine": MACHINE,
} | dict(obs=101, action=12, batch=256, utd=20, hidden=256)

WORLDS: dict[str, Any] = {
    "part": "worlds",
    "task": "stand",
    "rows": [
        {
            "engine": "native",
            "num_envs": 1024,
            "control_steps_per_s": 12_345.6,
            "control_steps_spread": 0.02,
            "physics_steps_per_s": 123_456.0,
            "bare_physics_steps_per_s": 130_000.0,
            "environment_overhead": 0.053,
            "compile_s": 4.2,
        }
    ],
    "skipped": [{"engine": "mjx", "num_envs": 16, "reason": "no time"}],
    "native_over_mjx": {"128": 3.456},
    "envpool_quadruped_steps_per_s": None,
    "envpool_reason": "envpool is not installed",
    "machine": MACHINE,
}

STARTUP: dict[str, Any] = {
    "part": "startup",
    "task": "stand",
    "preset": "cpu",
    "cold_s": 40.44,
    "warm_s": 8.0,
    "cache_mb": 31.4,
    "machine": MACHINE,
}

EPOCH: dict[str, Any] = {
    "part": "epoch",
    "task": "stand",
    "preset": "cpu",
    "engine": "native",
    "num_envs": 64,
    "env_steps": 1280,
    "critic_updates": 640,
    "epoch_s": 2.0,
    "seconds": {"physics": 0.5, "critic": 1.25},
    "shares": {"physics": 0.25, "critic": 0.625},
    "unaccounted_s": 0.25,
    "spread": 0.1,
    "peak_memory_mb": 1234.5,
    "machine": MACHINE,
}

PARTS = {"learner": LEARNER, "worlds": WORLDS, "startup": STARTUP, "epoch": EPOCH}


@pytest.mark.parametrize(
    ("value", "text"),
    [(None, "-"), (0.0, "0"), (2.345, "2.35"), (99.96, "100"), (123.4, "123"), (12345.6, "12,346")],
)
def test_numbers(value: float | None, text: str) -> None:
    assert report.number(value) == text


def test_every_part_has_its_table() -> None:
    sheets = {sheet.title: sheet for sheet in report.sheets_of(PARTS)}
    assert list(sheets) == ["Learner", "Worlds", "Start-up", "One training epoch"]
    assert sheets["Learner"].rows == (
        ("one learner, fast", "500", "7 %", "2.5"),
        ("2 seeds, one program", "600", "7 %", "3"),
        ("2 pinned processes", "800", "-", "4"),
        ("SBX DroQ", "200", "7 %", "1"),
        ("matrix products only", "1,000", "7 %", "5"),
    )
    assert "50 % of the bound" in sheets["Learner"].note
    worlds = ("native", "1,024", "12,346", "2 %", "123,456", "130,000", "5 %", "4.2")
    assert sheets["Worlds"].rows == (worlds,)
    assert "mjx with 16 worlds: no time" in sheets["Worlds"].note
    assert "128 worlds: 3.46" in sheets["Worlds"].note
    assert "envpool is not installed" in sheets["Worlds"].note
    assert sheets["Start-up"].rows == (("empty cache", "40.4"), ("filled cache", "8.0"))
    assert sheets["One training epoch"].rows == (
        ("physics", "500.0", "25 %"),
        ("critic", "1250.0", "62 %"),
        ("unaccounted", "250.0", "12 %"),
    )
    assert "1,234 MB" in sheets["One training epoch"].note or "1,235 MB" in (
        sheets["One training epoch"].note
    )
    for sheet in sheets.values():
        assert {len(row) for row in sheet.rows} == {len(sheet.columns)}


def test_what_was_not_measured_shows_its_reason() -> None:
    alone = LEARNER | {
        "sbx_updates_per_s": None,
        "sbx_reason": "no environment .venv-bench",
        "workers_updates_per_s": None,
        "workers_reason": "switched off",
        "detail": {name: LEARNER["detail"][name] for name in ("single", "seeds", "batch last")},
    }
    sheet = report.learner_sheet(alone)
    assert [row[3] for row in sheet.rows] == ["-"] * 5
    assert "no environment .venv-bench" in sheet.note
    assert "switched off" in sheet.note
    failed = report.sheets_of({"epoch": {"part": "epoch", "error": "stopped | after\n3 s"}})
    assert "| stopped \\| after 3 s |" in report.markdown(failed, MACHINE)


def test_markdown_tables_are_whole() -> None:
    text = report.markdown(report.sheets_of(PARTS), MACHINE)
    assert text.startswith("Fast, 2 CPUs used, 8 GB, cpu cpu; jax 1.2, commit abc;")
    for line in text.splitlines():
        if line.startswith("|"):
            assert line.endswith("|"), line
    assert "| SBX DroQ | 200 | 7 % | 1 |" in text


def test_section_is_replaced_and_nothing_else() -> None:
    page = f"# Top\n\n{report.BEGIN}\n\nold\n\n{report.END}\n\nbottom\n"
    once = report.replace_section(page, "new")
    assert once == f"# Top\n\n{report.BEGIN}\n\nnew\n\n{report.END}\n\nbottom\n"
    assert report.replace_section(once, "new") == once


@pytest.mark.parametrize(
    "page",
    ["", report.BEGIN, f"{report.END}{report.BEGIN}", f"{report.BEGIN}{report.END}{report.END}"],
)
def test_page_without_both_markers_is_refused(page: str) -> None:
    with pytest.raises(ValueError, match="once each and in order"):
        report.replace_section(page, "new")


def test_the_project_s_page_has_the_section() -> None:
    report.replace_section(PAGE.read_text(encoding="utf-8"), "new")


def test_unknown_part_suggests_the_nearest(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["bench", "world"]) == 2
    assert "nearest: 'worlds'" in capsys.readouterr().err
    assert cli.main(["bench", "--help"]) == 0
    assert "startup" in capsys.readouterr().out


def test_parts_get_the_options_that_apply() -> None:
    options = bench.AllBench(seconds=5.0, task="biped", preset="debug")
    assert bench.part_arguments("learner", options) == ["--json", "--seconds", "5.0"]
    assert bench.part_arguments("startup", options) == [
        "--json", "--task", "biped", "--preset", "debug",
    ]  # fmt: skip
    assert "--preset" not in bench.part_arguments("worlds", options)


def test_part_that_fails_or_has_no_time_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    assert "no time left" in bench.run_part("epoch", [], 0.0)["error"]
    monkeypatch.setattr(bench.sys, "executable", "false")
    assert bench.run_part("epoch", [], 60.0) == {"part": "epoch", "error": "ended with status 1"}


def wait_for(path: Path) -> None:
    deadline = time.monotonic() + 20.0
    while not path.exists() and time.monotonic() < deadline:
        time.sleep(0.01)


def is_running(number: int) -> bool:
    try:
        return psutil.Process(number).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


@pytest.fixture
def child_of_part(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A part that starts a process and waits; the file gets the number of that process."""
    note = tmp_path / "child"
    script = f"sleep 60 & echo $! > {note}.new; mv {note}.new {note}; wait"
    monkeypatch.setattr(bench, "part_command", lambda name, arguments: ["sh", "-c", script])
    return note


def assert_ended(note: Path) -> None:
    child = int(note.read_text())
    deadline = time.monotonic() + 5.0
    while is_running(child) and time.monotonic() < deadline:
        time.sleep(0.01)
    assert not is_running(child)


def test_rows_of_worlds_that_ran_out_of_time_are_the_record(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def command(name: str, words: list[str]) -> list[str]:
        assert words[-2] == "--keep"
        return ["sh", "-c", f'echo \'{{"part": "worlds"}}\' > {words[-1]}; sleep 60']

    monkeypatch.setattr(bench, "part_command", command)
    assert bench.run_part("worlds", [], 1.0) == {"part": "worlds"}


def test_part_out_of_time_ends_with_its_children(child_of_part: Path) -> None:
    assert "stopped after" in bench.run_part("startup", [], 0.5)["error"]
    assert_ended(child_of_part)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_interrupted_part_ends_with_its_children(
    child_of_part: Path, number: signal.Signals
) -> None:
    def interrupt() -> None:
        wait_for(child_of_part)
        os.kill(os.getpid(), number)

    def ignore(number: int, frame: Any) -> None:
        """Stand for what the process does otherwise, which would end the tests."""

    own = signal.default_int_handler if number == signal.SIGINT else ignore
    before = signal.signal(number, own)  # tests in the background (`make test &`) ignore SIGINT
    sender = threading.Thread(target=interrupt)
    try:
        sender.start()
        with pytest.raises(KeyboardInterrupt):
            bench.run_part("startup", [], 5.0)
        assert signal.getsignal(number) is own
    finally:
        sender.join()
        signal.signal(number, before)
    assert_ended(child_of_part)


def test_part_dies_with_the_command() -> None:
    words = bench.part_command("epoch", ["--json"])
    assert words[words.index(str(os.getpid())) :][2:] == [
        bench.sys.executable, "-m", "twirl_mjx", "bench", "epoch", "--json",
    ]  # fmt: skip
    assert words[2].endswith("launch.py")


def test_everything_is_written(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = dict(PARTS)
    monkeypatch.setattr(bench, "run_part", lambda name, arguments, left: given[name])
    page, out = tmp_path / "page.md", tmp_path / "runs" / "bench.json"
    page.write_text(f"# Speed\n{report.BEGIN}{report.END}\n")
    words = ["bench", "--page", str(page), "--out", str(out)]
    assert cli.main(words) == 0
    first = page.read_text()
    assert "SBX DroQ" in first
    assert json.loads(out.read_text())["parts"] == PARTS
    assert "SBX DroQ" in capsys.readouterr().out
    for changed, why in (
        ({"part": "epoch", "error": "stopped"}, "epoch: stopped"),
        (EPOCH | {"spread": 0.21}, "epoch: samples spread by 21 %"),
    ):
        given["epoch"] = changed
        assert cli.main(words) == 1
        assert page.read_text() == first
        assert f"stay as they were: {why}" in " ".join(capsys.readouterr().out.split())
        assert json.loads(out.read_text())["parts"]["epoch"] == changed


def test_noise_and_contradictions_are_doubts() -> None:
    assert report.doubts(PARTS) == []
    noisy = {"single": {"spread": 0.3}, "sbx": {"spread": 0.2}}
    row = WORLDS["rows"][0] | {"control_steps_spread": 0.5}
    assert report.doubts(
        {
            "learner": LEARNER | {"detail": noisy, "share_of_matmul_bound": 1.52},
            "worlds": WORLDS | {"rows": [row]},
            "epoch": EPOCH | {"unaccounted_s": -1.3},
        }
    ) == [
        "learner: 152 % of a bound that nothing can be above",
        "epoch: its parts leave -65 % of it unaccounted",
        "learner, single: samples spread by 30 %",
        "worlds, native with 1024: samples spread by 50 %",
    ]


def test_page_is_checked_before_anything_is_measured(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(bench, "run_part", None)
    page = tmp_path / "page.md"
    page.write_text("no markers\n")
    assert cli.main(["bench", "all", "--page", str(page), "--out", str(tmp_path / "x.json")]) == 2
    assert cli.main(["bench", "all", "--page", str(tmp_path / "absent.md")]) == 2
    assert page.read_text() == "no markers\n"
