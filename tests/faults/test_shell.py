"""What is given to ``make`` is data: neither make nor the shell runs a word of it."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SCRIPT = '#!/bin/sh\nfor word in "$@"; do printf "<%s>" "$word"; done >> said\n'


def made(folder: Path, *words: str) -> str:
    """Run the Makefile with a ``twirl`` that writes down its words; return those."""
    shutil.copy(ROOT / "Makefile", folder)
    for name, text in ((".ci/setup", "#!/bin/sh\n"), (".venv/bin/twirl", SCRIPT)):
        path = folder / name
        path.parent.mkdir(parents=True)
        path.write_text(text)
        path.chmod(0o755)
    subprocess.run(["make", "-s", *words], cwd=folder, check=True, timeout=60, capture_output=True)
    return (folder / "said").read_text()


@pytest.mark.parametrize(
    "text",
    ["x; touch f", "x' ; touch f ; '", "$(touch f)", "`touch f`", "$(shell touch f)", "x&touch f",
     "x #", "$$HOME", "a,b", "ä b"],
)  # fmt: skip
def test_a_value_stays_one_word(text: str, tmp_path: Path) -> None:
    found = made(tmp_path, "train", f"TASK={text}", "SEED=3")
    assert found == f"<train><--task><{text}><--seed><3>"
    assert not (tmp_path / "f").exists()


def test_a_line_break_begins_no_command(tmp_path: Path) -> None:
    assert made(tmp_path, "sweep", "GRID=x\ntouch f #") == "<sweep><x touch f #>"
    assert not (tmp_path / "f").exists()


def test_several_runs_are_several_words_and_args_are_shell(tmp_path: Path) -> None:
    found = made(tmp_path, "evaluate", "RUN=runs/a runs/b;c", "ARGS=--shifts 'icy' --out \"a b\"")
    assert found == "<evaluate><runs/a><runs/b;c><--shifts><icy><--out><a b>"


@pytest.mark.parametrize(
    ("said", "code", "status", "shown"),
    [
        ("No known vulnerabilities found", 0, 0, "requirements.lock: no known weakness"),
        ("Found 2 known vulnerabilities in 1 package", 1, 1, "Found 2 known"),
        ("ERROR: connection refused", 1, 0, "requirements.lock was not compared: ERROR: conn"),
    ],
)
def test_the_audit_tells_weak_packages_from_no_network(
    said: str, code: int, status: int, shown: str, tmp_path: Path
) -> None:
    for name, text in (
        (".ci/audit", (ROOT / ".ci" / "audit").read_text()),
        (".venv-audit/bin/pip-audit", f"#!/bin/sh\necho '{said}'\nexit {code}\n"),
    ):
        path = tmp_path / name
        path.parent.mkdir(parents=True)
        path.write_text(text)
        path.chmod(0o755)
    done = subprocess.run(
        [tmp_path / ".ci" / "audit"], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == status
    assert shown in done.stdout + done.stderr
