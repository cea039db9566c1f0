import dataclasses
import math

import pytest

from twirl_mjx.figures import summary, tables
from twirl_mjx.figures.facts import Facts, Measure


def rows(variant, values, *, task="biped", shift="none", metric="return", extra=()):
    for seed, value in enumerate(values):
        run = f"{task}-{shift}-{variant}-{seed}-{extra}"
        for steps, share in ((0, 0.0), (100, 1.0)):
            at = [steps, 20 * steps, steps / 2, share * value]
            yield [run, task, shift, variant, seed, metric, *at, *extra]


@pytest.fixture
def table_of(tmp_path, write):
    def make(*arms, columns=tables.CURVE_COLUMNS, notes=()):
        body = [row for arm in arms for row in arm]
        return tables.read_table(write(tmp_path / "arm.csv", columns, body, notes))

    return make


def test_summaries_by_hand(table_of):
    table = table_of(rows("scratch", [1, 2, 3]), rows("twirl", [4, 2, 6]), notes=["command: go"])
    scratch, twirl = summary.summarise(table, "return", {"variant": "scratch"})
    assert (twirl.label, scratch.label) == ("twirl", "scratch")
    assert (twirl.seeds, twirl.env_steps, twirl.grad_steps, twirl.wall_s) == (
        (0, 1, 2),
        100,
        2000,
        50,
    )
    assert twirl.runs == (4.0, 2.0, 6.0)
    assert (twirl.mean.estimate, twirl.mean.low, twirl.mean.high) == (4.0, 2.0, 6.0)
    assert (twirl.mean.over, twirl.robust.estimate) == ("runs", 4.0)
    assert twirl.commands == ("go",)
    assert twirl.ratio is not None
    assert twirl.ratio.estimate == 2.0
    assert twirl.better is not None
    assert twirl.better.estimate == pytest.approx((3 + 1.5 + 3) / 9)
    assert scratch.ratio is None
    assert (scratch.is_baseline, twirl.is_baseline) == (True, False)


def test_less_is_better_for_a_distance(table_of):
    near, far = (
        rows("twirl", [1, 1], metric="min_distance"),
        rows("scratch", [2, 2], metric="min_distance"),
    )
    facts = Facts(
        measures={"min_distance": Measure(smaller_is_better=True)}, baseline={"variant": "scratch"}
    )
    table = dataclasses.replace(table_of(near, far), facts=facts)
    twirl, far_off = cells = summary.summarise(table, "min_distance")
    assert summary.best(cells, facts.measure("min_distance")) == {("biped", "none"): twirl}
    assert summary.best(cells, Measure()) == {("biped", "none"): far_off}
    assert twirl.better is not None
    assert twirl.better.estimate == 1.0
    assert twirl.ratio is not None
    assert twirl.ratio.estimate == 0.5


def test_settings_are_cells_of_their_own(table_of):
    columns = [*tables.CURVE_COLUMNS, "phi"]
    table = table_of(
        rows("twirl", [2, 2], extra=(0.0,)), rows("twirl", [6, 6], extra=(0.5,)), columns=columns
    )
    none, half = summary.summarise(table, "return", {"phi": "0"})
    assert (none.label, half.label) == ("phi = 0", "phi = 0.5")
    assert none.ratio is None
    assert half.ratio is not None
    assert half.ratio.estimate == 3.0


def test_unstated_settings_are_left_out(table_of):
    columns = [*tables.CURVE_COLUMNS, "utd"]
    table = table_of(rows("source", [1, 2], extra=("",)), columns=columns)
    (source,) = summary.summarise(table, "return")
    assert source.label == "source"


def test_episode_summaries_count_episodes(tmp_path, write, episodes_of):
    body = [*episodes_of("biped", "icy", "twirl", 0), *episodes_of("biped", "icy", "twirl", 1)]
    table = tables.read_table(write(tmp_path / "e.csv", tables.EPISODE_COLUMNS, body))
    table = dataclasses.replace(table, facts=Facts(measures={"success": Measure(unit="share")}))
    (cell,) = summary.summarise(table, "success")
    assert (cell.samples, cell.seeds, cell.env_steps) == (24, (0, 1), 100_000)
    assert math.isnan(cell.wall_s)
    assert cell.robust == cell.mean
    assert cell.mean.over == "runs and episodes"
    assert cell.mean.low < cell.mean.estimate < cell.mean.high
    (alone,) = summary.summarise(tables.select(table, seed=0), "success")
    assert (alone.mean.over, alone.runs) == ("episodes", (alone.mean.estimate,))


def test_runs_can_be_summarised_side_by_side(table_of):
    table = table_of(rows("twirl", [1, 5]))
    assert [(s.label, s.mean.estimate) for s in summary.summarise(table, "return", by="run")] == [
        ("biped-none-twirl-0-()", 1.0),
        ("biped-none-twirl-1-()", 5.0),
    ]


def test_the_best_is_never_what_learns_nothing(table_of):
    arms = [
        *rows("twirl", [5, 5], shift="icy"),
        *rows("weights", [2, 2], shift="icy"),
        *rows("zero", [9, 9], shift="icy"),
        *rows("twirl", [9, 9], shift="gravity"),  # no rival, not compared
        *rows("zero", [1, 1], shift="gravity"),
    ]
    cells = summary.summarise(table_of(arms), "return", {"variant": "weights"})
    assert {k: s.label for k, s in summary.best(cells, Measure()).items()} == {
        ("biped", "icy"): "twirl"
    }
    zero = next(s for s in cells if s.label == "zero" and s.shift == "icy")
    assert zero.is_idle
    assert zero.ratio is not None
    assert zero.ratio.estimate == 4.5  # shown against the baseline like any other


def test_one_run_of_a_curve_has_no_interval(table_of):
    (cell,) = summary.summarise(table_of(rows("twirl", [5])), "return")
    assert cell.mean.over == ""
    assert math.isnan(cell.mean.low)


def test_a_policy_that_does_nothing_may_be_measured_under_several_settings(table_of):
    columns = (*tables.CURVE_COLUMNS, "course")
    table = table_of(
        rows("zero", [1], extra=("near",)), rows("zero", [3], extra=("far",)), columns=columns
    )
    found = {s.label: s.mean.estimate for s in summary.summarise(table, "return")}
    assert found == {"course = near": 1.0, "course = far": 3.0}
    assert all(s.is_idle for s in summary.summarise(table, "return"))
