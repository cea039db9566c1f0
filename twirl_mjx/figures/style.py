"""One look for every figure: sizes, two themes, and a colour per place in an order.

Colours are those of Okabe and Ito ("Color universal design", 2008), which stay apart for the common
forms of colour blindness; line style, marker and hatch repeat the same information for print.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from matplotlib import colormaps
from matplotlib.colors import to_hex

from twirl_mjx.checks import choose_one


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
    categories: tuple[str, ...]
    """One colour per place in an order of names, such as variants."""
    sequence: tuple[float, float]
    """Part of the viridis map used for ordered values such as phi."""


THEMES = {
    "light": Theme(
        background="#ffffff",
        text="#1f2328",
        faint="#d4d9df",
        categories=(
            *("#0072b2", "#e69f00", "#009e73", "#d55e00", "#b0558b", "#57606a"),
            "#1f2328",
        ),
        sequence=(0.0, 0.82),
    ),
    "dark": Theme(
        background="#161b22",
        text="#e6edf3",
        faint="#39424e",
        categories=(
            *("#56b4e9", "#f0b429", "#2fc79b", "#ff8a4c", "#e39ac8", "#b1bac4"),
            "#e6edf3",
        ),
        sequence=(0.3, 1.0),
    ),
}
"""Theme name -> colours."""

_DASHES, _DOTS = (0, (6, 1.5)), (0, (1, 1))
_LINES: tuple[Any, ...] = ("-", _DASHES, (0, (4, 1.2, 1, 1.2)), _DOTS, "-", _DOTS, _DASHES)
_MARKERS = ("o", "s", "^", "D", "v", "P", "X")
_HATCHES = ("", "///", "...", "\\\\\\", "xxx", "|||", "---")


def theme_of(name: str) -> Theme:
    """Return a theme by name.

    Raises:
        ValueError: If there is no such theme.
    """
    if name not in THEMES:
        raise ValueError(f"no theme '{name}': {choose_one(name, THEMES)}")
    return THEMES[name]


def category_mark(index: int, theme: Theme) -> Mark:
    """Return the look of the ``index``-th of some names; there are seven, then they repeat."""
    i = index % len(theme.categories)
    return Mark(theme.categories[i], _LINES[i], _MARKERS[i], _HATCHES[i])


def ordered_mark(index: int, count: int, theme: Theme) -> Mark:
    """Return the look of the ``index``-th of ``count`` ordered values (dark to bright)."""
    low, high = theme.sequence
    share = low + (high - low) * index / max(count - 1, 1)
    colour = to_hex(colormaps["viridis"](share))
    i = index % len(_MARKERS)
    return Mark(colour, _LINES[i], _MARKERS[i], _HATCHES[i])


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
        "text.parse_math": False,  # names come from tables: a dollar is a dollar
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
