"""The frame around every figure: title, legend, caption, and files that never differ by a byte."""

from __future__ import annotations

import functools
import io
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import matplotlib.style
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import RendererAgg
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.ticker import FuncFormatter, MaxNLocator
from PIL import Image
from PIL.Image import Dither, Quantize
from PIL.PngImagePlugin import PngInfo

from twirl_mjx import files
from twirl_mjx.figures.style import Theme, rc_params, short_count, theme_of
from twirl_mjx.figures.tables import Table, note_texts

_TITLE, _LEGEND_ROW, _CAPTION_LINE, _PAD = 0.27, 0.21, 0.15, 0.06  # inches
_TITLE_SIZE, _CAPTION_SIZE, _LEGEND_SIZE, _PANEL_SIZE, _LABEL_SIZE = 11, 7.5, 8.5, 9.5, 8.5  # pt
_HANDLE = 0.62  # inches beside a legend's label: its handle, and the gap to the next


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

    def title(self, axes: Axes, text: str) -> None:
        """Set the title of a panel, in as many lines as its width needs."""
        axes.set_title("\n".join(wrapped(text, self._panel_width(axes), _PANEL_SIZE, "bold")))

    def ylabel(self, axes: Axes, text: str) -> None:
        """Set the label of a vertical axis, in as many lines as its height needs."""
        room = self.figure.get_figheight() / self.axes.shape[0] - 0.5
        axes.set_ylabel("\n".join(wrapped(text, room, _LABEL_SIZE)))

    def xticks(self, axes: Axes, names: list[str]) -> None:
        """Name places 0, 1, ... of a horizontal axis, in as many lines as their room needs."""
        room = self._panel_width(axes) / max(len(names), 1) - 0.1
        lines = ["\n".join(wrapped(name, room, _LABEL_SIZE)) for name in names]
        axes.set_xticks(range(len(names)), lines)
        axes.set_xlim(-0.5, len(names) - 0.5)

    def _panel_width(self, axes: Axes) -> float:
        """Return the width of a panel whose vertical label is set, inches."""
        lines = axes.get_ylabel().count("\n")
        return self.figure.get_figwidth() / self.axes.shape[1] - 0.65 - 0.15 * lines


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


@functools.cache
def text_width(text: str, size: float, weight: str = "normal") -> float:
    """Return the width of one line of text, inches."""
    font = FontProperties(family="DejaVu Sans", size=size, weight=weight)
    renderer = RendererAgg(1, 1, 72)
    return renderer.get_text_width_height_descent(text, font, ismath=False)[0] / 72


def wrapped(text: str, room: float, size: float, weight: str = "normal") -> list[str]:
    """Break text into lines no wider than ``room`` inches; a longer word is cut, never clipped."""
    lines = [""]
    for word in text.split():
        joined = f"{lines[-1]} {word}".strip()
        if text_width(joined, size, weight) <= room:
            lines[-1] = joined
            continue
        lines += [""] if lines[-1] else []
        for letter in word:
            if lines[-1] and text_width(lines[-1] + letter, size, weight) > room:
                lines.append("")
            lines[-1] += letter
    return lines if text.strip() else []


def steps_axis(axes: Axes, *, ticks: int = 5, label: bool = True) -> None:
    """Format the horizontal axis as transitions."""
    axes.xaxis.set_major_locator(MaxNLocator(nbins=ticks, min_n_ticks=2))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: short_count(value)))
    if label:
        axes.set_xlabel("transitions")


def png_bytes(figure: Figure) -> bytes:
    """Return a figure as PNG of 256 colours (a third of the size); the same each time."""
    with Image.open(io.BytesIO(_encode(figure))) as picture:
        small = picture.convert("RGB").quantize(256, Quantize.MEDIANCUT, dither=Dither.NONE)
    buffer = io.BytesIO()
    about = PngInfo()
    about.add_text("Software", files.MARK)
    small.save(buffer, format="png", pnginfo=about)
    return buffer.getvalue()


def write_png(figure: Figure, path: Path) -> Path:
    """Write a figure as PNG, making the directory, and return the path."""
    files.write_bytes(path, png_bytes(figure))
    return path


def _encode(figure: Figure) -> bytes:
    colours = theme_of("light")  # the artists carry their colours; this fixes dpi, hash and hatch
    with matplotlib.style.context(["default", rc_params(colours)]):
        buffer = io.BytesIO()
        figure.savefig(
            buffer, format="png", metadata={"Software": None}, facecolor=figure.get_facecolor()
        )
    return buffer.getvalue()


def _decorate(frame: Canvas, title: str, reduced: str, panels_height: float) -> None:
    figure = frame.figure
    width = figure.get_figwidth()
    left = 0.09 / width
    room = width - 0.18
    heading = wrapped(title, room, _TITLE_SIZE, "bold")
    labels = [wrapped(label, room - _HANDLE, _LEGEND_SIZE) for label in frame.legend]
    columns, legend_rows = _legend_shape(labels, room)
    below = [(line, "bold") for line in wrapped(reduced, room, _CAPTION_SIZE, "bold")]
    below += [(line, "normal") for line in wrapped(" ".join(frame.captions), room, _CAPTION_SIZE)]
    heading_height = _TITLE * len(heading)
    top = heading_height + _LEGEND_ROW * legend_rows + _PAD
    bottom = _CAPTION_LINE * len(below) + _PAD
    height = panels_height + top + bottom
    figure.set_figheight(height)
    engine = figure.get_layout_engine()
    assert engine is not None
    engine.set(rect=(0, bottom / height, 1, 1 - (top + bottom) / height), h_pad=0.07)  # pyright: ignore[reportAttributeAccessIssue, reportCallIssue]
    figure.text(
        left, 1 - 0.06 / height, "\n".join(heading), va="top", fontsize=_TITLE_SIZE,
        fontweight="bold",
    )  # fmt: skip
    if frame.legend:
        figure.legend(
            list(frame.legend.values()),
            ["\n".join(lines) for lines in labels],
            loc="upper left",
            bbox_to_anchor=(left, 1 - heading_height / height),
            ncols=columns,
            borderaxespad=0,
            borderpad=0.1,
            columnspacing=1.6,
        )
    y = (_CAPTION_LINE * len(below) + _PAD / 2) / height
    for text, weight in below:
        figure.text(left, y, text, va="top", fontsize=_CAPTION_SIZE, fontweight=weight)
        y -= _CAPTION_LINE / height


def _legend_shape(labels: list[list[str]], room: float) -> tuple[int, int]:
    """Return the columns that fit beside each other, and the rows of text they then take."""
    if not labels:
        return 1, 0
    widths = [text_width(line, _LEGEND_SIZE) for lines in labels for line in lines]
    columns = max(1, min(len(labels), int(room / (max(widths) + _HANDLE))))
    tallest = max(len(lines) for lines in labels)
    return columns, -(-len(labels) // columns) * tallest
