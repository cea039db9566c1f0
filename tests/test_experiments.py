"""The grids of ``experiments/``: they build, and they are the ones the paper's figures need."""

from __future__ import annotations

import copy
import dataclasses
import itertools
from pathlib import Path

import pytest

from twirl_mjx.commands.options import parse_train
from twirl_mjx.sweep import grid as grids
from twirl_mjx.sweep import plan
from twirl_mjx.sweep.grid import load

NAMES = ("auto", "guide", "phi", "shifts", "tasks", "utd")
pytestmark = pytest.mark.usefixtures("no_shipped_policies")
BOTH = [(name, reduced) for name in NAMES for reduced in (False, True)]
CELLS = {
    ("auto", False): 2 * 2 * 3,
    ("auto", True): 2 * 2 * 3,
    ("guide", False): 3 * 2 * 3,
    ("guide", True): 3 * 2 * 3,
    ("tasks", False): 2 * 2 * 3 + 2,
    ("tasks", True): 2 * 2 * 2 + 2,
    ("shifts", False): 2 * 5 * 4 * 3,
    ("shifts", True): 2 * 5 * 3 * 3,
    ("phi", False): 2 * 5 * 4 * 3,
    ("phi", True): 2 * 4 * 3,
    ("utd", False): 2 * 5 * 4 * 3,
    ("utd", True): 4 * 2,
}


def test_all_grids_are_known() -> None:
    assert tuple(sorted(p.stem for p in grids.grids_folder().glob("*.py"))) == NAMES


@pytest.mark.parametrize(("name", "reduced"), BOTH)
def test_cells_are_the_product(name: str, reduced: bool) -> None:
    grid = load(name, reduced=reduced)
    assert len(grid.drafts) == CELLS[name, reduced]
    assert grid.results_name == (f"{name}_reduced" if reduced else name)
    assert grid.command == f"make sweep GRID={name}" + (' ARGS="--reduced"' if reduced else "")


@pytest.mark.parametrize(("name", "reduced"), BOTH)
def test_names_and_digests_are_unique(name: str, reduced: bool, tmp_path: Path) -> None:
    grid = load(name, reduced=reduced)
    cells = plan.make_plan(grid, tmp_path)
    assert len({(c.arm, c.config.seed) for c in cells if c.arm}) == len(grid.drafts)
    assert len({c.name for c in cells}) == len(cells)
    assert len({c.config for c in cells}) == len(cells)
    places = {cell.name: i for i, cell in enumerate(cells)}
    assert all(places[n] < places[c.name] for c in cells for n in c.needs)


@pytest.mark.parametrize("name", NAMES)
def test_building_mutates_nothing(name: str) -> None:
    module = grids._module(grids.grids_folder() / f"{name}.py")
    for form in ("GRID", "REDUCED"):
        blocks = getattr(module, form)
        before = copy.deepcopy(blocks)
        first = [d for block in blocks for d in grids.expand(block, "here", None)]
        second = [d for block in blocks for d in grids.expand(block, "here", None)]
        assert first == second
        assert blocks == before


@pytest.mark.parametrize("name", NAMES)
def test_full_form_is_the_papers(name: str) -> None:
    for draft in load(name).drafts:
        config = draft.config
        scratch_on_hurdles = (config.task, config.variant) == ("hurdles", "scratch")
        budget = 100_000 if config.shift != "none" else 3_000_000 if scratch_on_hurdles else 10**6
        assert draft.preset == "paper"
        assert config.total_env_steps == budget
        assert config.replay.phi == 0.5 or name in ("phi", "auto")
        assert config.droq.utd == 20 or name == "utd"
        assert config.eval.final_episodes == 100
    seeds = {draft.config.seed for draft in load(name).drafts}
    assert seeds == {0, 1, 2}


def test_axes_have_the_papers_values() -> None:
    phi, utd = load("phi").drafts, load("utd").drafts
    assert sorted({d.config.replay.phi for d in phi}) == [0.0, 0.25, 0.5, 0.75]
    assert sorted({d.config.droq.utd for d in utd}) == [1, 5, 10, 20]
    # one actor update per transition at every UTD
    assert all(d.config.blocks_per_step == d.config.num_envs for d in utd)
    shifts = {(d.config.task, d.config.shift, d.config.variant) for d in load("shifts").drafts}
    assert shifts == set(
        itertools.product(
            ("biped", "hurdles"),
            ("bumpy", "icy", "weakened", "sloped", "gravity"),
            ("twirl", "twirl+weights", "weights", "zero-shot"),
        )
    )


@pytest.mark.parametrize("name", NAMES)
def test_reduced_form_is_smaller_and_says_so(name: str) -> None:
    grid = load(name, reduced=True)
    full = {d.arm: d.config for d in load(name).drafts}
    for draft in grid.drafts:
        assert draft.config.total_env_steps < full[draft.arm].total_env_steps
        # budgets are whole epochs, so that runs end where they say
        config = draft.config
        assert config.total_env_steps % (config.steps_per_epoch * config.num_envs) == 0
    trained = [d for d in grid.drafts if d.config.variant != "zero-shot"]
    fewest = 1 if name == "shifts" else 2  # its budget is nearly the paper's instead
    assert all(
        len({d.config.seed for d in arm}) >= fewest
        for _, arm in itertools.groupby(trained, key=lambda d: d.arm)
    )
    assert "transitions" in grid.note


def test_adaptation_starts_from_the_runs_of_the_tasks_grid(tmp_path: Path) -> None:
    tasks = {c.name for c in plan.make_plan(load("tasks"), tmp_path) if c.arm}
    for name in ("shifts", "phi", "utd"):
        cells = plan.make_plan(load(name), tmp_path)
        nominal = {n for c in cells if c.arm for n in c.needs}
        assert len(nominal) == 2 * 3
        assert nominal <= tasks


def test_reduced_phi_shares_its_cells_with_reduced_shifts(tmp_path: Path) -> None:
    """Phi 0.5 is ``twirl+weights`` of seed 0, so that neither grid trains it again."""
    phi, shifts = (
        {c.name for c in plan.make_plan(load(name, reduced=True), tmp_path) if c.arm}
        for name in ("phi", "shifts")
    )
    assert {name.rsplit("-", 1)[0] for name in phi & shifts} == {
        "biped-icy-twirl_weights-s0",
        "biped-gravity-twirl_weights-s0",
    }


@pytest.mark.parametrize(("name", "reduced"), BOTH)
def test_arguments_give_the_config(name: str, reduced: bool, tmp_path: Path) -> None:
    cells = plan.make_plan(load(name, reduced=reduced), tmp_path)
    for cell in cells[:: max(1, len(cells) // 6)]:
        options = parse_train(plan.arguments(cell, tmp_path)[1:])
        assert options.config == dataclasses.replace(cell.config, source=cell.source)
        assert (options.name, options.runs) == (cell.name, tmp_path)
