import dataclasses

import numpy as np
import pytest

from twirl_mjx.figures import aggregate, cells, tables
from twirl_mjx.figures.aggregate import Series
from twirl_mjx.figures.bars import shift_bars
from twirl_mjx.figures.curves import learning_curves
from twirl_mjx.figures.errors import TableError
from twirl_mjx.figures.facts import Axis, Facts, Measure
from twirl_mjx.figures.summary import summarise


def row(
    run, seed, env_steps, value, *, task="biped", shift="icy", variant="twirl", metric="return"
):
    return [run, task, shift, variant, seed, metric, env_steps, 0, 0.0, value]


@pytest.fixture
def table_of(tmp_path, write):
    def make(rows, columns=tables.CURVE_COLUMNS):
        return tables.read_table(write(tmp_path / "arm.csv", columns, rows))

    return make


def series(steps, values, seed=0):
    return Series(f"r{seed}", seed, np.array(steps), np.array(values, float))


def test_step_hold_keeps_the_last_value():
    held = aggregate.step_hold(series([10, 20], [1, 5]), np.array([9, 10, 19, 20, 99]))
    np.testing.assert_array_equal(held, [np.nan, 1, 1, 5, 5])


def test_common_axis_is_where_every_run_lives():
    runs = [series([0, 10, 20, 30], [0] * 4), series([5, 15, 25], [0] * 3, 1)]
    assert aggregate.common_axis(runs).tolist() == [5, 10, 15, 20, 25]
    assert aggregate.common_axis(runs, points=3).tolist() == [5, 15, 25]


def test_curves_by_hand():
    runs = [series([0, 10], [1, 3]), series([0, 10], [3, 9], 1)]
    mean = aggregate.curve(runs, "mean")
    np.testing.assert_array_equal(mean.centre, [2, 6])
    np.testing.assert_allclose(mean.high - mean.centre, [np.sqrt(2), np.sqrt(18)])
    iqm = aggregate.curve(runs, "iqm")
    np.testing.assert_array_equal([iqm.centre, iqm.low, iqm.high], [[2, 6], [1, 3], [3, 9]])
    with pytest.raises(ValueError, match=r"no statistic 'iqr': .*nearest: 'iqm'"):
        aggregate.curve(runs, "iqr")


def test_groups_follow_the_order_of_figures(table_of):
    names = ["source", "weights", "other", "twirl"]
    table = table_of([row(n, 0, 0, 1.0, variant=n) for n in names])
    assert [key[0] for key in cells.groups(table, ["variant"])] == names
    listed = dataclasses.replace(
        table, facts=Facts(axes={"variant": Axis(order=("twirl", "absent", "source"))})
    )
    order = [key[0] for key in cells.groups(listed, ["variant"])]
    assert order == ["twirl", "source", "weights", "other"]


def test_a_label_holds_what_tells_arms_apart(tmp_path, write):
    columns = [*tables.CURVE_COLUMNS, "tau", "size"]
    pairs = [("10", "small"), ("9", "small"), ("9", "big")]
    rows = [[*row(f"r{i}", 0, 5, 1.0), *cell] for i, cell in enumerate(pairs)]
    rows += [[*row("z", 0, 0, 1.0, variant="zero-shot"), "", ""]]
    rows += [[*row("zero", 0, 7, 1.0, variant="scripted"), "", ""]]
    table = tables.read_table(write(tmp_path / "a.csv", columns, rows))
    assert table.settings == ["tau", "size"]
    labelled = cells.labelled(table)
    assert cells.ordered(labelled, "label") == [
        "tau = 9, size = small",
        "tau = 9, size = big",
        "tau = 10, size = small",
        "zero-shot",
        "zero",
    ]
    assert cells.is_idle(table).tolist() == [False] * 4 + [True]
    assert labelled.settings == ["tau", "size"]
    # With two variants of which one has settings, the variant is said too.
    more = [*rows, [*row("w", 0, 5, 1.0, variant="weights"), "9", "big"]]
    table = cells.labelled(tables.read_table(write(tmp_path / "b.csv", columns, more)))
    names = cells.ordered(table, "label")
    assert {"weights, tau = 9, size = big", "twirl, tau = 9, size = big"} <= set(names)


def test_runs_are_sorted_and_repeated_rows_dropped(table_of):
    table = table_of([row("a", 0, 20, 2.0), row("a", 0, 10, 1.0), row("a", 0, 20, 2.0)])
    (run,) = aggregate.run_series(table)
    assert run.env_steps.tolist() == [10, 20]
    assert run.values.tolist() == [1.0, 2.0]


def test_contradictions_are_refused(table_of):
    twice = table_of([row("a", 0, 20, 2.0), row("a", 0, 20, 3.0)])
    with pytest.raises(TableError, match=r"'a' has two values of 'return' at 20 .*, 2 and 3"):
        aggregate.run_series(twice)
    clones = table_of([row("a", 0, 20, 2.0), row("b", 0, 20, 3.0)])
    with pytest.raises(TableError, match="runs 'a' and 'b' are the same cell with seed 0"):
        aggregate.run_series(clones)


def test_values_are_compared_where_every_trained_run_has_been(table_of):
    table = table_of(
        [
            *(row("long", 0, s, s / 10) for s in (0, 100, 200)),
            *(row("short", 1, s, -s / 10) for s in (0, 100)),
            row("untrained", 0, 0, 7.0, variant="zero-shot"),
            row("source", 0, 50, 7.0, variant="scripted"),
        ]
    )
    assert aggregate.common_end(table) == {("biped", "icy"): 100}
    twirl = aggregate.run_series(tables.select(table, variant="twirl"))
    assert aggregate.final_values(twirl, 100).tolist() == [10.0, -10.0]
    late = [series([150], [1.0])]
    with pytest.raises(TableError, match="run 'r0' is first measured at 150 transitions"):
        aggregate.final_values(late, 100)


def test_a_measure_that_is_seldom_defined_is_drawn_and_summarised(table_of):
    """Hurdles passed in a single flight, by runs that hardly ever pass one."""
    rows = [
        *(row(r, k, s, 1.0) for k, r in enumerate("abc") for s in (50, 100)),
        row("a", 0, 50, 0.5, metric="share"),
        row("b", 1, 100, 0.5, metric="share"),
    ]
    table = table_of(rows)
    shares = aggregate.run_series(tables.select(table, metric="share"))
    for statistic in ("mean", "iqm"):
        assert aggregate.curve(shares, statistic).centre.shape == (0,)  # they do not overlap
        assert learning_curves(table, "share", statistic=statistic)
    (found,) = summarise(table, "share")
    assert (found.runs, found.seeds, found.env_steps) == ((0.5, 0.5), (0, 1), 100)
    assert shift_bars(table, "share", statistic="iqm")


def test_unmeasured_rows_are_left_out(table_of):
    table = table_of([row("a", 0, 10, "nan"), row("a", 0, 20, 2.0)])
    assert len(aggregate.metric_rows(table, "return")) == 1
    with pytest.raises(TableError, match="metric 'return' is NaN in every row"):
        aggregate.metric_rows(table_of([row("a", 0, 10, "nan")]), "return")


def test_episodes_are_those_per_run_of_the_longest_trained_policy(tmp_path, write):
    def episode(run, seed, age, number, value):
        return [run, "biped", "icy", "twirl", seed, age, number, "return", value]

    rows = [episode("a", 0, 5, 0, -1.0), episode("a", 0, 9, 0, 1.0), episode("a", 0, 9, 1, 2.0)]
    rows.append(episode("b", 1, 9, 0, 3.0))
    table = tables.read_table(write(tmp_path / "e.csv", tables.EPISODE_COLUMNS, rows))
    assert [s.tolist() for s in aggregate.cell_runs(table, 0)] == [[1.0, 2.0], [3.0]]
    rows.append(episode("b", 1, 9, 0, 3.0))
    table = tables.read_table(write(tmp_path / "e.csv", tables.EPISODE_COLUMNS, rows))
    with pytest.raises(TableError, match="run 'b' has episode 0 2 times"):
        aggregate.cell_runs(table, 0)


def test_a_rate_is_shown_by_its_mean():
    facts = Facts(measures={"success": Measure(unit="share")})
    assert aggregate.statistics_of(facts, "success") == ("rate",)
    assert aggregate.statistics_of(facts, "eval/success") == ("rate",)
    assert aggregate.statistics_of(facts, "return") == ("mean", "iqm")
    nine_of_ten = [np.array([1.0] * 9 + [0.0])]
    assert aggregate.estimate(nine_of_ten, "rate").estimate == pytest.approx(0.9)
    assert aggregate.estimate(nine_of_ten, "iqm").estimate == 1.0  # why a rate is not an IQM


def test_what_leads_a_task_is_what_all_learning_runs_report(table_of):
    def named(name, run="a", variant="twirl"):
        return [run, "biped", "icy", variant, 0, name, 5, 0, 0.0, 1.0]

    both = table_of([named("eval/return"), named("return"), named("eval/q"), named("q")])
    assert cells.lead_metrics(both, "biped") == ["eval/return"]
    assert cells.shown_metrics(both, "biped") == ["eval/return", "eval/q"]
    mixed = table_of([named("eval/return"), named("return"), named("q"), named("return", "b")])
    assert cells.shown_metrics(mixed, "biped") == ["return", "q"]
    idle = table_of([named("eval/return"), named("return", "zero", "scripted")])
    assert cells.lead_metrics(idle, "biped") == ["eval/return"]
    with pytest.raises(TableError, match="run 'b' has none of 'return' for all runs"):
        cells.lead_metrics(table_of([named("return"), named("q", "b")]), "biped")
