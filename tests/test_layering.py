"""The architecture as a test: which way imports point, who may touch the process, how long code is.

``docs/development.md`` says why the layers are cut this way.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "twirl_mjx"

BASE = {
    "cache", "machine", "types", "checks", "exits", "files", "array_files", "plugins", "records",
    "assets",
}  # fmt: skip
WORLD = BASE | {"sim", "motion", "tasks", "worlds"}
ACTING = WORLD | {"droq", "policies"}
ALLOWED: dict[str, set[str]] = {
    "types": set(),
    "cache": set(),
    "machine": set(),
    "checks": set(),
    "exits": set(),
    "assets": set(),
    "files": {"checks"},
    "array_files": {"files", "plugins"},
    "faults": {"exits"},
    "plugins": {"checks", "files"},
    "records": {"checks"},
    "sim": BASE,
    "motion": BASE | {"sim"},
    "tasks": BASE | {"sim", "motion"},
    "worlds": WORLD,
    "droq": {"types", "checks"},
    "replay": {"types", "checks", "files", "array_files"},
    "policies": ACTING | {"replay"},
    "evaluation": ACTING,
    "training": ACTING | {"evaluation", "replay"},
    "deploy": ACTING | {"evaluation", "figures"},
    "view": BASE | {"sim", "policies", "deploy"},
    "figures": {"checks", "files"},
    "sweep": ACTING | {"training", "figures"},
    "bench": ACTING | {"evaluation", "replay", "training", "deploy", "figures"},
    "commands": ACTING
    | {"evaluation", "replay", "training", "deploy", "view", "figures", "sweep", "bench"},
}
"""What each part may import of ours, besides itself; ``cli`` and the package root: everything."""

EVERYTHING = {"__init__", "cli"}
MAX_FILE_LINES = 500
MAX_FUNCTION_LINES = 60


def sources(*folders: str) -> list[Path]:
    return sorted(path for folder in folders for path in (ROOT / folder).rglob("*.py"))


def parse(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), filename=str(path))


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imported_modules(tree: ast.Module, module: str, *, is_package: bool) -> Iterator[str]:
    """Yield every absolute dotted name that is imported anywhere in the file, lazily or not."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            parent = module.split(".")
            if node.level:
                parent = parent[: len(parent) - node.level + is_package]
            prefix = [*parent, *filter(None, [node.module])] if node.level else [node.module or ""]
            yield from (".".join([*prefix, alias.name]) for alias in node.names)


def part_of(module: str) -> str:
    """Return the layer of a dotted name: ``twirl_mjx.sim.look`` -> ``sim``."""
    parts = module.split(".")
    return parts[1] if len(parts) > 1 else "__init__"


def import_faults(source: str, module: str, *, is_package: bool = False) -> list[str]:
    """Return one line for each import of ``source`` that the layers forbid."""
    part = part_of(module)
    if part not in ALLOWED and part not in {*EVERYTHING, "__main__"}:
        return [f"{module}: no layer '{part}'; add it to ALLOWED, with what it may import"]
    faults = []
    for name in imported_modules(ast.parse(source), module, is_package=is_package):
        top = name.split(".")[0]
        if part == "figures" and top in {"jax", "jaxlib", "flax", "mujoco"}:
            faults.append(f"{module}: figures read tables only and may not import {name}")
        if top != PACKAGE or part in EVERYTHING:
            continue
        permitted = {"cli"} if part == "__main__" else ALLOWED[part] | {part}
        if part_of(name) not in permitted:
            faults.append(f"{module}: {part} may not import {name}")
    return faults


def environment_uses(source: str) -> list[int]:
    """Return the lines that read or write environment variables."""
    names = {"environ", "environb", "getenv", "putenv", "unsetenv"}
    lines = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Attribute) and node.attr in names:
            lines.add(node.lineno)
        if isinstance(node, ast.ImportFrom) and node.module == "os":
            lines |= {node.lineno for alias in node.names if alias.name in names}
    return sorted(lines)


def environment_writes(source: str) -> list[int]:
    """Return the lines that change ``os.environ``; a copy for a child process is no change."""
    changing = {"update", "setdefault", "pop", "popitem", "clear"}
    lines = set()
    for node in ast.walk(ast.parse(source)):
        match node:
            case ast.Subscript(value=owner, ctx=ast.Store() | ast.Del()):
                pass
            case ast.Attribute(value=owner, attr=name) if name in changing:
                pass
            case _:
                continue
        if ast.unparse(owner).split(".")[-1] in {"environ", "environb"}:
            lines.add(node.lineno)
    return sorted(lines)


def function_lengths(source: str) -> Iterator[tuple[str, int]]:
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield node.name, (node.end_lineno or node.lineno) - node.lineno + 1


@pytest.mark.parametrize("path", sources(PACKAGE), ids=module_name)
def test_imports_point_down(path: Path) -> None:
    source = path.read_text(encoding="utf-8")
    assert not import_faults(source, module_name(path), is_package=path.name == "__init__.py")


def test_experiments_import_settings_only() -> None:
    faults = [
        f"{path.name}: {name}"
        for path in sources("experiments")
        for name in imported_modules(parse(path), module_name(path), is_package=False)
        if name.split(".")[0] == PACKAGE and part_of(name) not in {"config", "presets"}
    ]
    assert not faults


def test_layers_have_no_cycle() -> None:
    done: set[str] = set()
    while ready := {part for part, below in ALLOWED.items() if below - {part} <= done} - done:
        done |= ready
    assert set(ALLOWED) == done


def test_only_the_command_line_touches_the_environment() -> None:
    """``bench`` starts child processes and may read what they shall inherit; ``cache`` asks
    where compiled programs are kept.
    """
    faults = []
    for path in sources(PACKAGE):
        source = path.read_text(encoding="utf-8")
        part = part_of(module_name(path))
        rule = environment_writes if part in {"bench", "cache"} else environment_uses
        if part != "cli":
            faults += [f"{path.relative_to(ROOT)}:{line}" for line in rule(source)]
    assert not faults


@pytest.mark.parametrize("path", sources(PACKAGE, "experiments", "tests"), ids=module_name)
def test_code_is_short(path: Path) -> None:
    source = path.read_text(encoding="utf-8")
    name = path.relative_to(ROOT).as_posix()
    assert len(source.splitlines()) <= MAX_FILE_LINES
    for function, lines in function_lengths(source):
        assert lines <= MAX_FUNCTION_LINES, f"{name}: {function} has {lines} lines"


@pytest.mark.parametrize(
    ("module", "source", "fault"),
    [
        ("twirl_mjx.sim.look", "from twirl_mjx.tasks import biped", "sim may not import"),
        ("twirl_mjx.sim.look", "from ..tasks import biped", "sim may not import"),
        ("twirl_mjx.sim.look", "from twirl_mjx import tasks", "sim may not import"),
        ("twirl_mjx.sim.look", "def f():\n    import twirl_mjx.tasks.biped", "sim may not import"),
        ("twirl_mjx.sim.look", "import twirl_mjx", "sim may not import"),
        ("twirl_mjx.training.loop", "from twirl_mjx import cli", "training may not import"),
        ("twirl_mjx.evaluation.rollout", "import twirl_mjx.replay.ring", "evaluation may not"),
        ("twirl_mjx.figures.plots", "import jax.numpy as jnp", "figures read tables only"),
        ("twirl_mjx.figures.plots", "from twirl_mjx.config import x", "figures may not import"),
        ("twirl_mjx.helpers", "import os", "no layer 'helpers'"),
    ],
)
def test_import_rule_catches(module: str, source: str, fault: str) -> None:
    faults = import_faults(source, module)
    assert len(faults) == 1
    assert fault in faults[0]


def test_import_rule_permits() -> None:
    assert not import_faults("from . import frames, look", "twirl_mjx.sim", is_package=True)
    assert not import_faults("from .frames import yaw", "twirl_mjx.sim.look")
    assert not import_faults("from twirl_mjx.sim import look\nimport jax", "twirl_mjx.tasks.stand")
    assert not import_faults("import twirl_mjx.training.loop", "twirl_mjx.cli")


def test_environment_rules_catch() -> None:
    reads = "import os\nchild = dict(os.environ)\nos.getenv('A')\nfrom os import environ\n"
    assert environment_uses(reads) == [2, 3, 4]
    assert environment_writes(reads) == []
    writes = "import os\nos.environ['A'] = '1'\nos.environ.update(A='1')\ndel os.environ['A']\n"
    assert environment_uses(writes) == environment_writes(writes) == [2, 3, 4]
