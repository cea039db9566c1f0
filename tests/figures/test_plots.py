import dataclasses
import io
import subprocess
import sys

import numpy as np
import pytest
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from PIL import Image

from twirl_mjx.figures import canvas, plots, style, tables
from twirl_mjx.figures.errors import TableError
from twirl_mjx.figures.facts import Axis, Facts
from twirl_mjx.figures.tables import read_table


@pytest.fixture(scope="module")
def made(results, tmp_path_factory):
    said = []
    output = tmp_path_factory.mktemp("figures")
    return plots.make_figures(results, output, say=said.append), said


@pytest.fixture
def icy(tmp_path, write, rows_of):
    """Two variants under one shift, two seeds each."""
    rows = [
        row for v in ("twirl", "weights") for s in (0, 1) for row in rows_of("biped", "icy", v, s)
    ]
    return read_table(write(tmp_path / "icy.csv", tables.CURVE_COLUMNS, rows, ["reduced: 2 seeds"]))


def xdata(line: Line2D) -> np.ndarray:
    return np.asarray(line.get_xdata())


def ydata(line: Line2D) -> np.ndarray:
    return np.asarray(line.get_ydata())


def texts(figure):
    found = [t.get_text() for t in figure.texts]
    for axes in figure.axes:
        found += [axes.get_title(loc="left"), axes.get_xlabel(), axes.get_ylabel()]
        found += [t.get_text() for t in axes.get_xticklabels()]
    return found + [t.get_text() for legend in figure.legends for t in legend.get_texts()]


@pytest.mark.slow
def test_every_grid_is_drawn(made):
    paths, said = made
    names = {path.stem for path in paths}
    assert names == {
        "tasks_curves_return_mean",
        "tasks_curves_return_iqm",
        "tasks_curves_standing_time_iqm",
        "shifts_bars_return_mean",
        "shifts_bars_return_iqm",
        "shifts_curves_return_mean",
        "shifts_curves_return_iqm",
        "phi_ablation_return_mean",
        "phi_ablation_return_iqm",
        "utd_ablation_return_mean",
        "utd_ablation_return_iqm",
        "evaluation_episodes_bars_return_mean",
        "evaluation_episodes_bars_return_iqm",
        "evaluation_episodes_bars_success_rate",
    }
    assert said == []


def test_a_smoke_run_is_no_result(tmp_path, write, rows_of, facts_of):
    rows = list(rows_of("biped", "none", "twirl", 0))
    for name in ("small", "real"):
        write(tmp_path / name / "a.csv", tables.CURVE_COLUMNS, rows)
    facts_of(tmp_path / "small", smoke=True)
    said = []
    assert list(plots.read_grids(tmp_path, said.append)) == ["real"]
    assert said == ["grid 'small': a smoke run is no result, no figure"]


def test_a_closing_value_alone_is_no_curve(tmp_path, write, rows_of):
    rows = [row for seed in (0, 1) for row in rows_of("biped", "icy", "twirl", seed)]
    rows = [[*row[:5], "eval/return", *row[6:]] for row in rows]
    closing = [[*row[:5], "eval/final_return", *row[6:]] for row in (rows[20], rows[41])]
    write(tmp_path / "twirl.csv", tables.CURVE_COLUMNS, [*rows, *closing])
    curves, _ = tables.read_directory(tmp_path)
    assert {d.metric for d in plots.drawings("mine", curves, None)} == {"eval/return"}


def test_what_only_runs_without_the_setting_report_has_no_effect(tmp_path, write, rows_of):
    rows = [r for phi in (0, 0.5) for r in rows_of("biped", "icy", "twirl", 0, extra=(phi,))]
    rows += rows_of("biped", "icy", "zero-shot", 0, extra=("",), standing=True)
    write(tmp_path / "a.csv", [*tables.CURVE_COLUMNS, "phi"], rows)
    curves, _ = tables.read_directory(tmp_path)
    assert {d.metric for d in plots.drawings("mine", curves, None)} == {"return"}


def test_two_settings_have_an_effect_each(tmp_path, write, rows_of):
    rows = [
        row
        for tau in (0.005, 0.01)
        for critics in (2, 10)
        for seed in (0, 1)
        for row in rows_of("biped", "none", "twirl", seed, extra=(tau, critics), points=3)
    ]
    write(tmp_path / "a.csv", [*tables.CURVE_COLUMNS, "tau", "critics"], rows)
    curves, _ = tables.read_directory(tmp_path)
    drawn = {d.name: d for d in plots.drawings("mine", curves, None)}
    assert set(drawn) == {
        f"mine_ablation_{s}_return_{k}" for s in ("tau", "critics") for k in ("mean", "iqm")
    }
    shown = texts(drawn["mine_ablation_tau_return_iqm"].draw("light"))
    assert {"biped, critics = 2", "biped, critics = 10", "tau = 0.005", "tau = 0.01"} <= set(shown)
    shown = texts(drawn["mine_ablation_critics_return_mean"].draw("light"))
    assert {"biped, tau = 0.005", "biped, tau = 0.01", "critics = 2", "critics = 10"} <= set(shown)


def test_what_learns_nothing_is_a_level_and_no_bar(tmp_path, write, episodes_of):
    rows = [*episodes_of("biped", "icy", "weights", 0), *episodes_of("biped", "icy", "source", 0)]
    table = read_table(write(tmp_path / "e.csv", tables.EPISODE_COLUMNS, rows))
    figure = plots.shift_bars(table, "return", statistic="mean")
    (axes,) = figure.axes
    (bar,), (level,) = axes.patches, axes.lines
    assert isinstance(bar, Rectangle)
    source = tables.select(table, variant="source", metric="return")["value"].mean()
    assert ydata(level).tolist() == [source, source]
    assert {"weights", "source (learns nothing)"} <= set(texts(figure))


def test_an_effect_shows_what_learns_nothing_as_a_level(tmp_path, write, rows_of):
    rows = [
        row
        for phi in (0, 0.5)
        for row in rows_of("biped", "icy", "twirl", 0, extra=(phi,), level=0.5 + phi)
    ]
    rows += [[*row[:10], ""] for row in rows_of("biped", "icy", "source", 0)]
    table = read_table(write(tmp_path / "a.csv", [*tables.CURVE_COLUMNS, "phi"], rows))
    figure = plots.ablation(table, "phi", "return")
    assert {"phi = 0", "phi = 0.5", "source"} <= set(texts(figure))
    level = tables.select(table, variant="source")["value"].tolist()
    assert any(ydata(line).tolist() == level * 2 for line in figure.axes[0].lines)


def effect(table, metric):
    return plots.ablation(table, "a_setting_with_a_long_name", metric)


@pytest.mark.parametrize("draw", [plots.learning_curves, plots.shift_bars, effect])
def test_nothing_is_clipped_and_text_is_taken_as_it_is(icy, draw, clipped):
    name = "the_share_of_hurdles_" * 6 + "$x_{$"
    long = "$\\frac{ " + "a very long name of a variant " * 5
    is_twirl = icy["variant"] == "twirl"
    columns = {**icy.columns, "metric": np.full(len(icy), name)}
    columns["variant"] = np.where(is_twirl, long, icy["variant"])
    columns["shift"] = np.full(len(icy), "a shift with a long name, " * 4)
    if draw is effect:
        columns["a_setting_with_a_long_name"] = np.where(is_twirl, "0." + "123456789" * 4, "0.5")
    figure = draw(tables.Table(columns, icy.notes, "mine"), name)
    assert clipped(figure) == []
    assert "$" in " ".join(texts(figure))


def test_a_clipped_text_is_noticed(icy, clipped):
    figure = plots.learning_curves(icy, "return")
    figure.text(0.9, 0.5, "over the edge " * 5)
    assert clipped(figure) == ["over the edge " * 5]


@pytest.mark.slow
def test_pictures_are_legible_in_size_and_not_blank(made):
    for path in made[0]:
        with Image.open(path) as picture:
            pixels = np.asarray(picture.convert("RGB"))
        assert pixels.shape[1] >= 700, path
        assert (pixels != 255).any(axis=-1).mean() > 0.02, path


def test_grids_without_data_are_named(tmp_path, write, rows_of):
    write(tmp_path / "tasks" / "a.csv", tables.CURVE_COLUMNS, rows_of("biped", "none", "twirl", 0))
    write(tmp_path / "mine" / "a.csv", tables.CURVE_COLUMNS, [])
    said = []
    assert list(plots.read_grids(tmp_path, said.append)) == ["tasks"]
    assert [line.split("'")[1] for line in said] == ["mine"]
    assert all("no data in" in line for line in said)
    with pytest.raises(TableError, match=r"no such directory, expected <grid>/<arm>\.csv below it"):
        plots.read_grids(tmp_path / "nowhere")


def test_the_same_table_gives_the_same_bytes(icy):
    def draw(theme):
        return plots.learning_curves(icy, "return", statistic="iqm", theme=theme)

    for theme in ("light", "dark"):
        assert canvas.png_bytes(draw(theme)) == canvas.png_bytes(draw(theme))


def test_user_settings_of_matplotlib_change_nothing(icy):
    import matplotlib

    expected = canvas.png_bytes(plots.shift_bars(icy, "return"))
    with matplotlib.rc_context({"font.size": 30, "axes.grid": False, "savefig.dpi": 20}):
        assert canvas.png_bytes(plots.shift_bars(icy, "return")) == expected


def test_a_curve_shows_the_mean_of_its_runs_in_the_colour_of_its_variant(icy):
    (axes,) = plots.learning_curves(icy, "return", statistic="mean").axes
    part = tables.select(icy, variant="weights", metric="return")
    runs = [tables.select(part, seed=s)["value"] for s in (0, 1)]
    colour = style.category_mark(1, style.theme_of("light")).colour
    (line,) = [li for li in axes.lines if li.get_color() == colour and li.get_linewidth() > 1]
    np.testing.assert_allclose(ydata(line), np.mean(runs, axis=0))
    assert xdata(line)[-1] == 100_000


def test_bars_show_the_last_values(icy):
    (axes,) = plots.shift_bars(icy, "return", statistic="mean").axes
    last = tables.select(icy, metric="return", env_steps=100_000)
    expected = [tables.select(last, variant=v)["value"].mean() for v in ("twirl", "weights")]
    np.testing.assert_allclose(
        [bar.get_height() for bar in axes.patches if isinstance(bar, Rectangle)], expected
    )


def test_episode_bars_pool_the_runs_of_a_variant(tmp_path, write, episodes_of):
    rows = [row for seed in (0, 3) for row in episodes_of("biped", "icy", "weights", seed)]
    table = read_table(write(tmp_path / "e.csv", tables.EPISODE_COLUMNS, rows))
    figure = plots.shift_bars(table, "success", statistic="rate")
    (bar,) = figure.axes[0].patches
    assert isinstance(bar, Rectangle)
    values = [tables.select(table, metric="success", seed=s)["value"] for s in (0, 3)]
    assert values[0].mean() != values[1].mean()
    assert bar.get_height() == pytest.approx(np.concatenate(values).mean())
    assert "2 seeds and their episodes" in " ".join(texts(figure))


def test_runs_can_be_set_side_by_side(icy):
    (axes,) = plots.shift_bars(icy, "return", by="run").axes
    assert len(axes.patches) == 4
    with pytest.raises(ValueError, match="cannot draw one bar per 'seed': "):
        plots.shift_bars(icy, "return", by="seed")


def test_untrained_variants_are_level_lines(tmp_path, write, rows_of):
    rows = [r for v in ("scratch", "source") for r in rows_of("biped", "none", v, 0)]
    table = read_table(write(tmp_path / "a.csv", tables.CURVE_COLUMNS, rows))
    (axes,) = plots.learning_curves(table, "return").axes
    colour = style.category_mark(1, style.theme_of("light")).colour
    (line,) = [li for li in axes.lines if li.get_color() == colour]
    assert xdata(line).tolist() == [0, 100_000]
    assert len(set(ydata(line).tolist())) == 1


def test_reduced_results_say_so_in_the_picture(icy):
    for figure in (plots.learning_curves(icy, "return"), plots.shift_bars(icy, "return")):
        assert "Reduced: 2 seeds" in texts(figure)
        assert any(", 2 seeds" in text for text in texts(figure))
    whole = tables.Table(icy.columns, (), icy.source)
    assert not any("educed" in text for text in texts(plots.learning_curves(whole, "return")))


def test_a_single_seed_is_shown_without_an_interval(icy):
    single = tables.select(icy, seed=0)
    figure = plots.shift_bars(single, "return")
    assert any("one seed allows no interval" in text for text in texts(figure))
    assert list(figure.axes[0].collections) == []
    curves = plots.learning_curves(single, "return")
    assert "Lines: single runs; one seed allows no interval." in texts(curves)
    assert list(curves.axes[0].collections) == []


def test_ablation_has_one_line_and_one_point_per_value(tmp_path, write, rows_of):
    rows = [
        row
        for utd in (1, 20)
        for seed in (0, 1)
        for row in rows_of("biped", "icy", "twirl", seed, extra=(utd,), level=utd / 20)
    ]
    columns = [*tables.CURVE_COLUMNS, "utd"]
    table = read_table(write(tmp_path / "a.csv", columns, rows))
    figure = plots.ablation(table, "utd", "return")
    shown = texts(figure)
    assert {"utd = 1", "utd = 20", "after 100k transitions", "biped, icy"} <= set(shown)
    right = figure.axes[1]
    assert [ydata(line)[0] for line in right.lines] == pytest.approx(
        [
            tables.select(table, metric="return", env_steps=100_000, utd=str(u))["value"].mean()
            for u in (1, 20)
        ]
    )


def test_episodes_of_an_ablation_are_not_pooled_into_bars(tmp_path, write, episodes_of):
    rows = list(episodes_of("biped", "icy", "twirl", 0))
    rows = [[*row, phi] for phi in (0, 0.5) for row in rows]
    rows = [[f"{row[0]}-{row[-1]}", *row[1:]] for row in rows]
    table = read_table(write(tmp_path / "e.csv", [*tables.EPISODE_COLUMNS, "phi"], rows))
    (axes,) = plots.shift_bars(table, "return").axes
    assert len(axes.patches) == 2


def test_unknown_names_are_refused_with_the_nearest(icy, tmp_path, write, rows_of):
    with pytest.raises(TableError, match=r"metric 'retrun': .*nearest: 'return'"):
        plots.learning_curves(icy, "retrun")
    with pytest.raises(ValueError, match=r"no theme 'drak': .*nearest: 'dark'"):
        plots.learning_curves(icy, "return", theme="drak")
    with pytest.raises(TableError, match="no setting 'phi': there is none"):
        plots.ablation(icy, "phi", "return")


def test_a_variant_keeps_its_colour_whatever_else_is_drawn(icy):
    facts = Facts(axes={"variant": Axis(order=("scratch", "twirl", "weights"))})
    table = dataclasses.replace(icy, facts=facts)
    look = style.theme_of("light")
    for part in (table, tables.select(table, variant="weights")):
        (axes,) = plots.learning_curves(part, "return").axes
        assert axes.lines[-1].get_color() == style.category_mark(2, look).colour


def test_an_empty_setting_column_is_refused(tmp_path, write, rows_of):
    rows = rows_of("biped", "icy", "twirl", 0, extra=("",))
    table = read_table(write(tmp_path / "a.csv", [*tables.CURVE_COLUMNS, "phi"], rows))
    with pytest.raises(TableError, match="column 'phi' is empty in every row"):
        plots.ablation(table, "phi", "return")


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_colours_differ_and_stand_out_from_the_background(theme):
    def luminance(colour):
        channels = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
        linear = [c / 12.92 if c <= 0.03928 else ((c + 0.055) / 1.055) ** 2.4 for c in channels]
        return np.dot(linear, [0.2126, 0.7152, 0.0722])

    def contrast(a, b):
        high, low = sorted((luminance(a), luminance(b)), reverse=True)
        return (high + 0.05) / (low + 0.05)

    look = style.theme_of(theme)
    marks = [style.category_mark(i, look) for i in range(len(look.categories))]
    assert len({m.colour for m in marks}) == len(marks)
    assert len({m.hatch for m in marks}) == len(marks)
    assert contrast(look.text, look.background) > 7
    assert min(contrast(m.colour, look.background) for m in marks) > 2
    assert len({style.ordered_mark(i, 4, look).colour for i in range(4)}) == 4


def test_png_keeps_the_background_of_the_theme(icy):
    for theme, rgb in (("light", (255, 255, 255)), ("dark", (22, 27, 34))):
        picture = Image.open(
            io.BytesIO(canvas.png_bytes(plots.shift_bars(icy, "return", theme=theme)))
        )
        assert picture.convert("RGB").getpixel((1, 1)) == rgb


def test_figures_need_no_jax_and_no_simulator():
    code = "import sys, twirl_mjx.figures.report; print({'jax', 'mujoco'} & set(sys.modules))"
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert shown.stdout.strip() == "set()"
