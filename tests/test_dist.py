"""Wheel and sdist, installed where there is no checkout: everything a command needs is inside."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import sysconfig
import tarfile
import zipfile
from pathlib import Path

import pytest

import twirl_mjx

ROOT = Path(__file__).resolve().parents[1]


def run(*command: str | Path, cwd: Path) -> str:
    """Run a command that knows nothing of the checkout; return what it prints."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "VIRTUAL_ENV"))}
    done = subprocess.run(
        [str(part) for part in command], cwd=cwd, env=kept, timeout=250,
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def build(source: Path, out: Path) -> tuple[Path, Path]:
    """Return the wheel and the sdist built from a source tree."""
    run(sys.executable, "-m", "hatchling", "build", "-d", out, cwd=source)
    return next(out.glob("*.whl")), next(out.glob("*.tar.gz"))


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    return build(ROOT, tmp_path_factory.mktemp("dist"))


@pytest.fixture(scope="module")
def installed(built: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with blanks in its name and an environment, into which the wheel was installed.

    Its dependencies are those of the environment that runs the tests: no network is needed.
    """
    folder = tmp_path_factory.mktemp("an environment")
    run(sys.executable, "-m", "venv", "env", cwd=folder)
    python = folder / "env" / "bin" / "python"
    run(python, "-m", "pip", "install", "-q", "--no-deps", "--no-index", built[0], cwd=folder)
    paths = run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", cwd=folder)
    borrowed = sysconfig.get_path("purelib")
    (Path(paths.strip()) / "borrowed.pth").write_text(f"{borrowed}\n", encoding="utf-8")
    return folder


@pytest.mark.slow
def test_the_wheel_holds_package_and_assets_only(built: tuple[Path, Path]) -> None:
    with zipfile.ZipFile(built[0]) as wheel:
        names = wheel.namelist()
    tops = {name.split("/")[0] for name in names}
    assert tops == {"twirl_mjx", f"twirl_mjx-{twirl_mjx.__version__}.dist-info"}
    shipped = {p.relative_to(ROOT / "assets") for p in (ROOT / "assets").rglob("*") if p.is_file()}
    inside = {Path(n).relative_to("twirl_mjx/_assets") for n in names if "/_assets/" in n}
    assert inside == shipped and Path("view/page.html") in inside


@pytest.mark.slow
def test_the_sdist_builds_the_same_wheel(built: tuple[Path, Path], tmp_path: Path) -> None:
    with tarfile.open(built[1]) as archive:
        archive.extractall(tmp_path, filter="data")
    again, _ = build(next(tmp_path.iterdir()), tmp_path / "again")
    with zipfile.ZipFile(built[0]) as first, zipfile.ZipFile(again) as second:
        assert sorted(first.namelist()) == sorted(second.namelist())


@pytest.mark.slow
def test_commands_work_without_a_checkout(installed: Path) -> None:
    twirl = installed / "env" / "bin" / "twirl"
    assert run(twirl, "--version", cwd=installed) == f"twirl {twirl_mjx.__version__}\n"
    where = "from twirl_mjx.assets import asset_path as a; print(a('policies', 'stand.npz'))"
    policy = run(installed / "env" / "bin" / "python", "-c", where, cwd=installed).strip()
    assert Path(policy).is_relative_to(installed)
    short = ("--episodes", "1", "--robot.episode-s", "1")
    assert "standing_time" in run(twirl, "rehearse", policy, *short, cwd=installed)
    run(twirl, "view", "--seconds", "1", "--html", "a page.html", cwd=installed)
    assert (installed / "a page.html").stat().st_size > 30_000


def test_the_container_is_made_by_targets_that_exist() -> None:
    container = (ROOT / "Dockerfile").read_text(encoding="utf-8")
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.M))
    page = (ROOT / "docs" / "development.md").read_text(encoding="utf-8")
    used = re.findall(r"RUN make ([a-z]+)", container)
    used += re.findall(r'CMD \["([a-z]+)"', container)
    used += re.findall(r"docker run .* twirl ([a-z]+)", page)
    assert {"setup", "demo", "train", "view"} <= set(used) <= targets
    accel = re.findall(r"ACCEL=([a-z0-9]+)", container + page)
    valid = re.search(r"'' \| ([^)]*)\)", (ROOT / ".ci" / "setup").read_text(encoding="utf-8"))
    assert valid and set(accel) <= set(valid[1].split(" | "))
    ignored = (ROOT / ".dockerignore").read_text(encoding="utf-8").split()
    assert {".git", ".venv", "runs"} <= set(ignored)
    assert not {"assets", "requirements.lock", ".ci"} & set(ignored)
