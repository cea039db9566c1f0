"""Pictures without a simulator: captions on frames, H.264 videos and strips of frames."""

from __future__ import annotations

import contextlib
import itertools
import subprocess
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from twirl_mjx import files


def overlay_text(frame: np.ndarray, lines: Sequence[str]) -> np.ndarray:
    """Return ``frame`` [H, W, 3] with lines of text on a translucent box, bottom left.

    The robot stands in the middle and reaches up when it stands on its hind legs.
    """
    from PIL import Image, ImageDraw

    font = _font(max(frame.shape[0] // 26, 10))
    image = Image.fromarray(frame).convert("RGBA")
    layer = Image.new("RGBA", image.size, (0, 0, 0, 0))
    draw = ImageDraw.Draw(layer)
    text, pad = "\n".join(lines), max(frame.shape[0] // 60, 4)
    box = draw.multiline_textbbox((2 * pad, 0), text, font=font)
    top = frame.shape[0] - 2 * pad - box[3]
    draw.rounded_rectangle(
        (pad, top + box[1] - pad, box[2] + pad, frame.shape[0] - pad),
        radius=pad,
        fill=(20, 24, 32, 150),
    )
    draw.multiline_text((2 * pad, top), text, font=font, fill=(255, 255, 255, 255))
    return np.asarray(Image.alpha_composite(image, layer).convert("RGB"))


def _font(size: int) -> Any:
    """Return the sans-serif font that ships with matplotlib."""
    import matplotlib
    from PIL import ImageFont

    path = Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"
    return ImageFont.truetype(str(path), size)


FILMS = (".mp4", ".webp")
"""Endings of films: H.264 (yuv420p), and an animated picture that pages show by themselves."""
WEBP_QUALITY = 45
"""0 to 100; a film of 8 s at 640 x 480 then takes about 1 MB."""


def film_paths(stem: str | Path) -> tuple[Path, Path]:
    """Return where a film and its strip go: a stem that ends as a film does is the film itself."""
    stem = Path(stem)
    film = stem if stem.suffix in FILMS else stem.parent / f"{stem.name}.mp4"
    return film, film.parent / f"{film.stem}.png"


def write_video(path: str | Path, frames: Iterable[np.ndarray], fps: int = 20) -> Path:
    """Write frames [H, W, 3] uint8 as a film that any browser plays.

    The encoder of ``.mp4`` is started without ``fork``, which a process that runs jax must not
    use.

    Args:
        path: target, ending in one of ``FILMS``; it is written whole or not at all.
        frames: pictures of one even size.
        fps: pictures per second.

    Raises:
        ValueError: wrong suffix, odd or changing size, or no frame.
        RuntimeError: the encoder failed; the message holds its own.
    """
    path = Path(path)
    if path.suffix not in FILMS:
        raise ValueError(f"{path}: a video file ends in {' or '.join(FILMS)}, got {path.suffix!r}")
    pictures = iter(frames)
    first = next(pictures, None)
    if first is None:
        raise ValueError("a video needs at least one frame")
    height, width = first.shape[:2]
    if height % 2 or width % 2:
        raise ValueError(f"video frames need an even size, got {width} x {height}")
    if path.suffix == ".webp":
        return _write_webp(path, itertools.chain([first], pictures), fps)
    with files.replacing(path) as temporary:
        encoder = _start_encoder(temporary, width, height, fps)
        try:
            _feed(encoder, itertools.chain([first], pictures))
        except BaseException:
            encoder.kill()
            encoder.communicate()
            raise
    return path


def _write_webp(path: Path, frames: Iterable[np.ndarray], fps: int) -> Path:
    """Write an animated WebP that repeats for ever."""
    from PIL import Image

    first, *others = (Image.fromarray(np.asarray(frame, np.uint8)) for frame in frames)
    if sizes := {image.size for image in others} - {first.size}:
        raise ValueError(f"video frames change size from {first.size} to {sizes.pop()}")
    with files.write_atomic(path) as file:
        first.save(
            file,
            "webp",
            save_all=True,
            append_images=others,
            duration=round(1000 / fps),
            loop=0,
            quality=WEBP_QUALITY,
            xmp=files.MARK.encode(),
        )
    return path


def _start_encoder(path: Path, width: int, height: int, fps: int) -> subprocess.Popen[bytes]:
    """Start ffmpeg reading raw RGB frames from its standard input."""
    import imageio_ffmpeg

    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", str(fps)]
    mark = ["-metadata", f"comment={files.MARK}"]
    target = ["-an", *mark, "-c:v", "libx264", "-crf", "21", "-pix_fmt", "yuv420p"]
    return subprocess.Popen(
        [
            imageio_ffmpeg.get_ffmpeg_exe(),
            *("-y", "-loglevel", "error", *source, "-i", "-"),
            *(*target, "-movflags", "+faststart", str(path)),
        ],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
    )


def _feed(encoder: subprocess.Popen[bytes], frames: Iterable[np.ndarray]) -> None:
    """Send every frame and wait for the encoder to finish."""
    shape, pipe = None, encoder.stdin
    assert pipe is not None
    with contextlib.suppress(BrokenPipeError):  # the encoder's own message is raised below
        for frame in frames:
            shape = shape or frame.shape
            if frame.shape != shape:
                raise ValueError(f"video frames change size from {shape} to {frame.shape}")
            pipe.write(np.ascontiguousarray(frame, np.uint8).tobytes())
    _, message = encoder.communicate()
    if encoder.returncode != 0:
        raise RuntimeError(f"the video encoder failed: {message.decode(errors='replace').strip()}")


def strip_indices(count: int, panels: int) -> list[int]:
    """Return ``panels`` frame indices spread evenly over ``count`` frames, ends included."""
    if panels < 1 or count < 1:
        raise ValueError(f"a strip needs panels and frames, got {panels} and {count}")
    return [round(i) for i in np.linspace(0, count - 1, min(panels, count))]


def write_strip(path: str | Path, frames: Sequence[np.ndarray], gap: int = 4) -> Path:
    """Write frames [H, W, 3] side by side as one wide PNG, ``gap`` white pixels between."""
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    path = Path(path)
    if path.suffix != ".png" or not len(frames):
        raise ValueError(f"{path}: a strip needs a .png name and at least one frame")
    spacer = np.full((frames[0].shape[0], gap, 3), 255, np.uint8)
    parts = [part for frame in frames for part in (spacer, frame)][1:]
    about = PngInfo()
    about.add_text("Software", files.MARK)
    with files.write_atomic(path) as file:
        picture = Image.fromarray(np.concatenate(parts, axis=1))
        picture.save(file, "png", optimize=True, pnginfo=about)
    return path
