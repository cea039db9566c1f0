"""The frame around every figure: title, legend, caption, and files that never differ by a byte."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import matplotlib.style
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator
from PIL import Image
from PIL.Image import Dither, Quantize

from twirl_mjx import files
from twirl_mjx.figures.style import Theme, rc_params, short_count, theme_of
from twirl_mjx.figures.tables import Table, note_texts

_TITLE, _LEGEND_ROW, _CAPTION_LINE, _PAD = 0.27, 0.21, 0.15, 0.06  # inches
_CHARACTERS_PER_INCH = 17.5  # of a caption
_LEGEND_CHARACTERS_PER_INCH = 13.0


@dataclass
class Canvas:
    """A figure in the making."""

    figure: Figure
    """The figure."""
    axes: np.ndarray
    """Its panels, [rows, columns] of Axes."""
    theme: Theme
    """Its colours."""
    captions: list[str] = field(default_factory=list)
    """Sentences below the panels."""
    legend: dict[str, Artist] = field(default_factory=dict)
    """Label -> handle of the common legend."""


@contextmanager
def canvas(
    title: str, table: Table, theme: str, shape: tuple[int, int], size: tuple[float, float]
) -> Iterator[Canvas]:
    """Open a figure in our style; title, legend and caption are added on leaving.

    A table that calls itself reduced puts that into the caption.

    Args:
        title: Heading of the figure.
        table: What is drawn; its notes are shown.
        theme: Name of a theme.
        shape: Rows and columns of panels.
        size: Width of the figure and height of one row of panels, inches.
    """
    colours = theme_of(theme)
    with matplotlib.style.context(["default", rc_params(colours)]):
        figure = Figure(figsize=(size[0], size[1] * shape[0]), layout="constrained")
        frame = Canvas(figure, figure.subplots(*shape, squeeze=False), colours)
        yield frame
        _decorate(frame, title, reduced_caption(table), size[1] * shape[0])


def reduced_caption(table: Table) -> str:
    """Return "Reduced: ..." if the table says so, else an empty string."""
    texts = note_texts(table, "reduced")
    if not texts:
        return ""
    return "Reduced: " + ("; ".join(text for text in texts if text) or "not the paper's budget")


def steps_axis(axes: Axes, *, ticks: int = 5, label: bool = True) -> None:
    """Format the horizontal axis as transitions."""
    axes.xaxis.set_major_locator(MaxNLocator(nbins=ticks, min_n_ticks=2))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: short_count(value)))
    if label:
        axes.set_xlabel("transitions")


def png_bytes(figure: Figure) -> bytes:
    """Return a figure as PNG of 256 colours (a third of the size); the same each time."""
    with Image.open(io.BytesIO(_encode(figure, "png", {"Software": None}))) as picture:
        small = picture.convert("RGB").quantize(256, Quantize.MEDIANCUT, dither=Dither.NONE)
    buffer = io.BytesIO()
    small.save(buffer, format="png")
    return buffer.getvalue()


def svg_bytes(figure: Figure) -> bytes:
    """Return a figure as SVG with outlined text; the same figure gives the same bytes."""
    return _encode(figure, "svg", {"Date": None, "Creator": None})


def write_png(figure: Figure, path: Path) -> Path:
    """Write a figure as PNG, making the directory, and return the path."""
    files.write_bytes(path, png_bytes(figure))
    return path


def _encode(figure: Figure, kind: str, metadata: dict) -> bytes:
    colours = theme_of("light")  # the artists carry their colours; this fixes dpi, hash and hatch
    with matplotlib.style.context(["default", rc_params(colours)]):
        buffer = io.BytesIO()
        figure.savefig(buffer, format=kind, metadata=metadata, facecolor=figure.get_facecolor())
    return buffer.getvalue()


def _decorate(frame: Canvas, title: str, reduced: str, panels_height: float) -> None:
    figure = frame.figure
    width = figure.get_figwidth()
    columns = _legend_columns(list(frame.legend), width)
    legend_rows = -(-len(frame.legend) // columns) if frame.legend else 0
    lines = textwrap.wrap(" ".join(frame.captions), int(width * _CHARACTERS_PER_INCH))
    warnings = textwrap.wrap(reduced, int(width * _CHARACTERS_PER_INCH * 0.94))
    top = _TITLE + _LEGEND_ROW * legend_rows + _PAD
    bottom = _CAPTION_LINE * (len(lines) + len(warnings)) + _PAD
    height = panels_height + top + bottom
    figure.set_figheight(height)
    engine = figure.get_layout_engine()
    assert engine is not None
    engine.set(rect=(0, bottom / height, 1, 1 - (top + bottom) / height), h_pad=0.07)  # pyright: ignore[reportAttributeAccessIssue, reportCallIssue]
    left = 0.09 / width
    figure.text(left, 1 - 0.06 / height, title, va="top", fontsize=11, fontweight="bold")
    if frame.legend:
        figure.legend(
            list(frame.legend.values()),
            list(frame.legend),
            loc="upper left",
            bbox_to_anchor=(left, 1 - _TITLE / height),
            ncols=columns,
            borderaxespad=0,
            borderpad=0.1,
            columnspacing=1.6,
        )
    y = (_CAPTION_LINE * (len(lines) + len(warnings)) + _PAD / 2) / height
    for text, weight in [*((w, "bold") for w in warnings), *((line, "normal") for line in lines)]:
        figure.text(left, y, text, va="top", fontsize=7.5, fontweight=weight)
        y -= _CAPTION_LINE / height


def _legend_columns(labels: Sequence[str], width: float) -> int:
    if not labels:
        return 1
    widest = max(len(label) for label in labels) / _LEGEND_CHARACTERS_PER_INCH + 0.55
    return max(1, min(len(labels), int(width / widest)))
