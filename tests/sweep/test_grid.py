"""Grid files: what is refused, and how cells come about."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from twirl_mjx.sweep.grid import expand, load

AXES = {"task": {"biped": {"task": "biped"}}}


def block(**changes: Any) -> dict[str, Any]:
    return {"preset": "debug", "seeds": (0, 1), "axes": AXES} | changes


def test_expand_is_a_product_with_seeds_innermost(grid_file: Path) -> None:
    grid = load(str(grid_file))
    assert [(d.arm, d.config.seed) for d in grid.drafts] == [
        ("biped-phi0.25", 0), ("biped-phi0.25", 1),
        ("biped-phi0.5", 0), ("biped-phi0.5", 1),
        ("biped-zs", 0),
    ]  # fmt: skip
    assert [d.config.replay.phi for d in grid.drafts[:4]] == [0.25, 0.25, 0.5, 0.5]
    assert grid.drafts[0].labels == (("task", "biped"), ("phi", "phi0.25"))


def test_seeds_can_be_chosen_but_a_single_seed_stays(grid_file: Path) -> None:
    grid = load(str(grid_file), seeds=(7, 8, 9))
    assert [d.config.seed for d in grid.drafts] == [7, 8, 9, 7, 8, 9, 0]


def test_settings_are_applied_at_once() -> None:
    # utd 3 alone would not fill blocks of 4 updates with 4 worlds
    axes = {"task": {"a": {"task": "biped", "droq.utd": 3.0, "droq.updates_per_block": 3}}}
    (draft,) = expand(block(axes=axes, seeds=(0,)), "here", None)
    assert draft.config.droq.utd == 3
    assert draft.config.droq.updates_per_block == 3


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        (block(preset="papr"), r"preset in here 'papr'.*nearest: 'paper'"),
        (block(seed=(0,)), r"key in here 'seed'.*nearest: 'seeds'"),
        (block(seeds=()), "no cells"),
        ({"preset": "cpu", "seeds": (0,)}, "no 'axes'"),
        (block(axes={"t": {"x": {"replay.phi": 0.5}}}), "arm x has no 'task'"),
        (block(base={"replay.fi": 0.5}), r"config field 'replay.fi'.*nearest: 'replay.phi'"),
        (block(base={"repla.phi": 0.5}), r"config field 'repla.phi'.*nearest: 'replay.phi'"),
        (block(base={"replay.phi": 1.5}), r"replay.phi = 1.5 is outside \[0.0, 1.0\]"),
        (block(base={"droq.utd": 3.3}), "not a whole number of blocks"),
        (
            block(base={"total_env_steps": "1000"}),
            r"here, arm biped: total_env_steps = '1000' is str, expected int \(nearest: 1000\)",
        ),
        (block(base={"droq.hidden_sizes": 256}), r"droq.hidden_sizes = 256 is int.*\(256,\)"),
        (block(axes={"t": {"x": {"task": 5}}}), "arm x: task = 5 is int, expected str"),
        (5, "here = 5 is int, expected dict"),
        (block(seeds=3), "here: seeds = 3 is int, expected tuple"),
        (block(base=[1]), r"here: base = \[1\] is list, expected dict"),
        (block(axes={"t": {}}), "axis 't' has no label"),
        (block(axes={"t": ["biped"]}), "axis 't' = .* is list, expected dict"),
        (block(axes={"t": {1: {}}}), "label of axis 't' = 1 is int, expected str"),
        (block(axes={"t": {"a": 1}}), "label 'a' = 1 is int, expected dict"),
        (block(axes={"t": {"a/b": {}}}), r"label 'a/b' .* name \(nearest: 'a_b'\)"),
        (block(axes={"t": {"a\n": {}}}), r"label of axis 't' 'a\\n' .*nearest: 'a_'"),
        (block(seeds=(2**32,)), r"seed = 4294967296 is outside \[0, 4294967295\]"),
    ],
)
def test_bad_blocks_are_refused(bad: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        expand(bad, "here", None)


def test_two_cells_of_one_arm_and_seed_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "twice.py"
    path.write_text(f"GRID = ({block()!r}, {block()!r})")
    with pytest.raises(ValueError, match="'biped' with seed 0 exists twice"):
        load(str(path))


def test_an_unknown_grid_names_the_nearest() -> None:
    with pytest.raises(ValueError, match=r"unknown grid 'fi'.*phi, shifts, tasks, utd"):
        load("fi")
    with pytest.raises(ValueError, match="no grid file"):
        load("nowhere/phi.py")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("raise SystemExit(0)", "no grid: SystemExit"),
        ("GRID = 1 / 0", "no grid: ZeroDivisionError"),
        (f"GRID = ({block()!r},)\nRESULTS = 3", "RESULTS = 3 is int, expected dict"),
        (f"REDUCED = ({block()!r},)\nREDUCED_NOTE = 'a\\nb'", "REDUCED_NOTE .*nearest: 'a_b'"),
    ],
)
def test_modules_that_are_no_grid_are_refused(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "odd.py"
    path.write_text(text)
    with pytest.raises(ValueError, match=rf"odd\.py.*{message}"):
        load(str(path), reduced="REDUCED" in text)


def test_a_module_without_the_form_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "half.py"
    path.write_text(f"GRID = ({block()!r},)")
    with pytest.raises(ValueError, match="REDUCED is None"):
        load(str(path), reduced=True)
