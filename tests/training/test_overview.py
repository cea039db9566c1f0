"""Runs on disk: how they stand, where they differ, and what may be deleted of them."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from twirl_mjx.commands import runs as command
from twirl_mjx.commands.selection import selected, the_one
from twirl_mjx.machine import try_lock
from twirl_mjx.training import overview

COLUMNS = "run,task,shift,variant,seed"
METRICS = (
    f"{COLUMNS},metric,env_steps,grad_steps,wall_s,value\n"
    "a,biped,none,twirl,0,eval/return,100,10,5.0,12.5\n"
    "a,biped,none,twirl,0,eval/return,200,20,9.5,11\n"
    "a,biped,none,twirl,0,q_mean,300,30,14.5,400\n"
)
EPISODES = (
    f"{COLUMNS},env_steps,episode,metric,value\n"
    "a,biped,none,twirl,0,300,0,return,10\n"
    "a,biped,none,twirl,0,300,1,return,11\n"
    "a,biped,none,twirl,0,300,1,success,1\n"
)
POLICIES = ("policy.npz", "policy_last.npz")


def make_run(folder: Path, name: str, *, finished: bool = True, utd: float = 0.5) -> Path:
    path = folder / name
    (path / "checkpoints" / "300").mkdir(parents=True)
    (path / "checkpoints" / "300" / "replay").write_bytes(b"x" * 3000)
    (path / "source.npz").write_bytes(b"x" * 500)
    for policy in POLICIES:
        (path / policy).write_bytes(b"p" * 7)
    config = {
        "task": "biped", "variant": "twirl", "shift": "none", "seed": 0, "source": "auto",
        "total_env_steps": 300, "droq": {"utd": utd, "batch_size": 64},
    }  # fmt: skip
    (path / "config.json").write_text(json.dumps(config))
    (path / "metrics.csv").write_text(METRICS)
    if finished:
        (path / "eval.csv").write_text(EPISODES)
    return path


def test_a_finished_run(tmp_path: Path) -> None:
    run = overview.look(make_run(tmp_path, "a"))
    assert (run.name, run.state, run.env_steps, run.wall_s) == ("a", "finished", 300, 14.5)
    assert run.best_return == 12.5  # of the evaluations, above the closing 10.5
    assert run.measures == {"return": 10.5, "success": 1.0}
    assert run.setting("droq.utd") == 0.5
    assert run.setting("nothing") == "?"
    assert run.prunable == 3500
    assert run.size == 3500 + 14 + len(METRICS) + len(EPISODES) + os.path.getsize(
        tmp_path / "a" / "config.json"
    )


def test_a_finished_run_that_goes_on_is_not_finished(tmp_path: Path) -> None:
    path = make_run(tmp_path, "a")
    finished = overview.look(path)
    config = json.loads((path / "config.json").read_text())
    (path / "config.json").write_text(json.dumps(config | {"total_env_steps": 900}))
    longer = METRICS + "a,biped,none,twirl,0,q_mean,600,60,14.5,800\n"
    (path / "metrics.csv").write_text(longer)
    run = overview.look(path)
    assert (run.state, run.env_steps) == ("stopped", 600)
    for stale in (run, finished):
        with pytest.raises(ValueError, match="is stopped, and only finished runs are pruned"):
            overview.prune(stale)
    assert (path / "checkpoints").is_dir()
    zero_shot = config | {"total_env_steps": 900, "variant": "zero-shot"}
    (path / "config.json").write_text(json.dumps(zero_shot))
    assert overview.look(path).state == "finished"


def test_datasets_of_minari_are_no_condition() -> None:
    assert overview.condition("minari:biped-v0") is None
    assert overview.condition("task:biped") == ("task", "biped")


def test_states(tmp_path: Path) -> None:
    stopped = make_run(tmp_path, "stopped", finished=False)
    assert overview.look(stopped).state == "stopped"
    assert overview.look(stopped).env_steps == 300
    (stopped / "metrics.csv").write_text(METRICS + "a,biped,none,twirl,0,q_mean,400,4")
    assert overview.look(stopped).env_steps == 300  # the last row is being written
    with (stopped / ".lock").open("a+") as file:
        assert try_lock(file)
        assert overview.look(stopped).state == "running"
    assert overview.look(stopped).state == "stopped"
    (stopped / "config.json").write_text("{")
    damaged = overview.look(stopped)
    assert (damaged.state, damaged.setting("task")) == ("damaged", "?")
    empty = tmp_path / "empty"
    empty.mkdir()
    (empty / "config.json").write_text('{"task": "stand"}')
    assert overview.look(empty).state == "empty"


def test_names_patterns_and_paths(tmp_path: Path) -> None:
    a, b = make_run(tmp_path, "biped-a"), make_run(tmp_path, "stand-b")
    (tmp_path / "no-run").mkdir()
    assert overview.find(tmp_path) == [a, b]
    assert overview.find(tmp_path, ("stand-*", "biped-a", "*")) == [b, a]
    assert overview.find(tmp_path / "elsewhere", (str(a),)) == [a]
    with pytest.raises(FileNotFoundError, match=r"no run 'biped-x'.*nearest: 'biped-a'"):
        overview.find(tmp_path, ("biped-x",))


def test_conditions_narrow_and_hold_together(tmp_path: Path) -> None:
    a, b = make_run(tmp_path, "biped-a"), make_run(tmp_path, "biped-b", finished=False, utd=1.0)
    assert overview.find(tmp_path, ("task:biped",)) == [a, b]
    assert overview.find(tmp_path, ("status:finished", "seed:0")) == [a]
    assert overview.find(tmp_path, ("biped-*", "droq.utd:1.0")) == [b]
    assert overview.find(tmp_path, ("name:*-b", "status:finished")) == []
    assert overview.find(tmp_path / "none", ("task:biped",)) == []
    with pytest.raises(ValueError, match=r"condition on runs.*tsk.*nearest: 'task'"):
        overview.find(tmp_path, ("tsk:biped",))


def test_policies_keep_their_place_and_runs_become_paths(tmp_path: Path) -> None:
    a, b = (str(make_run(tmp_path, f"biped-{name}")) for name in "ab")
    file = str(tmp_path / "biped-a" / "policy.npz")
    same = ["zero", file, "my.py:walk", "NAME=stand.npz"]
    assert overview.expand(same, tmp_path) == same
    assert overview.expand(["zero", "biped-*", file], tmp_path) == ["zero", a, b, file]
    assert overview.expand(["biped-b", a], tmp_path) == [b, a]
    assert overview.expand(["seed:0", "zero"], tmp_path) == [a, b, "zero"]
    assert overview.expand(["biped-a"], tmp_path, but=("biped-a",)) == ["biped-a"]
    with pytest.raises(FileNotFoundError, match=r"no run in .* fits seed:1"):
        overview.expand(["zero", "seed:1"], tmp_path)


def test_where_one_policy_is_meant(tmp_path: Path) -> None:
    path = str(make_run(tmp_path, "trot"))
    make_run(tmp_path, "bipeds")
    assert the_one("trot", tmp_path) == "trot"  # a controller of that name goes before
    assert the_one("name:trot", tmp_path) == path
    assert the_one("nothing", tmp_path) == "nothing"  # the command says what it could be
    assert the_one("mine=bipeds", tmp_path) == f"mine={tmp_path / 'bipeds'}"
    assert the_one("mine=trot", tmp_path) == "mine=trot"
    named = ["old=name:trot", "new=bipeds", "zero=zero"]
    paths = (f"old={path}", f"new={tmp_path / 'bipeds'}", "zero=zero")
    assert selected(named, tmp_path) == paths
    with pytest.raises(ValueError, match=r"'\*' selects 2 runs, expected one"):
        the_one("mine=*", tmp_path)
    with pytest.raises(ValueError, match=r"'\*' selects 2 runs, expected one: bipeds, trot"):
        the_one("*", tmp_path)


def test_differences(tmp_path: Path) -> None:
    paths = make_run(tmp_path, "a"), make_run(tmp_path, "b", utd=1.0)
    found = [overview.look(path) for path in paths]
    assert overview.differences(found) == {"droq.utd": [0.5, 1.0]}


def test_prune_says_asks_and_keeps_policies(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    done, going = make_run(tmp_path, "done"), make_run(tmp_path, "going", finished=False)
    words = ["prune", "--runs", str(tmp_path)]
    assert command.main(words) == 0
    said = capsys.readouterr().out
    assert f"would delete checkpoints and source.npz of {done}: 4 kB" in said
    assert "nothing was deleted; --yes frees 4 kB" in said
    assert "going" not in said
    assert (done / "checkpoints" / "300" / "replay").exists()
    with pytest.raises(ValueError, match="going is stopped, and only finished runs are pruned"):
        command.main([*words, "going", "--yes"])
    assert command.main([*words, "--yes"]) == 0
    left = {path.name for path in done.iterdir()}
    assert left == {*POLICIES, "config.json", "metrics.csv", "eval.csv", ".lock"}
    assert (going / "checkpoints" / "300" / "replay").exists()
    capsys.readouterr()
    assert command.main(words) == 0
    assert "nothing to delete" in capsys.readouterr().out


def test_prune_leaves_runs_in_use_and_what_links_lead_to(tmp_path: Path) -> None:
    path, other = make_run(tmp_path, "a"), make_run(tmp_path, "b")
    with (path / ".lock").open("a+") as file:
        assert try_lock(file)
        with pytest.raises(ValueError, match="a is running"):
            overview.prune(overview.look(path))
    (path / "source.npz").unlink()
    (path / "source.npz").symlink_to(other / "policy.npz")
    overview.prune(overview.look(path))
    assert not (path / "source.npz").is_symlink()
    assert (other / "policy.npz").exists()


def test_list_sorts_and_filters(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make_run(tmp_path, "a")
    big = make_run(tmp_path, "b", finished=False)
    (big / "source.npz").write_bytes(b"x" * 9_000_000)
    os.utime(tmp_path / "a" / "config.json")

    def names(*words: str) -> list[str]:
        assert command.main([*words, "--runs", str(tmp_path), "--json"]) == 0
        return [row["name"] for row in json.loads(capsys.readouterr().out)]

    assert names("--sort", "size") == ["b", "a"]
    assert names("--sort", "status") == ["a", "b"]
    assert names("--status", "finished") == ["a"]
    assert names("status:finished", "task:biped") == ["a"]
    assert names("--seed", "1") == []
    assert names("--variant", "scratch") == []
    assert names("list", "b") == ["b"]
    assert command.main(["--runs", str(tmp_path), "--sort", "name"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].split()[:7] == ["a", "biped", "twirl", "finished", "0", "300", "12.5"]
    assert lines[-1] == "2 runs, 9 MB"


def test_show_and_compare(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make_run(tmp_path, "a")
    make_run(tmp_path, "b", utd=1.0)
    assert command.main(["show", "a", "--runs", str(tmp_path)]) == 0
    shown = capsys.readouterr().out
    for part in ("twirl, source auto", "300 of 300", "12.5", "closing success", "0:00 h"):
        assert part in shown
    assert command.main(["compare", "a", "b", "--runs", str(tmp_path)]) == 0
    rows = {
        line.split()[0]: line.split()[1:] for line in capsys.readouterr().out.splitlines() if line
    }
    assert rows["droq.utd"] == ["0.5", "1.0"]
    assert "droq.batch_size" not in rows
    with pytest.raises(ValueError, match="found 1 of the runs to compare"):
        command.main(["compare", "a", "--runs", str(tmp_path)])
    with pytest.raises(ValueError, match="'\\*' matches 2 runs, expected one: a, b"):
        command.main(["show", "*", "--runs", str(tmp_path)])


@pytest.mark.parametrize(
    ("count", "text"),
    [(755_000, "755 kB"), (12_300_000, "12 MB"), (812_000_000, "0.8 GB"), (2e12, "2.0 TB")],
)
def test_sizes(count: int, text: str) -> None:
    assert overview.size_text(count) == text


def test_ages() -> None:
    assert [overview.age(s) for s in (40, 300, 10_800, 1_036_800)] == [
        "40 s", "5 min", "3 h", "12 d",
    ]  # fmt: skip
