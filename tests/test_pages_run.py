"""What the pages tell people to type: command lines are understood, Python runs as it stands."""

from __future__ import annotations

import ast
import contextlib
import importlib
import importlib.util
import json
import os
import re
import shlex
import subprocess
import sys
import textwrap
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import twirl_mjx
from twirl_mjx import cli
from twirl_mjx.commands import console

ROOT = Path(__file__).resolve().parents[1]
PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "experiments/README.md")),
    *sorted((ROOT / "docs").glob("*.md")),
    ROOT / "assets" / "policies" / "README.md",
]
FENCE = re.compile(r"^ *```(\w*)[^\n]*\n(.*?)^ *```", re.M | re.S)
INLINE = re.compile(r"(?<!`)`([^`]+)`(?!`)")
COMMAND = re.compile(r"(?:\.venv/bin/)?(?:twirl|make) [a-z]")
PLACEHOLDER = re.compile(
    r"\.\.\.|…|\b[A-Z]{2,}\b(?!=)|=\.\.|=k\b|[$\[{<|>]|\bmy[_.]|/mine\b|\bX\b|\bgo1\.py\b"
)
"""What stands for something else: `make render RUN=runs/NAME`, `twirl sweep my_grid.py`; or needs a
file that is not here: `examples/go1.py` reads the MJCF of another package."""


def blocks(page: Path, *languages: str) -> Iterator[str]:
    for language, text in FENCE.findall(page.read_text(encoding="utf-8")):
        if language in languages:
            yield textwrap.dedent(text)


def commands(page: Path) -> Iterator[str]:
    """Yield the command lines of `twirl` and `make` of a page, each on one line."""
    for block in blocks(page, "sh", "bash", "console"):
        for line in block.replace("\\\n", " ").splitlines():
            yield re.sub(r"(^|\s)#.*", "", line).strip()
    prose = FENCE.sub("", page.read_text(encoding="utf-8"))
    for code in INLINE.findall(prose):
        if len(code.split()) > 2:  # `twirl render` is a name
            yield " ".join(code.split())


LINES = sorted(
    {
        line
        for page in PAGES
        for line in commands(page)
        if COMMAND.match(line) and not PLACEHOLDER.search(line)
    }
)


class Understood(BaseException):
    """The options of a command fit; it is not run."""


def understood(argv: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a command parse its options and stop there."""
    parse = console.tyro.cli

    def only_parse(*args: Any, **more: Any) -> None:
        parse(*args, **more)
        raise Understood

    monkeypatch.setattr(console.tyro, "cli", only_parse)
    monkeypatch.setattr(cli, "probe_gl", lambda environ: "disable")
    monkeypatch.setenv("MUJOCO_GL", "disable")
    with contextlib.suppress(Understood):
        assert cli.main(argv) == 0, argv


@pytest.mark.slow
@pytest.mark.parametrize("line", LINES)
def test_command_lines_are_understood(
    line: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(ROOT)
    if line.startswith("make"):
        made = subprocess.run(
            ["make", "-n", *shlex.split(line)[1:]], capture_output=True, text=True, check=False
        )
        assert made.returncode == 0, made.stderr
        found = re.findall(r"^\.venv/bin/(twirl .*)$", made.stdout.replace("\\\n", " "), re.M)
    else:
        found = [line.removeprefix(".venv/bin/")]
    for command in found:
        try:
            understood(shlex.split(command)[1:], monkeypatch)
        except SystemExit as ending:
            assert ending.code == 0, capsys.readouterr()


def test_command_lines_are_found() -> None:
    assert len(LINES) > 40
    assert {line.split()[0] for line in LINES} == {"make", "twirl", ".venv/bin/twirl"}


PYTHON = [(page, text) for page in PAGES for text in blocks(page, "python")]


@pytest.mark.parametrize(
    ("page", "text"), PYTHON, ids=[f"{p.name}-{i}" for i, (p, _) in enumerate(PYTHON)]
)
def test_python_of_the_pages_names_what_exists(page: Path, text: str) -> None:
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("twirl_mjx"):
            module = importlib.import_module(node.module or "")
            for alias in node.names:
                if not hasattr(module, alias.name):
                    importlib.import_module(f"{node.module}.{alias.name}")
        match node:
            case ast.Attribute(value=ast.Name(id="twirl_mjx"), attr=name):
                assert hasattr(twirl_mjx, name), (page, name)


def test_a_wrong_option_is_not_understood(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(SystemExit) as ending:
        understood(["rehearse", "policy.npz", "--episods", "2"], monkeypatch)
    assert ending.value.code == 2


SHORTER = {
    "num_envs=256": "num_envs=2",
    "num_envs=64": "num_envs=2",
    '"runs/biped-twirl-cpu-s0"': "POLICY",
    '"assets/policies/biped.npz"': "POLICY",
}
"""Parts of the pages' Python that would take long, or need a run, and what stands for them."""
GIVEN = """
import jax, numpy as np, twirl_mjx
from twirl_mjx.assets import asset_path
from twirl_mjx.deploy.conditions import IDEAL
from twirl_mjx.deploy.ground import build_model
POLICY = str(asset_path("policies", "biped.npz"))
action, obs = np.zeros((2, 12), np.float32), np.zeros(101, np.float32)
model = build_model(IDEAL, np.zeros(0))
qpos = np.repeat(model.key("home").qpos[None], 3, axis=0)
"""
"""What the pages speak of before: actions, an observation, a trajectory."""
RUN = (("adapters.md", 0), ("adapters.md", 1), ("shifts.md", 1), ("view.md", 0))
"""Page and block. The others show a form (a task, a sink), or need packages and results of
one's own."""


PATIENCE_S = 1500
"""s, longest that a shortened example may take on a machine that does other things as well."""


def run_python(text: str, folder: Path) -> None:
    for long, short in SHORTER.items():
        text = text.replace(long, short)
    done = subprocess.run(
        [sys.executable, "-c", GIVEN + text],
        cwd=folder, env=os.environ | {"PYTHONPATH": str(ROOT)}, timeout=PATIENCE_S - 20,
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "Warning" not in done.stderr and "Failed" not in done.stderr, done.stderr


@pytest.mark.slow
@pytest.mark.timeout(PATIENCE_S)
@pytest.mark.parametrize(("name", "place"), RUN)
def test_python_of_the_pages_runs(name: str, place: int, tmp_path: Path) -> None:
    page = next(page for page in PAGES if page.name == name)
    run_python(list(blocks(page, "python"))[place], tmp_path)


NOTEBOOK = ROOT / "examples" / "first_steps.ipynb"


def cells() -> list[dict[str, Any]]:
    found = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    return [cell for cell in found if cell["cell_type"] == "code"]


def test_the_notebook_was_executed_and_is_small() -> None:
    assert NOTEBOOK.stat().st_size < 300_000
    counts = [cell["execution_count"] for cell in cells()]
    assert counts == list(range(1, len(counts) + 1))
    outputs = [output for cell in cells() for output in cell["outputs"]]
    assert not [o for o in outputs if o["output_type"] == "error" or o.get("name") == "stderr"]
    kinds = {kind for output in outputs for kind in output.get("data", {})}
    assert {"image/png", "text/html"} <= kinds  # the curves and the film
    assert "/root" not in NOTEBOOK.read_text() and "/tmp" not in NOTEBOOK.read_text()


def test_the_notebook_installs_the_package_where_it_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In Colab the wheel comes by upload; in a checkout nothing happens."""
    called: list[list[str]] = []
    wheel = "twirl_mjx-0.2.0-py3-none-any.whl"
    files = types.SimpleNamespace(upload=Path(wheel).touch)
    install = "".join(cells()[0]["source"])
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(subprocess, "check_call", called.append)
    exec(install, {})
    assert called == []
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    monkeypatch.setitem(sys.modules, "google.colab", types.SimpleNamespace(files=files))
    exec(install, {})
    assert [command[1:] for command in called] == [["-m", "pip", "install", "--quiet", wheel]]


@pytest.mark.slow
@pytest.mark.timeout(PATIENCE_S)
def test_the_notebook_runs(tmp_path: Path) -> None:
    """Its code as it stands, but for a training and a film of seconds; the film goes nowhere."""
    text = "\n".join("".join(cell["source"]) for cell in cells())
    shown = (
        "import sys, types\n"
        "def video(path, **options): print(path)\n"
        "sys.modules['IPython.display'] = types.SimpleNamespace(Video=video)"
    )
    settings = re.compile(r'    preset="cpu",.*?    say=', re.S)
    short = settings.sub('    preset="debug",\n    say=', text)
    assert "total_env_steps" in text and "total_env_steps" not in short
    for long, brief in (("plt.show()", ""), ("steps=80", "steps=8"), ("episodes=2", "episodes=1")):
        assert long in short
        short = short.replace(long, brief)
    run_python(f"{shown}\n{short}", tmp_path)
    for name in ("first-steps-film.mp4", "first-steps.html", "first-steps/policy.npz"):
        assert (tmp_path / "runs" / name).is_file()


# ---- the command blocks, in order, on a clean clone

SHORT = "--preset debug"
BRIEF = {
    r"make demo$": 'make demo ARGS="--episodes 1 --no-film"',
    r"make train TASK=biped$": f'make train TASK=biped ARGS="{SHORT} --name biped-twirl-cpu-s0"',
    r"make train TASK=examples/trot.py:Trot$": f"make train TASK=examples/trot.py:Trot"
    f' ARGS="{SHORT}"',
    r"make view$": 'make view ARGS="--seconds 1 --html live.html --overwrite"',
    r"make test$": 'make test ARGS="-n 0 -q tests/test_links.py"',
    r"make lint$": ".venv/bin/ruff check -q .",
    r"make figures$": 'make figures ARGS="--no-pictures"',
    r"make report$": "mkdir -p build/one && cp -r experiments/results/trot build/one/ &&"
    ' make report ARGS="--results build/one"',
    r"(make sweep .*--reduced)\"$": r'\1 --dry-run"',
    r"(.*twirl train .*--seeds) 0 1 2 3(.*)": rf"\1 0 1\2 {SHORT}",
    r"(.*twirl train .*) --and (.*)": rf"\1 {SHORT} --and \2 {SHORT}",
    r"(.*twirl train .*trot48.*)": rf"\1 {SHORT}",
    r"(.*twirl render .*)": r"\1 --seconds 1 --panels 2",
    r"(.*twirl rehearse .*)": r"\1 --episodes 1 --robot.episode-s 2",
    r"(.*twirl evaluate .*)": r"\1 --episodes 1 --shifts none",
    r"(.*twirl view(?: runs\S*)?)$": r"\1 --seconds 1 --html live.html --overwrite",
    r"(.*twirl view .*--html .*)": r"\1 --seconds 1",
}
"""Command line -> its shortened form; what is not here runs as it stands."""
LEFT_OUT = {
    r"make setup|make format|\.ci/run": "an environment, and what CI does",
    r"docker ": "no container engine",
    r"make web": "tests/view/test_web.py does it",
    r".*http\.server": "serves until it is stopped",
    r".*downloaded\.onnx": "a file of the reader's",
    r"(T|MILD)=|.*train \$T": "hours of runs that made a shipped policy",
    r"twirl curriculum --target": "hours; tests/sweep/test_contest.py has a short one",
    r"make gpu|make test-gpu": "needs a GPU, or gigabytes",
}
"""Lines that are not run -> why."""
BLOCKS = [page for page in PAGES if any(blocks(page, "sh", "bash", "console"))]


@pytest.fixture(scope="module")
def clone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What is committed, in a folder with a blank, with the environment of this checkout."""
    folder = tmp_path_factory.mktemp("pages") / "a clone"
    subprocess.run(["git", "clone", "-q", str(ROOT), str(folder)], check=True)
    (folder / ".ci" / "setup").write_text("#!/bin/sh\n")
    (folder / ".venv" / "bin").mkdir(parents=True)
    for name in ("twirl", "pytest", "ruff", "python"):
        module = {"twirl": "-m twirl_mjx ", "python": ""}.get(name, f"-m {name} ")
        script = folder / ".venv" / "bin" / name
        script.write_text(f'#!/bin/sh\nexec {shlex.quote(sys.executable)} {module}"$@"\n')
        script.chmod(0o755)
    return folder


def shell_lines(page: Path) -> Iterator[str]:
    for block in blocks(page, "sh", "bash", "console"):
        for line in block.replace("\\\n", " ").splitlines():
            if text := re.sub(r"(^|\s)#.*", "", line).strip():
                yield text


def brief(line: str) -> str:
    """Return what is run for a line; empty where nothing is."""
    if any(re.match(pattern, line) for pattern in LEFT_OUT):
        return ""
    for pattern, short in BRIEF.items():
        if re.fullmatch(pattern, line):
            return re.sub(pattern, short, line)
    return line


def test_every_shortened_and_every_omitted_line_is_on_a_page() -> None:
    lines = [line for page in BLOCKS for line in shell_lines(page)]
    for pattern in (*LEFT_OUT, *BRIEF):
        if not pattern.startswith("make gpu"):
            assert any(re.match(pattern, line) for line in lines), pattern
    assert not [line for line in lines if "make train" in line and "debug" not in brief(line)]


@pytest.mark.slow
@pytest.mark.timeout(2 * PATIENCE_S)
@pytest.mark.parametrize("page", BLOCKS, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_command_blocks_run_in_order(page: Path, clone: Path) -> None:
    environ = os.environ | {"PYTHONPATH": str(clone), "MPLBACKEND": "Agg"}
    environ["PATH"] = f"{clone / '.venv' / 'bin'}{os.pathsep}{environ['PATH']}"
    for line in filter(None, map(brief, shell_lines(page))):
        done = subprocess.run(["sh", "-c", line], cwd=clone, env=environ, timeout=PATIENCE_S,
                              capture_output=True, text=True, check=False)  # fmt: skip
        assert done.returncode == 0, f"{line}\n{done.stdout[-2000:]}{done.stderr[-2000:]}"
        assert "Traceback" not in done.stderr, f"{line}\n{done.stderr[-2000:]}"
