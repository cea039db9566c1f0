"""``import twirl_mjx`` is free of side effects: no device, no asset, no environment variable."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from twirl_mjx import assets, cli
from twirl_mjx.commands import bench

# An audit hook sees every file that is opened. jax is allowed to be imported, not to start a
# device: `backends_are_initialized` is what jax itself asks before it may change platforms.
_PROBE = """
import os, sys
opened = []
sys.addaudithook(lambda event, args: opened.append(str(args[0])) if event == "open" else None)
before = dict(os.environ)
{statement}
changed = {{k for k in before.keys() | os.environ.keys() if before.get(k) != os.environ.get(k)}}
data = [p for p in opened if "{marker}" in p.replace(os.sep, "/")]
print("DATA", data)
print("ENVIRONMENT", sorted(k for k in changed if k.startswith(("JAX", "XLA", "MUJOCO", "TWIRL"))))
bridge = sys.modules.get("jax._src.xla_bridge")
print("DEVICES", bool(bridge and bridge.backends_are_initialized()))
"""


def probe(statement: str, marker: str = "/assets/") -> str:
    result = subprocess.run(
        [sys.executable, "-c", _PROBE.format(statement=statement, marker=marker)],
        env={**os.environ, "PYTHONPATH": str(Path(assets.__file__).parents[1])},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    return result.stdout


def test_import_has_no_side_effects() -> None:
    report = probe("import twirl_mjx")
    assert "DATA []" in report
    assert "ENVIRONMENT []" in report
    assert "DEVICES False" in report


def test_public_names_exist_without_starting_a_device() -> None:
    report = probe("from twirl_mjx import make, load_policy, to_gymnasium, __version__")
    assert "DATA []" in report
    assert "DEVICES False" in report


def test_the_probe_notices_side_effects() -> None:
    readme = Path(__file__).resolve().as_posix()
    report = probe(
        f"open({readme!r}).close(); os.environ['XLA_FLAGS'] = ''; import jax; jax.devices()",
        marker="test_import.py",
    )
    assert "test_import.py" in report
    assert "ENVIRONMENT ['XLA_FLAGS']" in report
    assert "DEVICES True" in report


def test_asset_path_finds_the_model() -> None:
    assert assets.asset_path("a1", "a1.xml").is_file()


def test_asset_path_names_both_places() -> None:
    with pytest.raises(FileNotFoundError) as error:
        assets.asset_path("a1", "missing.xml")
    for root in ("_assets", "assets"):
        assert str(Path(root, "a1", "missing.xml")) in str(error.value)


@pytest.mark.parametrize("bad", ["../pyproject.toml", "/etc/hostname"])
def test_asset_path_stays_inside(bad: str) -> None:
    with pytest.raises(ValueError, match="below the assets folder"):
        assets.asset_path(bad)


HEAVY = ("jax", "mujoco", "flax", "optax", "orbax", "scipy", "matplotlib", "onnx", "ray")
_IMPORTS = """
import contextlib, io, sys
from twirl_mjx import cli
heavy = {heavy!r}
for line in {lines!r}:
    before = set(sys.modules)
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        with contextlib.suppress(SystemExit):
            cli.main(line.split())
    print(line, [name for name in heavy if name in sys.modules and name not in before])
"""


def heavy_imports(lines: list[str], heavy: tuple[str, ...] = HEAVY) -> list[str]:
    """Return, for each command line, which heavy packages it was the first to import."""
    result = subprocess.run(
        [sys.executable, "-c", _IMPORTS.format(lines=lines, heavy=heavy)],
        env={**os.environ, "PYTHONPATH": str(Path(assets.__file__).parents[1])},
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    return result.stdout.splitlines()


def test_help_and_refusals_of_every_command_import_nothing_heavy(tmp_path: Path) -> None:
    """A first word and a typo are answered at once: what simulates is loaded after the options."""
    nested = [f"runs {name}" for name in ("list", "show", "compare", "prune")]
    nested += [f"clip {name}" for name in ("make", "show", "check")]
    nested += [f"bench {part}" for part in (*bench.PARTS, *bench.ALONE)]
    lines = [f"{name} --help" for name in (*cli.COMMANDS, *nested)]
    lines += [f"{name} --hlep" for name in nested]
    lines += [f"{name} --taks biped" for name in cli.COMMANDS]
    lines += ["train --task bipd", "train --num-envs 0", "evaluate zero --shifts icey", "hlep",
              f"runs --runs {tmp_path}", f"runs --runs {tmp_path} --status finished"]  # fmt: skip
    assert heavy_imports(lines) == [f"{line} []" for line in lines]


def test_help_and_a_typo_of_train_are_answered_without_numpy() -> None:
    lines = ["train --help", "train --tsk biped"]
    assert heavy_imports(lines, (*HEAVY, "numpy")) == [f"{line} []" for line in lines]


def test_heavy_imports_are_noticed() -> None:
    first, second = heavy_imports(["clip check", "train --help"])
    assert "'jax'" in first
    assert second == "train --help []"
