"""One look for every figure: sizes, two themes, and a fixed colour per variant.

Colours are those of Okabe and Ito ("Color universal design", 2008), which stay apart for the common
forms of colour blindness; line style, marker and hatch repeat the same information for print.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

from matplotlib import colormaps
from matplotlib.colors import to_hex

from twirl_mjx.checks import choose_one

TASKS = ("stand", "biped", "imitate", "hurdles")
"""Tasks in the order of figures and tables."""
SHIFTS = ("none", "bumpy", "icy", "weakened", "sloped", "gravity")
"""Dynamics shifts in the order of figures and tables."""
VARIANTS = ("twirl", "twirl+weights", "weights", "zero-shot", "scratch", "source")
"""Variants in the order of figures and tables."""


@dataclass(frozen=True)
class Metric:
    """How a metric is written in figures and tables."""

    label: str
    """Name for people, lower case."""
    unit: str = ""
    """Unit; empty for counts, shares and returns."""
    higher_is_better: bool = True
    """Direction of improvement."""
    is_headline: bool = False
    """Whether it has figures of its own; the others are in tables only."""
    is_rate: bool = False
    """Whether an episode has 0 or 1, so that quartiles mean nothing and the mean is shown."""


METRICS = {
    "return": Metric("return", is_headline=True),
    "success": Metric("success rate", is_headline=True, is_rate=True),
    "standing_time": Metric("standing time", "s", is_headline=True),
    "min_distance": Metric("minimum distance to goal", "m", False, is_headline=True),
    "leaps": Metric("leap cycles", is_headline=True),
    "tracking": Metric("share of the highest tracking reward"),
    "hurdles_passed": Metric("hurdles passed", is_headline=True),
    "clean_clearances": Metric("hurdles cleared in one flight", is_headline=True),
    "hit_hurdle": Metric("hurdle hits per episode", "", False, is_rate=True),
    "fall": Metric("falls per episode", "", False, is_rate=True),
    "terminated": Metric("early ends per episode", "", False, is_rate=True),
    "terminated_share": Metric("share of episodes ended early", "", False),
    "forward_speed": Metric("forward speed", "m/s"),
    "episode_length": Metric("episode length", "control steps"),
}
"""Metrics with a written name; any other metric is shown under its own name."""

EVALUATION = "eval/"
"""Prefix of a metric measured during training, but with the deterministic policy on own seeds."""

MAIN_METRICS = (f"{EVALUATION}return", "return")
"""What a grid is judged by: the first of these that all of its runs report."""


@dataclass(frozen=True)
class Mark:
    """How one line or bar is drawn."""

    colour: str
    """Hexadecimal colour."""
    line: Any
    """Matplotlib line style."""
    marker: str
    """Matplotlib marker."""
    hatch: str
    """Matplotlib hatch."""


@dataclass(frozen=True)
class Theme:
    """Colours of one background."""

    background: str
    """Figure and page background."""
    text: str
    """Text, ticks and error bars."""
    faint: str
    """Grid and spines."""
    variants: tuple[str, ...]
    """One colour per entry of ``VARIANTS``."""
    sequence: tuple[float, float]
    """Part of the viridis map used for ordered values such as phi."""


THEMES = {
    "light": Theme(
        background="#ffffff",
        text="#1f2328",
        faint="#d4d9df",
        variants=("#0072b2", "#e69f00", "#009e73", "#d55e00", "#b0558b", "#57606a"),
        sequence=(0.0, 0.82),
    ),
    "dark": Theme(
        background="#161b22",
        text="#e6edf3",
        faint="#39424e",
        variants=("#56b4e9", "#f0b429", "#2fc79b", "#ff8a4c", "#e39ac8", "#b1bac4"),
        sequence=(0.3, 1.0),
    ),
}
"""Theme name -> colours."""

_LINES: tuple[Any, ...] = ("-", (0, (6, 1.5)), (0, (4, 1.2, 1, 1.2)), (0, (1, 1)), "-", (0, (1, 1)))
_MARKERS = ("o", "s", "^", "D", "v", "P")
_HATCHES = ("", "///", "...", "\\\\\\", "xxx", "|||")


def theme_of(name: str) -> Theme:
    """Return a theme by name.

    Raises:
        ValueError: If there is no such theme.
    """
    if name not in THEMES:
        raise ValueError(f"no theme '{name}': {choose_one(name, THEMES)}")
    return THEMES[name]


def variant_mark(variant: str, theme: Theme) -> Mark:
    """Return the fixed look of a variant.

    Raises:
        ValueError: If the variant has none.
    """
    if variant not in VARIANTS:
        raise ValueError(f"no colour for variant '{variant}': {choose_one(variant, VARIANTS)}")
    i = VARIANTS.index(variant)
    return Mark(theme.variants[i], _LINES[i], _MARKERS[i], _HATCHES[i])


def ordered_mark(index: int, count: int, theme: Theme) -> Mark:
    """Return the look of the ``index``-th of ``count`` ordered values (dark to bright)."""
    low, high = theme.sequence
    share = low + (high - low) * index / max(count - 1, 1)
    colour = to_hex(colormaps["viridis"](share))
    i = index % len(_MARKERS)
    return Mark(colour, _LINES[i], _MARKERS[i], _HATCHES[i])


def metric_info(name: str) -> Metric:
    """Return how a metric is written; an unlisted one is written as it is called."""
    if name.startswith(EVALUATION):
        plain = metric_info(name.removeprefix(EVALUATION))
        return replace(plain, label=f"evaluation {plain.label}")
    return METRICS.get(name, Metric(name.replace("_", " ")))


def metric_label(name: str) -> str:
    """Return the axis label of a metric, with its unit."""
    metric = metric_info(name)
    text = metric.label[:1].upper() + metric.label[1:]
    return f"{text} [{metric.unit}]" if metric.unit else text


def canonical(values: Iterable, order: tuple[str, ...] = ()) -> list:
    """Sort values: those of ``order`` first, as listed there, then the rest by value."""
    distinct = set(values)
    known = [value for value in order if value in distinct]
    return known + sorted(distinct - set(order))


def short_count(value: float) -> str:
    """Write a count in at most a few characters: 950, 20k, 1.5M."""
    for factor, suffix in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if abs(value) >= factor:
            return f"{value / factor:.3g}{suffix}"
    return f"{value:.3g}"


def rc_params(theme: Theme) -> dict[str, Any]:
    """Return the matplotlib settings of a theme, to be put on top of the defaults."""
    return {
        "font.family": "DejaVu Sans",
        "font.size": 8.5,
        "axes.titlesize": 9.5,
        "axes.titleweight": "bold",
        "axes.titlelocation": "left",
        "axes.labelsize": 8.5,
        "axes.facecolor": theme.background,
        "axes.edgecolor": theme.text,
        "axes.labelcolor": theme.text,
        "axes.titlecolor": theme.text,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.linewidth": 0.7,
        "axes.grid": True,
        "axes.grid.axis": "y",
        "axes.axisbelow": True,
        "grid.color": theme.faint,
        "grid.linewidth": 0.6,
        "xtick.color": theme.text,
        "ytick.color": theme.text,
        "xtick.labelsize": 8,
        "ytick.labelsize": 8,
        "xtick.major.width": 0.7,
        "ytick.major.width": 0.7,
        "text.color": theme.text,
        "text.parse_math": False,  # names in tables are shown as they are
        "figure.facecolor": theme.background,
        "figure.dpi": 100,
        "savefig.facecolor": theme.background,
        "savefig.dpi": 170,
        "legend.frameon": False,
        "legend.fontsize": 8.5,
        "legend.handlelength": 2.4,
        "lines.linewidth": 1.8,
        "lines.markersize": 4.5,
        "hatch.linewidth": 0.6,
        "svg.hashsalt": "twirl_mjx",
        "svg.fonttype": "path",
    }
