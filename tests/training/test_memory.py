"""Memory: what is needed is counted before it is allocated, and what does not fit is refused."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from twirl_mjx import cli, exits
from twirl_mjx.training import memory, state
from twirl_mjx.training.config import TrainConfig
from twirl_mjx.training.config_json import settle
from twirl_mjx.training.presets import make_config
from twirl_mjx.worlds.make import make_env

GB = 10**9


def config(**settings: Any) -> TrainConfig:
    flat = {name.replace("__", "."): value for name, value in settings.items()}
    return settle(make_config("stand", "debug"), flat)


def size_of(found: list[memory.Need], setting: str) -> int:
    return next(need.size for need in found if need.setting == setting)


def test_sizes_are_those_of_what_is_allocated() -> None:
    run = config()
    env = make_env(run)
    shapes = jax.eval_shape(lambda key: state.init(run, env, key, None), jax.random.key(0))
    found = memory.needs(run)
    ring = int(np.prod(shapes.replay.online.rows.shape)) * 4
    assert size_of(found, "replay.capacity") == memory.RING_COPIES * ring
    learner = sum(4 * int(np.prod(leaf.shape)) for leaf in jax.tree.leaves(shapes.learner))
    assert size_of(found, "droq.hidden_sizes") == memory.LEARNER_COPIES * learner
    assert "replay.source_size" not in {need.setting for need in found}  # from scratch
    twice = memory.needs(run, seeds=2)
    assert [need.size for need in twice] == [2 * need.size for need in found]
    assert memory.needs(make_config("biped", "debug"))[-1].setting == "replay.source_size"


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"replay__capacity": 10**8}, r"for replay\.capacity 100,000,000,"),
        ({"num_envs": 1_000_000, "replay__capacity": 1_000_000}, r"for num_envs 1,000,000,"),
        ({"eval__final_episodes": 1_000_000}, r"for eval\.final_episodes 1,000,000,"),
        ({"droq__hidden_sizes": (10**9, 10**9)}, r"for droq\.hidden_sizes 1000000000 1000000000,"),
        ({"droq__batch_size": 1_000_000}, r"for droq\.batch_size 1,000,000,"),
    ],
)
def test_what_does_not_fit_is_refused_with_the_nearest_that_does(
    settings: dict[str, Any], said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(memory, "room", lambda: (2 * GB, "this machine"))
    run = config(**settings)
    with pytest.raises(ValueError, match=rf"{said} and this machine has 2\.0 GB") as error:
        memory.check_run(run)
    assert re.match(
        r"[\d,.]+ [GM]B of memory are needed, [\d,.]+ [GM]B of them for", str(error.value)
    )
    found = re.search(r"\(nearest: (\S+) ([\d, ]+)\)$", str(error.value))
    assert found is not None
    numbers = tuple(int(word.replace(",", "")) for word in found[2].split())
    value = numbers if "hidden" in found[1] else numbers[0]
    memory.check_run(config(**settings | {found[1].replace(".", "__"): value}))


def test_what_no_single_setting_mends_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "room", lambda: (GB, "this machine"))
    run = config(replay__capacity=10**8, eval__final_episodes=1_000_000)
    with pytest.raises(ValueError, match=r"the other settings alone need \d+\.\d GB\)$"):
        memory.check_run(run)


@pytest.mark.parametrize(
    "argv",
    [
        ["train", "--task", "stand", "--preset", "debug", "--replay.capacity", "100000000"],
        ["collect", "--task", "biped", "--preset", "debug", "--replay.source-size", "100000000"],
        ["evaluate", "zero", "--task", "stand", "--episodes", "1000000"],
    ],
    ids=lambda argv: argv[0],
)
def test_commands_refuse_in_one_line_and_leave_nothing(
    argv: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(memory, "room", lambda: (8 * GB, "this machine"))
    assert cli.main(argv) == exits.UNUSABLE
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert "of memory are needed" in err
    assert "has 8.0 GB (nearest: " in err
    assert not list(tmp_path.iterdir())


def group(folder: Path, limit: str, used: str, names: tuple[str, str]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in zip(names, (limit, used), strict=True):
        (folder / name).write_text(f"{text}\n")


def test_limits_of_control_groups_count(tmp_path: Path) -> None:
    """Both versions, of the group itself and of those above it; ``max`` is none."""
    (tmp_path / "proc" / "self").mkdir(parents=True)
    told = tmp_path / "proc" / "self" / "cgroup"
    root = tmp_path / "sys" / "fs" / "cgroup"
    _, _, names = memory.GROUPS[0]
    group(root / "a" / "b", "max", "5", names)
    group(root / "a", "1000", "300", names)
    told.write_text("0::/a/b\n")
    assert list(memory._rooms_of_groups(str(tmp_path))) == [700]
    _, _, names = memory.GROUPS[1]
    group(root / "memory" / "c", "90", "50", names)
    group(root / "memory", "800", "100", names)
    told.write_text("9:name=systemd:/\n5:cpu,memory:/c\n")
    assert list(memory._rooms_of_groups(str(tmp_path))) == [40, 700]
    told.unlink()
    assert list(memory._rooms_of_groups(str(tmp_path))) == []


def test_a_limit_on_addresses_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    import resource

    import psutil

    there = memory.host_room()
    assert 0 < there <= psutil.virtual_memory().total
    monkeypatch.setattr(resource, "getrlimit", lambda kind: (1, 1))
    assert memory.host_room() == 0


def test_a_finished_run_needs_no_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from twirl_mjx.training import pipeline, rundir

    run = dataclasses.replace(config(), variant="scratch")
    run_dir = rundir.RunDir(tmp_path / "a")
    run_dir.open(run)
    episodes = np.arange(float(run.eval.final_episodes))
    run_dir.write_episodes(run, 96, {"return": episodes, "episode_length": episodes})
    monkeypatch.setattr(memory, "room", lambda: (0, "this machine"))
    said: list[str] = []
    pipeline.run(run, "debug", tmp_path, "a", said.append)
    assert said == [f"{run_dir} is finished"]
    with pytest.raises(ValueError, match="of memory are needed"):
        pipeline.run(run, "debug", tmp_path, "b", said.append)
