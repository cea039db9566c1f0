"""Names of metrics, and the page that explains them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pytest

from twirl_mjx.droq.learner import METRICS as LEARNING
from twirl_mjx.tasks.measures import COMMON
from twirl_mjx.tasks.registry import TASKS
from twirl_mjx.training.metrics import FAMILIES, METRICS, describe
from twirl_mjx.types import MetricInfo

PAGE = Path(__file__).parents[2] / "docs" / "metrics.md"


def table(metrics: Mapping[str, MetricInfo]) -> str:
    rows = [f"| `{name}` | {info.about} | {info.unit} |" for name, info in metrics.items()]
    return "\n".join(["| metric | meaning | unit |", "|---|---|---|", *rows]) + "\n"


def tables() -> dict[str, str]:
    """Return every table of the page by its heading."""
    families = {f"{prefix}<name>": info for prefix, info in FAMILIES.items()}
    found = {"Every run": table(METRICS | families), "DroQ": table(LEARNING)}
    for task in TASKS.builtin_names():
        measures = TASKS.get(task).measures
        found[f"Task {task}"] = table({k: MetricInfo(m.about, m.unit) for k, m in measures.items()})
    return found


@pytest.mark.parametrize("heading", tables())
def test_the_page_explains_every_metric(heading: str) -> None:
    expected = f"### {heading}\n\n{tables()[heading]}"
    assert expected in PAGE.read_text(), f"docs/metrics.md should have:\n\n{expected}"


def test_what_every_task_measures_is_reported_by_training() -> None:
    assert {*COMMON, "success"} <= set(METRICS)


def test_a_name_is_described_by_whoever_declares_it() -> None:
    own = {"hops": MetricInfo("hops in an episode", "1")}
    assert describe("hops", own) is own["hops"]
    assert describe("return", own) is METRICS["return"]
    assert describe("eval/hops", own).about.startswith("the metric after the slash")
    with pytest.raises(ValueError, match=r"unknown metric 'hop'; the closest known name is 'hops'"):
        describe("hop", own)
    with pytest.raises(ValueError, match="unknown metric 'hops'"):
        describe("hops", {})
