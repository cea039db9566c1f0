"""``.ci/setup``: refuses what does not fit, does nothing twice, and survives interruption.

The cases build the ``bench`` environment from an empty lock, which needs no network.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).resolve().parents[1] / ".ci" / "setup"


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A folder with a space in its name, the script, and an empty lock."""
    root = tmp_path / "a project"
    (root / ".ci").mkdir(parents=True)
    (root / "experiments").mkdir()
    (root / "experiments" / "bench-requirements.lock").touch()
    (root / "requirements.lock").touch()
    (root / "pyproject.toml").touch()
    shutil.copy(SCRIPT, root / ".ci")
    return root


def setup(project: Path, *arguments: str, **variables: str) -> subprocess.CompletedProcess[str]:
    inherited = {k: v for k, v in os.environ.items() if k not in {"PYTHON", "ACCEL"}}
    return subprocess.run(
        [str(project / ".ci" / "setup"), *arguments],
        env=inherited | variables,
        capture_output=True,
        text=True,
        timeout=200,
        check=False,
    )


def fake_python(folder: Path, version: str) -> Path:
    """An interpreter that answers every question as one of an unfit version does."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "python3"
    path.write_text(f"#!/bin/sh\necho '{version} is too old' >&2\nexit 1\n")
    path.chmod(0o755)
    return path


@pytest.mark.parametrize("accel", ["cuda11", "gpu"])
def test_unknown_accelerator_is_refused(project: Path, accel: str) -> None:
    result = setup(project, ACCEL=accel)
    assert result.returncode == 2
    assert f"unknown ACCEL '{accel}'" in result.stderr
    assert "cpu cuda12 cuda13 tpu" in result.stderr
    assert not (project / ".venv").exists()


def test_unknown_environment_is_refused(project: Path) -> None:
    result = setup(project, "tests")
    assert result.returncode == 2
    assert "valid: main bench gpu oldest docs audit" in result.stderr


def test_unfit_interpreter_is_named_with_the_range(project: Path) -> None:
    python = fake_python(project / "bin", "3.9.2")
    result = setup(project, PYTHON=str(python))
    assert result.returncode == 1
    assert str(python) in result.stderr
    assert "3.9.2 is too old" in result.stderr
    assert ">= 3.12" in result.stderr


def test_nothing_fits_lists_what_was_tried(project: Path, tmp_path: Path) -> None:
    tools = tmp_path / "bin"
    python = fake_python(tools, "3.8.1")
    for tool in ("sh", "sed", "cat", "cksum", "tr", "ls", "head", "dirname"):
        found = shutil.which(tool)
        assert found
        (tools / tool).symlink_to(found)
    places = ("/opt/homebrew/bin", "/usr/local/bin")
    if any(Path(place, f"python3.{minor}").exists() for place in places for minor in (12, 13, 14)):
        pytest.skip("an interpreter in a fixed place fits on this machine")
    result = setup(project, PATH=str(tools), HOME=str(tmp_path), PYENV_ROOT=str(tmp_path))
    assert result.returncode == 1
    assert f"{python}: 3.8.1 is too old" in result.stderr
    assert ">= 3.12" in result.stderr
    assert not (project / ".venv").exists()


def test_life_of_an_environment(project: Path) -> None:
    venv = project / ".venv-bench"
    stamp, started, leftover = (
        venv / name for name in (".setup-stamp", ".setup-started", "half-installed")
    )
    venv.mkdir()
    started.touch()
    leftover.touch()

    made = setup(project, "bench", PYTHON=sys.executable)
    assert made.returncode == 0, made.stderr
    assert "interrupted" in made.stderr
    assert stamp.exists()
    assert not started.exists()
    assert not leftover.exists()
    pip = subprocess.run([venv / "bin" / "python", "-c", "import pip"], check=False)
    assert pip.returncode == 0

    again = setup(project, "bench")
    assert (again.returncode, again.stderr) == (0, "")

    (project / "experiments" / "bench-requirements.lock").write_text("\n")
    changed = setup(project, "bench")
    assert changed.returncode == 0, changed.stderr
    assert "updating .venv-bench" in changed.stderr
    assert "making" not in changed.stderr
