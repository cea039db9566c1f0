"""Headless pictures of episodes: H.264 video and strips of PNG frames."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path

import mujoco
import numpy as np

from twirl_mjx.deploy.video import (
    film_paths,
    overlay_text,
    strip_indices,
    write_strip,
    write_video,
)
from twirl_mjx.sim.draw import CameraView, SceneRenderer

GOAL_MARGIN = 1.2
"""m, camera distance when the robot is at its goal."""
GOAL_SHARE = 0.9
"""m of camera distance for every m between robot and goal: both are then in the picture."""


def camera_path(
    qpos: np.ndarray, view: CameraView, frame_dt: float, goals: np.ndarray | None = None
) -> np.ndarray:
    """Return the smoothed path [T, 4] m of look-at point and camera distance.

    The camera looks at the robot, or half way to its goal from so far back that both are seen.
    A first-order low-pass is run forwards and backwards, so it does not lag.

    Args:
        qpos: [T, 7 + J].
        view: camera.
        frame_dt: time between frames, s.
        goals: [T, 2 or 3] m, goal per frame; ``None`` for none.
    """
    heights = np.maximum(view.height, 0.6 * qpos[:, 2])
    path = np.column_stack([qpos[:, :2], heights, np.full(len(qpos), view.distance)])
    if goals is not None:
        way = np.asarray(goals)[:, :2] - qpos[:, :2]
        path[:, :2] += 0.5 * way
        apart = GOAL_MARGIN + GOAL_SHARE * np.linalg.norm(way, axis=1)
        path[:, 3] = np.maximum(path[:, 3], apart)
    keep = np.exp(-frame_dt / view.smoothing_s) if view.smoothing_s > 0 else 0.0
    for order in (slice(None), slice(None, None, -1)):
        points = path[order]
        for i in range(1, len(points)):
            points[i] = keep * points[i - 1] + (1.0 - keep) * points[i]
    return path


def render_frames(
    model: mujoco.MjModel,
    qpos: np.ndarray,
    *,
    frame_dt: float = 0.05,
    goals: np.ndarray | None = None,
    captions: Sequence[Sequence[str]] | None = None,
    view: CameraView | None = None,
    size: tuple[int, int] = (640, 480),
    antialias: bool = False,
) -> Iterator[np.ndarray]:
    """Yield the frames [H, W, 3] uint8 of a trajectory.

    Args:
        model: the scene; hurdle bands and terrain are part of it.
        qpos: [T, model.nq] trajectory, one row per frame.
        frame_dt: time between rows, s.
        goals: [T, 2] or [T, 3] m, goal position per frame, world frame; ``None`` for none.
        captions: T lists of text lines; ``None`` for none.
        view: camera.
        size: (width, height) in pixels.
        antialias: smooth edges, slower.

    Raises:
        ValueError: lengths or widths that do not fit, or a state that is not finite.
        RenderError: no OpenGL backend works.
    """
    qpos = np.asarray(qpos, float)
    if qpos.ndim != 2 or qpos.shape[1] != model.nq or not len(qpos):
        raise ValueError(f"qpos has shape {qpos.shape}, expected [T >= 1, {model.nq}]")
    if not np.isfinite(qpos).all():
        row = int(np.argwhere(~np.isfinite(qpos))[0, 0])
        raise ValueError(f"qpos[{row}] is not finite; render the frames before it")
    for name, values in (("goals", goals), ("captions", captions)):
        if values is not None and len(values) != len(qpos):
            raise ValueError(f"{len(values)} {name} for {len(qpos)} frames")
    view = view or CameraView()
    path = camera_path(qpos, view, frame_dt, goals)
    with SceneRenderer(model, *size, antialias=antialias) as renderer:
        for i, state in enumerate(qpos):
            seen = dataclasses.replace(view, distance=float(path[i, 3]))
            frame = renderer.draw(state, seen, path[i, :3], None if goals is None else goals[i])
            yield frame if captions is None else overlay_text(frame, captions[i])


def render_episode(
    model: mujoco.MjModel,
    qpos: np.ndarray,
    stem: str | Path,
    *,
    frame_dt: float = 0.05,
    panels: int = 8,
    goals: np.ndarray | None = None,
    captions: Sequence[Sequence[str]] | None = None,
    view: CameraView | None = None,
    size: tuple[int, int] = (640, 480),
    antialias: bool = False,
) -> tuple[Path, Path]:
    """Write ``<stem>.mp4`` and ``<stem>.png``, a strip of ``panels`` frames, in one pass.

    A ``stem`` that ends as a film does (``FILMS``) is the name of the film itself.

    Args and raises: as ``render_frames``.

    Returns:
        The paths of the video and of the strip.
    """
    stem = Path(stem)
    wanted = set(strip_indices(len(qpos), panels))
    kept: list[np.ndarray] = []
    frames = render_frames(
        model,
        qpos,
        frame_dt=frame_dt,
        goals=goals,
        captions=captions,
        view=view,
        size=size,
        antialias=antialias,
    )

    def watched() -> Iterator[np.ndarray]:
        for i, frame in enumerate(frames):
            if i in wanted:
                kept.append(frame)
            yield frame

    film, strip = film_paths(stem)
    return write_video(film, watched(), round(1.0 / frame_dt)), write_strip(strip, kept)
