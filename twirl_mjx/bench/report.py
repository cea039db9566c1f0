"""Results of the measurements as tables: for the terminal, and in a Markdown page."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from twirl_mjx import files
from twirl_mjx.bench.measure import Record

BEGIN = "<!-- bench:begin -->"
END = "<!-- bench:end -->"


@dataclasses.dataclass(frozen=True)
class Sheet:
    """One table: a title, column names, and rows of text."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""


def number(value: float | None, digits: int = 3) -> str:
    """Return a number with thousands separated and at least ``digits`` digits; None as a dash."""
    if value is None:
        return "-"
    if abs(value) >= 10 ** (digits - 1):
        return f"{value:,.0f}"
    return f"{value:.{digits}g}"


def percent(value: float | None) -> str:
    """Return a share as per cent; None as a dash."""
    return "-" if value is None else f"{100 * value:.0f} %"


def learner_sheet(record: Record) -> Sheet:
    """Lay out the learner's rates, each beside its ratio to SBX."""
    sbx = record["sbx_updates_per_s"]
    detail = record["detail"]

    def row(name: str, rate: float | None, spread: float | None) -> tuple[str, ...]:
        ratio = None if rate is None or not sbx else rate / sbx
        return name, number(rate), percent(spread), number(ratio)

    def spread(name: str) -> float | None:
        return detail[name]["spread"] if name in detail else None

    layout = record["matmul_bound_layout"]
    rows = (
        row(f"one learner, {record['form']}", record["critic_updates_per_s"], spread("single")),
        row(
            f"{record['seeds']} seeds, one program", record["seeds_updates_per_s"], spread("seeds")
        ),
        row(f"{record['workers']} pinned processes", record["workers_updates_per_s"], None),
        row("SBX DroQ", sbx, spread("sbx")),
        row("matrix products only", record["matmul_bound_updates_per_s"], spread(layout)),
    )
    reasons = [record[key] for key in ("sbx_reason", "workers_reason") if record[key]]
    note = (
        f"obs {record['obs']}, action {record['action']}, batch {record['batch']},"
        f" UTD {record['utd']}, hidden 2 x {record['hidden']}, {record['matmul_dtype']};"
        f" cold compilation {record['compile_s']:.1f} s; one learner reaches"
        f" {percent(record['share_of_matmul_bound'])} of the bound"
    )
    return Sheet(
        "Learner",
        ("what", "critic updates/s", "spread", "x SBX"),
        rows,
        "; ".join([note, *reasons]),
    )


def worlds_sheet(record: Record) -> Sheet:
    """Lay out one row per engine and number of worlds."""
    rows = [
        (
            row["engine"],
            f"{row['num_envs']:,}",
            number(row["control_steps_per_s"]),
            percent(row["control_steps_spread"]),
            number(row["physics_steps_per_s"]),
            number(row["bare_physics_steps_per_s"]),
            percent(row["environment_overhead"]),
            f"{row['compile_s']:.1f}",
        )
        for row in record["rows"]
    ]
    ratios = [f"{n} worlds: {number(x)}" for n, x in record["native_over_mjx"].items()]
    notes = [f"task {record['task']}"]
    notes += [f"native over MJX at {', '.join(ratios)}"] if ratios else []
    notes += [
        f"{row['engine']} with {row['num_envs']} worlds: {row['reason']}"
        for row in record["skipped"]
    ]
    rate, reason = record["envpool_quadruped_steps_per_s"], record["envpool_reason"]
    notes.append(f"EnvPool's quadruped: {reason or number(rate)}")
    columns = (
        "engine",
        "worlds",
        "control steps/s",
        "spread",
        "physics steps/s",
        "bare physics steps/s",
        "overhead",
        "compile s",
    )
    return Sheet("Worlds", columns, tuple(rows), "; ".join(notes))


def startup_sheet(record: Record) -> Sheet:
    """Lay out cold and warm start."""
    rows = (
        ("empty cache", f"{record['cold_s']:.1f}"),
        ("filled cache", f"{record['warm_s']:.1f}"),
    )
    note = (
        f"`twirl train --task {record['task']} --preset {record['preset']}`;"
        f" the cache then holds {record['cache_mb']:.0f} MB"
    )
    return Sheet("Start-up", ("compilation cache", "s to the first critic updates"), rows, note)


def epoch_sheet(record: Record) -> Sheet:
    """Lay out the cost split of an epoch."""
    rows = [
        (name, f"{1e3 * value:.1f}", percent(record["shares"][name]))
        for name, value in record["seconds"].items()
    ]
    left = record["unaccounted_s"]
    rows.append(("unaccounted", f"{1e3 * left:.1f}", percent(left / record["epoch_s"])))
    note = (
        f"{record['task']}, preset {record['preset']}, engine {record['engine']}:"
        f" {record['env_steps']} transitions of {record['num_envs']} worlds and"
        f" {record['critic_updates']} critic updates in {record['epoch_s']:.3f} s;"
        f" peak memory {record['peak_memory_mb']:,.0f} MB"
    )
    return Sheet("One training epoch", ("part", "ms", "share"), tuple(rows), note)


def forms_sheet(record: Record) -> Sheet:
    """Lay out the returns of the forms of the learner, a row per quarter of the run."""

    def text(form: str, part: Mapping[str, Any]) -> str:
        values = part[form]
        apart = "" if part["overlap"][form] else ", apart"
        return f"{sum(values) / len(values):.1f} ({min(values):.1f} to {max(values):.1f}{apart})"

    forms = list(record["wall_s"])
    rows = tuple(
        (str(i + 1), *(text(form, part) for form in forms))
        for i, part in enumerate(record["quarters"])
    )
    walls = ", ".join(f"{form} {wall:.0f} s" for form, wall in record["wall_s"].items())
    note = (
        f"mean episode return over {record['seeds']} seeds (range; 'apart' where it does not meet"
        f" that of the plain form); {record['task']}, preset {record['preset']},"
        f" {record['env_steps']:,} transitions and {record['critic_updates']:,} critic updates of"
        f" every seed; took: {walls}"
    )
    return Sheet("Forms of the learner", ("quarter", *forms), rows, note)


def gpu_compile_sheet(record: Record) -> Sheet:
    """Lay out operations per turn of the innermost loop, and of what surrounds it."""
    rows = tuple(
        (
            row["program"],
            row["form"] or "MJX",
            str(row["seeds"]),
            str(row["in_loop"]),
            " > ".join(
                f"{block['name']} {block['count']}"
                for block in row["loops"]
                if block["name"] != "condition"
            ),
            f"{row['temporary_mb']:.0f}",
            f"{row['compile_s']:.0f}",
        )
        for row in record["rows"]
    )
    note = f"compiled for {record['card']} without one; epoch (no physics) and worlds"
    note += f" ({record['num_envs']:,} of MJX): {record['task']}"
    note += f"; XLA flags: {' '.join(record['flags'])}" if record["flags"] else ""
    columns = ("program", "form", "seeds", "in the loop", "all", "temporary MB", "compile s")
    return Sheet("GPU operations", columns, rows, note)


def gpu_parity_sheet(record: Record) -> Sheet:
    """Lay out the largest error of every part against the CPU."""
    worst: dict[str, Record] = {}
    for row in record["rows"]:
        part = row["name"].rsplit(".", 1)[0]
        if part not in worst or not row["error"] <= worst[part]["error"]:
            worst[part] = row
    rows = tuple(
        (
            part,
            row["name"].rsplit(".", 1)[1],
            f"{row['error']:.1e}",
            f"{row['tolerance']:.0e}",
            "yes" if row["error"] <= row["tolerance"] else "no",
        )
        for part, row in worst.items()
    )
    columns = ("part", "worst array", "relative error", "tolerance", "within")
    return Sheet("Parity with the CPU", columns, rows)


def gpu_timings_sheet(record: Record) -> Sheet:
    """Lay out a row per variant, and why one was not measured."""
    rows = tuple(
        (row["name"], "-", row["unit"], "-", row["fault"])
        if row["fault"]
        else (row["name"], number(row["rate"]), row["unit"], percent(row["spread"]), "")
        for row in record["rows"]
    )
    return Sheet("Timings", ("variant", "rate", "unit", "spread", "not measured because"), rows)


def gpu_training_sheet(record: Record) -> Sheet:
    """Lay out how far every run came."""
    rows = tuple(
        (
            row["run"],
            f"{row['env_steps']:,}",
            f"{row['grad_steps']:,}",
            f"{row['wall_s']:.0f}",
            number(row["updates_per_s"]),
            number(row["eval_return"]),
        )
        for row in record["rows"]
    )
    columns = ("run", "transitions", "critic updates", "s", "updates/s", "return")
    return Sheet("Training", columns, rows)


SHEETS: dict[str, Callable[[Record], Sheet]] = {
    "learner": learner_sheet,
    "worlds": worlds_sheet,
    "startup": startup_sheet,
    "epoch": epoch_sheet,
    "forms": forms_sheet,
    "gpu-compile": gpu_compile_sheet,
    "gpu-parity": gpu_parity_sheet,
    "gpu-timings": gpu_timings_sheet,
    "gpu-training": gpu_training_sheet,
}


def sheets_of(parts: Mapping[str, Record]) -> list[Sheet]:
    """Lay out every part; one that failed becomes a table with its error."""
    found = []
    for name, record in parts.items():
        if "error" in record:
            found.append(Sheet(name.capitalize(), ("not measured",), ((record["error"],),)))
        else:
            found.append(SHEETS[name](record))
    return found


NOISY = 0.2
"""Spread, or share that does not add up, above which a result is not published."""


def doubts(parts: Mapping[str, Record]) -> list[str]:
    """Return a line for every reason not to publish results: faults, noise, contradictions."""
    told = [f"{name}: {record['error']}" for name, record in parts.items() if "error" in record]
    whole = {name: record for name, record in parts.items() if "error" not in record}
    spreads: dict[str, float] = {}
    if learner := whole.get("learner"):
        spreads |= {f"learner, {name}": each["spread"] for name, each in learner["detail"].items()}
        if learner["share_of_matmul_bound"] > 1.0:
            share = percent(learner["share_of_matmul_bound"])
            told.append(f"learner: {share} of a bound that nothing can be above")
    if worlds := whole.get("worlds"):
        for row in worlds["rows"]:
            name = f"worlds, {row['engine']} with {row['num_envs']}"
            spreads[name] = row["control_steps_spread"]
    if epoch := whole.get("epoch"):
        spreads["epoch"] = epoch["spread"]
        left = epoch["unaccounted_s"] / epoch["epoch_s"]
        if abs(left) > NOISY:
            told.append(f"epoch: its parts leave {percent(left)} of it unaccounted")
    noisy = {name: spread for name, spread in spreads.items() if spread > NOISY}
    return told + [f"{name}: samples spread by {percent(spread)}" for name, spread in noisy.items()]


def machine_line(machine: Mapping[str, Any]) -> str:
    """Return the machine and the versions in one sentence."""
    shown = ("python", "jax", "mujoco", "mujoco-mjx", "commit")
    versions = ", ".join(
        f"{name} {machine['versions'][name]}" for name in shown if name in machine["versions"]
    )
    return (
        f"{machine['processor']}, {machine['cpus']} CPUs used, {machine['memory_gb']:g} GB,"
        f" {', '.join(machine['devices'])}; {versions}; load before the start"
        f" {machine['load_before']:g}."
    )


def print_sheets(sheets: Sequence[Sheet], machine: Mapping[str, Any]) -> None:
    """Show the tables in the terminal."""
    from rich.console import Console
    from rich.table import Table

    console = Console()
    for sheet in sheets:
        table = Table(title=sheet.title, caption=sheet.note or None)
        for i, column in enumerate(sheet.columns):
            table.add_column(column, justify="right" if i else "left")
        for row in sheet.rows:
            table.add_row(*row)
        console.print(table)
    console.print(machine_line(machine), highlight=False)


def markdown(sheets: Sequence[Sheet], machine: Mapping[str, Any]) -> str:
    """Return the tables as Markdown."""
    blocks = [machine_line(machine)]
    for sheet in sheets:
        lines = [
            f"### {sheet.title}",
            "",
            "| " + " | ".join(sheet.columns) + " |",
            "|---" + "|---:" * (len(sheet.columns) - 1) + "|",
            *("| " + " | ".join(_cell(text) for text in row) + " |" for row in sheet.rows),
        ]
        blocks.append("\n".join(lines))
        if sheet.note:
            blocks.append(sheet.note[0].upper() + sheet.note[1:] + ".")
    return "\n\n".join(blocks)


def _cell(text: str) -> str:
    return " ".join(text.replace("|", "\\|").split())


def replace_section(page: str, section: str) -> str:
    """Put a text between the markers of a page; doing it twice changes nothing.

    Raises:
        ValueError: The page does not have both markers, once each and in order.
    """
    if page.count(BEGIN) != 1 or page.count(END) != 1 or page.index(BEGIN) > page.index(END):
        raise ValueError(f"the page needs the lines {BEGIN} and {END}, once each and in order")
    head, tail = page.split(BEGIN)[0], page.split(END)[1]
    return f"{head}{BEGIN}\n\n{section}\n\n{END}{tail}"


def write_section(path: Path, section: str) -> None:
    """Put a text between the markers of a file."""
    files.write_text(path, replace_section(files.read_text(path, "a page"), section))
