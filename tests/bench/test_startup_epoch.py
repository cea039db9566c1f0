"""Start-up and epoch: what is run, what counts as started, how the cost is split."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from twirl_mjx.bench import epoch, startup
from twirl_mjx.bench.epoch import EpochBench
from twirl_mjx.bench.startup import StartupBench
from twirl_mjx.commands.options import parse_train
from twirl_mjx.training.presets import PRESETS, make_config
from twirl_mjx.training.sinks.table import COLUMNS

HEADER = ",".join(COLUMNS)


@pytest.mark.parametrize("preset", PRESETS)
def test_child_updates_in_its_first_epoch_at_the_preset_s_shapes(
    preset: str, tmp_path: Path
) -> None:
    words = startup.command(StartupBench(preset=preset), tmp_path)
    assert words[1:4] == ["-m", "twirl_mjx", "train"]
    options = parse_train(words[4:])
    config, base = options.config, make_config("stand", preset)
    assert (config.droq, config.num_envs, config.replay) == (base.droq, base.num_envs, base.replay)
    assert options.preset == preset
    assert config.steps_per_epoch == 2
    # The first vector step ends the warm-up, the second is followed by updates.
    assert config.warmup_env_steps == config.num_envs
    assert config.updates_per_step >= 1


def test_started_means_a_whole_row_with_updates(tmp_path: Path) -> None:
    path = tmp_path / "metrics.csv"
    assert not startup.has_updates(path)
    path.write_text(HEADER + "\n")
    assert not startup.has_updates(path)
    path.write_text(f"{HEADER}\nr,stand,none,scratch,0,reward,64,0,1.0,0.5\n")
    assert not startup.has_updates(path)
    with path.open("a") as file:
        file.write("r,stand,none,scratch,0,reward,128,6")
    assert not startup.has_updates(path)
    with path.open("a") as file:
        file.write("4,2.0,0.5\n")
    assert startup.has_updates(path)


def replace_child(monkeypatch: pytest.MonkeyPatch, code: str) -> None:
    monkeypatch.setattr(startup, "command", lambda options, runs: [sys.executable, "-c", code])


def test_start_that_fails_is_reported(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    replace_child(monkeypatch, "raise SystemExit('broken')")
    with pytest.raises(RuntimeError, match=r"no critic update after \d+ s: broken"):
        startup.start_once(StartupBench(), tmp_path / "cache", tmp_path)


def test_child_gets_the_cache_of_the_measurement(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The cache that this process uses must not warm the child's start."""
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "somewhere")
    code = "import os; raise SystemExit(f'{dict(os.environ)}')"
    replace_child(monkeypatch, code)
    with pytest.raises(RuntimeError):
        startup.start_once(StartupBench(), tmp_path / "cache", tmp_path)
    log = (tmp_path / "log.txt").read_text()
    assert f"'TWIRL_CACHE_DIR': '{tmp_path / 'cache'}'" in log
    assert "JAX_COMPILATION_CACHE_DIR" not in log


def test_epoch_is_short_and_past_the_warm_up() -> None:
    for preset in PRESETS:
        config = EpochBench(preset=preset).config
        assert config.warmup_env_steps == config.num_envs
        assert config.steps_per_epoch * config.updates_per_step <= max(640, config.updates_per_step)
        assert config.droq == make_config("stand", preset).droq


def test_split_adds_up() -> None:
    """40 vector steps of 32 updates in 4 blocks, 10 s."""
    config = EpochBench(preset="cpu").config
    assert (config.steps_per_epoch, config.blocks_per_step) == (20, 4)
    rates = {
        "physics": 10.0,  # 2 s
        "worlds": 8.0,  # 2.5 s, so 0.5 s of environment logic
        "act": 200.0,
        "insert": 100.0,
        "sample": 400.0,  # of 80 blocks: 0.2 s
        "update": 20.0,  # 4 s
        "actor": 80.0,  # 1 s of these
    }
    found = epoch.split(config, rates, 10.0)
    assert found["seconds"] == pytest.approx(
        {
            "physics": 2.0,
            "environment": 0.5,
            "act": 0.1,
            "insert": 0.2,
            "sample": 0.2,
            "critic": 3.0,
            "actor": 1.0,
        }
    )
    assert found["unaccounted_s"] == pytest.approx(3.0)
    assert found["shares"]["critic"] == pytest.approx(0.3)


def test_peak_memory_is_that_of_a_process_with_jax() -> None:
    assert 100 < epoch.peak_memory_mb() < 1e6


def run_part(*words: str) -> dict:
    done = subprocess.run(
        [sys.executable, "-m", "twirl_mjx", "bench", *words, "--json"],
        capture_output=True,
        text=True,
        timeout=1200,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout)


@pytest.mark.slow
@pytest.mark.timeout(1300)
def test_startup_measured_from_the_shell() -> None:
    found = run_part("startup", "--preset", "debug", "--repeats", "1")
    assert found["cold_s"] > found["warm_s"] > 1.0
    assert found["cache_mb"] > 0.1


@pytest.mark.slow
@pytest.mark.timeout(1300)
def test_epoch_measured_from_the_shell() -> None:
    found = run_part("epoch", "--preset", "debug", "--seconds", "3")
    assert found["epoch_s"] > 0
    assert set(found["seconds"]) == {
        "physics", "environment", "act", "insert", "sample", "critic", "actor",
    }  # fmt: skip
    assert found["peak_memory_mb"] > 100
