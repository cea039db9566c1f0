"""A contest: who competes, who goes on, what it costs, and that it goes on where it was stopped."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from twirl_mjx import cli, files
from twirl_mjx.figures.decisions import DROPPED, Decision, ancestry, read_decisions
from twirl_mjx.figures.tree import contest_tree
from twirl_mjx.policies.learned import load_policy
from twirl_mjx.sweep import contest
from twirl_mjx.sweep.contest import Candidate, Contest, Rules, rungs_of, stages_of

RULES: dict[str, Any] = {
    "task": "biped", "preset": "debug", "seed": 0, "budget": 1200, "episodes": 4,
    "sources": (("zero", "zero"), ("trot", "trot")),
}  # fmt: skip


class Told(Contest):
    """A contest whose runs are worth what a table says, episode by episode."""

    worth: dict[str, list[float]] = {}
    """Part of a run's name -> its value in every judgement."""
    trained: list[tuple[str, int]]

    def _train(self, candidates: Sequence[Candidate]) -> set[str]:
        self.trained = getattr(self, "trained", [])
        self.trained += [(each.run, each.trained) for each in candidates]
        return {each.run for each in candidates if math.isnan(self._next(each.run))}

    def _measure(self, candidate: Candidate) -> np.ndarray:
        value = self._next(candidate.run)
        return np.array([value - 1.0, value + 1.0])

    def _next(self, run: str) -> float:
        part = next(part for part in self.worth if part in run)
        judged = sum(row.run == run for row in self.rows)
        return self.worth[part][min(judged, len(self.worth[part]) - 1)]

    def _judge_source(self, word: str, source: object) -> None:
        del word, source


def held(tmp_path: Path, worth: dict[str, list[float]], **rules: Any) -> tuple[Told, Candidate]:
    """Hold a contest in a folder; return it with its winner."""
    told = Told(Rules(**(RULES | rules)), tmp_path, "c", lambda _: None, math.inf)
    told.worth = worth
    return told, told.hold()


@pytest.mark.parametrize(
    ("count", "rungs"), [(1, [1]), (2, [2]), (3, [3, 2]), (4, [4, 2]), (6, [6, 3, 2])]
)
def test_half_of_the_candidates_go_on_until_one_is_left(count: int, rungs: list[int]) -> None:
    assert rungs_of(count) == rungs


def test_the_first_round_gets_half_of_the_budget_and_all_of_it_where_there_is_no_other() -> None:
    rules = Rules(**RULES)
    assert [rules.pot(n) for n in (1, 2, 3)] == [600, 300, 300]
    assert Rules(**(RULES | {"rounds": 1})).pot(1) == 1200


def test_every_rung_costs_the_same_and_the_best_is_trained_on(tmp_path: Path) -> None:
    worth = {"1-walk-from-trot": [3.0, 5.0, 6.0], "1-": [2.0, 1.0, 0.0], "2-": [3.0], "3-": [3.0]}
    told, winner = held(tmp_path, worth, sources=(("trot", "trot"), ("zero", "zero")))
    first = [row for row in told.rows if row.round == 1]
    # Four candidates: 300 / 4 = 75 each, then two with 300 / 2 = 150 more.
    assert [(row.rung, row.env_steps) for row in first] == [(1, 75)] * 4 + [(2, 225)] * 2
    assert told.spent <= 1200
    assert first[-1].spent == 600
    second = [row for row in told.rows if (row.round, row.rung) == (2, 1)]
    assert [row.run for row in second] == ["c-2-walk", "c-2-biped", "c-2-walk-on"]
    assert {row.source for row in second} == {"c-1-walk-from-trot"}
    # Three candidates in two rungs: 150 / 3 for each.
    assert [row.env_steps for row in second] == [50, 50, 50]
    assert ancestry(told.rows, winner.run)[0].run == "c-1-walk-from-trot"
    assert not [run for run, steps in told.trained if "1-walk-from-trot" in run and steps > 225]


def test_a_winner_is_the_source_of_the_next_round_and_the_line_of_descent_is_told(
    tmp_path: Path,
) -> None:
    worth = {"1-walk-from-zero": [4.0], "1-": [0.0], "2-biped": [9.0], "2-walk": [5.0], "3-": [1.0]}
    told, winner = held(tmp_path, worth)
    assert winner.run == "c-3-walk"
    line = [row.run for row in ancestry(told.rows, winner.run)]
    assert line == ["c-1-walk-from-zero", "c-2-biped", "c-3-walk"]
    handed_on = [*told.first(), *told.following(4, winner)]
    assert {each.config.eval.keep for each in handed_on} == {"last"}  # and judged
    text = told.summary(winner)
    assert "chain: zero -> walk (c-1-walk-from-zero) -> biped (c-2-biped) -> walk (c-3" in text
    assert "better before: c-2-biped, 9.0 " in text


def test_what_was_better_before_is_told(tmp_path: Path) -> None:
    told, winner = held(tmp_path, {"1-walk-from-zero": [8.0, 3.0], "1-": [0.0]}, rounds=1)
    assert "better before: c-1-walk-from-zero, 8.00 [7.00, 9.00] at 150" in told.summary(winner)


def test_a_smaller_value_is_better_where_the_measure_says_so(tmp_path: Path) -> None:
    worth = {"1-walk-from-trot": [0.5], "1-": [2.0], "2-": [3.0], "3-": [3.0]}
    told, winner = held(tmp_path, worth, measure="min_distance")
    assert ancestry(told.rows, winner.run)[0].run == "c-1-walk-from-trot"


def test_a_run_that_diverges_is_dropped_and_all_of_them_end_the_contest(tmp_path: Path) -> None:
    worth = {"1-walk-from-zero": [math.nan], "1-": [1.0], "2-": [0.0], "3-": [0.0]}
    told, winner = held(tmp_path / "a", worth)
    assert "walk-from-zero" not in winner.run
    assert [row.kept for row in told.rows if "walk-from-zero" in row.run] == [0]
    with pytest.raises(ValueError, match="all candidates of round 1 diverged"):
        held(tmp_path / "b", {"1-": [math.nan]})


def test_a_contest_goes_on_where_it_was_stopped(tmp_path: Path) -> None:
    worth = {"1-walk-from-trot": [3.0, 5.0, 6.0], "1-": [2.0, 1.0, 0.0], "2-": [3.0], "3-": [9.0]}
    whole, _ = held(tmp_path / "whole", worth)

    class Stopped(Told):
        def _train(self, candidates: Sequence[Candidate]) -> set[str]:
            if any(each.run.startswith("c-2") for each in candidates):
                raise KeyboardInterrupt
            return super()._train(candidates)

    stopped = Stopped(Rules(**RULES), tmp_path / "part", "c", lambda _: None, math.inf)
    stopped.worth = worth
    with pytest.raises(KeyboardInterrupt):
        stopped.hold()
    again, _ = held(tmp_path / "part", worth)
    assert again.rows == whole.rows
    assert stopped.trained + again.trained == whole.trained, "nothing was trained twice"
    table = [tmp_path / name / "c" / contest.DECISIONS for name in ("whole", "part")]
    assert table[0].read_text() == table[1].read_text()
    finished, winner = held(tmp_path / "part", worth)
    assert not [run for run, _ in getattr(finished, "trained", [])]
    assert winner.run == "c-3-walk"


def test_another_contest_of_that_name_is_refused(tmp_path: Path) -> None:
    held(tmp_path, {"c-": [1.0]}, rounds=1)
    before = (tmp_path / "c" / contest.DECISIONS).read_text()
    with pytest.raises(ValueError, match=r"budget 1200 \(here 1300\); rounds 1 \(here 3\)"):
        held(tmp_path, {"c-": [1.0]}, budget=1300)
    assert (tmp_path / "c" / contest.DECISIONS).read_text() == before


def test_damaged_decisions_are_refused_by_line(tmp_path: Path) -> None:
    held(tmp_path, {"c-": [1.0]}, rounds=1)
    table = tmp_path / "c" / contest.DECISIONS
    table.write_text(table.read_text().replace(",150,150,", ",many,150,"))
    with pytest.raises(files.FileError, match=r"decisions.csv: line 3: .*many"):
        held(tmp_path, {"c-": [1.0]}, rounds=1)


def test_fresh_networks_learn_as_the_preset_says_and_a_run_hands_over_its_own(
    tmp_path: Path,
) -> None:
    told = Told(Rules(**RULES), tmp_path, "c", lambda _: None, math.inf)
    walk = next(each for each in told.first() if each.stage == "walk")
    assert walk.config.variant == "twirl"
    assert walk.config.options.distance_weight == 4.0
    assert walk.config.episode_length == 200
    assert walk.config.droq == told.target.droq
    _, biped, on = told.following(2, walk)
    assert (biped.stage, biped.config.variant) == ("biped", "twirl+weights")
    assert biped.config.source == on.config.source == str(tmp_path / walk.run)
    assert biped.config.droq.target_entropy == -12.0
    assert (on.stage, on.config.variant, on.config.droq) == (
        "walk", "twirl+weights", told.target.droq,
    )  # fmt: skip
    assert on.config.options == walk.config.options
    third = told.following(3, biped)
    assert [each.stage for each in third] == ["walk", "biped"], "it has its stage's settings"


def test_stages_are_the_links_of_the_chain_in_the_target_task_or_the_task_itself() -> None:
    assert [stage.name for stage in stages_of("biped")] == ["walk", "biped"]
    assert [stage.name for stage in stages_of("hurdles")] == ["hurdles", "polish"]
    assert [(stage.name, stage.settings) for stage in stages_of("stand")] == [
        ("stand", {"task": "stand"})
    ]


def test_recorded_data_compete_without_acting(tmp_path: Path) -> None:
    told = Told(Rules(**RULES), tmp_path, "c", lambda _: None, math.inf)
    data = type("Recorded", (), {"data": object(), "policy": None})()
    Contest._judge_source(told, "clip", data)
    assert told.rows == []


def test_the_tree_has_a_line_for_every_run_and_a_cross_where_one_was_dropped(
    tmp_path: Path,
) -> None:
    worth = {"1-walk-from-zero": [4.0], "1-": [0.0], "2-biped": [9.0], "2-walk": [5.0], "3-": [1.0]}
    told, _ = held(tmp_path, worth)
    figure = contest_tree([Decision(0, 0, "", "", "zero", 0, 0, 0.5, 0.1, 1.0, -1), *told.rows],
                          told.told_measure, "Contest")  # fmt: skip
    axes = figure.axes[0]
    labels = [text.get_text() for text in axes.get_yticklabels()]
    pairs = [(source, stage) for source in ("zero", "trot") for stage in ("walk", "biped")]
    assert labels == [
        *(f"1: {stage} from {source}" for source, stage in pairs),
        "2: walk", "2: biped", "2: walk, as before", "3: walk", "3: biped",
    ]  # fmt: skip
    figure.draw_without_rendering()
    boxes = [text.get_window_extent() for text in axes.get_yticklabels()]
    heights = sorted((box.y0, box.y1) for box in boxes)
    assert all(below[1] <= above[0] for below, above in itertools.pairwise(heights)), "overlap"
    crosses = [line for line in axes.lines if line.get_marker() == "x"]
    assert len(crosses) == sum(row.kept == DROPPED for row in told.rows) == 6
    with pytest.raises(ValueError, match="no candidate"):
        contest_tree([], "goal", "Contest")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--budget", "100"], "--budget 100 would do nothing here (nearest: add --sources)"),
        (["--sources", "zero", "--shifts", "icy"], "--shifts icy would do nothing here"),
        (
            ["--sources", "zero", "zero"],
            "--sources zero zero names one twice (nearest: --sources zero)",
        ),
        (["--sources", "zero", "--measure", "walking"], "nearest: 'standing_time'"),
        (["--sources", "zero", "--rounds", "0"], "rounds = 0 is outside [1, 20] (nearest: 1)"),
        (
            ["--sources", "zero", "--episodes", "1"],
            "episodes = 1 is outside [2, 10000] (nearest: 2)",
        ),
        (["--sources", "zerro"], "nearest: 'zero'"),
        (["--sources", "no/such.npz"], "no/such.npz"),
        (["--sources", "zero", "--name", "a/b"], "nearest: 'b'"),
        (["--task", "imitate", "--sources", "imitate_fin"], "imitate_fin"),
    ],
)
def test_options_are_refused_in_a_line_and_nothing_is_written(
    options: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["curriculum", "--preset", "debug", "--runs", str(tmp_path / "runs"), *options]
    assert cli.main(command) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") <= 2
    assert not (tmp_path / "runs").exists()


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_contest_trains_judges_and_is_not_repeated(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = [
        "curriculum", "--target", "stand", "--preset", "debug", "--sources", "zero", "up=stand",
        "--budget", "1200", "--rounds", "2", "--episodes", "4", "--runs", str(tmp_path),
    ]  # fmt: skip
    assert cli.main(command) == 0
    told = capsys.readouterr().out
    assert "winner: " in told
    folder = tmp_path / "stand-contest-debug-s0"
    rows = read_decisions(folder / contest.DECISIONS)
    assert [row.run for row in rows if row.round == 0] == ["", ""]
    for run in {row.run for row in rows} - {""}:
        judged, last = (
            load_policy(tmp_path / run / name).header.card["env_steps"]
            for name in ("policy.npz", "policy_last.npz")
        )
        assert judged == last
    assert rows[-1].spent <= 1200
    assert (folder / "tree.png").stat().st_size > 5000
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("policy.npz")}
    assert cli.main(command) == 0
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("policy.npz")} == before
