from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import imageio_ffmpeg
import mujoco
import numpy as np
import pytest
from PIL import Image, ImageSequence

from twirl_mjx import files
from twirl_mjx.deploy import render
from twirl_mjx.deploy.ground import build_model
from twirl_mjx.deploy.rehearsal import IDEAL
from twirl_mjx.deploy.render import camera_path, render_frames
from twirl_mjx.deploy.video import overlay_text, strip_indices, write_strip, write_video
from twirl_mjx.sim import gl as gl_probe
from twirl_mjx.sim.draw import CameraView, SceneRenderer
from twirl_mjx.sim.gl import RenderError
from twirl_mjx.sim.scene import BUMP_CELL, BUMP_HALF_SIZE, build_scene

SIZE = (96, 64)


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return build_model(IDEAL, np.zeros(0))


@pytest.fixture(scope="module")
def gl(model: mujoco.MjModel) -> None:
    try:
        gl_probe.open_context(16, 16).free()
    except RenderError as error:
        pytest.skip(f"no headless OpenGL on this machine: {error}")


def decode(video: Path) -> tuple[np.ndarray, str]:
    """Return the frames [T, 64, 96, 3] of a video and what ffmpeg says about it."""
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", str(video), "-f", "rawvideo"]
    run = subprocess.run([*command, "-pix_fmt", "rgb24", "-"], capture_output=True, check=True)
    pixels = np.frombuffer(run.stdout, np.uint8).reshape(-1, 64, 96, 3)
    return pixels, run.stderr.decode()


def home(model: mujoco.MjModel, frames: int = 1) -> np.ndarray:
    return np.tile(model.key("home").qpos, (frames, 1))


@pytest.mark.usefixtures("gl")
def test_frames_show_the_robot_and_follow_it(model: mujoco.MjModel) -> None:
    qpos = home(model, 2)
    qpos[1, 0] = 5.0
    view = CameraView(smoothing_s=0.0)
    near, far = render_frames(model, qpos, size=SIZE, view=view)
    assert near.shape == (64, 96, 3)
    assert near.dtype == np.uint8
    assert near.std() > 10
    ground = slice(40, None)  # the drawn horizon depends on the place
    assert np.abs(near[ground].astype(float) - far[ground]).max() < 30
    qpos[1, 2] += 0.5
    _, raised = render_frames(model, qpos, size=SIZE, view=view)
    assert np.abs(raised.astype(float) - far).max() > 60


@pytest.mark.usefixtures("gl")
def test_goal_marker_is_drawn_where_it_is(model: mujoco.MjModel) -> None:
    def green(frame: np.ndarray) -> np.ndarray:
        red, grass, blue = np.moveaxis(frame.astype(int), -1, 0)
        return (grass > red + 40) & (grass > blue + 20)

    qpos = home(model)
    view = CameraView(azimuth=90.0)
    (without,) = render_frames(model, qpos, size=SIZE, view=view)
    (ahead,) = render_frames(model, qpos, size=SIZE, view=view, goals=np.array([[0.5, 0.0]]))
    assert not green(without).any()
    columns = np.flatnonzero(green(ahead).any(axis=0))
    assert len(columns)
    assert columns.min() > SIZE[0] / 2  # +x is to the right


@pytest.mark.usefixtures("gl")
def test_episode_writes_a_video_and_a_strip(model: mujoco.MjModel, tmp_path: Path) -> None:
    qpos = home(model, 6)
    captions = [[f"t = {i}"] for i in range(6)]
    video, strip = render.render_episode(
        model, qpos, tmp_path / "out" / "stand", panels=3, captions=captions, size=SIZE
    )
    assert sorted(p.name for p in video.parent.iterdir()) == ["stand.mp4", "stand.png"]
    pixels, facts = decode(video)
    assert pixels.shape == (6, 64, 96, 3)
    for fact in ("h264", "yuv420p", "96x64", "20 fps"):
        assert fact in facts
    with Image.open(strip) as image:
        np.testing.assert_allclose(pixels[0].mean(), np.asarray(image)[:, :96].mean(), atol=5)
    with Image.open(strip) as image:
        assert image.size == (3 * 96 + 2 * 4, 64)


def test_bad_trajectories_are_refused(model: mujoco.MjModel) -> None:
    with pytest.raises(ValueError, match=r"shape \(2, 18\), expected \[T >= 1, 19\]"):
        list(render_frames(model, np.zeros((2, 18))))
    qpos = home(model, 3)
    qpos[2, 4] = np.nan
    with pytest.raises(ValueError, match=r"qpos\[2\] is not finite"):
        list(render_frames(model, qpos))
    with pytest.raises(ValueError, match="2 goals for 1 frames"):
        list(render_frames(model, home(model), goals=np.zeros((2, 2))))


def test_message_names_what_was_tried_and_the_fix(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gl_probe, "GL_BACKENDS", ("nosuch", "neither"))
    monkeypatch.setitem(sys.modules, "OpenGL", render)  # the process has its platform
    with pytest.raises(RenderError, match=r"Tried nosuch: .*; neither: .*Fix: .*libegl1"):
        gl_probe.open_context(8, 8)
    monkeypatch.delitem(sys.modules, "OpenGL")
    with pytest.raises(RenderError, match=r"Tried nosuch: RuntimeError: .*; neither: .*libegl1"):
        gl_probe.open_context(8, 8)
    with pytest.raises(RenderError, match=r"nosuch: RuntimeError: invalid value .*neither: "):
        gl_probe.probe_gl(os.environ)


@pytest.mark.usefixtures("gl")
def test_probe_finds_a_backend() -> None:
    assert gl_probe.probe_gl({**os.environ, "MUJOCO_GL": "nonsense"}) in gl_probe.GL_BACKENDS


def test_camera_follows_smoothly_without_lag() -> None:
    qpos = np.zeros((41, 19))
    qpos[20:, 0] = 1.0
    path = camera_path(qpos, CameraView(), 0.05)
    assert np.all(np.diff(path[:, 0]) >= 0)
    assert np.abs(np.diff(path[:, 0])).max() < 0.2
    assert path[19, 0] > 0.2  # moves before the step: the filter has no delay
    still = camera_path(qpos, CameraView(smoothing_s=0.0), 0.05)
    np.testing.assert_array_equal(still[:, 0], qpos[:, 0])


def test_camera_keeps_robot_and_goal_in_the_picture() -> None:
    qpos, goals = np.zeros((3, 19)), np.array([[0.2, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 5.0, 0.0]])
    view = CameraView(smoothing_s=0.0)
    path = camera_path(qpos, view, 0.05, goals)
    np.testing.assert_allclose(path[:, :2], goals[:, :2] / 2)
    np.testing.assert_allclose(path[:, 3], [view.distance, 1.2 + 0.9 * 2.0, 1.2 + 0.9 * 5.0])
    half_width = 4 / 3 * np.tan(np.radians(45 / 2))  # of the picture at 1 m
    assert (np.linalg.norm(goals, axis=1) / 2 < half_width * path[:, 3]).all()


@pytest.mark.usefixtures("gl")
def test_an_episode_is_filmed_under_the_name_given(model: mujoco.MjModel, tmp_path: Path) -> None:
    qpos = home(model, 3)
    qpos[:, 2] += [0.0, 0.1, 0.2]
    film, strip = render.render_episode(model, qpos, tmp_path / "x.webp", panels=2, size=SIZE)
    assert (film.name, strip.name) == ("x.webp", "x.png")
    assert files.check_ours(film) == film  # carries the mark
    with Image.open(film) as image:
        assert (image.format, image.size) == ("WEBP", SIZE)
        assert sum(1 for _ in ImageSequence.Iterator(image)) == 3
        image.seek(1)
        image.load()
        assert image.info["duration"] == 50
        assert image.info["loop"] == 0
        assert np.asarray(image.convert("RGB")).std() > 10
    film, _ = render.render_episode(model, home(model, 2), tmp_path / "y.mp4", panels=1, size=SIZE)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["x.png", "x.webp", "y.mp4", "y.png"]


def test_caption_changes_its_corner_only() -> None:
    frame = np.full((240, 320, 3), 200, np.uint8)
    shown = overlay_text(frame, ["biped", "t = 1.00 s"])
    changed = (shown != frame).any(axis=2)
    assert changed[-60:, :100].mean() > 0.25
    assert not changed[:160].any()
    assert not changed[:, 160:].any()


def test_strip_frames_are_spread_evenly() -> None:
    assert strip_indices(401, 5) == [0, 100, 200, 300, 400]
    assert strip_indices(3, 8) == [0, 1, 2]
    with pytest.raises(ValueError, match="panels"):
        strip_indices(5, 0)


def test_bad_pictures_are_refused(tmp_path: Path) -> None:
    frame = np.zeros((8, 9, 3), np.uint8)
    with pytest.raises(ValueError, match="even size, got 9 x 8"):
        write_video(tmp_path / "v.mp4", [frame])
    with pytest.raises(ValueError, match=r"ends in \.mp4"):
        write_video(tmp_path / "v.gif", [frame])
    with pytest.raises(ValueError, match="at least one frame"):
        write_video(tmp_path / "v.mp4", [])
    good = np.zeros((8, 8, 3), np.uint8)
    with pytest.raises(ValueError, match=r"change size from \(8, 8, 3\) to \(8, 6, 3\)"):
        write_video(tmp_path / "v.mp4", [good, good[:, :6]])
    with pytest.raises(ValueError, match=r"change size from \(8, 8\) to \(6, 8\)"):
        write_video(tmp_path / "v.webp", [good, good[:, :6]])
    with pytest.raises(RuntimeError, match=r"the video encoder failed: .+"):
        write_video(tmp_path / "v.mp4", [good], fps=-1)
    with pytest.raises(ValueError, match=r"needs a \.png name"):
        write_strip(tmp_path / "s.png", [])
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("gl")
def test_bumps_are_coloured_by_their_height() -> None:
    scene = build_scene("bumpy")
    model = scene.mj_model
    model.light_active[:] = 0  # flat light: only the ground's own colour is left
    model.vis.headlight.ambient[:], model.vis.headlight.diffuse[:] = 1.0, 0.0
    view = CameraView(distance=1.0, azimuth=90.0, elevation=-89.9)
    away = model.key("home").qpos + np.array([20.0, 20.0, 5.0, *np.zeros(16)])
    points = np.random.default_rng(0).integers(40, 160, size=(12, 2))
    with SceneRenderer(model, 32, 32) as renderer:
        seen = [
            renderer.draw(away, view, np.array([*(cell[::-1] * BUMP_CELL - BUMP_HALF_SIZE), 0.03]))
            for cell in points
        ]
    brightness = [frame[14:18, 14:18].mean() for frame in seen]
    assert np.corrcoef(brightness, scene.bumps[points[:, 0], points[:, 1]])[0, 1] > 0.9
