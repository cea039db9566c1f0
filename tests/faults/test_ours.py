"""Nothing of the user's is ever replaced: what is known as ours, and every command that writes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from twirl_mjx import files
from twirl_mjx.assets import asset_path
from twirl_mjx.commands import bench, demo, evaluate, figures, render, report
from twirl_mjx.deploy.video import write_strip, write_video
from twirl_mjx.figures import page, plots
from twirl_mjx.figures.canvas import write_png
from twirl_mjx.motion import show
from twirl_mjx.motion.formats import read_clip, write_clip
from twirl_mjx.training import config_json
from twirl_mjx.training.presets import make_config
from twirl_mjx.training.rundir import EVAL_COLUMNS, Foreign, New, RunDir

FRAMES = [np.full((64, 64, 3), i, np.uint8) for i in range(4)]


def plot(path: Path) -> None:
    import matplotlib.figure

    write_png(matplotlib.figure.Figure(), path)


OURS: dict[str, Callable[[Path], object]] = {
    "film.mp4": lambda path: write_video(path, FRAMES),
    "strip.png": lambda path: write_strip(path, FRAMES),
    "figure.png": plot,
    "clip.png": lambda path: show.show(read_clip(asset_path("a1", "leap.json")), path),
    "clip.json": lambda path: write_clip(read_clip(asset_path("a1", "leap.json")), path),
    "page.html": lambda path: files.write_text(path, page.document("t", "")),
}


@pytest.mark.parametrize("name", OURS)
def test_what_we_write_is_known_and_what_others_write_is_not(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    assert files.check_ours(path) == path.resolve()  # there is nothing to lose
    path.write_bytes(b"somebody's work, two weeks of it")
    with pytest.raises(files.FileError, match=r"not written by this command; nothing was touched"):
        files.check_ours(path)
    files.check_ours(path, overwrite=True)
    OURS[name](path)
    files.check_ours(path)
    with pytest.raises(files.FileError, match=rf"{path.stem}-2\{path.suffix}, or --overwrite"):
        files.check_ours(path, "another mark")


def test_an_empty_file_and_a_table_by_its_header(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    path.touch()
    files.check_ours(path)
    evaluate.write_rows(path, [])
    files.check_ours(path, ",".join(EVAL_COLUMNS))


def refuse(draws: bool) -> None:
    raise AssertionError("the simulation was prepared before the refusal")


@pytest.mark.parametrize(
    ("name", "run"),
    [
        ("t.csv", lambda p: evaluate.main(["zero", "--task", "stand", "--out", str(p)])),
        ("f.png", lambda p: evaluate.main(["zero", "--task", "stand", "--figure", str(p)])),
        ("e.mp4", lambda p: render.main(
            ["zero", "--task", "stand", "--out", str(p.with_suffix(""))], lambda draws: None)),
        ("e.png", lambda p: render.main(
            ["zero", "--task", "stand", "--out", str(p.with_suffix(""))], lambda draws: None)),
        ("biped.mp4", lambda p: demo.main(["--out", str(p.parent)], lambda draws: None)),
        ("r.html", lambda p: report.main(["--out", str(p)])),
        ("b.json", lambda p: bench.main(["--out", str(p)])),
    ],
)  # fmt: skip
def test_commands_refuse_before_they_begin(
    name: str, run: Callable[[Path], Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / name
    path.write_text("mine")
    monkeypatch.setattr(bench, "run_parts", refuse)
    with pytest.raises(files.FileError, match=r"not written by this command"):
        run(path)
    assert path.read_text() == "mine"
    assert sorted(p.name for p in tmp_path.iterdir()) == [name]


@pytest.mark.slow
def test_figures_check_all_before_they_draw_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn = [plots.Drawing(n, "curves", "return", "mean", lambda theme: None) for n in "ab"]  # type: ignore[arg-type,return-value]
    monkeypatch.setattr(plots, "read_grids", lambda *_: {"g": (None, None)})
    monkeypatch.setattr(plots, "drawings", lambda *_: iter(drawn))
    monkeypatch.setattr(plots, "write_png", lambda figure, path: path)
    (tmp_path / "b.png").write_text("mine")
    with pytest.raises(files.FileError, match=r"b\.png is there"):
        figures.main(["--out", str(tmp_path)])
    assert (
        figures.main(["--out", str(tmp_path), "--overwrite", "--shown", str(tmp_path / "s")]) == 0
    )


@pytest.mark.parametrize("name", ["config.json", "source.json", "versions.json", "policy.npz"])
def test_a_run_does_not_begin_over_files_of_others(name: str, tmp_path: Path) -> None:
    config, run_dir = make_config("stand", "debug"), RunDir(tmp_path)
    assert isinstance(run_dir.status(config), New)
    (tmp_path / name).write_text('{"learning_rate": 3}')
    found = run_dir.status(config)
    assert isinstance(found, Foreign)
    assert name in str(found.error)
    assert "nothing was touched" in str(found.error)


def test_a_start_that_failed_is_begun_anew(tmp_path: Path) -> None:
    config, run_dir = make_config("stand", "debug"), RunDir(tmp_path)
    run_dir.open(make_config("biped", "debug"), {"origin": "a", "digest": "b"})
    assert isinstance(run_dir.status(config), New)
    assert config_json.to_json(config)
