"""Figures of a clip: files are written and show what they should."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest

from twirl_mjx.assets import asset_path
from twirl_mjx.motion.clip import Clip
from twirl_mjx.motion.formats import read_clip
from twirl_mjx.motion.show import compare, forward_paths, pitch_angles, show


@pytest.fixture(scope="module")
def leap() -> Clip:
    return read_clip(asset_path("a1", "leap.json"))


def test_figures_are_written(leap: Clip, tmp_path: Path) -> None:
    show(leap, tmp_path / "leap.png")
    compare([leap, leap], tmp_path / "compare.png", source="ours twice")
    for name in ("leap.png", "compare.png"):
        image = iio.imread(tmp_path / name)
        assert image.shape[0] > 600
        assert image[..., :3].std() > 10


def test_nothing_is_clipped_however_long_the_names_are(
    leap: Clip, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, clipped: Callable
) -> None:
    drawn = []
    monkeypatch.setattr("twirl_mjx.motion.show._save", lambda figure, path: drawn.append(figure))
    named = dataclasses.replace(leap, name="my_leap_over_the_brook_" * 8)
    show(named, tmp_path / "a.png")
    compare([named, leap], tmp_path / "b.png", source="a motion library, " * 9)
    assert [clipped(figure) for figure in drawn] == [[], []]


def test_pitch_is_positive_nose_up() -> None:
    half = 0.1
    quat = np.tile([np.cos(half), 0, -np.sin(half), 0], (2, 1))
    clip = Clip(np.zeros((2, 3)), quat, np.zeros((2, 12)), frame_duration=0.1)
    np.testing.assert_allclose(pitch_angles(clip), np.degrees(0.2))


def test_paths_start_forward(leap: Clip) -> None:
    root, feet = forward_paths(leap)
    np.testing.assert_allclose(root[0, :2], 0.0, atol=1e-9)
    assert root[-1, 0] == pytest.approx(leap.cycle_displacement[0])
    assert feet.shape == (leap.num_frames, 4, 3)
