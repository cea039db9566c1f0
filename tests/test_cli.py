"""The command line: help, refusals, and the whole method on the debug preset."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from twirl_mjx import cli, files
from twirl_mjx.commands import collect, demo, options, render
from twirl_mjx.replay import dataset
from twirl_mjx.sim.gl import RenderError
from twirl_mjx.training import collection, pipeline
from twirl_mjx.training.rundir import RunDir


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
        (["collect", "--task", "stand", "--preset", "debug"], "nearest: --source trot"),
        (["collect", "--task", "imitate", "--preset", "debug"], "nearest: --source clip"),
        (["collect", "--task", "stand", "--preset", "debug", "--shift", "icy"], "nominal run"),
        (["render", "nowhere"], "no policy at nowhere"),
        (["demo", "--seconds", "0", "--no-film"], "seconds = 0.0 is outside [0.1, 3600.0]"),
        (["evaluate", "trot"], "give --task"),
        (["evaluate", "trot", "--task", "stand", "--out", "."], "nearest: evaluation.csv"),
        (["evaluate", "trot", "--task", "stand", "--figure", "f.txt"], "nearest: f.png"),
        (["clip", "show", "none.json"], "none.json"),
        (["evaluate", "trot", "--task", "biped", "--biped.goal-distance", "0"], "nearest: 0.01"),
        (["evaluate", "trot", "--task", "hurdles", "--hurdles.gap", "1"], "nearest: 1.4"),
        (["evaluate", "trot", "--task", "stand", "--hurdles.gap", "2"], "option of task hurdles"),
        (["render", "trot", "--task", "biped", "--shift", "icey"], "nearest: 'icy'"),
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


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("seconds", 0.0, r"seconds = 0\.0 is outside .*nearest: 0\.1"),
        ("seconds", float("nan"), "seconds = nan"),
        ("panels", 0, "panels = 0"),
    ],
)
def test_films_that_cannot_be_made_are_refused(option: str, value: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        render.RenderOptions("trot", **{option: value})
    with pytest.raises(SystemExit) as error:
        cli.main(["render", "trot", f"--{option}", str(value)])
    assert error.value.code == 2


@pytest.fixture
def no_gl(monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine on which nothing can be drawn, and a user who has not chosen a backend."""

    def probe(environ: Any) -> str:
        raise RenderError("cannot draw")

    monkeypatch.setattr(cli, "probe_gl", probe)
    monkeypatch.setenv("MUJOCO_GL", "any")  # so that the next line is undone at the end
    monkeypatch.delenv("MUJOCO_GL")


@pytest.mark.usefixtures("no_gl")
@pytest.mark.parametrize(
    "argv", [["render", "--help"], ["clip", "make", "--help"], ["demo", "--help"]]
)
def test_help_needs_no_opengl(argv: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ending:
        cli.main(argv)
    assert ending.value.code == 0
    assert "--" in capsys.readouterr().out


@pytest.mark.usefixtures("no_gl")
def test_opengl_is_looked_for_when_something_is_drawn(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shown: list[str] = []
    monkeypatch.setattr(demo, "_show", lambda path, options: shown.append(path.stem))
    for argv in (["demo"], ["render", "trot", "--task", "stand"], ["clip", "show"]):
        assert cli.main(argv) == 1
        assert "cannot draw" in capsys.readouterr().err
    assert not shown
    assert cli.main(["demo", "--no-film"]) == 0
    assert "stand" in shown
    assert os.environ["MUJOCO_GL"] == "disable"


def test_commands_that_draw_import_mujoco_when_the_backend_is_chosen() -> None:
    code = """
import sys
from twirl_mjx import cli
for name in cli.DRAWING:
    cli._import_command(name)
assert not {"mujoco", "jax"} & set(sys.modules), sorted(sys.modules)
"""
    subprocess.run([sys.executable, "-c", code], timeout=250, check=True)


@pytest.mark.parametrize(
    ("run_dir", "existing", "collects", "message"),
    [
        (None, False, True, "done: "),
        (None, True, True, "done: "),
        (None, True, False, "source.npz already fits these settings"),
        (Path("runs/nominal"), False, False, "the replay of runs/nominal is the source data"),
    ],
)
def test_collect_says_what_happened(
    run_dir: Path | None, existing: bool, collects: bool, message: str, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    writes = True

    def source_data(config: Any, target: RunDir, source: Any, say: Any) -> None:
        if writes:
            files.write_text(target.dataset, "data")

    source = SimpleNamespace(identity={"origin": "x", "digest": "y"}, run_dir=run_dir, data=None)
    monkeypatch.setattr(pipeline, "find_source", lambda *_: source)
    monkeypatch.setattr(collection, "source_data", source_data)
    words = ["--task", "biped", "--preset", "debug", "--shift", "icy", "--runs", str(tmp_path)]
    path = tmp_path / "mine" / "source.npz"
    if existing:
        assert collect.main([*words, "--name", "mine"]) == 0
        capsys.readouterr()
    writes = collects
    assert collect.main([*words, "--name", "mine"]) == 0
    said = capsys.readouterr().out
    assert message in said
    assert ("done" in said) == collects == (path.exists() and "nothing" not in said)


@pytest.mark.slow
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


@pytest.mark.parametrize("name", ["a b/x", "a b/x.mp4", "a b/x.png"])
def test_a_name_with_its_ending_is_that_file(name: str) -> None:
    assert render.stem_of(Path(name)) == Path("a b/x")
    assert render.stem_of(Path("a b/x.1")) == Path("a b/x.1")


@pytest.mark.parametrize(
    ("argv", "ending"),
    [
        (["view", "--seconds", "0.1", "--html", "a ü.html"], "open it in any browser"),
        (["figures", "--results", "no ü"], "no ü: no such directory"),
    ],
)
def test_odd_surroundings_give_no_warning(argv: list[str], ending: str, tmp_path: Path) -> None:
    """Blanks and other letters in paths, no locale, no home: the one line, and nothing else."""
    folder = tmp_path / "some ü folder"
    folder.mkdir()
    odd = {"LC_ALL": "C", "HOME": "/proc/nowhere", "PATH": os.environ["PATH"]}
    odd["PYTHONPATH"] = str(Path(__file__).resolve().parents[1])
    done = subprocess.run(
        [sys.executable, "-m", "twirl_mjx", *argv],
        cwd=folder, env=odd, timeout=200,
        capture_output=True, text=True, encoding="utf-8", check=False,
    )  # fmt: skip
    lines = (done.stdout + done.stderr).splitlines()
    assert len(lines) == 1 and ending in lines[0], lines
