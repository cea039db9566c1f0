"""One HTML page with every table, figure and clip, made from result files only."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

import numpy as np

from twirl_mjx import files
from twirl_mjx.figures import page
from twirl_mjx.figures.canvas import png_bytes, reduced_caption
from twirl_mjx.figures.cells import groups, is_idle, lead_metrics, ordered, shown_metrics
from twirl_mjx.figures.curves import place_name
from twirl_mjx.figures.errors import TableError
from twirl_mjx.figures.facts import Facts, Measure
from twirl_mjx.figures.page import Media
from twirl_mjx.figures.plots import Drawing, drawings, read_grids
from twirl_mjx.figures.statistics import FEW_RUNS, Interval
from twirl_mjx.figures.style import short_count
from twirl_mjx.figures.summary import Summary, best, summarise
from twirl_mjx.figures.tables import Table, mask
from twirl_mjx.figures.wording import TERMS, duration, interval_text, numbers

__all__ = ["Media", "write_report"]

_SHORT_TABLE = 12  # rows; a longer table of details is folded


@dataclass(frozen=True)
class Part:
    """The rows of one task in one table of a grid, ready to be shown."""

    grid: str
    """Name of the grid."""
    table: Table
    """Curve or episode rows of the task."""
    leads: list[str]
    """Metrics the task is judged by, the main one first."""
    summaries: dict[str, list[Summary]]
    """Metric -> one summary per cell."""

    @property
    def main(self) -> str:
        """The metric that leads."""
        return self.leads[0]

    def measure(self, metric: str) -> Measure:
        """Return how a metric is written."""
        return self.table.facts.measure(metric)


def write_report(
    results_dir: str | Path,
    output_path: str | Path,
    media: Sequence[Media | str | Path] = (),
    *,
    title: str = "twirl_mjx results",
    say: Callable[[str], None] = print,
) -> Path:
    """Write one self-contained page: findings, tables, curves and clips, no outside resources.

    The grid with the lowest ``place`` comes first; smoke runs are left out.

    Args:
        results_dir: ``experiments/results``, with ``<grid>/<arm>.csv`` below it.
        output_path: The HTML file, replaced if it exists.
        media: Clips and pictures in the order of the page.
        title: Heading of the page.
        say: Called with one line per grid that is left out, and before a grid is drawn.

    Returns:
        The file written.

    Raises:
        TableError: If a table is not valid or there is nothing at all to show.
        MediaError: If a clip is missing or of an unknown kind.
    """
    grids = read_grids(results_dir, say)
    clips = [m if isinstance(m, Media) else Media(Path(m)) for m in media]
    if not grids and not clips:
        raise TableError(f"{results_dir}: no rows and no clips, nothing to report")
    shown = "".join(page.clip(m) for m in clips)  # refused before minutes of drawing
    sections = []
    for i, (grid, tables) in enumerate(grids.items()):
        say(f"drawing grid '{grid}', {i + 1} of {len(grids)}")
        html = _grid_html(grid, *tables, opened=not sections)
        sections.append((grid, _facts(tables).title or f"Grid: {grid}", html))
    if clips:
        sections.insert(1, ("clips", "Clips", f'<div class="clips">{shown}</div>'))
    sections.append(("terms", "How to read the numbers", TERMS))
    links = "".join(f'<li><a href="#{escape(k)}">{escape(t)}</a></li>' for k, t, _ in sections)
    body = "".join(
        f'<section id="{escape(key)}" aria-labelledby="{escape(key)}-title">'
        f'<h2 id="{escape(key)}-title">{escape(name)}</h2>{html}</section>'
        for key, name, html in sections
    )
    html = page.document(
        title,
        f'<header><h1>{escape(title)}</h1><p class="lead">{_lead(grids)}</p>'
        f'<nav aria-label="Contents"><ul>{links}</ul></nav></header><main id="main">{body}</main>'
        f"<footer><p>Made from tidy CSV files by {page.command('make report')}; the figures alone: "
        f"{page.command('make figures')}.</p></footer>",
    )
    path = Path(output_path)
    files.write_text(path, html)
    return path


def _facts(tables: tuple[Table | None, Table | None]) -> Facts:
    return next(table.facts for table in tables if table is not None)


def _lead(grids: dict[str, tuple[Table | None, Table | None]]) -> str:
    tables = [table for pair in grids.values() for table in pair if table is not None]
    names = {
        (grid, run)
        for grid, pair in grids.items()
        for table in pair
        if table is not None
        for (run,) in groups(mask(table, ~is_idle(table)), ["run"])
    }
    text = f"{len(grids)} grid{'s' * (len(grids) != 1)}, {len(names)} run{'s' * (len(names) != 1)}."
    if any(reduced_caption(table) for table in tables):
        text += " Some results come from reduced budgets; each says so where it is shown."
    return escape(f"{text} Click a figure to see it whole, and once more to go back.")


def _grid_html(grid: str, curves: Table | None, episodes: Table | None, *, opened: bool) -> str:
    pieces = []
    if about := _facts((curves, episodes)).about:
        pieces.append(f"<p>{escape(about)}</p>")
    for table in (curves, episodes):
        if table is None:
            continue
        parts = [_part(grid, table, task) for task in ordered(table, "task")]
        if table.is_episodes:
            pieces.append("<h3>Evaluation episodes</h3>")
        if reduced := reduced_caption(table):
            pieces.append(f'<p class="reduced">{escape(reduced)}</p>')
        pieces += [_findings(parts), _figures(grid, table, parts)]
        shown = [text for part in parts for text in (_main_table(part), _more_table(part))]
        shown += [] if table.is_episodes else [_runs_table(parts)]
        pieces.append(page.fold("Tables", "".join(shown), opened=opened))
    return "".join(pieces)


def _part(grid: str, table: Table, task: str) -> Part:
    rows = mask(table, table["task"] == task)
    summaries = {metric: summarise(rows, metric) for metric in shown_metrics(table, task)}
    return Part(grid, rows, lead_metrics(table, task), summaries)


def _figures(grid: str, table: Table, parts: Sequence[Part]) -> str:
    tables = (None, table) if table.is_episodes else (table, None)
    leads = {metric for part in parts for metric in part.leads}
    first, more = [], []
    for drawing in drawings(grid, *tables):
        if drawing.metric in leads:
            (more if drawing.statistic == "mean" else first).append(_figure(drawing, parts))
    html = f'<div class="plots">{"".join(first)}</div>'
    if more:
        name = "The same as mean ± standard deviation (paper style)"
        html += page.fold(name, f'<div class="plots">{"".join(more)}</div>', opened=False)
    return html


def _figure(drawing: Drawing, parts: Sequence[Part]) -> str:
    light, dark = (png_bytes(drawing.draw(theme)) for theme in ("light", "dark"))
    measure = parts[0].measure(drawing.metric)
    shown = [
        f"{_place(s)}: {s.label} {interval_text(s.robust)}"
        for part in parts
        for s in part.summaries.get(drawing.metric, [])
    ]
    kind = {"curves": "Learning curves", "bars": "Bars", "ablation": "Ablation"}[drawing.kind]
    unit = f" in {measure.unit}" if measure.unit else ""
    about = f"{kind} of {measure.label}"
    return page.thumbnail(light, dark, f"{about}{unit}. {'; '.join(shown)}.", about)


_FEW_PLACES = 3
"""Combinations of task and shift up to which each has a sentence; more are counted."""


def _findings(parts: Sequence[Part]) -> str:
    """Return the headline of a grid as a list, made of the numbers of its main tables."""
    lines = []
    winners: Counter[str] = Counter()
    for part in parts:
        measure = part.measure(part.main)
        extreme = "lowest" if measure.smaller_is_better else "highest"
        for place, s in best(part.summaries[part.main], measure).items():
            winners[s.label] += 1
            line = f"{place_name(*place)}: {extreme} {measure.label} {interval_text(s.robust)}"
            line += f" ({_over(s.robust, s)}): {s.label}"
            baseline = next((b.label for b in part.summaries[part.main] if b.is_baseline), "")
            if s.ratio and not np.isnan(s.ratio.estimate):
                line += f", {interval_text(s.ratio)} times that of {baseline}"
            lines.append(line)
    if len(lines) > _FEW_PLACES:
        shares = "; ".join(f"{label} in {n}" for label, n in winners.most_common())
        lines = [f"Best of each of {len(lines)} combinations of task and shift: {shares}."]
    items = "".join(f"<li>{escape(line)}</li>" for line in lines)
    return f'<ul class="findings">{items}</ul>' if items else ""


def _main_table(part: Part) -> str:
    rows, facts = part.summaries[part.main], part.table.facts
    measure, episodes = part.measure(part.main), part.table.is_episodes
    compared = any(s.is_baseline for s in rows)
    winners = best(rows, measure)
    header = ["task, shift", "arm", "seeds", *(["episodes"] if episodes else []), "transitions"]
    header += [] if episodes else ["updates", "wall time"]
    header += ["mean [95 %]", *([] if measure.is_rate else ["IQM [95 %]"])]
    header += ["interval over", "each run"]
    header += ["ratio", "P(better)", "command"] if compared else ["command"]
    lines = []
    for s in rows:
        is_best = winners.get((s.task, s.shift)) is s
        label = escape(s.label)
        label += ' <span class="idle">(learns nothing)</span>' if s.is_idle else ""
        cells = [escape(_place(s)), label, str(len(s.seeds))]
        cells += [str(s.samples)] if episodes else []
        cells += [short_count(s.env_steps)]
        cells += [] if episodes else [short_count(s.grad_steps), duration(s.wall_s)]
        cells += [_interval_html(s.mean, best=is_best)]
        cells += [] if measure.is_rate else [_interval_html(s.robust, best=is_best)]
        cells += [_over(s.mean, s), ", ".join(numbers(*s.runs))]
        if compared:
            missing = "baseline" if s.is_baseline else "\N{EN DASH}"
            pair = (s.ratio, s.better)
            cells += [_interval_html(value) if value else missing for value in pair]
        commands = "<br>".join(page.command(c) for c in _commands(part.grid, s))
        lines.append([*cells, f'<div class="commands">{commands}</div>'])
    against = ", ".join(f"{k} {v}" for k, v in facts.baseline.items()) if compared else ""
    caption = f"{facts.label(part.main)}. Bold: best of its task and shift."
    caption += f" Ratio and P(better) against {against}." if against else ""
    return page.table(caption, header, lines, numeric=range(2, len(header) - 1))


def _over(interval: Interval, summary: Summary) -> str:
    """Return what an interval is over, and of how few runs."""
    runs = len(summary.runs)
    if not interval.over:
        return "1 run, no interval" if runs == 1 else f"{runs} runs"
    if interval.over == "episodes":
        return "episodes (1 run)"
    return interval.over.replace("runs", "only " * (runs < FEW_RUNS) + f"{runs} runs", 1)


def _more_table(part: Part) -> str:
    """Return the other metrics, one column each, with their interval."""
    others = [m for m in part.summaries if m != part.main]
    if not others:
        return ""
    cells: dict[tuple[str, str], dict[str, str]] = {}
    for metric in others:
        for s in part.summaries[metric]:
            cells.setdefault((_place(s), s.label), {})[metric] = _interval_html(s.robust)
    lines = [
        [escape(place), escape(label), *(values.get(m, "") for m in others)]
        for (place, label), values in cells.items()
    ]
    header = ["task, shift", "arm", *(part.table.facts.label(m) for m in others)]
    caption = "IQM (mean for shares) with 95 % interval"
    body = page.table(caption, header, lines, numeric=range(2, len(header)))
    return page.fold("Other measures", body, opened=len(lines) <= _SHORT_TABLE)


def _runs_table(parts: Sequence[Part]) -> str:
    lines = []
    for part in parts:
        for (arm, run, seed), rows in groups(part.table, ["arm", "run", "seed"]).items():
            values = rows["metric"] == part.main
            last = int(np.argmax(np.where(values, rows["env_steps"], -1)))
            value = numbers(float(rows["value"][last]))[0] if values.any() else "\N{EN DASH}"
            lines.append(
                [
                    escape(str(run)),
                    str(seed),
                    f"{int(rows['env_steps'].max()):,}",
                    f"{int(rows['grad_steps'].max()):,}",
                    duration(float(rows["wall_s"].max())),
                    f"{escape(part.measure(part.main).label)} {value}",
                    f"<code>{escape(f'{part.grid}/{arm}.csv')}</code>",
                ]
            )
    header = ["run", "seed", "transitions", "updates", "wall time", "last value", "file"]
    body = page.table("Every run with its last main value", header, lines, numeric=range(1, 6))
    return page.fold(f"Single runs ({len(lines)})", body, opened=False)


def _commands(grid: str, summary: Summary) -> tuple[str, ...]:
    """Return the commands the files state, else the one that runs the whole grid."""
    return summary.commands or (f"make sweep GRID={grid}",)


def _place(summary: Summary) -> str:
    return place_name(summary.task, summary.shift)


def _interval_html(interval: Interval, *, best: bool = False) -> str:
    centre, low, high = numbers(interval.estimate, interval.low, interval.high)
    centre = f'<span class="best">{centre}</span>' if best else centre
    if np.isnan(interval.low):
        return centre
    return f'{centre}<span class="bounds">[{low}, {high}]</span>'
