"""Damaged, foreign and missing files of every kind: one clear line that names the file."""

from __future__ import annotations

import dataclasses
import json
import random
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from twirl_mjx import array_files, cli, exits
from twirl_mjx.assets import asset_path
from twirl_mjx.deploy.export import export_onnx
from twirl_mjx.figures.plots import make_figures
from twirl_mjx.figures.tables import CURVE_COLUMNS, TableError, read_table
from twirl_mjx.motion.formats import read_clip
from twirl_mjx.policies.learned import load_policy
from twirl_mjx.replay import dataset
from twirl_mjx.sweep import gather, plan
from twirl_mjx.training import config_json
from twirl_mjx.training.config import TrainConfig
from twirl_mjx.training.rundir import Foreign, RunDir
from twirl_mjx.training.sinks.table import truncate_csv

CURVE = "run,task,shift,variant,seed,metric,env_steps,grad_steps,wall_s,value\n"
EPISODE = "run,task,shift,variant,seed,env_steps,episode,metric,value\n"


def check_run(path: Path) -> None:
    (path.parent / "checkpoints" / "orbax" / "1").mkdir(parents=True, exist_ok=True)
    (path.parent / "config.json").exists() or (path.parent / "config.json").write_text(
        config_json.to_json(TrainConfig())
    )
    match RunDir(path.parent).status(TrainConfig(), {"origin": "o", "digest": "d"}):
        case Foreign(error):
            raise error


def curves(path: Path) -> None:
    (path.parent / "eval.csv").write_text(EPISODE + "a,b,c,d,0,1,0,return,1\n")
    gather.curve_rows(RunDir(path.parent))


READERS: dict[str, tuple[str, Callable[[Path], object]]] = {
    "policy": ("policy.npz", load_policy),
    "onnx": ("policy.onnx", load_policy),
    "clip": ("clip.json", read_clip),
    "config": ("config.json", lambda path: RunDir(path.parent).read_config()),
    "resumed config": ("config.json", check_run),
    "source": ("source.json", check_run),
    "evaluation": ("eval.csv", lambda path: RunDir(path.parent).finished()),
    "steps": ("eval.csv", lambda path: plan.evaluated_steps(path.parent)),
    "episodes": ("eval.csv", lambda path: gather.episode_rows(RunDir(path.parent))),
    "curves": ("metrics.csv", curves),
    "resumed metrics": ("metrics.csv", lambda path: truncate_csv(path, 10)),
    "table": ("table.csv", read_table),
}
GROWS = ("resumed metrics",)
"""Tables in which a row without its end is no fault."""
DAMAGE = {
    "bytes": b"\xff\xfe\x00garbage",
    "a foreign text": b"hello\nworld\n",
    "a null": b"null",
    "a list": b"[1, 2]",
    "numbers that are none": (CURVE + "a,b,c,d,0,return,x,y,z,w\n").encode(),
    "half a row": (EPISODE + "a,b,c\n").encode(),
    "deep brackets": b"[" * 100_000,
}


@pytest.mark.parametrize("damage", DAMAGE)
@pytest.mark.parametrize("kind", READERS)
def test_damage_is_named(kind: str, damage: str, tmp_path: Path) -> None:
    name, read = READERS[kind]
    path = tmp_path / "a" / name
    path.parent.mkdir()
    path.write_bytes(DAMAGE[damage] + b"\n" * (kind in GROWS))
    before = path.read_bytes()
    with pytest.raises(ValueError, match="/a/") as error:
        read(path)
    assert str(path) in str(error.value)
    assert path.read_bytes() == before


@pytest.mark.parametrize("kind", READERS)
def test_nodes_are_refused_at_once(kind: str, tmp_path: Path) -> None:
    """``/dev/zero`` has no end; an evaluation or a table that is none counts as none."""
    name, read = READERS[kind]
    path = tmp_path / "a" / name
    path.parent.mkdir()
    path.symlink_to("/dev/zero")
    if kind in ("evaluation", "steps", "curves"):
        assert read(path) is None
        return
    with pytest.raises((ValueError, FileNotFoundError), match="is a device"):
        read(path)


def test_byte_order_marks_are_no_fault(tmp_path: Path) -> None:
    path = tmp_path / "clip.json"
    path.write_bytes(b"\xef\xbb\xbf" + asset_path("a1", "leap.json").read_bytes())
    assert read_clip(path).num_frames == read_clip(asset_path("a1", "leap.json")).num_frames
    path = tmp_path / "t.csv"
    path.write_text(CURVE + "a,b,c,d,0,return,1,2,3,4\n", encoding="utf-8-sig")
    assert read_table(path)["value"].tolist() == [4.0]


@pytest.mark.parametrize("name", ["policy.npz", "policy.onnx", "clip.json", "t.csv"])
def test_flips_and_cuts(name: str, tmp_path: Path) -> None:
    """60 damaged copies of a good file: read, or refused by name; nothing else."""
    path = tmp_path / name
    readers: dict[str, Callable[[Path], object]] = {
        "clip.json": read_clip, "t.csv": read_table,
    }  # fmt: skip
    if name == "policy.onnx":
        export_onnx(asset_path("policies", "stand.npz"), path)
    elif name == "policy.npz":
        shutil.copy(asset_path("policies", "stand.npz"), path)
    elif name == "clip.json":
        shutil.copy(asset_path("a1", "leap.json"), path)
    else:
        path.write_text("# reduced: x\n" + CURVE + "a,b,c,d,0,return,1,2,3,4\n" * 20)
    whole = path.read_bytes()
    rng = random.Random(name)
    for number in range(60):
        damaged = bytearray(whole)
        for _ in range(rng.randrange(1, 5)):
            damaged[rng.randrange(len(whole))] = rng.randrange(256)
        path.write_bytes(damaged[: rng.randrange(len(whole))] if number % 2 else damaged)
        try:
            readers.get(name, load_policy)(path)
        except ValueError as error:
            assert str(path) in str(error)


def test_tables_with_odd_cells(tmp_path: Path) -> None:
    for text, message in (
        (CURVE + "a,b,c,d,1e30,return,1,2,3,4\n", "seed is '1e30', expected a whole number"),
        (CURVE + "a,b,c,d,0,return,1,2,3," + "4" * 200_000, "field larger than"),
    ):
        path = tmp_path / "t.csv"
        path.write_text(text)
        with pytest.raises(TableError, match=rf"t\.csv.*{message}"):
            read_table(path)


def test_mathematics_in_tables_is_drawn_as_text(tmp_path: Path) -> None:
    """``$\\frac{a$`` in a cell or a note would end in matplotlib's parser."""
    odd = "$\\frac{a$"
    rows = [f"{odd},biped,none,twirl,0,return,{s},1,1,{s}\n" for s in (0, 10, 20)]
    folder = tmp_path / "results" / "tasks"
    folder.mkdir(parents=True)
    text = ",".join(CURVE_COLUMNS) + "\n" + "".join(rows)
    (folder / f"biped-{odd.replace('/', '')}.csv").write_text(f"# reduced: {odd}\n{text}")
    assert make_figures(tmp_path / "results", tmp_path / "out")


# ---- command lines


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["evaluate", "trot", "--task", "stand", "--shifts"], "--shifts needs a condition"),
        (["evaluate", "trot", "--task", "stand", "--seed", str(2**63)], "seed = 922"),
        (["demo", "--no-film", "--seed", str(2**63)], "seed = 922"),
        (["rehearse", "zero", "--seed", "-1"], "seed = -1"),
        (["evaluate", "trot", "--task", "stand", "--out", "node"], "node is a device and would"),
        (["evaluate", "node", "--task", "stand"], "node"),
        (["evaluate", "zero.onnx", "--task", "stand"], "zero.onnx is a device, expected an ONNX"),
        (["train", "--task", "imitate", "--preset", "debug", "--imitate.clip", "node"],
         "node is a device, expected a clip"),
        (["train", "--task", "imitate", "--preset", "debug", "--imitate.clip", "fifo"],
         "fifo is a FIFO, expected a clip"),
        (["train", "--task", "imitate", "--preset", "debug", "--imitate.clip", "n" * 300],
         "File name too long"),
        (["train", "--task", "imitate", "--preset", "debug", "--imitate.clip", "loop"],
         "loop: Too many levels of symbolic links"),
        (["export", "stand.npz", "--out", "node.onnx"], "node.onnx is a device and would be"),
        (["export", "fifo.npz"], "fifo.npz is a FIFO, expected a policy"),
        (["clip", "make", "--out", "node"], "node is a device and would be replaced"),
        (["sweep", "bad.py", "--dry-run"], "bad.py: no grid: SyntaxError"),
        (["bench", "--page", "fifo"], "fifo is a FIFO, expected a page"),
    ],
)  # fmt: skip
def test_bad_paths_and_numbers_are_one_line(
    argv: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    import os

    monkeypatch.chdir(tmp_path)
    shutil.copy(asset_path("policies", "stand.npz"), "stand.npz")
    for name in ("node", "zero.onnx", "node.onnx"):
        Path(name).symlink_to("/dev/zero")
    for name in ("fifo", "fifo.npz"):
        os.mkfifo(name)
    Path("loop").symlink_to("loop")
    Path("bad.py").write_text("GRID = (\n")
    before = sorted(tmp_path.iterdir())
    assert cli.main(argv) == exits.UNUSABLE
    err = capsys.readouterr().err
    assert err.startswith(f"twirl {argv[0]}: ")
    assert message in err
    assert err.count("\n") == 1
    assert sorted(tmp_path.iterdir()) == before
    assert np.lib  # numpy was imported before the working directory changed


@pytest.mark.parametrize(
    ("value", "message"),
    [(np.float64(1e300), "not finite"), (np.complex64(1j), "need .*numbers")],
)
def test_numbers_that_float32_cannot_hold_are_refused(
    value: Any, message: str, tmp_path: Path
) -> None:
    """1e300 became infinite on its way into the ring, after the check."""
    path = tmp_path / "a.npz"
    arrays = array_files.read_npz(asset_path("policies", "stand.npz"), "a policy")
    bias = np.full(arrays["hidden_0/bias"].shape, value)
    array_files.write_npz(path, arrays | {"hidden_0/bias": bias})
    with pytest.raises(ValueError, match=rf"a\.npz.*hidden_0/bias .*{message}"):
        load_policy(path)
    header = dataset.DatasetHeader("stand", "none", "zero", 1, 2, 1, 0.0)
    data = {"obs": np.full((1, 2), value), "action": np.zeros((1, 1)), "reward": np.zeros(1)}
    data |= {"terminated": np.zeros(1, bool), "next_obs": np.zeros((1, 2))}
    text = json.dumps(dataclasses.asdict(header))
    array_files.write_npz(path, {"header": np.array(text)} | data)
    with pytest.raises(ValueError, match=rf"a\.npz: obs .*{message}"):
        dataset.read(path, task="stand", observation_size=2, action_size=1)


def test_names_out_of_a_file_cannot_break_the_line(tmp_path: Path) -> None:
    """Keys and fields with line breaks, found by the fuzzer."""
    clip = json.loads(asset_path("a1", "leap.json").read_text())
    clip["Order\n\x13\u2028é"] = clip.pop("Frames")
    (tmp_path / "a.json").write_text(json.dumps(clip))
    with pytest.raises(ValueError, match="key Frames is missing") as refused:
        read_clip(tmp_path / "a.json")
    assert str(refused.value).isprintable()
    assert r"Order\n\x13\u2028é" in str(refused.value)
    header = dataclasses.asdict(dataset.DatasetHeader("t", "none", "s", 1, 2, 2, 0.0))
    record = {"format": dataset.FORMAT, "version": dataset.VERSION, **header, "a\n\x82": 1}
    np.savez(tmp_path / "a.npz", header=np.array(json.dumps(record)))
    with pytest.raises(dataset.DatasetError, match="the header has wrong fields") as refused:
        dataset.read(tmp_path / "a.npz", task="t", observation_size=2, action_size=2)
    assert str(refused.value).isprintable()
