"""Pieces of a self-contained HTML page: every picture, clip and style is inside the file.

The page carries a content security policy that forbids any request, and no script, so it opens
offline and from an untrusted sender alike. It follows the reader's light or dark setting.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

from twirl_mjx import files
from twirl_mjx.checks import choose_one

_VIDEO = {".mp4": "video/mp4", ".webm": "video/webm"}
_IMAGE = {".png": "image/png", ".jpg": "image/jpeg", ".jpeg": "image/jpeg", ".gif": "image/gif"}
_IMAGE |= {".webp": "image/webp"}
_SIGNATURES = {
    "video/mp4": (4, b"ftyp"),
    "video/webm": (0, b"\x1a\x45\xdf\xa3"),
    "image/png": (0, b"\x89PNG\r\n\x1a\n"),
    "image/jpeg": (0, b"\xff\xd8\xff"),
    "image/gif": (0, b"GIF8"),
    "image/webp": (8, b"WEBP"),
}

MEDIA_LIMIT = 256 << 20
"""Bytes, largest clip that is put into a page: browsers refuse longer addresses."""


class MediaError(ValueError):
    """A clip cannot be put into the page; the message names the file and what is allowed."""


@dataclass(frozen=True)
class Media:
    """A clip or picture of the page."""

    path: Path
    """The file: mp4, webm, png, jpg, gif or webp."""
    title: str = ""
    """Caption; by default made from the file name."""
    description: str = ""
    """What a reader who cannot see it should know; by default the caption."""
    command: str = ""
    """Command that makes the file again."""

    @property
    def caption(self) -> str:
        """The title, or the file name in words."""
        return self.title or self.path.stem.replace("_", " ").replace("-", " ")


def data_uri(content: bytes, kind: str) -> str:
    """Return bytes as a ``data:`` address of a MIME type."""
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"


def document(title: str, body: str) -> str:
    """Return a whole page around a body."""
    policy = "default-src 'none'; img-src data:; media-src data:; style-src 'unsafe-inline'"
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<meta name="generator" content="{files.MARK}">
<meta http-equiv="Content-Security-Policy" content="{policy}">
<title>{escape(title)}</title>
<link rel="icon" href="data:,">
<style>{STYLE}</style>
</head>
<body>
<a class="skip" href="#main">Skip to the results</a>
{body}
</body>
</html>
"""


def table(
    caption: str, header: Sequence[str], rows: Sequence[Sequence[str]], *, numeric: Sequence[int]
) -> str:
    """Return an accessible table that scrolls sideways on a narrow screen.

    Args:
        caption: What the table shows (plain text).
        header: Column names (plain text).
        rows: Cells as HTML; the first of a row is its header.
        numeric: Positions of the columns that are aligned to the right.
    """
    head = "".join(
        f'<th scope="col"{_class(i, numeric)}>{escape(name)}</th>' for i, name in enumerate(header)
    )
    lines = []
    for row in rows:
        cells = [f'<th scope="row">{row[0]}</th>']
        cells += [f"<td{_class(i, numeric)}>{c}</td>" for i, c in enumerate(row[1:], start=1)]
        lines.append(f"<tr>{''.join(cells)}</tr>")
    return (
        f'<div class="scroll" role="region" tabindex="0" aria-label="{escape(caption)}"><table>'
        f"<caption>{escape(caption)}</caption><thead><tr>{head}</tr></thead>"
        f"<tbody>{''.join(lines)}</tbody></table></div>"
    )


def thumbnail(light: bytes, dark: bytes, alt: str, caption: str) -> str:
    """Return a figure shown small, which fills the window while it is open; needs no script.

    Args:
        light: PNG for a light page.
        dark: PNG for a dark page.
        alt: What the picture shows, in words and numbers.
        caption: Visible caption.
    """
    night, day = data_uri(dark, "image/png"), data_uri(light, "image/png")
    return (
        '<figure class="plot"><details name="plot"><summary><picture>'
        f'<source media="(prefers-color-scheme: dark)" srcset="{night}">'
        f'<img src="{day}" alt="{escape(alt)}"></picture></summary></details>'
        f"<figcaption>{escape(caption)}</figcaption></figure>"
    )


def fold(name: str, body: str, *, opened: bool) -> str:
    """Return a part of the page under a line that opens and closes it."""
    state = " open" if opened else ""
    return f"<details{state}><summary>{escape(name)}</summary>{body}</details>"


def clip(media: Media) -> str:
    """Return a clip or picture with its caption and command.

    Raises:
        MediaError: If the file is missing, of another kind, or not what its name says.
    """
    kinds = _VIDEO | _IMAGE
    kind = kinds.get(media.path.suffix.lower())
    if kind is None:
        raise MediaError(f"{media.path}: cannot be shown: {choose_one(media.path.suffix, kinds)}")
    try:
        content = files.read_bytes(media.path, kind, MEDIA_LIMIT)
    except (files.FileError, FileNotFoundError) as error:
        raise MediaError(str(error)) from error
    offset, signature = _SIGNATURES[kind]
    if content[offset : offset + len(signature)] != signature:
        raise MediaError(f"{media.path}: the content is not {kind}")
    text = escape(media.description or media.caption)
    source = data_uri(content, kind)
    if kind in _VIDEO.values():
        shown = (
            f'<video controls loop muted playsinline preload="auto" aria-label="{text}" '
            f'src="{source}"></video>'
        )
    else:
        shown = f'<img src="{source}" alt="{text}">'
    under = f"<br>{command(media.command)}" if media.command else ""
    return f"<figure>{shown}<figcaption>{escape(media.caption)}{under}</figcaption></figure>"


def command(text: str) -> str:
    """Return a command that one click selects."""
    return f'<code class="command">{escape(text)}</code>'


def _class(column: int, numeric: Sequence[int]) -> str:
    return ' class="number"' if column in numeric else ""


STYLE = """
:root { color-scheme: light dark; --page: #f4f6f8; --card: #ffffff; --text: #1f2328;
  --quiet: #57606a; --line: #d4d9df; --accent: #0069a6; --code: #eef1f4; --warn: #fff4d6;
  --warn-line: #b07d00; }
@media (prefers-color-scheme: dark) { :root { --page: #0d1117; --card: #161b22; --text: #e6edf3;
  --quiet: #a2acb8; --line: #39424e; --accent: #6cb8f0; --code: #222a35; --warn: #2f2711;
  --warn-line: #d9a420; } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--page); color: var(--text);
  font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "DejaVu Sans", sans-serif; }
header, main, footer { max-width: 1240px; margin: 0 auto; padding: 0 20px; }
header { padding-top: 36px; }
h1 { font-size: 1.9rem; line-height: 1.2; margin: 0 0 6px; }
h2 { font-size: 1.3rem; margin: 0 0 4px; }
h3 { font-size: 1.02rem; margin: 22px 0 6px; }
p { margin: 6px 0 12px; max-width: 76ch; }
.lead, figcaption, caption, footer { color: var(--quiet); }
a { color: var(--accent); }
.skip { position: absolute; left: -999px; }
.skip:focus { left: 12px; top: 12px; background: var(--card); padding: 8px 12px; }
nav ul { display: flex; flex-wrap: wrap; gap: 4px 18px; list-style: none; padding: 0;
  margin: 12px 0 0; }
section { background: var(--card); border: 1px solid var(--line); border-radius: 12px;
  padding: 22px 24px; margin: 22px 0; }
.reduced { background: var(--warn); border-left: 4px solid var(--warn-line); padding: 8px 12px;
  border-radius: 4px; margin: 10px 0; }
.findings { padding-left: 20px; margin: 8px 0 14px; }
figure { margin: 14px 0; }
figure img, figure video { display: block; max-width: 100%; height: auto; border-radius: 6px; }
.plots { display: grid; grid-template-columns: repeat(auto-fill, minmax(250px, 1fr)); gap: 16px; }
.plot { margin: 0; }
.plot details { height: 200px; margin: 0; }
.plot summary { display: block; height: 100%; cursor: zoom-in; }
.plot summary::-webkit-details-marker { display: none; }
.plot img { width: 100%; height: 200px; object-fit: contain; object-position: left top; }
.plot [open] summary { position: fixed; inset: 0; z-index: 2; height: auto; overflow: auto;
  padding: 20px; background: var(--page); cursor: zoom-out; }
.plot [open] img { width: auto; height: auto; margin: 0 auto; }
.clips { display: grid; grid-template-columns: repeat(auto-fill, minmax(320px, 1fr)); gap: 18px; }
.clips figure { margin: 0; }
.clips img, .clips video { width: 100%; background: #000; }
figcaption { font-size: 0.88rem; margin-top: 6px; }
.scroll { overflow: auto; max-height: 440px; margin: 12px 0; }
table { border-collapse: collapse; font-size: 0.86rem; min-width: 60%;
  font-variant-numeric: tabular-nums; }
caption { text-align: left; padding: 4px 0 8px; }
th, td { padding: 5px 9px; border-bottom: 1px solid var(--line); text-align: left;
  white-space: nowrap; vertical-align: baseline; }
thead th { position: sticky; top: 0; background: var(--card); font-weight: 600;
  box-shadow: inset 0 -2px var(--line); }
tbody th { font-weight: 600; }
tbody tr:hover { background: var(--code); }
th:first-child, td:first-child { padding-left: 0; }
.number { text-align: right; }
.best { font-weight: 700; }
.bounds { display: block; color: var(--quiet); font-size: 0.92em; font-weight: 400; }
.idle { color: var(--quiet); font-weight: 400; }
.commands { white-space: normal; min-width: 340px; }
code { font: 0.92em ui-monospace, "DejaVu Sans Mono", Menlo, Consolas, monospace;
  background: var(--code); padding: 1px 5px; border-radius: 4px; }
.command { user-select: all; overflow-wrap: anywhere; }
details { margin: 10px 0; }
summary { cursor: pointer; color: var(--accent); font-weight: 600; }
dt { font-weight: 600; } dd { margin: 0 0 8px; max-width: 80ch; }
footer { padding-bottom: 40px; font-size: 0.9rem; }
@media print { section { border: none; padding: 0; } nav { display: none; }
  .scroll { max-height: none; } .plots { grid-template-columns: 1fr 1fr; }
  .plot details, .plot img { height: auto; } }
"""
"""Style sheet: two palettes, no fonts or pictures from elsewhere."""
