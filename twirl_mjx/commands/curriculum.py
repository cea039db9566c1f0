"""``twirl curriculum``."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from twirl_mjx.checks import check_choice, check_once, check_range
from twirl_mjx.commands.console import parse, say
from twirl_mjx.commands.options import default_preset
from twirl_mjx.commands.waiting import waiting
from twirl_mjx.sim.leaves import PAPER_SHIFTS, SHIFTS
from twirl_mjx.sweep.grid import configure
from twirl_mjx.tasks.registry import TASKS
from twirl_mjx.tasks.task import Link
from twirl_mjx.training.config import TrainConfig
from twirl_mjx.training.presets import PRESETS

if TYPE_CHECKING:
    from twirl_mjx.sweep.contest import Contest

ADAPTATION_ENV_STEPS = 100_000
"""Transitions of an adaptation run (paper, section "Transfer to New Environments")."""
CONTEST = ("budget", "rounds", "measure", "episodes", "name")
"""Options of a contest only."""
CHAIN = ("shifts", "source")
"""Options of a chain only."""


@dataclasses.dataclass(frozen=True)
class CurriculumOptions:
    """Train a chain unattended: easier tasks first, the target task, then every dynamics shift.

    With --source the target task starts from that source, and the easier tasks are left out. With
    --sources no chain is given: sources and easier tasks compete for the target (--budget, ...).
    """

    task: Annotated[str, tyro.conf.arg(aliases=["--target"])] = TrainConfig.task
    """Target task at the heart of the chain."""
    preset: Annotated[str, tyro.conf.arg(help="paper, cpu, massive or debug")] = ""
    """Settings; cpu without an accelerator, else paper."""
    seed: int = 0
    """Seed of every run."""
    runs: Path = Path("runs")
    """Folder of all runs."""
    shifts: tuple[str, ...] | None = None
    """Shifts to adapt to; all five after a chain, none after a contest by default."""
    source: str = ""
    """Source of the target task instead of the easier ones: whatever twirl train takes."""
    source_contract: str = ""
    """How a foreign source meets the robot, by name or file (docs/sources.md)."""
    source_command: str = ""
    """What a foreign source is told to do: 0.5,0,0 or towards-goal:0.5."""
    allow_clipping: bool = False
    """Record a source although more than 20 % of its joint targets lie outside the action box."""
    sources: tuple[str, ...] = ()
    """Sources that compete: tasks with a shipped policy, or whatever --source takes; NAME=SOURCE
    gives another name."""
    budget: int = 2_400_000
    """Of a contest: transitions in all."""
    rounds: int = 3
    """Of a contest: rounds; the winner of one is a source of the next."""
    measure: str = ""
    """Of a contest: the measure of the target task that decides; the task's aim by default."""
    episodes: int = 100
    """Of a contest: episodes by which a candidate is judged."""
    minutes: float | None = None
    """Save and stop after this wall time; the same command goes on."""
    name: str | None = None
    """Of a contest: its name, with which its runs begin."""


def chain_of(task: str) -> tuple[Link, ...]:
    """Return the runs that lead to a task: its own chain, else those of its sources and its own."""
    kind = TASKS.get(task)
    if kind.chain:
        return kind.chain
    before = chain_of(kind.source) if kind.source else ()
    return (*before, Link(task, {"task": task}))


def plan(options: CurriculumOptions, preset: str) -> list[tuple[str, TrainConfig]]:
    """Return name and config of every run of the chain; each is the source of the next.

    All shifts start from the run of the target task.
    """
    from twirl_mjx.training.rundir import default_name  # needs jax, which options do not

    links: list[tuple[str, TrainConfig]] = []
    task = TASKS.admit(options.task)
    for name, settings in chain_of(task)[-1:] if options.source else chain_of(task):
        source = {"source": str(options.runs / links[-1][0])} if links else given_source(options)
        config = configure(preset, {**settings, **source, "seed": options.seed}, f"link {name}")
        chained = f"{name}-chain-{preset}-s{options.seed}"
        # The first link is the run of `twirl train`, which may be there already.
        links.append((chained if links else default_name(config, preset), config))
    target, config = links[-1]
    budget = min(ADAPTATION_ENV_STEPS, config.total_env_steps)
    for shift in shifts_of(options):
        adapted = dataclasses.replace(
            config,
            shift=shift,
            source=str(options.runs / target),
            source_contract="",
            source_command="",
            total_env_steps=budget,
        )
        chained = f"{task}-{shift}-chain-{preset}-s{options.seed}"
        # From a source that was named, a link is named after the run that learned from it.
        links.append((f"{target}-{shift}" if options.source else chained, adapted))
    return links


def shifts_of(options: CurriculumOptions) -> tuple[str, ...]:
    """Return the shifts at the end of the chain."""
    return PAPER_SHIFTS[1:] if options.shifts is None else options.shifts


def given_source(options: CurriculumOptions) -> dict[str, str | bool]:
    """Return the settings of the source that was named, none if there was none.

    Raises:
        ValueError: A contract or a command, and no source that could have one.
    """
    terms = {"contract": options.source_contract, "command": options.source_command}
    if not options.source:
        for name, value in terms.items():
            if value:
                raise ValueError(
                    f"--source-{name} {value} would do nothing without a foreign source (nearest:"
                    " --source FILE.onnx)"
                )
        return {}
    said: dict[str, str | bool] = {f"source_{name}": value for name, value in terms.items()}
    return {"source": options.source, "variant": "twirl", **said} | (
        {"allow_clipping": True} if options.allow_clipping else {}
    )


def check_together(options: CurriculumOptions) -> None:
    """Refuse options that would do nothing.

    Raises:
        ValueError: They belong to a contest and there is none, or the other way round.
    """
    names, nearest = CONTEST, "add --sources"
    if options.sources:
        names, nearest = CHAIN, "drop --sources"
    defaults = {field.name: field.default for field in dataclasses.fields(options)}
    for name in names:
        if (value := getattr(options, name)) != defaults[name]:
            told = " ".join(value) if isinstance(value, tuple) else value
            raise ValueError(f"--{name} {told} would do nothing here (nearest: {nearest})")
    if options.minutes is not None:
        check_range("minutes", options.minutes, 0.001, 1e7)


def main(argv: list[str]) -> int:
    """Run the chain; links that are finished are skipped, an interrupted one resumes."""
    options = parse(CurriculumOptions, argv, "twirl curriculum")
    check_together(options)
    preset = options.preset or default_preset()
    check_choice("preset", preset, PRESETS)
    if options.sources:
        return compete(options, preset)
    shifts = tuple(map(SHIFTS.admit, shifts_of(options)))
    options = dataclasses.replace(options, shifts=shifts)
    check_once("--shifts", shifts)
    from twirl_mjx.training import pipeline, source_rules

    links = plan(options, preset)
    for _, config in links:  # the last link would be refused after hours of those before it
        source_rules.check_source_is_used(config, preset)
    deadline = pipeline.deadline_after(options.minutes)
    for number, (name, config) in enumerate(links, 1):
        say(f"link {number} of {len(links)}: {name}")
        pipeline.run(config, preset, options.runs, name, say, deadline=deadline)
    return 0


def compete(options: CurriculumOptions, preset: str) -> int:
    """Hold a contest; draw its tree, however it ends."""
    with waiting("loading the trainer"):
        from twirl_mjx.policies.resolve import Terms
        from twirl_mjx.sweep.contest import Contest, Rules
        from twirl_mjx.training import pipeline
    terms = Terms(options.source_contract, options.source_command, options.allow_clipping)
    rules = Rules(
        task=options.task,
        preset=preset,
        seed=options.seed,
        sources=tuple(map(entrant, options.sources)),
        budget=options.budget,
        rounds=options.rounds,
        measure=options.measure,
        episodes=options.episodes,
        terms=terms,
    )
    name = options.name or f"{TASKS.get(rules.task).name}-contest-{preset}-s{options.seed}"
    with waiting("looking at the sources"):
        deadline = pipeline.deadline_after(options.minutes)
        contest = Contest(rules, options.runs, name, say, deadline)
    try:
        winner = contest.hold()
    finally:
        draw(contest)
    say(contest.summary(winner))
    return 0


def entrant(word: str) -> tuple[str, str]:
    """Return name and ``--source`` of a source that competes.

    Raises:
        ValueError: A task of which no policy is shipped.
    """
    from twirl_mjx.assets import asset_path
    from twirl_mjx.commands.tables import named
    from twirl_mjx.sweep.contest import slug

    name, given = named(word)
    if given in TASKS.names():
        try:
            return (given if name == word else name), str(asset_path("policies", f"{given}.npz"))
        except FileNotFoundError:
            raise ValueError(
                f"no policy of task {given} is shipped (nearest: train one, twirl train --task"
                f" {given}, and name its run)"
            ) from None
    return (slug(given) if given == word else name), given


def draw(contest: Contest) -> None:
    """Draw the tree of a contest as far as it went."""
    if not any(row.run for row in contest.rows):
        return
    from twirl_mjx.figures.canvas import write_png
    from twirl_mjx.figures.tree import contest_tree

    figure = contest_tree(contest.rows, contest.told_measure, f"Contest {contest.name}")
    say(f"wrote {write_png(figure, contest.folder / 'tree.png')}")
