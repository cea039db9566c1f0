import math

import pytest

from twirl_mjx.figures import summary, tables
from twirl_mjx.figures.tables import TableError


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
    twirl, scratch = summary.summarise(table, "return", {"variant": "scratch"})
    assert (twirl.variant, scratch.variant) == ("twirl", "scratch")
    assert (twirl.seeds, twirl.env_steps, twirl.grad_steps, twirl.wall_s) == (
        (0, 1, 2),
        100,
        2000,
        50,
    )
    assert (twirl.mean, twirl.std, twirl.robust.estimate) == (4.0, 2.0, 4.0)
    assert twirl.commands == ("go",)
    assert twirl.ratio is not None
    assert twirl.ratio.estimate == 2.0
    assert twirl.better is not None
    assert twirl.better.estimate == pytest.approx((3 + 1.5 + 3) / 9)
    assert scratch.ratio is None
    assert scratch.matches({"variant": "scratch"})
    assert not twirl.matches({"variant": "scratch"})


def test_less_is_better_for_a_distance(table_of):
    near, far = (
        rows("twirl", [1, 1], metric="min_distance"),
        rows("scratch", [2, 2], metric="min_distance"),
    )
    twirl, _ = summary.summarise(table_of(near, far), "min_distance", {"variant": "scratch"})
    assert twirl.better is not None
    assert twirl.better.estimate == 1.0
    assert twirl.ratio is not None
    assert twirl.ratio.estimate == 0.5


def test_settings_are_cells_of_their_own(table_of):
    columns = [*tables.CURVE_COLUMNS, "phi"]
    table = table_of(
        rows("twirl", [2, 2], extra=(0.0,)), rows("twirl", [6, 6], extra=(0.5,)), columns=columns
    )
    none, half = summary.summarise(table, "return", summary.baseline_of("phi_small"))
    assert (none.label, half.label) == ("twirl, phi 0", "twirl, phi 0.5")
    assert none.ratio is None
    assert half.ratio is not None
    assert half.ratio.estimate == 3.0


def test_unstated_settings_are_left_out(table_of):
    columns = [*tables.CURVE_COLUMNS, "utd"]
    table = table_of(rows("source", [1, 2], extra=("",)), columns=columns)
    (source,) = summary.summarise(table, "return")
    assert source.settings == {}
    assert source.label == "source"


def test_episode_summaries_count_episodes(tmp_path, write, episodes_of):
    body = [*episodes_of("biped", "icy", "twirl", 0), *episodes_of("biped", "icy", "twirl", 1)]
    table = tables.read_table(write(tmp_path / "e.csv", tables.EPISODE_COLUMNS, body))
    (cell,) = summary.summarise(table, "success")
    assert (cell.samples, cell.seeds, cell.env_steps) == (24, (0, 1), 100_000)
    assert math.isnan(cell.wall_s)
    assert cell.robust.estimate == cell.mean
    assert cell.robust.low < cell.mean < cell.robust.high


def test_runs_can_be_summarised_side_by_side(table_of):
    table = table_of(rows("twirl", [1, 5]))
    assert [(s.variant, s.mean) for s in summary.summarise(table, "return", by="run")] == [
        ("biped-none-twirl-0-()", 1.0),
        ("biped-none-twirl-1-()", 5.0),
    ]


def test_shift_wins_counts_cells_that_hold_all_rivals(table_of):
    variants = ("twirl", "twirl+weights", "weights", "zero-shot")
    levels = {
        "icy": (5, 1, 2, 3),  # won by twirl
        "sloped": (1, 4, 2, 3),  # won by twirl+weights
        "bumpy": (1, 1, 2, 3),  # lost to both
        "weakened": (2.5, 1, 2, 3),  # lost to one of them
    }
    arms = [
        rows(variant, [level, level], shift=shift)
        for shift, values in levels.items()
        for variant, level in zip(variants, values, strict=True)
    ]
    arms.append(rows("twirl", [9, 9], shift="gravity"))  # no rival, not compared
    assert summary.shift_wins(summary.summarise(table_of(*arms), "return")) == (2, 4)


def test_main_metric_is_what_all_runs_report(table_of):
    both = [*rows("twirl", [1], metric="eval/return"), *rows("twirl", [1])]
    assert summary.main_metric(table_of(both)) == "eval/return"
    assert summary.main_metric(table_of(both, rows("scratch", [1]))) == "return"
    with pytest.raises(
        TableError, match=r"run 'biped-none-weights-0-.*' has neither 'eval/return'"
    ):
        summary.main_metric(table_of(both, rows("weights", [1], metric="q")))


def test_shown_metrics_share_the_prefix_of_the_main_one(table_of):
    names = ["eval/return", "eval/success", "return", "standing_time", "q"]
    table = table_of(*(rows("twirl", [1], metric=name) for name in names))
    assert summary.shown_metrics(table, "eval/return") == ["eval/return", "eval/success"]
    assert summary.shown_metrics(table, "return") == ["return", "standing_time"]


def test_the_kind_of_a_grid_is_its_first_word():
    assert [summary.grid_kind(n) for n in ("phi", "phi_cpu", "shifts-small")] == [
        "phi",
        "phi",
        "shifts",
    ]
    assert summary.baseline_of("mine") == {}
