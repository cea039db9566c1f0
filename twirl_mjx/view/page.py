"""The page itself: one HTML document without any other file, for a live view or a replay."""

from __future__ import annotations

import html
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from twirl_mjx import files
from twirl_mjx.assets import asset_path
from twirl_mjx.view.picture import Picture, encode


def live_page(title: str) -> str:
    """Return the page that shows, and steers, the loop behind the server it came from."""
    return _page(title, "null")


def web_page(title: str) -> str:
    """Return the page whose loop runs in the browser; its other files are those of ``web``."""
    return _page(title, '"inside"', before=_asset("web.js"))


def _page(title: str, replay: str, before: str = "") -> str:
    """Fill the page's template; scripts may hold anything but the end of a script."""
    text = files.read_text(asset_path("view", "page.html"), "the page")
    parts = {"scene": _asset("scene.js"), "page": before + _asset("page.js")}
    text = text.replace("@TITLE@", html.escape(title)).replace("@MARK@", files.MARK)
    for name, content in (parts | {"replay": replay}).items():
        text = text.replace(f"@{name.upper()}@", content)
    return text


def _asset(name: str) -> str:
    return files.read_text(asset_path("view", name), "a script of the page")


def check_page(path: str | Path, *, overwrite: bool = False) -> Path:
    """Return the path of a page that can be written.

    Raises:
        ValueError: It does not end in ``.html``, or something that this project did not write is
            there.
    """
    path = Path(path)
    if path.suffix != ".html":
        raise ValueError(
            f"{path}: a replay ends in .html, got {path.suffix!r} (nearest:"
            f" {path.with_suffix('.html').name})"
        )
    files.check_ours(path, overwrite=overwrite)
    return path


def write_replay(
    path: str | Path,
    model: mujoco.MjModel,
    qpos: np.ndarray,
    *,
    title: str,
    note: str = "",
    frame_dt: float = 0.05,
    overwrite: bool = False,
    goals: np.ndarray | None = None,
    values: Mapping[str, Sequence[float]] | None = None,
) -> Path:
    """Write a trajectory as one HTML file that plays in any browser with WebGL 2, offline.

    Args:
        path: target, ending in ``.html``.
        model: the scene; hurdle bands and terrain are part of it.
        qpos: [T, model.nq] trajectory, one row per frame.
        title: heading of the page.
        note: a line or more below it.
        frame_dt: time between rows, s.
        overwrite: whether a file may be replaced that this project did not write.
        goals: [T, 2] or [T, 3] m, goal position per frame, world frame; None for none.
        values: name to [T] numbers that are shown beside the picture; None for none.

    Returns:
        The path.

    Raises:
        ValueError: wrong suffix, lengths or widths that do not fit, or a state that is not finite.
    """
    path, qpos = check_page(path, overwrite=overwrite), np.asarray(qpos, float)
    if qpos.ndim != 2 or qpos.shape[1] != model.nq or not len(qpos):
        raise ValueError(f"qpos has shape {qpos.shape}, expected [T >= 1, {model.nq}]")
    if not np.isfinite(qpos).all():
        row = int(np.argwhere(~np.isfinite(qpos))[0, 0])
        raise ValueError(f"qpos[{row}] is not finite; show the frames before it")
    values = dict(values or {})
    if goals is not None:
        values_of_goals = np.asarray(goals, np.float32)
        goals = np.pad(values_of_goals, ((0, 0), (0, 3 - values_of_goals.shape[1])))
    for name, series in (values | ({} if goals is None else {"goals": goals})).items():
        if len(series) != len(qpos):
            raise ValueError(f"{len(series)} {name} for {len(qpos)} frames")
    picture = Picture(model)
    record: dict[str, Any] = {
        "scene": picture.scene,
        "dt": frame_dt,
        "note": note,
        "poses": encode(np.stack([picture.poses(row) for row in qpos])),
        "goals": None if goals is None else encode(goals),
        "values": {name: _finite(series) for name, series in values.items()},
    }
    text = json.dumps(record, separators=(",", ":"), allow_nan=False).replace("</", "<\\/")
    files.write_text(path, _page(title, text))
    return path


def _finite(series: Sequence[float]) -> list[float | None]:
    """Return numbers for JSON, which has no infinite ones."""
    return [round(float(x), 4) if np.isfinite(x) else None for x in series]
