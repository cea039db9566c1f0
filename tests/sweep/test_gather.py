"""From runs to the committed tables, read back by what draws the figures."""

from __future__ import annotations

import dataclasses
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from twirl_mjx import cli
from twirl_mjx.figures.cells import lead_metrics
from twirl_mjx.figures.plots import make_figures, read_grids
from twirl_mjx.figures.report import write_report
from twirl_mjx.figures.summary import summarise
from twirl_mjx.figures.tables import read_directory, read_episodes, read_table
from twirl_mjx.sweep.describe import describe
from twirl_mjx.sweep.gather import arm_of, gather, gather_runs, nominal_notes, settings_of, thin
from twirl_mjx.sweep.grid import Grid, grids_folder, load
from twirl_mjx.sweep.plan import Cell, make_plan
from twirl_mjx.training.presets import make_config
from twirl_mjx.training.rundir import RunDir

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

    curves = read_table(folder / "biped-phi0.5.csv")
    assert set(curves["metric"]) == {"eval/return"}
    assert set(curves["phi"]) == {"0.5"}
    for seed in (0, 1):
        rows = curves["seed"] == seed
        assert rows.sum() == 100
        assert (curves["env_steps"][rows].min(), curves["env_steps"][rows].max()) == (1, 250)
        np.testing.assert_allclose(
            curves["value"][rows], seed + curves["env_steps"][rows] / 1000, rtol=1e-5
        )
    episodes = read_episodes(folder / "biped-phi0.5.episodes.csv")
    # what the run measures of episodes, listed nowhere
    assert sorted(set(episodes["metric"])) == ["episode_length", "return", "unlisted"]
    assert len(episodes) == 2 * 3 * 4


def test_figures_find_what_they_need(
    plan_of: tuple[Grid, tuple[Cell, ...]], tmp_path: Path, finish_run: Finish
) -> None:
    grid, cells = plan_of
    for cell in cells:
        finish_run(cell, tmp_path / "runs")
    gather(grid, cells, tmp_path / "runs", tmp_path / "results")
    curves, episodes = read_directory(tmp_path / "results" / "phi_reduced")
    assert curves is not None and episodes is not None
    assert lead_metrics(curves, "biped") == ["eval/return"]
    rows = {s.label: s for s in summarise(curves, "eval/return")}
    assert rows["phi = 0.25"].mean.estimate == pytest.approx(0.75)  # seeds 0 and 1, plus 0.25
    assert rows["zero-shot"].mean.estimate == pytest.approx(1.5)  # episodes 0 to 3, at no training
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


@pytest.mark.parametrize(
    ("seed", "name", "arm"),
    [
        (0, "biped-twirl-cpu-s0", "biped-twirl-cpu"),
        (12, "biped-twirl-cpu-s12-source_trot", "biped-twirl-cpu-source_trot"),
        (1, "try-s12", "try-s12"),
        (1, "a-s1-b-s1", "a-s1-b"),
        (1, "mine", "mine"),
    ],
)
def test_an_arm_is_the_name_without_the_seed(
    seed: int, name: str, arm: str, tmp_path: Path
) -> None:
    run = RunDir(tmp_path / name)
    run.open(dataclasses.replace(make_config("stand", "debug"), seed=seed))
    assert arm_of(run) == arm


def test_runs_by_themselves_are_reported(
    plan_of: tuple[Grid, tuple[Cell, ...]],
    tmp_path: Path,
    finish_run: Finish,
    capsys: pytest.CaptureFixture[str],
) -> None:
    _, cells = plan_of
    two = [cell for cell in cells if cell.config.task == "biped"][:2]
    paths = [finish_run(cell, tmp_path / "runs") for cell in two]
    folder = gather_runs(paths, tmp_path / "results")
    arms = {
        path.name.replace(f"-s{cell.config.seed}", "", 1)
        for path, cell in zip(paths, two, strict=True)
    }
    assert {p.name for p in folder.glob("*.csv")} == {
        f"{arm}{suffix}.csv" for arm in arms for suffix in ("", ".episodes")
    }
    _, episodes = read_directory(folder)
    assert episodes is not None and set(episodes["runs"]) == arms
    page = tmp_path / "report.html"
    words = ["report", "task:biped", "--runs", str(tmp_path / "runs"), "--out", str(page)]
    assert cli.main(words) == 0
    text = page.read_text(encoding="utf-8")
    assert all(arm in text for arm in arms) and "2 runs" in text
    (paths[0] / "eval.csv").unlink()
    assert cli.main([*words, "--overwrite"]) == 2
    assert f"{paths[0]} is not finished" in capsys.readouterr().err


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


def documented_grid() -> str:
    """Return the "grid of your own" of the documentation, as it stands there."""
    text = (grids_folder() / "README.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"```python\n(.*?)```", text.split("## A grid of your own")[1], re.S)
    return code


@pytest.mark.slow
def test_the_documented_grid_of_your_own(tmp_path: Path, finish_run: Finish) -> None:
    """From the file to tables, figures and the report; its runs are made up."""
    path, runs, results = tmp_path / "mine.py", tmp_path / "runs", tmp_path / "results"
    path.write_text(documented_grid())
    grid = load(str(path))
    assert settings_of(grid)["tau0.01-critics4"] == {"tau": "0.01", "critics": "4"}
    cells = make_plan(grid, runs)
    for cell in cells:
        finish_run(cell, runs, epochs=3)
    assert len(gather(grid, cells, runs, results)) == 2 * 4
    header = (results / "mine" / "tau0.01-critics4.csv").read_text().splitlines()
    assert next(line for line in header if line[0] != "#").endswith(",value,tau,critics")
    said: list[str] = []
    pictures = make_figures(results, tmp_path / "pictures", said.append)
    names = {path.stem for path in pictures}
    assert {"mine_ablation_tau_eval_return_iqm", "mine_ablation_critics_eval_return_mean"} <= names
    assert "mine_episodes_bars_unlisted_iqm" in names  # a measure that is listed nowhere
    page = write_report(results, tmp_path / "report.html", say=said.append).read_text()
    assert all(f"tau = {t}, critics = {n}" in page for t in ("0.005", "0.01") for n in (2, 4))
    assert "What you vary" in page
    assert [line for line in said if not line.startswith("drawing grid")] == []


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_the_documented_grid_for_real(tmp_path: Path) -> None:
    code = documented_grid().replace('"cpu"', '"debug"').replace("(0, 1, 2)", "(0,)")
    code = code.replace('"total_env_steps": 200_000', '"variant": "scratch"')
    (tmp_path / "mine.py").write_text(code)
    folders = ["--runs", str(tmp_path / "runs"), "--results", str(tmp_path / "results")]
    command = [sys.executable, "-m", "twirl_mjx", "sweep", str(tmp_path / "mine.py"), *folders]
    subprocess.run([*command, "--workers", "1"], check=True, cwd=tmp_path)
    pictures = make_figures(tmp_path / "results", tmp_path / "pictures")
    assert len({p.stem for p in pictures if "ablation_tau_eval_return" in p.stem}) == 2


def grid_of(path: Path, axes: str, more: str = "") -> Grid:
    path.write_text(
        f'BLOCK = {{"preset": "debug", "seeds": (0,), "axes": {axes}{more}}}\nGRID = (BLOCK,)'
    )
    return load(str(path))


def test_axes_that_tell_arms_apart_are_columns(tmp_path: Path) -> None:
    task, path = '"task": {"biped": {"task": "biped"}}', tmp_path / "g.py"
    variants = '"v": {"a": {"variant": "twirl"}, "b": {"variant": "scratch"}}'
    assert settings_of(grid_of(path, f"{{{task}, {variants}}}")) == {"biped-a": {}, "biped-b": {}}
    goals = '"task": {"slow": {"task": "biped"}, "fast": {"task": "biped", "droq.tau": 0.01}}'
    assert settings_of(grid_of(path, f"{{{goals}}}")) == {
        "slow": {"axis_task": "slow"},
        "fast": {"axis_task": "fast"},
    }
    alike = '"tau": {"tau0.1": {"droq.tau": 0.1}, "0.1": {"droq.tau": 0.2}}'
    assert settings_of(grid_of(path, f"{{{task}, {alike}}}")) == {
        "biped-tau0.1": {"tau": "tau0.1"},
        "biped-0.1": {"tau": "0.1"},
    }


def test_a_smoke_grid_gives_no_results(tmp_path: Path, finish_run: Finish) -> None:
    axes, runs = '{"task": {"biped": {"task": "biped"}}}', tmp_path / "runs"
    grid = grid_of(tmp_path / "g.py", axes, ', "smoke": True')
    cells = make_plan(grid, runs)
    for cell in cells:
        finish_run(cell, runs)
    written = gather(grid, cells, runs, tmp_path / "results")
    assert not (tmp_path / "results").exists()
    assert {p.parent for p in written} == {runs / "smoke" / "g"}
    said: list[str] = []
    assert read_grids(runs / "smoke", said.append) == {}
    assert said == ["grid 'g': a smoke run is no result, no figure"]
    mixed = (tmp_path / "g.py").read_text() + '\nGRID += (BLOCK | {"smoke": False},)'
    (tmp_path / "g.py").write_text(mixed.replace("(BLOCK |", "({**BLOCK, 'seeds': (1,)} |"))
    with pytest.raises(ValueError, match="some blocks are smoke, some not"):
        load(str(tmp_path / "g.py"))


def test_what_is_shown_of_a_grid_is_checked(tmp_path: Path) -> None:
    axes = '{"task": {"biped": {"task": "biped"}}}'
    path = tmp_path / "g.py"
    grid_of(path, axes)
    text = path.read_text()
    path.write_text(text + '\nRESULTS = {"titel": "x"}')
    with pytest.raises(ValueError, match="nearest: 'title'"):
        load(str(path))
    path.write_text(text + '\nRESULTS = {"place": "first"}')
    with pytest.raises(ValueError, match=r"RESULTS\['place'\]"):
        load(str(path))


def test_tables_of_no_grid_are_described(tmp_path: Path) -> None:
    folder = tmp_path / "mine"
    folder.mkdir()
    rows = ["run,task,shift,variant,seed,metric,env_steps,grad_steps,wall_s,value,tau"]
    for task, shift in (("hurdles", "icy"), ("biped", "none"), ("mine", "none")):
        rows += [f"{task}{tau},{task},{shift},twirl,0,return,0,0,0,1,{tau}" for tau in (10, 9)]
    (folder / "a.csv").write_text("\n".join(rows))
    (folder / "grid.json").write_text('{"title": "Mine", "axes": {"tau": {"title": "share"}}}')
    describe(folder)
    curves, _ = read_directory(folder)
    assert curves is not None
    facts = curves.facts
    assert (facts.title, facts.axis_title("tau")) == ("Mine", "tau (share)")
    assert facts.order("task") == ("biped", "hurdles", "mine")
    assert facts.order("shift") == ("none", "icy")
    assert facts.order("tau") == ("9", "10")
    assert facts.lead("hurdles")[:2] == ("hurdles_passed", "single_flight")
    assert facts.measure("min_distance").smaller_is_better
    assert facts.label("eval/standing_time") == "Evaluation standing time [s]"


@pytest.mark.parametrize("count", [1, 99, 100, 101, 250, 1000])
def test_thin_keeps_both_ends(count: int) -> None:
    rows = [{"i": str(i)} for i in range(count)]
    kept = [int(row["i"]) for row in thin(rows)]
    assert len(kept) == min(count, 100)
    assert (kept[0], kept[-1]) == (0, count - 1)
    assert kept == sorted(set(kept))
