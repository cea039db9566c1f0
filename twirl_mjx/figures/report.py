"""One HTML page with every table, figure and clip, made from result files only."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

import numpy as np

from twirl_mjx import files
from twirl_mjx.figures import page
from twirl_mjx.figures.aggregate import groups
from twirl_mjx.figures.canvas import png_bytes, reduced_caption
from twirl_mjx.figures.page import Media
from twirl_mjx.figures.plots import GRIDS, Drawing, drawings, read_grids
from twirl_mjx.figures.statistics import Interval
from twirl_mjx.figures.style import metric_info, metric_label, short_count
from twirl_mjx.figures.summary import (
    Summary,
    baseline_of,
    grid_kind,
    main_metric,
    shift_wins,
    shown_metrics,
    summarise,
)
from twirl_mjx.figures.tables import Table, TableError

__all__ = ["Media", "write_report"]

_ABOUT = {
    "tasks": "Learning a task from scratch, with TWiRL, and the source policy it starts from.",
    "shifts": "Adapting a finished policy to changed dynamics.",
    "phi": "The share of every minibatch that comes from the source.",
    "utd": "Critic updates per transition.",
}

_SHORT_TABLE = 12  # rows; a longer table of details is folded

_TERMS = """<dl>
<dt>IQM [95 %]</dt><dd>Interquartile mean over seeds (or episodes): the mean without the lowest and
highest quarter; the plain mean below four samples, and for rates such as success. In brackets the
percentile interval of a stratified bootstrap with 2000 resamples and a fixed seed. A single
sample has no interval.</dd>
<dt>mean ± std</dt><dd>Mean and standard deviation (n - 1), as in the paper.</dd>
<dt>ratio</dt><dd>IQM over the IQM of the baseline of the same task and shift, with a bootstrap
interval. Compare ratios with the paper, not returns: its text does not fix their scale.</dd>
<dt>P(better)</dt><dd>Probability that a random run of this row is better than a random run of the
baseline, ties counted half.</dd>
<dt>transitions</dt><dd>Control steps summed over all worlds. Variants are compared at the
transitions that every trained run of the same task and shift has reached.</dd>
<dt>updates, wall time</dt><dd>Critic updates and time by then, of the run with the most.</dd>
</dl>"""


@dataclass(frozen=True)
class Part:
    """One table of a grid, ready to be shown."""

    grid: str
    """Name of the grid."""
    table: Table
    """Curve or episode rows."""
    main: str
    """Main metric."""
    summaries: dict[str, list[Summary]]
    """Metric -> one summary per cell."""


def write_report(
    results_dir: str | Path,
    output_path: str | Path,
    media: Sequence[Media | str | Path] = (),
    *,
    title: str = "twirl_mjx results",
    say: Callable[[str], None] = print,
) -> Path:
    """Write one self-contained page: findings, tables, curves and clips, no outside resources.

    Args:
        results_dir: ``experiments/results``, with ``<grid>/<arm>.csv`` below it.
        output_path: The HTML file, replaced if it exists.
        media: Clips and pictures in the order of the page.
        title: Heading of the page.
        say: Called with one line per grid without data.

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
    sections = [
        (grid, f"Grid: {grid}", _grid_html(grid, *tables)) for grid, tables in grids.items()
    ]
    if clips:
        shown = "".join(page.clip(m) for m in clips)
        sections.insert(0, ("clips", "Clips", f'<div class="clips">{shown}</div>'))
    sections.append(("terms", "How to read the numbers", _TERMS))
    links = "".join(f'<li><a href="#{escape(k)}">{escape(t)}</a></li>' for k, t, _ in sections)
    body = "".join(
        f'<section id="{escape(key)}" aria-labelledby="{escape(key)}-title">'
        f'<h2 id="{escape(key)}-title">{escape(name)}</h2>{html}</section>'
        for key, name, html in sections
    )
    missing = [g for g in GRIDS if g not in {grid_kind(name) for name in grids}]
    html = page.document(
        title,
        f'<header><h1>{escape(title)}</h1><p class="lead">{_lead(grids, missing)}</p>'
        f'<nav aria-label="Contents"><ul>{links}</ul></nav></header><main id="main">{body}</main>'
        f"<footer><p>Made from tidy CSV files by {page.command('make report')}; the figures alone: "
        f"{page.command('make figures')}.</p></footer>",
    )
    path = Path(output_path)
    files.write_text(path, html)
    return path


def _lead(grids: dict, missing: Sequence[str]) -> str:
    tables = [table for pair in grids.values() for table in pair if table is not None]
    runs = sum(len(groups(table, ["arm", "run", "seed"])) for table in tables)
    text = f"{len(grids)} grid{'s' * (len(grids) != 1)}, {runs} run{'s' * (runs != 1)}."
    if missing:
        text += f" No data yet for: {', '.join(missing)}."
    if any(reduced_caption(table) for table in tables):
        text += " Some results come from reduced budgets; each says so where it is shown."
    return escape(text)


def _grid_html(grid: str, curves: Table | None, episodes: Table | None) -> str:
    pieces = [f"<p>{escape(_ABOUT.get(grid_kind(grid), ''))}</p>"]
    for table in (curves, episodes):
        if table is None:
            continue
        main = main_metric(table)
        baseline = baseline_of(grid)
        summaries = {m: summarise(table, m, baseline) for m in shown_metrics(table, main)}
        part = Part(grid, table, main, summaries)
        if table.is_episodes:
            pieces.append("<h3>Evaluation episodes</h3>")
        if reduced := reduced_caption(table):
            pieces.append(f'<p class="reduced">{escape(reduced)}</p>')
        pieces += [_findings(part), _figures(part), _main_table(part), _more_table(part)]
        if not table.is_episodes:
            pieces.append(_runs_table(part))
    return "".join(pieces)


def _figures(part: Part) -> str:
    tables = (None, part.table) if part.table.is_episodes else (part.table, None)
    first, more = [], []
    for drawing in drawings(part.grid, *tables):
        (more if drawing.statistic == "mean" else first).append(_figure(drawing, part))
    html = "".join(first)
    if more:
        html += "<details><summary>The same as mean ± standard deviation (paper style)</summary>"
        html += "".join(more) + "</details>"
    return html


def _figure(drawing: Drawing, part: Part) -> str:
    light, dark = (png_bytes(drawing.draw(theme)) for theme in ("light", "dark"))
    info = metric_info(drawing.metric)
    parts = [
        f"{_place(s)}: {s.label} {interval_text(s.robust)}" for s in part.summaries[drawing.metric]
    ]
    kind = {"curves": "Learning curves", "bars": "Bars", "ablation": "Ablation"}[drawing.kind]
    unit = f" in {info.unit}" if info.unit else ""
    return page.picture(light, dark, f"{kind} of {info.label}{unit}. {'; '.join(parts)}.")


def _findings(part: Part) -> str:
    """Return the headline of a grid as a list, made of the numbers of its main table."""
    kind, rows = grid_kind(part.grid), part.summaries[part.main]
    name = metric_info(part.main).label
    lines = []
    if kind == "tasks":
        lines = [
            f"{_place(s)}: TWiRL has {interval_text(s.ratio)} times the {name} of scratch"
            for s in rows
            if s.variant == "twirl" and s.ratio and not np.isnan(s.ratio.estimate)
        ]
    elif kind == "shifts":
        won, compared = shift_wins(rows)
        if compared:
            lines = [
                f"The better TWiRL variant has a higher {name} than both weights and zero-shot in "
                f"{won} of {compared} combinations of task and shift."
            ]
    elif kind in ("phi", "utd"):
        for place in dict.fromkeys(_place(s) for s in rows):
            best = max((s for s in rows if _place(s) == place), key=lambda s: s.robust.estimate)
            value = f"{best.settings.get(kind, float('nan')):g}"
            lines.append(
                f"{place}: highest {name} at {kind} = {value}: {interval_text(best.robust)}"
            )
    items = "".join(f"<li>{escape(line)}</li>" for line in lines)
    return f'<ul class="findings">{items}</ul>' if items else ""


def _main_table(part: Part) -> str:
    rows, baseline = part.summaries[part.main], baseline_of(part.grid)
    info, episodes = metric_info(part.main), part.table.is_episodes
    header = ["task, shift", "variant", "seeds", *(["episodes"] if episodes else []), "transitions"]
    header += [] if episodes else ["updates", "wall time"]
    header += ["mean ± std", "mean [95 %]" if info.is_rate else "IQM [95 %]"]
    header += ["ratio", "P(better)", "command"] if baseline else ["command"]
    lines = []
    for s in rows:
        best = _is_best(s, rows, higher=info.higher_is_better)
        cells = [escape(_place(s)), escape(s.label), str(len(s.seeds))]
        cells += [str(s.samples)] if episodes else []
        cells += [short_count(s.env_steps)]
        cells += [] if episodes else [short_count(s.grad_steps), duration(s.wall_s)]
        cells += [" ± ".join(numbers(s.mean, s.std)), _interval_html(s.robust, best=best)]
        if baseline:
            missing = "baseline" if s.matches(baseline) else "\N{EN DASH}"
            pair = (s.ratio, s.better)
            cells += [_interval_html(value) if value else missing for value in pair]
        commands = "<br>".join(page.command(c) for c in _commands(part.grid, s))
        lines.append([*cells, f'<div class="commands">{commands}</div>'])
    against = ", ".join(
        f"{k} {v:g}" if isinstance(v, float) else f"{k} {v}" for k, v in baseline.items()
    )
    caption = f"{metric_label(part.main)}. Bold: best of its task and shift."
    caption += f" Ratio and P(better) against {against}." if against else ""
    return page.table(caption, header, lines, numeric=range(2, len(header) - 1))


def _more_table(part: Part) -> str:
    """Return the other metrics with a written name, one column each."""
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
    header = ["task, shift", "variant", *(metric_label(m) for m in others)]
    body = page.table(
        "IQM (mean for rates) with 95 % interval", header, lines, numeric=range(2, len(header))
    )
    opened = " open" if len(lines) <= _SHORT_TABLE else ""
    return f"<details{opened}><summary>Other metrics</summary>{body}</details>"


def _runs_table(part: Part) -> str:
    lines = []
    for (arm, run, seed), rows in groups(part.table, ["arm", "run", "seed"]).items():
        values = rows["metric"] == part.main
        last = int(np.argmax(np.where(values, rows["env_steps"], -1)))
        lines.append(
            [
                escape(str(run)),
                str(seed),
                f"{int(rows['env_steps'].max()):,}",
                f"{int(rows['grad_steps'].max()):,}",
                duration(float(rows["wall_s"].max())),
                numbers(float(rows["value"][last]))[0],
                f"<code>{escape(f'{part.grid}/{arm}.csv')}</code>",
            ]
        )
    header = ["run", "seed", "transitions", "updates", "wall time", "last value", "file"]
    body = page.table(
        f"Every run with its last {metric_info(part.main).label}",
        header,
        lines,
        numeric=range(1, 6),
    )
    return f"<details><summary>Single runs ({len(lines)})</summary>{body}</details>"


def _commands(grid: str, summary: Summary) -> tuple[str, ...]:
    """Return the commands the files state, else the one that runs the whole grid."""
    return summary.commands or (f"make sweep GRID={grid}",)


def _is_best(summary: Summary, rows: Sequence[Summary], *, higher: bool) -> bool:
    sign = 1 if higher else -1
    rivals = [s.robust.estimate * sign for s in rows if _place(s) == _place(summary)]
    return len(rivals) > 1 and summary.robust.estimate * sign == max(rivals)


def _place(summary: Summary) -> str:
    return summary.task if summary.shift == "none" else f"{summary.task}, {summary.shift}"


def interval_text(interval: Interval) -> str:
    """Write an interval as "2.9 [2.5, 3.4]", or without brackets where there are no bounds."""
    centre, low, high = numbers(interval.estimate, interval.low, interval.high)
    return centre if np.isnan(interval.low) else f"{centre} [{low}, {high}]"


def numbers(*values: float) -> list[str]:
    """Write numbers with the digits that suit the largest; NaN is a dash."""
    size = max((abs(value) for value in values if not np.isnan(value)), default=0.0)
    digits = 0 if size >= 100 else 1 if size >= 10 else 2
    return ["\N{EN DASH}" if np.isnan(value) else f"{value:,.{digits}f}" for value in values]


def duration(seconds: float) -> str:
    """Write a duration as "2 h 05 min", "17 min" or "42 s"; NaN is a dash."""
    if np.isnan(seconds):
        return "\N{EN DASH}"
    if seconds < 60:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes // 60} h {minutes % 60:02d} min" if minutes >= 60 else f"{minutes} min"


def _interval_html(interval: Interval, *, best: bool = False) -> str:
    centre, low, high = numbers(interval.estimate, interval.low, interval.high)
    centre = f'<span class="best">{centre}</span>' if best else centre
    if np.isnan(interval.low):
        return centre
    return f'{centre}<span class="bounds">[{low}, {high}]</span>'
