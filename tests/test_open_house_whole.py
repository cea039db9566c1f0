"""The open house as a user walks through it: a package, a grid of one's own, a report."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from twirl_mjx.figures.tables import read_directory

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]

ROOT = Path(__file__).parents[1]
ENTRY_POINTS = """[twirl_mjx.tasks]
trot = gaits.trot:Trot
[twirl_mjx.shifts]
muddy = gaits.muddy:MUDDY
"""
SINK = """
class Lines:
    def open(self, run):
        self.file = (run.directory / "lines.txt").open("a")
    def log(self, env_steps, grad_steps, wall_s, values):
        print(env_steps, len(values), file=self.file)
    def close(self):
        self.file.close()
"""
GRID = """
GRID = (
    {"preset": "debug", "seeds": (0, 1),
     "base": {"variant": "twirl", "source": "trot", "total_env_steps": 640, "eval.every": 320},
     "axes": {"task": {"trot": {"task": "TASK"}},
              "speed": {"slow": {"trot.speed": 0.5}, "quick": {"trot.speed": 1.0}}}},
)
"""


def twirl(folder: Path, *words: str, status: int = 0) -> str:
    """Run the command line in a folder, with the packages of ``folder/site`` installed."""
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder / "site"), str(ROOT)])}
    done = subprocess.run(
        [sys.executable, "-m", "twirl_mjx", *words],
        cwd=folder, env=env, capture_output=True, text=True, timeout=900, check=False,
    )  # fmt: skip
    assert done.returncode == status, f"{words}\n{done.stdout[-2000:]}\n{done.stderr[-3000:]}"
    return done.stdout + done.stderr


def test_an_installed_package_offers_a_task_and_a_shift(tmp_path: Path) -> None:
    package = tmp_path / "site" / "gaits"
    package.mkdir(parents=True)
    (package / "__init__.py").touch()
    (package / "lines.py").write_text(SINK)
    for name in ("trot.py", "muddy.py"):
        (package / name).write_text((ROOT / "examples" / name).read_text())
    record = tmp_path / "site" / "gaits-1.0.dist-info"
    record.mkdir()
    (record / "METADATA").write_text("Metadata-Version: 2.1\nName: gaits\nVersion: 1.0\n")
    (record / "entry_points.txt").write_text(ENTRY_POINTS)

    words = ["--preset", "debug", "--variant", "scratch", "--total-env-steps", "640"]
    twirl(tmp_path, "train", "--task", "trot", *words, "--log", "site/gaits/lines.py:Lines",
          "--name", "mine")  # fmt: skip
    assert (tmp_path / "runs" / "mine" / "lines.txt").read_text().count("\n") >= 1
    words = ["--shifts", "muddy", "--episodes", "2", "--out", "table.csv"]
    assert "muddy" in twirl(tmp_path, "evaluate", "runs/mine", *words)
    said = twirl(tmp_path, "train", "--task", "trott", "--preset", "debug", status=2)
    assert "nearest: 'trot'" in said


def test_a_grid_of_a_task_of_ones_own_becomes_figures_and_a_report(tmp_path: Path) -> None:
    (tmp_path / "trot.py").write_text((ROOT / "examples" / "trot.py").read_text())
    (tmp_path / "mygrid.py").write_text(GRID.replace("TASK", "trot.py:Trot"))
    twirl(tmp_path, "sweep", "mygrid.py", "--results", "results", "--workers", "1")
    curves, episodes = read_directory(tmp_path / "results" / "mygrid")
    assert curves is not None and episodes is not None
    assert {*curves["speed"].tolist()} == {*episodes["speed"].tolist()} == {"slow", "quick"}
    assert {"return", "speed"} <= {*episodes["metric"].tolist()}
    twirl(tmp_path, "figures", "--results", "results", "--out", "pictures")
    names = {path.name for path in (tmp_path / "pictures").glob("*.png")}
    assert any("ablation" in name for name in names), names
    twirl(tmp_path, "report", "--results", "results", "--out", "report.html")
    assert "mygrid" in (tmp_path / "report.html").read_text()
