"""Numbers of pages come from committed tables: the pages as they are, and how fields are read."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest

from twirl_mjx.commands.figures import FiguresOptions
from twirl_mjx.figures.errors import TableError
from twirl_mjx.figures.quotes import Quotes

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / page for page in FiguresOptions().pages]
BLOCK = re.compile(r"<!-- quotes: ([\w-]+) -->\n(.*?)<!-- end: \1 -->", re.S)
CURVES = ["run", "task", "shift", "variant", "seed", "metric", "env_steps", "grad_steps"]
CURVES += ["wall_s", "value"]
EPISODES = ["run", "task", "shift", "variant", "seed", "env_steps", "episode", "metric", "value"]


@pytest.fixture(scope="module")
def committed() -> Quotes:
    return Quotes(ROOT / "experiments" / "results", ROOT / "experiments" / "quotes")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_a_page_quotes_what_the_tables_say(page: Path, committed: Quotes) -> None:
    text = page.read_text(encoding="utf-8")
    assert BLOCK.search(text)
    assert committed.fill(text) == text, "a number and its table disagree: make figures"


def test_a_changed_number_is_noticed(committed: Quotes) -> None:
    text = (ROOT / "docs" / "results.md").read_text(encoding="utf-8")
    block = BLOCK.search(text)
    assert block
    changed = re.sub(r"\d+\.\d+ \[", "99.9 [", block[2], count=1)
    assert changed != block[2]
    assert committed.fill(text.replace(block[2], changed)) == text


def test_every_template_is_shown_and_no_interval_is_typed_by_hand() -> None:
    texts = [page.read_text(encoding="utf-8") for page in PAGES]
    shown = {name for text in texts for name, _ in BLOCK.findall(text)}
    templates = {p.name.removesuffix(".md.in") for p in (ROOT / "experiments/quotes").iterdir()}
    assert shown == templates
    interval = re.compile(r"\d \[-?[\d.]+, -?[\d.]+\]")
    for text in texts:
        assert not interval.search(BLOCK.sub("", text))
        assert not BLOCK.search(text) or interval.search(text)


@pytest.fixture
def quotes(tmp_path: Path, write: Callable, facts_of: Callable) -> Quotes:
    """Two runs of episodes and of curves, and one baseline, with numbers easy by head."""
    folder, templates = tmp_path / "results" / "mine", tmp_path / "quotes"
    measures = {
        "fall": {"unit": "share", "smaller_is_better": True},
        "distance": {"unit": "m", "smaller_is_better": True},
    }
    facts_of(folder, measures=measures)
    runs = {("a", "twirl", 0): [10.0, 20.0], ("b", "twirl", 1): [30.0, 40.0]}
    runs[("c", "scratch", 0)] = [5.0, 5.0]
    rows = [
        [run, "biped", "none", variant, seed, 100, i, metric, value]
        for (run, variant, seed), values in runs.items()
        for i, return_ in enumerate(values)
        for metric, value in (
            ("return", return_),
            ("fall", float(return_ > 25)),
            ("distance", 1 / return_),
        )
    ]
    write(folder / "x.episodes.csv", EPISODES, rows)
    curve = {0: (1.0, 0.5), 50: (9.0, 0.25), 100: (4.0, 0.75)}
    rows = [
        [run, "biped", "none", variant, seed, metric, at, at, 1.0, factor * value]
        for (run, variant, seed), factor in zip(runs, (1, 2, 1), strict=True)
        for at, values in curve.items()
        for metric, value in zip(("eval/return", "eval/distance"), values, strict=True)
    ]
    write(folder / "x.csv", CURVES, rows)
    templates.mkdir()
    (templates / "one.md.in").write_text("| {{mine return run=c}} |\n")
    return Quotes(tmp_path / "results", templates)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("mine return run=c", "5.00 [5.00, 5.00]"),
        ("mine return variant=twirl seeds", "15.0 / 35.0"),
        ("mine return variant=twirl median", "25.0"),
        ("mine fall variant=twirl short", "50 %"),
        ("mine return variant=twirl count", "4"),
        ("mine fall variant=twirl seeds", "0 / 100 %"),
        ("mine fall run=c", "0 % [0, 0]"),
        ("mine return run=c over variant=scratch", "1.00 [1.00, 1.00]"),
        ("mine distance variant=twirl over variant=scratch better", "1.00 [1.00, 1.00]"),
        ("mine eval/return run=a", "4.00"),
        ("mine eval/return variant=twirl seeds", "4.00 / 8.00"),
        ("mine eval/return variant=twirl at=60 seeds", "9.0 / 18.0"),
        ("mine eval/distance variant=twirl best", "0.25 / 0.50"),
    ],
)
def test_fields(words: str, expected: str, quotes: Quotes) -> None:
    assert quotes.quote(words) == expected


def test_a_mean_of_several_runs_draws_runs_anew(quotes: Quotes) -> None:
    assert quotes.quote("mine return variant=twirl").startswith("25.0 [1")
    assert re.fullmatch(r"50 % \[0, 100\]", quotes.quote("mine fall variant=twirl"))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("mien return run=c", "no folder 'mien': .*nearest: 'mine'"),
        ("mine retrun run=c", "no row with metric 'retrun': .*nearest: 'return'"),
        ("mine return run=d", "no run 'd'"),
        ("mine return ran=c", "no column 'ran': .*nearest: 'run'"),
        ("mine return run=c medain", "no form 'medain': .*nearest: 'median'"),
        ("mine return", r"variant is any of \['scratch', 'twirl'\]: name one"),
    ],
)
def test_a_wrong_field_is_refused_by_name(words: str, message: str, quotes: Quotes) -> None:
    with pytest.raises(TableError, match=message):
        quotes.quote(words)


def test_blocks_are_written_and_all_else_is_kept(quotes: Quotes, tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    text = "# Page\n<!-- quotes: one -->\n{}<!-- end: one -->\nall else {{{{stays}}}}\n"
    page.write_text(text.format("| 7 |\n"))
    assert quotes.write(page)
    assert page.read_text() == text.format("| 5.00 [5.00, 5.00] |\n")
    assert not quotes.write(page)
    with pytest.raises(TableError, match=r"no template 'on': .*nearest: 'one'"):
        quotes.fill("<!-- quotes: on -->\n<!-- end: on -->")
