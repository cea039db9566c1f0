"""Pictures without a simulator: captions on frames, H.264 videos and strips of frames."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np


def overlay_text(frame: np.ndarray, lines: Sequence[str]) -> np.ndarray:
    """Return ``frame`` [H, W, 3] with lines of text on a translucent box, top left."""
    from PIL import Image, ImageDraw

    font = _font(max(frame.shape[0] // 26, 10))
    image = Image.fromarray(frame).convert("RGBA")
    layer = Image.new("RGBA", image.size, (0, 0, 0, 0))
    draw = ImageDraw.Draw(layer)
    text, pad = "\n".join(lines), max(frame.shape[0] // 60, 4)
    box = draw.multiline_textbbox((2 * pad, 2 * pad), text, font=font)
    draw.rounded_rectangle(
        (pad, pad, box[2] + pad, box[3] + pad), radius=pad, fill=(20, 24, 32, 150)
    )
    draw.multiline_text((2 * pad, 2 * pad), text, font=font, fill=(255, 255, 255, 255))
    return np.asarray(Image.alpha_composite(image, layer).convert("RGB"))


def _font(size: int) -> Any:
    """Return the sans-serif font that ships with matplotlib."""
    import matplotlib
    from PIL import ImageFont

    path = Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"
    return ImageFont.truetype(str(path), size)


def write_video(path: str | Path, frames: Iterable[np.ndarray], fps: int = 20) -> Path:
    """Write frames [H, W, 3] uint8 as H.264 (yuv420p) in an ``.mp4`` that any browser plays.

    Args:
        path: target, ending in ``.mp4``.
        frames: pictures of one even size.
        fps: pictures per second.

    Raises:
        ValueError: wrong suffix, odd size or no frame.
    """
    import imageio_ffmpeg

    path = Path(path)
    if path.suffix != ".mp4":
        raise ValueError(f"{path}: a video file ends in .mp4, got {path.suffix!r}")
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(path.stem + ".partial.mp4")
    writer = None
    for frame in frames:
        if writer is None:
            height, width = frame.shape[:2]
            if height % 2 or width % 2:
                raise ValueError(f"video frames need an even size, got {width} x {height}")
            writer = imageio_ffmpeg.write_frames(
                str(partial),
                (width, height),
                fps=fps,
                codec="libx264",
                pix_fmt_out="yuv420p",
                macro_block_size=2,
                quality=7,
                output_params=["-movflags", "+faststart"],
            )
            writer.send(None)
        writer.send(np.ascontiguousarray(frame))
    if writer is None:
        raise ValueError("a video needs at least one frame")
    writer.close()
    partial.replace(path)
    return path


def strip_indices(count: int, panels: int) -> list[int]:
    """Return ``panels`` frame indices spread evenly over ``count`` frames, ends included."""
    if panels < 1 or count < 1:
        raise ValueError(f"a strip needs panels and frames, got {panels} and {count}")
    return [round(i) for i in np.linspace(0, count - 1, min(panels, count))]


def write_strip(path: str | Path, frames: Sequence[np.ndarray], gap: int = 4) -> Path:
    """Write frames [H, W, 3] side by side as one wide PNG, ``gap`` white pixels between."""
    from PIL import Image

    path = Path(path)
    if path.suffix != ".png" or not len(frames):
        raise ValueError(f"{path}: a strip needs a .png name and at least one frame")
    spacer = np.full((frames[0].shape[0], gap, 3), 255, np.uint8)
    parts = [part for frame in frames for part in (spacer, frame)][1:]
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.concatenate(parts, axis=1)).save(path, optimize=True)
    return path
