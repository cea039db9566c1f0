"""Grids: data in ``experiments/*.py``, checked here and expanded into resolved configs.

A grid file is executed, like any Python program: load only files that you would run.

A grid module holds ``GRID`` and ``REDUCED`` (a smaller form), each a tuple of *blocks*, and
``REDUCED_NOTE``. A block is a dict: ``preset``, ``seeds``, ``axes`` (axis -> label -> settings by
dotted config field), and optionally ``base`` (settings of every cell) and ``nominal`` (settings of
the run that adaptation starts from). Its cells are the product of all axes and seeds; the labels
joined by ``-`` name the *arm*, which is a cell without its seed. ``"smoke": True`` in every block
of a form says that its runs only show that everything works: they give no results. The module may
say how its results are shown in ``RESULTS`` (``title``, ``about``, ``place``, ``titles`` of axes,
``baseline``), all of them optional.
"""

from __future__ import annotations

import dataclasses
import importlib.util
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

from twirl_mjx.checks import check_choice, check_printable
from twirl_mjx.records import check_type
from twirl_mjx.training.config import TrainConfig
from twirl_mjx.training.config_json import settle
from twirl_mjx.training.presets import PRESETS, make_config

BLOCK_TYPES = {
    "preset": str, "seeds": tuple | list | range, "axes": dict, "base": dict, "nominal": dict,
    "smoke": bool,
}  # fmt: skip
"""What a block may hold, and its type; the first three are needed."""
BLOCK_KEYS = tuple(BLOCK_TYPES)
RESULTS_KEYS = {"title": str, "about": str, "place": int, "titles": dict, "baseline": dict}
"""What ``RESULTS`` may hold, and its type."""

Settings = Mapping[str, Any]
"""Dotted config field -> value."""


@dataclasses.dataclass(frozen=True)
class Draft:
    """One cell as the grid states it; where its source comes from is not resolved yet."""

    arm: str
    """Labels of its axes, joined; the cell without its seed."""
    preset: str
    """Preset the config came from."""
    config: TrainConfig
    """The run, every field resolved but ``source``."""
    nominal: tuple[tuple[str, Any], ...]
    """Settings of the nominal run on top of its preset; only used under a shift."""
    labels: tuple[tuple[str, str], ...] = ()
    """(axis, label) of the cell on every axis of its block."""


@dataclasses.dataclass(frozen=True)
class Grid:
    """An expanded grid."""

    name: str
    """Name of the module, ``phi`` for ``experiments/phi.py``."""
    reduced: bool
    """Whether this is the smaller form."""
    note: str
    """What was reduced; empty for the full form."""
    drafts: tuple[Draft, ...]
    """Its cells, arms in order, seeds innermost."""
    command: str
    """Command that runs it."""
    smoke: bool = False
    """Whether its runs are no results."""
    shown: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """``RESULTS`` of the module."""

    @property
    def results_name(self) -> str:
        """Folder of its tables: the two forms never share one."""
        return f"{self.name}_reduced" if self.reduced else self.name


def grids_folder() -> Path:
    """Return ``experiments/`` of the working directory, else of the checkout this code is in."""
    here = Path("experiments")
    return here if here.is_dir() else Path(__file__).resolve().parents[2] / "experiments"


def load(name: str, *, reduced: bool = False, seeds: Sequence[int] | None = None) -> Grid:
    """Read a grid.

    Args:
        name: Name of a module in ``experiments/``, or the path of a grid file.
        reduced: Take the smaller form.
        seeds: Seeds instead of the grid's; blocks with a single seed keep theirs.

    Raises:
        ValueError: No such grid (with the nearest name), or its data are not valid; the message
            names the block and the entry.
    """
    path = Path(name)
    command = f"twirl sweep {path.name}" + " --reduced" * reduced
    if path.suffix != ".py":
        command = f"make sweep GRID={name}" + ' ARGS="--reduced"' * reduced
        known = tuple(sorted(p.stem for p in grids_folder().glob("*.py")))
        if not known:
            raise ValueError(f"no grids in {grids_folder().resolve()}: run from a checkout")
        check_choice("grid", name, known)
        path = grids_folder() / f"{name}.py"
    module = _module(path)
    form = "REDUCED" if reduced else "GRID"
    blocks = getattr(module, form, None)
    if not isinstance(blocks, tuple) or not blocks:
        raise ValueError(f"{path}: {form} is {blocks!r:.200}, expected a tuple of blocks")
    drafts: list[Draft] = []
    for number, block in enumerate(blocks):
        drafts += expand(block, f"{path.name}: {form}[{number}]", seeds)
    check_unique(drafts, f"{path.name}: {form}")
    note = str(getattr(module, "REDUCED_NOTE", "smaller budgets")) if reduced else ""
    check_printable(f"{path}: REDUCED_NOTE", note)
    smoke = {bool(block.get("smoke", False)) for block in blocks}
    if len(smoke) > 1:
        raise ValueError(f"{path}: {form}: some blocks are smoke, some not (nearest: all or none)")
    shown = check_results(getattr(module, "RESULTS", {}), str(path))
    return Grid(path.stem, reduced, note, tuple(drafts), command, smoke.pop(), shown)


def check_results(shown: Mapping[str, Any], where: str) -> Mapping[str, Any]:
    """Return ``RESULTS`` of a module.

    Raises:
        ValueError: An unknown key (with the nearest), or a value of another type.
    """
    check_type(f"{where}: RESULTS", shown, dict)
    for key, value in shown.items():
        check_choice(f"key in {where}: RESULTS", key, tuple(RESULTS_KEYS))
        check_type(f"{where}: RESULTS[{key!r}]", value, RESULTS_KEYS[key])
    return shown


def _module(path: Path) -> ModuleType:
    if not path.is_file():
        raise ValueError(f"no grid file {path}; grids: {', '.join(_names())}")
    spec = importlib.util.spec_from_file_location(f"_twirl_grid_{path.stem}", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        raise ValueError(f"{path}: no grid: {type(error).__name__}: {error}") from error
    return module


def _names() -> list[str]:
    return sorted(p.stem for p in grids_folder().glob("*.py"))


def expand(block: Mapping[str, Any], where: str, seeds: Sequence[int] | None) -> list[Draft]:
    """Return the cells of a block: the product of its axes, each with every seed.

    Raises:
        ValueError: A missing or unknown key, a value of another type, a label that cannot be part
            of a file's name, no seeds, or a setting no config has.
    """
    _check_block(block, where)
    check_choice(f"preset in {where}", block["preset"], PRESETS)
    own = tuple(block["seeds"])
    chosen = own if seeds is None or len(own) == 1 else tuple(seeds)
    if not chosen or not block["axes"]:
        raise ValueError(f"{where} has no cells: seeds {chosen}, axes {list(block['axes'])}")
    nominal = tuple(sorted(block.get("nominal", {}).items()))
    drafts = []
    for choice in itertools.product(*(axis.items() for axis in block["axes"].values())):
        labels = tuple(zip(block["axes"], (label for label, _ in choice), strict=True))
        arm = "-".join(label for label, _ in choice)
        settings = dict(block.get("base", {}))
        for _, more in choice:
            settings |= more
        for seed in chosen:
            config = configure(block["preset"], settings | {"seed": seed}, f"{where}, arm {arm}")
            drafts.append(Draft(arm, block["preset"], config, nominal, labels))
    return drafts


def _check_block(block: Any, where: str) -> None:
    check_type(where, block, dict)
    for key, value in block.items():
        check_choice(f"key in {where}", key, BLOCK_KEYS)
        check_type(f"{where}: {key}", value, BLOCK_TYPES[key])
    for key in BLOCK_KEYS[:3]:
        if key not in block:
            raise ValueError(f"{where} has no {key!r}, it needs {', '.join(BLOCK_KEYS[:3])}")
    for axis, choices in block["axes"].items():
        check_type(f"{where}: axis {axis!r}", axis, str)
        check_type(f"{where}: axis {axis!r}", choices, dict)
        if not choices:
            raise ValueError(f"{where}: axis {axis!r} has no label, so there are no cells")
        for label, settings in choices.items():
            check_type(f"{where}: a label of axis {axis!r}", label, str)
            check_printable(f"{where}: label of axis {axis!r}", label)
            if "/" in label or label.startswith("."):
                nearest = label.replace("/", "_").lstrip(".") or "label"
                raise ValueError(
                    f"{where}: label {label!r} of axis {axis!r} cannot be part of a file's name"
                    f" (nearest: {nearest!r})"
                )
            check_type(f"{where}: axis {axis!r}, label {label!r}", settings, dict)


def configure(preset: str, settings: Settings, where: str) -> TrainConfig:
    """Return a preset's config of ``settings["task"]`` with all settings applied at once.

    Raises:
        ValueError: An unknown field (with the nearest), or a value of another type or out of range.
    """
    if "task" not in settings:
        raise ValueError(f"{where} has no 'task'")
    check_type(f"{where}: task", settings["task"], str)
    try:
        learner = settings.get("learner", TrainConfig.learner)
        plain = make_config(settings["task"], preset, learner)
        return settle(plain, {k: v for k, v in settings.items() if k not in ("task", "learner")})
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None


def check_unique(drafts: Sequence[Draft], where: str) -> None:
    """Check that no two cells share arm and seed.

    Raises:
        ValueError: Naming the first that do.
    """
    seen = set()
    for draft in drafts:
        key = (draft.arm, draft.config.seed)
        if key in seen:
            raise ValueError(f"{where}: arm {draft.arm!r} with seed {key[1]} exists twice")
        seen.add(key)
