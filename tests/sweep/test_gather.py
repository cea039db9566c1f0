"""From runs to the committed tables, read back by what draws the figures."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from twirl_mjx.figures.summary import main_metric, summarise
from twirl_mjx.figures.tables import read_curves, read_directory, read_episodes
from twirl_mjx.sweep.gather import gather, nominal_notes, thin
from twirl_mjx.sweep.grid import Grid, load
from twirl_mjx.sweep.plan import Cell, make_plan

Finish = Callable[..., Path]


@pytest.fixture
def plan_of(grid_file: Path, tmp_path: Path) -> tuple[Grid, tuple[Cell, ...]]:
    grid = load(str(grid_file), reduced=True)
    return grid, make_plan(grid, tmp_path / "runs")


def test_tables_of_a_finished_grid(
    plan_of: tuple[Grid, tuple[Cell, ...]], tmp_path: Path, finish_run: Finish
) -> None:
    grid, cells = plan_of
    for cell in cells:
        finish_run(cell, tmp_path / "runs")
    written = gather(grid, cells, tmp_path / "runs", tmp_path / "results")
    folder = tmp_path / "results" / "phi_reduced"
    arms = ("biped-phi0.25", "biped-phi0.5", "biped-zs")
    assert {p.name for p in written} == {f"{a}{s}.csv" for a in arms for s in ("", ".episodes")}
    text = (folder / "biped-phi0.5.csv").read_text().splitlines()
    assert text[:3] == [
        "# reduced: all of it",
        "# command: twirl sweep phi.py --reduced",
        "# grid: phi_reduced",
    ]
    assert text[3] == "run,task,shift,variant,seed,metric,env_steps,grad_steps,wall_s,value,phi"

    curves = read_curves(folder / "biped-phi0.5.csv")
    assert set(curves["metric"]) == {"eval/return"}
    assert set(curves["phi"]) == {0.5}
    for seed in (0, 1):
        rows = curves["seed"] == seed
        assert rows.sum() == 100
        assert (curves["env_steps"][rows].min(), curves["env_steps"][rows].max()) == (1, 250)
        np.testing.assert_allclose(
            curves["value"][rows], seed + curves["env_steps"][rows] / 1000, rtol=1e-5
        )
    episodes = read_episodes(folder / "biped-phi0.5.episodes.csv")
    assert sorted(set(episodes["metric"])) == ["episode_length", "return"]
    assert len(episodes) == 2 * 2 * 4


def test_figures_find_what_they_need(
    plan_of: tuple[Grid, tuple[Cell, ...]], tmp_path: Path, finish_run: Finish
) -> None:
    grid, cells = plan_of
    for cell in cells:
        finish_run(cell, tmp_path / "runs")
    gather(grid, cells, tmp_path / "runs", tmp_path / "results")
    curves, episodes = read_directory(tmp_path / "results" / "phi_reduced")
    assert curves is not None and episodes is not None
    assert main_metric(curves) == "eval/return"
    rows = {s.label: s for s in summarise(curves, "eval/return")}
    assert rows["twirl, phi 0.25"].mean == pytest.approx(0.75)  # seeds 0 and 1, plus 0.25
    assert rows["zero-shot"].mean == pytest.approx(1.5)  # episodes 0 to 3, at no training
    assert rows["zero-shot"].seeds == (0,)


def test_missing_seeds_are_stated(
    plan_of: tuple[Grid, tuple[Cell, ...]], tmp_path: Path, finish_run: Finish
) -> None:
    grid, cells = plan_of
    finish_run(next(c for c in cells if c.arm == "biped-phi0.5"), tmp_path / "runs")
    written = gather(grid, cells, tmp_path / "runs", tmp_path / "results")
    assert [p.name for p in written] == ["biped-phi0.5.csv", "biped-phi0.5.episodes.csv"]
    assert "# incomplete: 1 of 2 seeds" in written[0].read_text().splitlines()


def test_tables_of_adaptation_name_the_nominal_run(tmp_path: Path, finish_run: Finish) -> None:
    path, runs, results = tmp_path / "shifts.py", tmp_path / "runs", tmp_path / "results"
    axes = '{"task": {"biped": {"task": "biped"}}, "shift": {s: {"shift": s} for s in SHIFTS}}'
    path.write_text(
        'SHIFTS = ("none", "icy")\n'
        f'GRID = ({{"preset": "debug", "seeds": (0, 1), "nominal": {{"seed": 0}},'
        f' "axes": {axes}}},)'
    )
    grid = load(str(path))
    cells = make_plan(grid, runs)
    for cell in cells:
        finish_run(cell, runs)
    gather(grid, cells, runs, results)
    nominal = next(c.name for c in cells if c.arm == "biped-none" and c.config.seed == 0)

    def notes(name: str) -> list[str]:
        lines = (results / "shifts" / name).read_text().splitlines()
        return [line for line in lines if line.startswith("# nominal")]

    for suffix in (".csv", ".episodes.csv"):
        assert notes(f"biped-icy{suffix}") == [f"# nominal: {nominal}"]  # once for both seeds
        assert notes(f"biped-none{suffix}") == []
    adapted = [cell for cell in cells if cell.is_shifted]
    others = [dataclasses.replace(adapted[0], source="/elsewhere/mine"), adapted[1]]
    assert nominal_notes(others) == [f"# nominal: mine, {nominal}"]


def test_a_changed_grid_leaves_no_old_tables(
    plan_of: tuple[Grid, tuple[Cell, ...]], grid_file: Path, tmp_path: Path, finish_run: Finish
) -> None:
    grid, cells = plan_of
    for cell in cells:
        finish_run(cell, tmp_path / "runs")
    gather(grid, cells, tmp_path / "runs", tmp_path / "results")
    folder = tmp_path / "results" / "phi_reduced"
    (folder / "mine.csv").write_text("# of somebody else\n")
    # 0.25 becomes 0.75: a new arm, whose runs are missing
    grid_file.write_text(grid_file.read_text().replace("0.25", "0.75"))
    grid = load(str(grid_file), reduced=True)
    gather(grid, make_plan(grid, tmp_path / "runs"), tmp_path / "runs", tmp_path / "results")
    names = {p.name for p in folder.glob("*.csv")}
    arms = ("biped-phi0.5", "biped-zs")
    assert names == {f"{a}{s}.csv" for a in arms for s in ("", ".episodes")} | {"mine.csv"}


def test_tables_of_another_form_go_with_the_first_new_one(
    plan_of: tuple[Grid, tuple[Cell, ...]], grid_file: Path, tmp_path: Path, finish_run: Finish
) -> None:
    grid, cells = plan_of
    for cell in cells:
        finish_run(cell, tmp_path / "runs")
    gather(grid, cells, tmp_path / "runs", tmp_path / "results")
    # Longer runs, of which one arm is finished: the others' tables are of the shorter ones.
    grid_file.write_text(grid_file.read_text().replace("all of it", "half of it"))
    grid = load(str(grid_file), reduced=True)
    runs = tmp_path / "others"
    cells = make_plan(grid, runs)
    finish_run(next(c for c in cells if c.arm == "biped-phi0.5"), runs)
    gather(grid, cells, runs, tmp_path / "results")
    folder = tmp_path / "results" / "phi_reduced"
    names = {p.name for p in folder.glob("*.csv")}
    assert names == {"biped-phi0.5.csv", "biped-phi0.5.episodes.csv"}


def test_a_changed_setting_does_not_reuse_old_runs(
    plan_of: tuple[Grid, tuple[Cell, ...]], grid_file: Path, tmp_path: Path, finish_run: Finish
) -> None:
    for cell in plan_of[1]:
        finish_run(cell, tmp_path / "runs")
    changed = grid_file.read_text().replace('"twirl"}', '"twirl", "droq.tau": 0.01}')
    grid_file.write_text(changed)
    grid = load(str(grid_file), reduced=True)
    cells = make_plan(grid, tmp_path / "runs")
    written = gather(grid, cells, tmp_path / "runs", tmp_path / "results")
    assert {p.name for p in written} == {"biped-zs.csv", "biped-zs.episodes.csv"}


@pytest.mark.parametrize("count", [1, 99, 100, 101, 250, 1000])
def test_thin_keeps_both_ends(count: int) -> None:
    rows = [{"i": str(i)} for i in range(count)]
    kept = [int(row["i"]) for row in thin(rows)]
    assert len(kept) == min(count, 100)
    assert (kept[0], kept[-1]) == (0, count - 1)
    assert kept == sorted(set(kept))
