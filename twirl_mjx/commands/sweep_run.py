"""What ``twirl sweep`` does once its options are known."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from fnmatch import fnmatch
from pathlib import Path

from rich.console import Console

from twirl_mjx import files
from twirl_mjx.commands.console import say
from twirl_mjx.commands.sweep import SweepOptions
from twirl_mjx.machine import runtime_folder
from twirl_mjx.sweep import estimate, gather, plan
from twirl_mjx.sweep.grid import Grid, load
from twirl_mjx.sweep.scheduler import Progress, RayExecutor, run_all
from twirl_mjx.sweep.table import SweepView, plan_table
from twirl_mjx.sweep.together import make_teams
from twirl_mjx.sweep.worker import Job
from twirl_mjx.training.signals import stop_on_signal
from twirl_mjx.training.sinks.terminal import format_seconds


def sweep(options: SweepOptions) -> int:
    """Sweep; exit status 1 when a cell failed, 130 when stopped by a signal after saving.

    Raises:
        ValueError: No such grid, seed or arm, or cells that cannot be planned.
    """
    whole = load(options.grid, reduced=options.reduced)
    grid = only_arms(
        load(options.grid, reduced=options.reduced, seeds=options.seeds or None), options.arms
    )
    runs = options.runs.resolve()
    if not options.dry_run:
        runtime_folder()  # refused here rather than by every worker
        for folder in (runs, gather.tables_folder(grid, runs, options.results)):
            files.check_target(folder / "any")
    plan.make_plan(joined(whole, grid), runs, options.nominal)  # refused now, not when gathered
    cells = plan.make_plan(grid, runs, options.nominal)
    status: dict[str, plan.Status] = {cell.name: plan.status_of(cell, runs) for cell in cells}
    todo = wanted(cells, status)
    speeds = estimate.measure(runs)
    estimates = {cell.name: estimate.estimate(cell, runs, speeds) for cell in todo}
    console = Console()
    title = f"{grid.results_name}: {sum(1 for c in cells if c.arm)} cells"
    if options.dry_run:
        if not console.is_terminal:
            console.width = 400
        shown = [c for c in cells if c.arm or c in todo]
        console.print(plan_table(title, shown, status, estimates))
        say(total_line(todo, estimates, options))
        return 0
    code = 0
    if todo and not options.gather_only:
        say(total_line(todo, estimates, options))
        with SweepView(console, title, todo, runs, estimates) as view:
            code = report(_run(todo, runs, options, view))
    _gather(joined(whole, grid), runs, options)
    return code


def _gather(grid: Grid, runs: Path, options: SweepOptions) -> None:
    """Write the tables of all arms, not only of those that were asked for, and say so."""
    cells = plan.make_plan(grid, runs, options.nominal)
    written = gather.gather(grid, cells, runs, options.results)
    arms = [cell for cell in cells if cell.arm]
    finished = sum(plan.is_finished(cell, runs) for cell in arms)
    say(
        f"{grid.results_name}: {finished} of {len(arms)} cells finished;"
        f" {len(written)} tables in {gather.tables_folder(grid, runs, options.results)}"
    )


def joined(whole: Grid, part: Grid) -> Grid:
    """Return a grid with further cells (other seeds), without repeating any."""
    drafts = dict.fromkeys((*whole.drafts, *part.drafts))
    arms = dict.fromkeys(draft.arm for draft in drafts)
    return dataclasses.replace(whole, drafts=tuple(d for a in arms for d in drafts if d.arm == a))


def only_arms(grid: Grid, pattern: str) -> Grid:
    """Return the grid with the arms that match a shell pattern.

    Raises:
        ValueError: None does; the message lists all.
    """
    kept = tuple(draft for draft in grid.drafts if fnmatch(draft.arm, pattern))
    if not kept:
        arms = ", ".join(dict.fromkeys(draft.arm for draft in grid.drafts))
        raise ValueError(f"no arm matches {pattern!r}; arms: {arms}")
    return dataclasses.replace(grid, drafts=kept)


def wanted(cells: Sequence[plan.Cell], status: Mapping[str, plan.Status]) -> list[plan.Cell]:
    """Return the cells that are not finished, and of the runs they need those that are not.

    What others need comes first.
    """
    by_name = {cell.name: cell for cell in cells}
    names: set[str] = set()

    def want(cell: plan.Cell) -> None:
        if status[cell.name] != "finished" and cell.name not in names:
            names.add(cell.name)
            for need in cell.needs:
                want(by_name[need])

    for cell in cells:
        if cell.arm:
            want(cell)
    missing = [cell for cell in cells if cell.name in names]
    needed = {need for cell in missing for need in cell.needs}
    return sorted(missing, key=lambda cell: cell.name not in needed)


def total_line(
    todo: Sequence[plan.Cell], estimates: Mapping[str, estimate.Estimate], options: SweepOptions
) -> str:
    """Return the expected time of all missing cells in words."""
    seconds = sum(e.seconds for e in estimates.values())
    per = (
        f", {format_seconds(seconds / options.workers)} with {options.workers} workers"
        if (options.workers)
        else ""
    )
    bases = ", ".join(
        f"{sum(e.basis == basis for e in estimates.values())} {basis}"
        for basis in ("measured", "scaled", "default")
        if any(e.basis == basis for e in estimates.values())
    )
    return (
        f"{len(todo)} runs to do: about {format_seconds(seconds)} (h:mm:ss) of work on single"
        f" cores{per} (estimates: {bases or 'none needed'})"
    )


def _run(
    todo: Sequence[plan.Cell], runs: Path, options: SweepOptions, view: SweepView
) -> dict[str, Progress]:
    jobs = [job_of(cell, runs) for cell in todo]
    with (
        RayExecutor(
            address=options.address, workers=options.workers, gpus=options.gpus
        ) as executor,
        stop_on_signal() as stop,  # after Ray, which takes SIGTERM for itself when it starts
    ):
        return run_all(
            jobs,
            executor,
            retries=options.retries,
            stop=stop,
            show=view.update,
            look=look_of(todo, runs),
            say=view.say,
            teams=make_teams(todo, runs, options.together),
        )


def look_of(cells: Sequence[plan.Cell], runs: Path) -> Callable[[Job], plan.Status]:
    """Return a function that looks at how far the run of a job is, whoever works on it."""
    by_name = {cell.name: cell for cell in cells}
    return lambda job: plan.status_of(by_name[job.name], runs)


def job_of(cell: plan.Cell, runs: Path) -> Job:
    """Return the job that trains a cell: this program in a process of its own."""
    argv = ("-m", "twirl_mjx", *plan.arguments(cell, runs))
    return Job(cell.name, argv, str(runs / cell.name / "sweep.log"), cell.needs)


def report(table: Mapping[str, Progress]) -> int:
    """Say what did not finish and where its output is; return the exit status."""
    lost = [p for p in table.values() if p.state in ("failed", "blocked")]
    stopped = [p for p in table.values() if p.state in ("stopped", "waiting", "running", "busy")]
    for progress in lost:
        say(f"{progress.state}: {progress.job.name}: {progress.reason}; log: {progress.log}")
    if stopped:
        say(f"stopped with {len(stopped)} runs to do; the same command goes on")
        return 130
    return 1 if lost else 0
