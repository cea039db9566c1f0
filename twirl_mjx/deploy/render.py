"""Headless pictures of episodes: H.264 video and strips of PNG frames."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import mujoco
import numpy as np

from twirl_mjx.deploy.video import overlay_text, strip_indices, write_strip, write_video
from twirl_mjx.sim.draw import CameraView, SceneRenderer


def look_at_path(qpos: np.ndarray, view: CameraView, frame_dt: float) -> np.ndarray:
    """Return the smoothed path [T, 3] m of the look-at point.

    A first-order low-pass is run forwards and backwards, so the camera does not lag.

    Args:
        qpos: [T, 7 + J].
        view: camera.
        frame_dt: time between frames, s.
    """
    path = np.column_stack([qpos[:, :2], np.full(len(qpos), view.height)])
    path[:, 2] = np.maximum(path[:, 2], 0.6 * qpos[:, 2])
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
    path = look_at_path(qpos, view, frame_dt)
    with SceneRenderer(model, *size, antialias=antialias) as renderer:
        for i, state in enumerate(qpos):
            frame = renderer.draw(state, view, path[i], None if goals is None else goals[i])
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

    video_path = write_video(stem.parent / f"{stem.name}.mp4", watched(), round(1.0 / frame_dt))
    return video_path, write_strip(stem.parent / f"{stem.name}.png", kept)
