import math

import numpy as np
import pytest

from twirl_mjx.figures import tables
from twirl_mjx.figures.errors import TableError

CURVE = ["a-0", "biped", "icy", "twirl", 0, "return", 1000, 20000, 12.5, 3.25]
EPISODE = ["a-0", "biped", "icy", "twirl", 0, 1000, 7, "success", 1.0]


@pytest.fixture
def curve_file(tmp_path, write):
    def make(rows=(CURVE,), columns=tables.CURVE_COLUMNS, notes=()):
        return write(tmp_path / "arm.csv", columns, rows, notes)

    return make


def test_curve_table_has_typed_columns(curve_file):
    table = tables.read_table(curve_file([CURVE, [*CURVE[:6], 2000, 40000, 25, "nan"]]))
    assert len(table) == 2
    assert table["env_steps"].tolist() == [1000, 2000]
    assert table["env_steps"].dtype == np.int64
    assert table["value"][0] == 3.25
    assert math.isnan(table["value"][1])
    assert table["variant"].tolist() == ["twirl", "twirl"]
    assert table["arm"].tolist() == ["arm", "arm"]


def test_episode_table_is_recognised_by_its_column(tmp_path, write):
    path = write(tmp_path / "eval.csv", tables.EPISODE_COLUMNS, [EPISODE])
    assert tables.read_episodes(path)["episode"].tolist() == [7]


def test_a_curve_table_is_not_an_episode_table(curve_file):
    with pytest.raises(TableError, match="a curve table"):
        tables.read_episodes(curve_file())


def test_column_order_does_not_matter_and_empty_lines_are_skipped(tmp_path, write):
    columns, row = tables.CURVE_COLUMNS[::-1], CURVE[::-1]
    path = write(tmp_path / "arm.csv", columns, [row])
    path.write_text(path.read_text() + "\n\n")
    assert tables.read_table(path)["grad_steps"].tolist() == [20000]


def test_further_columns_are_settings_and_may_be_empty(curve_file):
    rows = [[*CURVE, cell] for cell in ("0.50", "", "10", "big", "9")]
    table = tables.read_table(curve_file(rows, [*tables.CURVE_COLUMNS, "phi"]))
    assert table["phi"].tolist() == ["0.5", "", "10", "big", "9"]
    assert tables.unique(table, "phi") == ["0.5", "9", "10", "", "big"]
    assert table.settings == ["phi"]


def test_notes_are_read_by_key(curve_file):
    notes = ["reduced: 20k of 100k", "command: make sweep GRID=phi", "free: text", "hello there"]
    table = tables.read_table(curve_file(notes=notes))
    assert tables.note_texts(table, "reduced") == ["20k of 100k"]
    assert tables.note_texts(table, "command") == ["make sweep GRID=phi"]
    assert tables.note_texts(table, "") == ["hello there"]


def test_notes_belong_to_the_rows_of_their_file(tmp_path, write):
    write(tmp_path / "a.csv", tables.CURVE_COLUMNS, [CURVE], ["reduced: small"])
    other = [*CURVE[:3], "weights", *CURVE[4:]]
    write(tmp_path / "b.csv", tables.CURVE_COLUMNS, [other])
    curves, episodes = tables.read_directory(tmp_path)
    assert episodes is None
    assert curves is not None
    part = tables.select(curves, variant="weights")
    assert tables.note_texts(part, "reduced") == []
    assert tables.note_texts(curves, "reduced") == ["small"]


@pytest.mark.parametrize(
    ("column", "cell", "message"),
    [
        ("value", "fast", r"arm\.csv:4: value is 'fast', expected a number"),
        ("value", "inf", r"arm\.csv:4: value is 'inf', expected a finite number"),
        ("value", "", r"arm\.csv:4: value is '', expected a number"),
        ("seed", "1.5", r"arm\.csv:4: seed is '1\.5', expected a whole number >= 0"),
        ("env_steps", "-1", r"arm\.csv:4: env_steps is '-1', expected a whole number >= 0"),
        ("grad_steps", "nan", r"arm\.csv:4: grad_steps is 'nan', expected a whole number"),
        ("metric", "", r"arm\.csv:4: metric is empty"),
    ],
)
def test_a_wrong_cell_is_named_with_file_and_line(curve_file, column, cell, message):
    wrong = list(CURVE)
    wrong[tables.CURVE_COLUMNS.index(column)] = cell
    with pytest.raises(TableError, match=message):
        tables.read_table(curve_file([CURVE, wrong], notes=["a note shifts the lines"]))


def test_wrong_headers_are_refused(curve_file):
    with pytest.raises(TableError, match="column 'seed' is missing"):
        tables.read_table(
            curve_file([CURVE[:4] + CURVE[5:]], [c for c in tables.CURVE_COLUMNS if c != "seed"])
        )
    with pytest.raises(TableError, match=r"'env_steps' is missing: .*nearest: 'env_step'"):
        columns = ["env_step" if c == "env_steps" else c for c in tables.CURVE_COLUMNS]
        tables.read_table(curve_file(columns=columns))
    with pytest.raises(TableError, match="column 'value' appears 2 times"):
        tables.read_table(curve_file([[*CURVE, 1]], [*tables.CURVE_COLUMNS, "value"]))
    with pytest.raises(TableError, match="column 'label' cannot be a setting"):
        tables.read_table(curve_file([[*CURVE, 1]], [*tables.CURVE_COLUMNS, "label"]))


def test_broken_files_are_refused(curve_file, tmp_path):
    with pytest.raises(TableError, match=r"arm\.csv:3: 9 cells, expected 10"):
        tables.read_table(curve_file([CURVE, CURVE[:-1]]))
    empty = tmp_path / "empty.csv"
    empty.write_text("")
    with pytest.raises(TableError, match=r"empty\.csv: empty file, expected the header run,task"):
        tables.read_table(empty)
    with pytest.raises(TableError, match=r"nowhere\.csv: no such file"):
        tables.read_table(tmp_path / "nowhere.csv")


def test_a_header_alone_is_a_table_without_rows(curve_file, tmp_path):
    assert len(tables.read_table(curve_file([]))) == 0
    assert tables.read_directory(tmp_path) == (None, None)


def test_select_keeps_matching_rows_and_names_the_nearest_choice(curve_file):
    other = [*CURVE[:5], "success", *CURVE[6:]]
    table = tables.read_table(curve_file([CURVE, other]))
    assert tables.select(table, metric="success", seed=0)["metric"].tolist() == ["success"]
    with pytest.raises(TableError, match=r"metric 'retrun': .*nearest: 'return'"):
        tables.select(table, metric="retrun")
    with pytest.raises(TableError, match=r"seed '3': choose one of 0"):
        tables.select(table, seed=3)
    with pytest.raises(TableError, match="no column 'utd'"):
        tables.select(table, utd=1)


def test_concatenate_fills_missing_settings(tmp_path, write):
    a = tables.read_table(write(tmp_path / "a.csv", tables.CURVE_COLUMNS, [CURVE]))
    columns = [*tables.CURVE_COLUMNS, "utd"]
    b = tables.read_table(write(tmp_path / "b.csv", columns, [[*CURVE, 20]]))
    joined = tables.concatenate([a, b], source="both")
    assert joined["utd"].tolist() == ["", "20"]
    assert joined["arm"].tolist() == ["a", "b"]
    episodes = tables.read_table(write(tmp_path / "e.csv", tables.EPISODE_COLUMNS, [EPISODE]))
    with pytest.raises(TableError, match="curve and episode tables cannot be joined"):
        tables.concatenate([a, episodes], source="both")
    with pytest.raises(TableError, match="no table to read"):
        tables.concatenate([], source="none")


def test_a_ratio_is_computed_of_rows_alike(tmp_path, write, facts_of):
    def rows(metric, values):
        return [[*EPISODE[:6], i, metric, value] for i, value in enumerate(values)]

    body = [*rows("clean", [1, 0, 3]), *rows("passed", [2, 0, 4]), *rows("other", [5])]
    write(tmp_path / "a.csv", tables.EPISODE_COLUMNS, body)
    facts_of(tmp_path, measures={"share": {"unit": "share", "ratio": ["clean", "passed"]}})
    _, episodes = tables.read_directory(tmp_path)
    assert episodes is not None
    share = tables.select(episodes, metric="share")
    assert share["episode"].tolist() == [0, 2]  # nothing passed: not measured
    assert share["value"].tolist() == [0.5, 0.75]
