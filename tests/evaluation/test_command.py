"""``twirl evaluate``: every name is good before the first episode, and no result is lost."""

from __future__ import annotations

import csv
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from twirl_mjx.commands import evaluate
from twirl_mjx.commands.render import config_of, name_of
from twirl_mjx.evaluation import shifts as scoring
from twirl_mjx.figures.tables import read_episodes
from twirl_mjx.files import FileError
from twirl_mjx.policies.learned import PolicyFileError, PolicyHeader, save_policy
from twirl_mjx.tasks.registry import TASKS
from twirl_mjx.training import rundir
from twirl_mjx.training.presets import make_config
from twirl_mjx.worlds.config import WorldConfig


def save(path: Path, task: str = "stand", **card: object) -> str:
    """Write a policy of no hidden layers that always answers zero; return its path."""
    layer = {"kernel": np.zeros((101, 12)), "bias": np.zeros(12)}
    header = PolicyHeader(task, 101, 12, 0.05, card=dict(card))
    return str(save_policy(path, {"mean": layer, "log_std": layer}, header))


def make_run(path: Path) -> Path:
    rundir.RunDir(path).open(make_config("stand", "debug"))
    save(path / "policy.npz")
    save(path / "policy_last.npz")
    return path


@pytest.fixture
def scored(monkeypatch: pytest.MonkeyPatch) -> list[WorldConfig]:
    """The configs that policies were scored under; nothing is simulated."""
    configs: list[WorldConfig] = []

    def score(config: WorldConfig, policy: object, *, shifts: Any, episodes: int, **_: object):
        configs.append(config)
        return {shift: {"return": np.arange(float(episodes))} for shift in shifts}

    monkeypatch.setattr(scoring, "evaluate_shifts", score)
    return configs


def run(out: Path, *words: str) -> list[dict[str, str]]:
    fixed = ["--out", str(out), "--shifts", "none", "--episodes", "2"]
    assert evaluate.main([*words, *fixed]) == 0
    return read(out)


def read(table: Path) -> list[dict[str, str]]:
    """Return the rows below the note that holds the command."""
    note, *lines = table.read_text().splitlines()
    assert note.startswith("# command: .venv/bin/twirl evaluate ")
    return list(csv.DictReader(lines))


def test_a_bad_name_is_found_before_anything_is_scored(
    scored: list[WorldConfig], tmp_path: Path
) -> None:
    out, good = tmp_path / "out" / "table.csv", save(tmp_path / "good.npz")
    with pytest.raises(FileNotFoundError, match="nowhere"):
        run(out, "trot", good, "nowhere.npz", "--task", "stand")
    (tmp_path / "foreign.npz").write_bytes(b"no archive")
    with pytest.raises(FileError, match="foreign"):
        run(out, good, str(tmp_path / "foreign.npz"))
    with pytest.raises(ValueError, match="option of task biped"):
        run(out, "trot", good, "--task", "stand", "--biped.goal-distance", "1")
    assert not scored
    assert not out.parent.exists()


def test_what_is_done_is_kept_when_a_later_policy_fails(
    scored: list[WorldConfig], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    score = scoring.evaluate_shifts

    def fail_later(config: WorldConfig, policy: Any, **words: Any) -> Any:
        if len(scored) == 2:
            raise RuntimeError("the third")
        return score(config, policy, **words)

    monkeypatch.setattr(scoring, "evaluate_shifts", fail_later)
    out = tmp_path / "table.csv"
    out.write_text("of yesterday")
    with pytest.raises(ValueError, match=r"not written by this command.*table-2\.csv"):
        run(out, "trot", "zero", "bound", "--task", "stand")
    assert out.read_text() == "of yesterday"
    with pytest.raises(RuntimeError, match="the third"):
        run(out, "trot", "zero", "bound", "--task", "stand", "--overwrite")
    rows = read(out)
    assert [row["run"] for row in rows] == ["trot", "trot", "zero", "zero"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["table.csv"]


def test_runs_have_the_names_of_their_directories(
    scored: list[WorldConfig], tmp_path: Path
) -> None:
    a, b = make_run(tmp_path / "a"), make_run(tmp_path / "biped-phi0.25-s0")
    words = [str(a / "policy.npz"), str(b), str(a / "policy_last.npz"), "trot"]
    rows = run(tmp_path / "table.csv", *words, "--task", "stand")
    names = list(dict.fromkeys(row["run"] for row in rows))
    assert names == ["a", "biped-phi0.25-s0", "a-policy_last", "trot"]
    assert len(rows) == 8


@pytest.mark.parametrize(("first", "second"), [("a", "a/policy.npz"), ("a", "c/a")])
def test_policies_that_the_table_cannot_tell_apart_are_refused(
    first: str, second: str, scored: list[WorldConfig], tmp_path: Path
) -> None:
    make_run(tmp_path / "a")
    make_run(tmp_path / "c" / "a")
    with pytest.raises(ValueError, match="would both be 'a' in"):
        run(tmp_path / "table.csv", str(tmp_path / first), str(tmp_path / second))
    assert not scored


def test_a_policy_is_given_a_name_and_a_table_columns(
    scored: list[WorldConfig], tmp_path: Path
) -> None:
    file = save(tmp_path / "stand.npz")
    out = tmp_path / "table.csv"
    words = [f"source={file}", f"again={file}", "zero", "--task", "stand"]
    rows = run(out, *words, "--setting", "gap=2.4", "course=near by")
    assert [row["run"] for row in rows] == ["source"] * 2 + ["again"] * 2 + ["zero"] * 2
    assert {(row["gap"], row["course"]) for row in rows} == {("2.4", "near by")}
    assert read_episodes(out).settings == ["gap", "course"]
    (tmp_path / "odd=name.npz").write_bytes(Path(file).read_bytes())
    assert run(out, str(tmp_path / "odd=name.npz"))[0]["run"] == "odd=name"
    assert len(scored) == 4


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["gap"], "not name=value"),
        (["2=4"], "not name=value"),
        (["seed=4"], "has a column seed already"),
        (["gap=1", "gap=2"], "has a column gap already"),
    ],
)
def test_a_column_that_is_none_is_refused(
    words: list[str], message: str, scored: list[WorldConfig], tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match=message):
        run(tmp_path / "table.csv", "zero", "--task", "stand", "--setting", *words)
    assert not scored


def test_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(make_run(tmp_path / "run.1"))
    for given in (".", "policy.npz", "../run.1", "../run.1/"):
        assert name_of(given) == "run.1"
    assert name_of("elsewhere/policy.npz") == "elsewhere"  # copied without its config
    assert name_of("shipped/biped.v2.npz") == "biped.v2"
    assert name_of("shipped/policy_kneeling.onnx") == "policy_kneeling"
    assert name_of("clip") == "clip"


def test_a_policy_file_is_scored_by_its_own_options(
    scored: list[WorldConfig], tmp_path: Path
) -> None:
    card = {"seed": 7, "env_steps": 64, "variant": "scratch"}
    for height in ("root", "front_feet"):
        path = save(tmp_path / f"{height}.npz", options={"height_of": height}, **card)
        rows = run(tmp_path / "table.csv", path)
        assert scored.pop().options.height_of == height
        told = {tuple(row[k] for k in ("variant", "seed", "env_steps")) for row in rows}
        assert told == {("scratch", "7", "64")}
    path = save(tmp_path / "root.npz", options={"height_of": "root"})
    assert config_of(path, "stand").options.height_of == "root"
    foreign = config_of(path, "biped")  # in another task the paper's options of that task
    assert foreign.options == make_config("biped").options
    assert foreign.robot == "a1"
    lost = save(tmp_path / "lost.npz", robot="lost.py:GO1")  # it is not shown on the A1 instead
    with pytest.raises(PolicyFileError, match=r"lost\.npz: .*lost\.py"):
        config_of(lost, "biped")


def test_a_policy_file_of_an_unknown_task_is_named(tmp_path: Path) -> None:
    path = save(tmp_path / "mine.npz", task="crawl")
    with pytest.raises(PolicyFileError, match=r"mine\.npz: unknown task 'crawl'"):
        config_of(path, None)


def test_tables_fit_into_80_columns(capsys: pytest.CaptureFixture[str]) -> None:
    names = ("clearances_mean", "min_distance", "episode_length", "standing_time")
    shifts = ("none", "bumpy", "icy", "weakened", "sloped", "gravity", "a_shift_of_my_own")
    values = {
        shift: {"return": np.arange(100.0)} | {name: np.full(100, 1234.5) for name in names}
        for shift in shifts
    }
    evaluate._print_table("runs/biped-twirl-cpu-s0 in biped", values)
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    assert not any("\u2026" in line for line in lines)  # nothing is cut
    heads = [word for line in lines for word in line.split() if word in shifts]
    assert heads == list(shifts)
    returns = [line.split()[1:] for line in lines if line.split()[:1] == ["return"]]
    intervals = [line for line in lines if "return 95 %" in line]
    means = [cell for row in returns if row[0] != "95" for cell in row]
    assert means == ["49.5"] * len(shifts)
    assert 2 * len(intervals) == len(returns)
    assert all(re.search(r"4[34]\.\d+, 5[45]\.\d+", line) for line in intervals)
    assert any("min_distance (median)" in line for line in lines)


def test_hurdles_are_led_by_hurdles(capsys: pytest.CaptureFixture[str]) -> None:
    found = {
        "return": np.array([10.0, 20.0]),
        "hurdles_passed": np.array([0.0, 4.0]),
        "clean_clearances": np.array([0.0, 3.0]),
        "fall": np.array([np.nan, np.nan]),
    }
    evaluate._print_table("hurdles", {"none": found}, TASKS.get("hurdles"))
    rows = [line.split() for line in capsys.readouterr().out.splitlines() if line.strip()]
    names = [row[0] for row in rows[3:]]
    assert names[:3] == ["hurdles_passed", "hurdles_passed", "single_flight"]
    cells = {row[0]: row[-1] for row in rows if len(row) == 2}
    assert cells["hurdles_passed"] == "2"
    assert cells["single_flight"] == "0.75"  # of the episode that passed any
    assert "fall" not in names
