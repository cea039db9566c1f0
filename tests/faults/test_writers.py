"""Every writer of the package on a full disk, on nodes and through links."""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from twirl_mjx import exits, faults, files
from twirl_mjx.assets import asset_path
from twirl_mjx.bench import report as bench_report
from twirl_mjx.commands import evaluate
from twirl_mjx.deploy.export import export_onnx
from twirl_mjx.deploy.video import write_strip, write_video
from twirl_mjx.figures.canvas import write_png
from twirl_mjx.figures.report import write_report
from twirl_mjx.motion import leap, show
from twirl_mjx.motion.clip import Clip
from twirl_mjx.motion.formats import read_clip, write_clip
from twirl_mjx.motion.leap_config import LeapConfig
from twirl_mjx.motion.leap_plan import make_layout
from twirl_mjx.policies.learned import NumpyPolicy, load_policy, save_policy
from twirl_mjx.replay import dataset
from twirl_mjx.sweep.gather import write_table
from twirl_mjx.training.config import TrainConfig
from twirl_mjx.training.rundir import RunDir
from twirl_mjx.training.sinks import table
from twirl_mjx.types import Transition

FRAMES = [np.random.default_rng(i).integers(0, 255, (64, 64, 3), np.uint8) for i in range(20)]


def shipped() -> NumpyPolicy:
    policy = load_policy(asset_path("policies", "stand.npz"))
    assert isinstance(policy, NumpyPolicy)
    return policy


def clip() -> Clip:
    return read_clip(asset_path("a1", "leap.json"))


def figure(path: Path) -> None:
    import matplotlib.figure

    write_png(matplotlib.figure.Figure(), path)


def plan(path: Path) -> None:
    layout = make_layout(LeapConfig())
    leap.write_plan(layout, np.zeros(len(layout.start)), path)


def rows(path: Path) -> None:
    size = 3
    data = Transition(
        obs=np.zeros((size, 2), np.float32),  # type: ignore[arg-type]
        action=np.zeros((size, 1), np.float32),  # type: ignore[arg-type]
        reward=np.zeros(size, np.float32),  # type: ignore[arg-type]
        terminated=np.zeros(size, bool),  # type: ignore[arg-type]
        next_obs=np.zeros((size, 2), np.float32),  # type: ignore[arg-type]
    )
    dataset.write(path, dataset.DatasetHeader("stand", "none", "zero", size, 2, 1, 0.0), data)


def report(path: Path) -> None:
    """Write a page of one picture and no table."""
    folder = Path(__file__).parents[2] / "docs" / "images"
    picture = min(folder.glob("*.png"), key=lambda p: p.stat().st_size)
    write_report(Path(__file__).parent, path, [picture], say=lambda _: None)


def cut_metrics(path: Path) -> None:
    if not path.exists() or path.read_text() == "old":
        lines = [",".join(table.COLUMNS), ",".join("abcd0m") + ",1,1,0.5,2"]
        path.write_text("\n".join(lines) + "\n")
    table.truncate_csv(path, 5)


WRITERS: dict[str, Callable[[Path], object]] = {
    "policy.npz": lambda path: save_policy(path, shipped().actor_params, shipped().header),
    "source.npz": rows,
    "policy.onnx": lambda path: export_onnx(shipped(), path),
    "film.mp4": lambda path: write_video(path, FRAMES),
    "strip.png": lambda path: write_strip(path, FRAMES),
    "figure.png": figure,
    "clip.png": lambda path: show.show(clip(), path),
    "compare.png": lambda path: show.compare([clip(), clip()], path),
    "clip.json": lambda path: write_clip(clip(), path),
    "plan.json": plan,
    "report.html": lambda path: report(path),
    "evaluation.csv": lambda path: evaluate.write_rows(path, [["a"] * 9]),
    "table.csv": lambda path: write_table(path, ["# n"], ["value"], [{"value": "1"}]),
    "bench.json": lambda path: files.write_json(path, {"a": 1.0}),
}
OTHERS: dict[str, Callable[[Path], object]] = {
    "config.json": lambda path: RunDir(path.parent).open(TrainConfig()),
    "metrics.csv": cut_metrics,
}
"""Writers that choose their own file, or read it first."""


@pytest.mark.parametrize("name", WRITERS | OTHERS)
def test_a_full_disk_leaves_what_was_there(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / name
    if name == "metrics.csv":
        cut_metrics(path)
    else:
        path.write_text("old")
    old = path.read_bytes()

    def refuse(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", refuse)
    with pytest.raises(OSError, match=re.escape(str(path))) as error:
        (WRITERS | OTHERS)[name](path)
    text, status = faults.explain(error.value)
    assert status == exits.NO_SPACE
    assert text.startswith(f"{path}: No space left on device: ")
    assert path.read_bytes() == old
    assert [p.name for p in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize("name", WRITERS)
def test_nodes_are_refused_and_links_followed(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.symlink_to("/dev/null")
    with pytest.raises(ValueError, match=rf"{re.escape(name)} is a device and would be replaced"):
        WRITERS[name](path)
    path.unlink()
    (tmp_path / "deep").mkdir()
    path.symlink_to("deep/target")
    WRITERS[name](path)
    assert path.is_symlink()
    assert (tmp_path / "deep" / "target").stat().st_size > 0
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(["deep", name])
    assert [p.name for p in (tmp_path / "deep").iterdir()] == ["target"]


def test_a_video_on_a_disk_that_is_too_small(small_disk: Path) -> None:
    """The encoder is another program, which writes the temporary file itself."""
    path = small_disk / "film.mp4"
    path.write_text("old")
    frames = (np.random.default_rng(i).integers(0, 255, (256, 256, 3), np.uint8) for i in range(60))
    with pytest.raises(RuntimeError, match="No space left") as error:
        write_video(path, frames)
    assert faults.explain(error.value).status == exits.NO_SPACE
    assert [p.name for p in small_disk.iterdir()] == ["film.mp4"]
    assert path.read_text() == "old"


def test_a_section_of_a_page(tmp_path: Path, no_space: None) -> None:
    path = tmp_path / "page.md"
    text = f"a\n{bench_report.BEGIN}\nold\n{bench_report.END}\n"
    path.write_text(text)
    with pytest.raises(OSError, match="No space left"):
        bench_report.write_section(path, "new")
    assert path.read_text() == text


def test_names_with_mathematics_are_drawn_as_they_are(tmp_path: Path) -> None:
    """Matplotlib would parse them; a name that is no UTF-8 is shown with question marks."""
    import dataclasses

    odd = dataclasses.replace(clip(), name="$\\frac{a$ \udcff")
    show.show(odd, tmp_path / "a.png")
    show.compare([odd, odd], tmp_path / "b.png", source="$\\frac{a$")
    assert (tmp_path / "a.png").read_bytes()[:4] == b"\x89PNG"
