"""Chains of runs: every link starts from the one before it, and a chain goes on where it ended."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from twirl_mjx import cli
from twirl_mjx.commands.curriculum import CurriculumOptions, chain_of, plan
from twirl_mjx.sim.leaves import PAPER_SHIFTS
from twirl_mjx.training import rundir
from twirl_mjx.training.presets import make_config


@pytest.mark.parametrize("task", ["biped", "hurdles"])
@pytest.mark.parametrize("preset", ["paper", "cpu", "debug"])
def test_every_link_starts_from_the_one_before_and_shifts_from_the_target(
    task: str, preset: str
) -> None:
    links = plan(CurriculumOptions(task=task, seed=3, runs=Path("r")), preset)  # type: ignore[arg-type]
    names, configs = zip(*links, strict=True)
    own = len(chain_of(task))
    assert len(set(names)) == len(names) == own + 5
    assert names[0] == rundir.default_name(configs[0], preset)
    assert configs[0].source == make_config(configs[0].task, preset).source
    for name, config in zip(names[: own - 1], configs[1:own], strict=True):
        assert config.source == f"r/{name}"
    target = configs[own - 1]
    plain = make_config(task, preset)
    wider = {"max_gap": 3.7} if task == "hurdles" else {}
    assert target.task == task
    assert target.options == dataclasses.replace(plain.options, **wider)
    assert [config.shift for config in configs[own:]] == list(PAPER_SHIFTS)[1:]
    assert {config.source for config in configs[own:]} == {f"r/{names[own - 1]}"}
    assert all(config.total_env_steps <= 100_000 for config in configs[own:])
    assert {config.seed for config in configs} == {3}


def test_links_from_another_source_have_another_name() -> None:
    def links(source: str) -> list[tuple[str, str]]:
        options = CurriculumOptions(source=source, shifts=("icy", "gravity"), runs=Path("r"))
        return [(name, config.source) for name, config in plan(options, "cpu")]

    (target, _), *shifts = links("trot")
    assert target.startswith("biped-twirl-cpu-s0-")
    assert shifts == [(f"{target}-{shift}", f"r/{target}") for shift in ("icy", "gravity")]
    own = {name for source in ("", "trot", "bound") for name, _ in links(source)}
    assert len(own) == len(links("")) + 3 + 3


def test_walk_has_an_easier_reward_and_biped_the_paper_s() -> None:
    links = plan(CurriculumOptions(shifts=()), "cpu")
    _, (_, walk), (_, biped) = links
    assert (walk.options.distance_reward, walk.options.distance_weight) == ("speed", 4.0)
    assert (biped.options.distance_reward, biped.options.distance_weight) == ("nearer", 1.0)
    assert walk.droq.target_entropy == biped.droq.target_entropy == -12.0
    assert walk.droq.learning_rate == pytest.approx(3 * biped.droq.learning_rate)


def test_a_task_without_a_chain_of_its_own_follows_its_sources() -> None:
    assert [link.name for link in chain_of("imitate")] == ["imitate"]
    assert [link.settings["task"] for link in chain_of("stand")] == ["stand"]


def test_unknown_shift_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["curriculum", "--preset", "debug", "--shifts", "icey"]) == 2
    assert "nearest: 'icy'" in capsys.readouterr().err


def test_a_shift_given_twice_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["curriculum", "--preset", "debug", "--shifts", "icy", "none", "icy"]) == 2
    assert "names one twice (nearest: --shifts icy none)" in capsys.readouterr().err


def test_a_link_that_cannot_adapt_is_refused_before_the_first(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = ["--runs", str(tmp_path)]
    assert cli.main(["curriculum", "--task", "stand", "--preset", "debug", *folder]) == 2
    assert "variant scratch uses no source" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_chain_runs_and_is_not_repeated(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["curriculum", "--preset", "debug", "--shifts", "icy", "--runs", str(tmp_path)]
    assert cli.main(command) == 0
    names = [name for name, _ in plan(CurriculumOptions(shifts=("icy",), runs=tmp_path), "debug")]
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(names)
    source = rundir.RunDir(tmp_path / "biped-icy-chain-debug-s0").read_source()
    assert source is not None
    assert source["origin"] == str(tmp_path / "biped-chain-debug-s0")
    capsys.readouterr()
    assert cli.main(command) == 0
    assert "".join(capsys.readouterr()).count("is finished") == len(names)
