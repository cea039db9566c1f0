"""From the cells of a grid to runs: identity, the runs they need first, and what is done already.

The identity of a cell is the digest of its resolved config, in which ``source`` says what the
source *is* (a policy file by its hash, a run by its own digest) and not where it lies. The digest
is part of the run's name, so two grids that hold the same cell share one run, and a changed
grid, preset or source never continues or counts the run of another.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

from twirl_mjx import files, plugins
from twirl_mjx.policies import rows
from twirl_mjx.sim.leaves import SHIFTS
from twirl_mjx.sim.robots import ROBOTS
from twirl_mjx.sweep.grid import Draft, Grid, configure
from twirl_mjx.tasks.registry import TASKS
from twirl_mjx.training import config_json, rundir, source_rules
from twirl_mjx.training.config import TrainConfig
from twirl_mjx.training.learners import LEARNERS
from twirl_mjx.training.presets import make_config
from twirl_mjx.training.rundir import RunDir

Status = Literal["finished", "in use", "cut off", "missing"]


@dataclasses.dataclass(frozen=True)
class Cell:
    """A run of the sweep: a cell of the grid, or a run that cells need first."""

    name: str
    """Name of the run."""
    arm: str
    """Arm of the grid; empty for a run that is only needed by others."""
    preset: str
    """Preset the config came from."""
    config: TrainConfig
    """The run, with ``source`` naming what the source is: this is the identity."""
    source: str
    """``--source`` of the run: where the source lies."""
    needs: tuple[str, ...] = ()
    """Names of the runs that have to be finished before."""
    contract: str = ""
    """``--source-contract`` of the run: a name, or where its file lies."""

    @property
    def is_shifted(self) -> bool:
        """Whether it adapts to a dynamics shift."""
        return self.config.shift != "none"

    @property
    def label(self) -> str:
        """Arm and seed, or the task and seed of a needed run."""
        seed = f"s{self.config.seed}"
        return f"{self.arm} {seed}" if self.arm else f"first: {self.config.task} {seed}"


def make_plan(grid: Grid, runs: Path, nominal: Sequence[Path] = ()) -> tuple[Cell, ...]:
    """Return all runs of a grid, each after those it needs.

    Args:
        grid: The grid.
        runs: Folder of all runs.
        nominal: Finished nominal runs to start adaptation from, at most one per task, instead
            of those of the grid.

    Raises:
        ValueError: Two nominal runs of one task, or one that is not finished.
    """
    given = given_nominals(nominal)
    cells: dict[str, Cell] = {}
    for draft in grid.drafts:
        resolve(draft, runs, given, cells)
    return tuple(cells.values())


def given_nominals(paths: Sequence[Path]) -> dict[str, Path]:
    """Return task -> run directory of the nominal runs a user names.

    Raises:
        ValueError: Two of one task, one under a shift, or one that is not finished.
    """
    found: dict[str, Path] = {}
    for path in paths:
        run_dir = RunDir(path)
        config = run_dir.read_config()
        if config.shift != "none" or not run_dir.finished():
            raise ValueError(f"{path} is not a finished run without a shift")
        if config.task in found:
            raise ValueError(
                f"{found[config.task]} and {path} are both nominal runs of {config.task}"
            )
        found[config.task] = path
    return found


def resolve(draft: Draft, runs: Path, given: Mapping[str, Path], cells: dict[str, Cell]) -> Cell:
    """Add a draft's cell to ``cells``, after the runs it needs; return it.

    Raises:
        ValueError: Its run is that of another arm already; the message names both arms.
    """
    identity, place, needs = _source_of(draft, runs, given, cells)
    contract, contract_place = _contract_of(draft.config)
    config = dataclasses.replace(draft.config, source=identity, source_contract=contract)
    name = run_name(config)
    if not draft.arm and (adopted := _adoptable(draft, runs)):
        name = adopted
    if (known := cells.get(name)) and known.arm:
        if draft.arm not in ("", known.arm):
            raise ValueError(
                f"arms {known.arm!r} and {draft.arm!r} have equal settings: both are the run"
                f" {name}, which one table can hold (drop one arm, or change a setting of it)"
            )
        return known
    cell = Cell(name, draft.arm, draft.preset, config, place, needs, contract_place)
    cells[name] = cell
    return cell


def _contract_of(config: TrainConfig) -> tuple[str, str]:
    """Return what the contract of a foreign source is, and where it lies; names are themselves."""
    if not (path := Path(config.source_contract)).is_file():
        return config.source_contract, config.source_contract
    return _identity_of_path(path), str(path.resolve())


def _source_of(
    draft: Draft, runs: Path, given: Mapping[str, Path], cells: dict[str, Cell]
) -> tuple[str, str, tuple[str, ...]]:
    """Return what the source is, where it lies, and the names of the runs needed for it."""
    config = draft.config
    if config.variant == "scratch":
        return "auto", "auto", ()
    match source_rules.source_of(config, draft.preset):
        case source_rules.Scripted(name):
            return name, name, ()
        case source_rules.InFile(reference):
            file, name = plugins.split(reference, "policy")
            return f"{_identity_of_path(file)} {name}", f"{file}:{name}", ()
        case source_rules.AtPath(path) if str(path).startswith(plugins.MINARI):
            return f"{path} {files.checksum(rows.find_minari(str(path))[0])[:12]}", str(path), ()
        case source_rules.AtPath(path, is_shipped):
            return _identity_of_path(path), "auto" if is_shipped else str(path.resolve()), ()
        case source_rules.NominalRun() if path := given.get(config.task):
            return _identity_of_path(path), str(path.resolve()), ()
        case source_rules.NominalRun():
            return _needed(_nominal_draft(draft), runs, given, cells)
        case source_rules.RunOf(first):
            return _needed(Draft("", draft.preset, first, ()), runs, given, cells)


def _needed(
    draft: Draft, runs: Path, given: Mapping[str, Path], cells: dict[str, Cell]
) -> tuple[str, str, tuple[str, ...]]:
    cell = resolve(draft, runs, given, cells)
    identity = f"run {rundir.digest(cell.config)}"
    return identity, str((runs / cell.name).resolve()), (cell.name,)


def _nominal_draft(draft: Draft) -> Draft:
    """Return the run without a shift that an adaptation starts from: same task, preset, seed."""
    task, seed = draft.config.task, draft.config.seed
    variant = make_config(task, draft.preset).variant
    settings = {"task": task, "seed": seed, "variant": variant} | dict(draft.nominal)
    config = configure(draft.preset, settings, f"nominal run of arm {draft.arm}")
    return Draft("", draft.preset, config, ())


def _adoptable(draft: Draft, runs: Path) -> str | None:
    """Return the name under which ``twirl train`` has finished the same run, if it has."""
    plain = make_config(draft.config.task, draft.preset)
    same = dataclasses.replace(plain, seed=draft.config.seed, variant=draft.config.variant)
    run_dir = RunDir(runs / rundir.default_name(same, draft.preset))
    if draft.config != same or not run_dir.finished():
        return None
    found = run_dir.read_config()
    free = tuple(set(rundir.may_change(same)) - {"total_env_steps:", "source:"})
    differs = [line for line in config_json.diff(found, same) if not line.startswith(free)]
    return None if differs else run_dir.name


def _identity_of_path(path: Path) -> str:
    """Return a text that changes with the content of a policy file or the config of a run."""
    if path.is_dir():
        steps = evaluated_steps(path)
        return f"{path.name} {rundir.digest(RunDir(path).read_config())} at {steps}"
    content = files.read_bytes(path, "a source policy")
    return f"{path.name} {hashlib.sha256(content).hexdigest()[:12]}"


def run_name(config: TrainConfig) -> str:
    """Return the name of a cell's run; it ends in the digest of the resolved config."""
    shift = "" if config.shift == "none" else f"-{config.shift}"
    variant = config.variant.replace("+", "_")
    return f"{config.task}{shift}-{variant}-s{config.seed}-{rundir.digest(config)[:8]}"


def evaluated_steps(run_dir: Path) -> int | None:
    """Return the transitions at which a run was closed by its final evaluation, None if not."""
    done = RunDir(run_dir).finished()
    return done.env_steps if done else None


def reached_steps(run_dir: Path) -> int:
    """Return the transitions of the last row of ``metrics.csv``, 0 without one."""
    path = RunDir(run_dir).metrics
    if not path.is_file():
        return 0
    tail = files.read_tail(path, "the metrics of a run", 4096)
    for line in reversed(tail.decode(errors="replace").splitlines(keepends=True)):
        cells = line.split(",")
        if line.endswith("\n") and len(cells) == 10 and cells[6].isdigit():
            return int(cells[6])
    return 0


def is_finished(cell: Cell, runs: Path) -> bool:
    """Return whether the run of a cell is closed, at its budget, under the same config.

    Raises:
        ValueError: The directory of the cell holds another run.
    """
    run_dir = runs / cell.name
    steps = evaluated_steps(run_dir)
    if steps is None:
        return False
    if cell.name == run_name(cell.config):
        found = dataclasses.replace(
            RunDir(run_dir).read_config(),
            source=cell.config.source,
            source_contract=cell.config.source_contract,
        )
        if found != cell.config:
            lines = "\n  ".join(config_json.diff(found, cell.config))
            raise ValueError(f"{run_dir} was changed by hand (there -> cell):\n  {lines}")
    return cell.config.variant == "zero-shot" or steps >= cell.config.total_env_steps


def status_of(cell: Cell, runs: Path) -> Status:
    """Return how far a cell is; a run is finished when its process has let go of it, too."""
    run_dir = runs / cell.name
    finished = is_finished(cell, runs)
    if RunDir(run_dir).owner() is not None:
        return "in use"
    if finished:
        return "finished"
    return "cut off" if reached_steps(run_dir) else "missing"


def arguments(cell: Cell, runs: Path) -> list[str]:
    """Return the arguments of ``twirl`` that train (or resume) a cell, in another process.

    What came from a user's file is named by it: that process has not loaded it.
    """
    registries = {"task": TASKS, "learner": LEARNERS, "shift": SHIFTS, "robot": ROBOTS}
    plain = config_json.flatten(make_config(cell.config.task, cell.preset, cell.config.learner)) | {
        "task": None,
        "learner": TrainConfig.learner,
    }
    wanted = config_json.flatten(
        dataclasses.replace(cell.config, source=cell.source, source_contract=cell.contract)
    )
    argv = ["train", "--preset", cell.preset, "--name", cell.name, "--runs", str(runs)]
    for field, value in wanted.items():
        if value == plain[field] or field == "uses":
            continue
        if field in registries:
            value = registries[field].reference(value) or value
        flag = field.replace("_", "-")
        if isinstance(value, bool):
            *parents, leaf = flag.split(".")
            argv.append("--" + ".".join([*parents, leaf if value else f"no-{leaf}"]))
        elif isinstance(value, tuple):
            argv += [f"--{flag}", *map(str, value)]
        else:
            argv += [f"--{flag}", str(value)]
    return argv
