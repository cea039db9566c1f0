"""``twirl rehearse``."""

from __future__ import annotations

import dataclasses
import shlex
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from twirl_mjx import files
from twirl_mjx.checks import check_range
from twirl_mjx.commands.console import json_text, say
from twirl_mjx.commands.options import parse_in_tasks
from twirl_mjx.commands.selection import the_one
from twirl_mjx.commands.tables import check_settings, named, write_rows
from twirl_mjx.deploy.conditions import RehearsalConfig

if TYPE_CHECKING:
    from twirl_mjx.deploy.rehearsal import Rehearsal

FORMAT = "twirl_mjx rehearsal"
"""What the JSON file says that it is."""


@dataclasses.dataclass(frozen=True)
class RehearseOptions:
    """Run a policy in an independent 1 ms simulator loop with latency, noise and motor limits.

    Of the options of tasks those of imitate matter: its clip.
    """

    policy: Annotated[str, tyro.conf.Positional]
    """Run (name or directory), policy file (.npz, .onnx), file.py:function or scripted name;
    NAME=POLICY gives it another name in the table."""
    task: str | None = None
    """Task; the one the policy was trained for by default."""
    episodes: int = 8
    """Episodes."""
    seed: int = 0
    """Seed of goals, noise and courses."""
    robot: RehearsalConfig = dataclasses.field(default_factory=RehearsalConfig)
    """The rehearsed robot."""
    source_contract: str = ""
    """How a foreign policy meets the robot, by name or file (docs/sources.md)."""
    source_command: str = ""
    """What a foreign policy is told to do: 0.5,0,0 or towards-goal:0.5."""
    allow_clipping: bool = False
    """Rehearse a foreign policy without a contract although its outputs leave [-1, 1]."""
    out: Path | None = None
    """Every metric of every episode: .csv, a table as evaluate writes it, or .json."""
    setting: tuple[str, ...] = ()
    """Columns that tell the .csv from others beside it, as name=value: latency_ms=15."""
    film: Path | None = None
    """Film of the first episode, .mp4, with a strip of frames beside it."""
    overwrite: bool = False
    """Replace files that are not of this command."""


def main(argv: list[str], set_up: Callable[[bool], None]) -> int:
    """Rehearse, print a table, and write what is asked for.

    Args:
        argv: Options.
        set_up: Gets whether anything is drawn, before MuJoCo is imported.
    """
    options, overrides = parse_in_tasks(RehearseOptions, argv, "twirl rehearse")
    check_range("episodes", options.episodes, 1, 100_000)
    check_range("seed", options.seed, 0, 2**32 - 1)
    run, policy = named(the_one(options.policy))
    settings = check_settings(options.setting)
    if settings and (options.out is None or options.out.suffix != ".csv"):
        raise ValueError("--setting is a column of a table (nearest: --out rehearsal.csv)")
    set_up(options.film is not None)
    from twirl_mjx.deploy.rehearsal import rehearse
    from twirl_mjx.policies.resolve import Terms

    check_targets(options.out, options.film, options.overwrite)
    result = rehearse(
        policy,
        task=options.task,
        episodes=options.episodes,
        seed=options.seed,
        config=options.robot,
        options=_options_of(policy, options.task, overrides),
        terms=Terms(options.source_contract, options.source_command, options.allow_clipping),
        say=say,
    )
    print_table(policy, result)
    if options.out is not None and options.out.suffix == ".csv":
        notes = f"# command: {shlex.join(['.venv/bin/twirl', 'rehearse', *argv])}\n"
        write_rows(options.out, rows_of(run, policy, result), notes, settings)
    elif options.out is not None:
        write(options.out, policy, result)
    if options.out is not None:
        say(f"wrote {options.out}")
    if options.film is not None:
        say(f"wrote {', '.join(map(str, film(options.film, result)))}")
    return 0


def check_targets(out: Path | None, film: Path | None, overwrite: bool) -> None:
    """Check where results go before anything is rehearsed.

    Raises:
        ValueError: Another ending than is written, or a file that this command did not write.
    """
    from twirl_mjx.training.rundir import EVAL_COLUMNS

    if out is not None:
        if out.suffix not in (".json", ".csv"):
            raise ValueError(
                f"--out {out} ends in {out.suffix!r}, need .json or .csv (nearest:"
                f" {out.with_suffix('.csv')})"
            )
        mark = ",".join(EVAL_COLUMNS) if out.suffix == ".csv" else FORMAT
        files.check_ours(out, mark, overwrite=overwrite)
    if film is not None:
        if film.suffix != ".mp4":
            raise ValueError(f"--film {film} is no .mp4 (nearest: {film.with_suffix('.mp4')})")
        for path in (film, film.with_suffix(".png")):
            files.check_ours(path, overwrite=overwrite)


def _options_of(policy: str, task: str | None, overrides: dict[str, dict[str, Any]]) -> Any:
    """Return the options of the task if any were given, None to take those of the policy.

    Raises:
        ValueError: Options of worlds, which the rehearsal does not have, or of another task.
    """
    if not overrides:
        return None
    from twirl_mjx.commands.options import with_overrides
    from twirl_mjx.commands.render import config_of

    if other := {"dynamics", "worlds"} & overrides.keys():
        name = "dynamics.*" if "dynamics" in other else "randomize"
        raise ValueError(
            f"--{name} sets the worlds of training, not the rehearsed robot (nearest:"
            " --robot.friction)"
        )
    config = with_overrides(config_of(policy, task), overrides)
    for name in overrides.get(config.task, {}):
        if name in config.task_type.course_options:
            own = [f.name for f in dataclasses.fields(RehearsalConfig) if f.name.endswith(name)]
            what = f"--robot.{own[0].replace('_', '-')}" if own else "without it"
            raise ValueError(
                f"--{config.task}.{name.replace('_', '-')} places the course of training worlds,"
                f" and the rehearsal has its own (nearest: {what})"
            )
    return config.options


def print_table(policy: str, result: Rehearsal) -> None:
    """Print mean and 95 % interval of every metric."""
    from rich.box import SIMPLE
    from rich.console import Console
    from rich.table import Table

    count = len(result.episodes)
    say(f"{policy} rehearsed in {result.task}, {count} episode{'s' * (count > 1)}")
    table = Table(box=SIMPLE)
    table.add_column("metric", overflow="fold")
    for column in ("mean", "95 % from", "to", "unit"):
        table.add_column(column, justify="left" if column == "unit" else "right")
    for row in result.table():
        ends = ["" if value != value else f"{value:.4g}" for value in (row.low, row.high)]
        table.add_row(row.metric, f"{row.mean:.4g}", *ends, row.unit)
    Console(width=None if sys.stdout.isatty() else 80).print(table)


def rows_of(run: str, policy: str, result: Rehearsal) -> list[list[object]]:
    """Return the cells of ``EVAL_COLUMNS``: every metric of every episode that is defined."""
    from twirl_mjx.policies.resolve import header_of

    header = header_of(policy)
    card = header.card if header else {}
    trained = [card.get("variant", "scripted"), card.get("seed", 0), card.get("env_steps", 0)]
    return [
        [run, result.task, "none", *trained, index, name, f"{value:.9g}"]
        for index, episode in enumerate(result.episodes)
        for name, value in episode.metrics.items()
        if value == value
    ]


def write(path: Path, policy: str, result: Rehearsal) -> None:
    """Write the table and every metric of every episode as JSON, whole or not at all."""
    record = {
        "format": FORMAT,
        "policy": policy,
        "task": result.task,
        "robot": dataclasses.asdict(result.config),
        "table": [dataclasses.asdict(row) for row in result.table()],
        "episodes": [
            {"ended": episode.cause, "metrics": episode.metrics} for episode in result.episodes
        ],
    }
    files.write_text(path, json_text(record) + "\n")


def film(path: Path, result: Rehearsal) -> tuple[Path, Path]:
    """Film the first episode; return the paths of film and strip."""
    from twirl_mjx.deploy.ground import build_model
    from twirl_mjx.deploy.render import render_episode
    from twirl_mjx.sim.robots import A1
    from twirl_mjx.tasks.registry import TASKS

    episode, kind = result.episodes[0], TASKS.get(result.task)
    count = len(episode.qpos)
    bands = episode.hurdles[episode.hurdles < episode.qpos[:, 0].max() + 4.0]
    model = build_model(result.config, bands)  # the ground that was rehearsed
    captions = [[f"{result.task}, rehearsal  {A1.control_dt * i:5.2f} s"] for i in range(count)]
    return render_episode(
        model,
        episode.qpos,
        path.with_suffix(""),
        frame_dt=A1.control_dt,
        goals=episode.goals if kind.shows_goal else None,
        captions=captions,
    )
