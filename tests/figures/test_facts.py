"""``grid.json``: what it may hold, and what is refused."""

import json

import pytest

from twirl_mjx.figures.errors import TableError
from twirl_mjx.figures.facts import Facts, read_facts


def test_without_a_file_everything_has_a_default(tmp_path):
    facts = read_facts(tmp_path)
    assert facts == Facts()
    assert facts.lead("anything") == ("return",)
    assert facts.label("eval/my_own_measure") == "Evaluation my own measure"
    assert facts.axis_title("tau") == "tau"
    assert not facts.measure("my_own_measure").is_rate


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", r"grid\.json: not JSON"),
        ("[1]", r"grid\.json is \[1\], expected an object"),
        ('{"titel": "x"}', "unknown key 'titel': .*nearest: 'title'"),
        ('{"place": "first"}', "place is 'first', expected a int"),
        (
            '{"measures": {"q": {"units": "m"}}}',
            r"measures\.q: unknown key 'units': .*nearest: 'unit'",
        ),
        ('{"axes": {"tau": {"order": "0.1"}}}', r"axes\.tau: order is '0\.1', expected a list"),
        ('{"tasks": ["biped"]}', r"tasks is \['biped'\], expected an object"),
        ('{"baseline": "scratch"}', "baseline is 'scratch', expected an object"),
    ],
)
def test_a_wrong_file_is_refused_by_name(tmp_path, content, message):
    (tmp_path / "grid.json").write_text(content)
    with pytest.raises(TableError, match=message):
        read_facts(tmp_path)


def test_what_it_says_is_read(tmp_path):
    data = {
        "place": 3,
        "axes": {"phi": {"title": "share", "order": ["0", "0.5"]}},
        "tasks": {"hurdles": {"lead": ["passed", "return"]}},
        "measures": {"fall": {"unit": "share", "smaller_is_better": True}, "q": {"unit": "1"}},
    }
    (tmp_path / "grid.json").write_text(json.dumps(data))
    facts = read_facts(tmp_path)
    assert facts.place == 3
    assert facts.order("phi") == ("0", "0.5")
    assert facts.axis_title("phi") == "phi (share)"
    assert facts.lead("hurdles") == ("passed", "return")
    fall = facts.measure("eval/fall")
    assert (fall.is_rate, fall.smaller_is_better, fall.label) == (True, True, "evaluation fall")
    assert facts.label("q") == "Q"
