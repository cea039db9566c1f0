"""The command line: help, refusals, and the whole method on the debug preset."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from twirl_mjx import cli
from twirl_mjx.commands import options
from twirl_mjx.replay import dataset


def test_every_command_has_a_module_and_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--help"]) == 0
    text = capsys.readouterr().out
    for name in cli.COMMANDS:
        assert name in text
        assert hasattr(cli._import_command(name), "main"), name


def test_unknown_command_suggests_the_nearest(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["trian"]) == 2
    assert "nearest: 'train'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["train", "--task", "bipde"], "nearest: 'biped'"),
        (["train", "--task", "stand", "--preset", "cpuu"], "nearest: 'cpu'"),
        (["train", "--task", "stand", "--preset", "debug", "--droq.utd", "0.3"], "whole number"),
        (["train", "--task", "stand", "--preset", "debug", "--variant", "twirl"], "no source"),
        (["train", "--task", "biped", "--preset", "debug", "--source", "nowhere.npz"], "nowhere"),
        (["train", "--task", "biped", "--preset", "debug", "--shift", "icy"], "nominal run"),
        (["render", "nowhere"], "no policy at nowhere"),
        (["evaluate", "trot"], "give --task"),
        (["evaluate", "trot", "--task", "biped", "--goal-distance", "0"], "nearest: 0.01"),
        (["evaluate", "trot", "--task", "hurdles", "--hurdle-gap", "1"], "nearest: 1.4"),
        (["evaluate", "trot", "--task", "stand", "--hurdle-gap", "2"], "option of task hurdles"),
    ],
)
def test_bad_input_is_refused_before_anything_is_written(
    argv: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    assert cli.main(argv) == 2
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [("--droq.utdd", "2", "--droq.utd"), ("--replay.phi", "1.5", "nearest: 1.0")],
)
def test_bad_option_is_refused_with_the_nearest(
    option: str, value: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as error:
        options.parse_train(["--task", "stand", "--preset", "debug", option, value])
    assert error.value.code == 2
    printed = capsys.readouterr()
    words = " ".join((printed.err + printed.out).replace("│", " ").replace("|", " ").split())
    assert message in words


def test_whole_method_on_the_debug_preset(tmp_path: Path) -> None:
    command = [
        sys.executable, "-m", "twirl_mjx", "train", "--task", "biped", "--preset", "debug",
        "--runs", str(tmp_path),
    ]  # fmt: skip
    first = subprocess.run(command, capture_output=True, text=True, timeout=280, check=False)
    assert first.returncode == 0, first.stderr[-2000:]
    assert "stage 1 of 3" in first.stdout
    assert "stage 2 of 3" in first.stdout
    target = tmp_path / "biped-twirl-debug-s0"
    for name in ("policy.npz", "eval.csv", "metrics.csv", "source.npz"):
        assert (target / name).is_file(), name
    assert (tmp_path / "stand-scratch-debug-s0" / "policy.npz").is_file()
    header, data = dataset.read(
        target / "source.npz", task="biped", observation_size=101, action_size=12
    )
    assert header.size == len(data.reward) == 64
    again = subprocess.run(command, capture_output=True, text=True, timeout=280, check=False)
    assert again.returncode == 0, again.stderr[-2000:]
    assert "compiling" not in again.stdout, "a finished pipeline ran again"


def test_output_that_nobody_reads_is_no_crash() -> None:
    command = [sys.executable, "-m", "twirl_mjx", "train", "--help"]
    run = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert run.stdout is not None
    run.stdout.close()
    assert "Traceback" not in run.communicate(timeout=120)[1]
    assert run.returncode in (0, 141)  # 0 where the whole text fits into the pipe's buffer
