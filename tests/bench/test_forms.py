"""Comparison of both forms of the learner: what counts as agreement, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from twirl_mjx.bench import report
from twirl_mjx.bench.forms import FormsBench, overlap


def test_ranges_overlap_when_they_share_a_point() -> None:
    assert overlap(np.array([1.0, 3.0]), np.array([2.0, 5.0]))
    assert overlap(np.array([2.0, 5.0]), np.array([5.0, 6.0]))
    assert not overlap(np.array([1.0, 2.0]), np.array([2.5, 5.0]))
    assert not overlap(np.array([2.5, 5.0]), np.array([1.0, 2.0]))


def test_forms_differ_in_nothing_but_the_form() -> None:
    options = FormsBench()
    fast, plain = options.config("fast"), options.config("plain")
    assert (fast.droq.fast, plain.droq.fast) == (True, False)
    assert fast.variant == plain.variant == "scratch"
    assert fast.replay == plain.replay
    assert fast.env == plain.env


def test_too_short_runs_and_single_seeds_are_refused() -> None:
    with pytest.raises(ValueError, match=r"env_steps = 3200 is outside \[12800, "):
        FormsBench(env_steps=3200)
    with pytest.raises(ValueError, match="seeds = 1 is outside"):
        FormsBench(seeds=1)


def test_sheet_shows_means_and_ranges() -> None:
    quarter = {"fast": [1.0, 3.0], "plain": [4.0, 6.0], "overlap": False}
    record = {
        "quarters": [quarter], "seeds": 2, "task": "stand", "preset": "cpu", "env_steps": 48_000,
        "critic_updates": 20_800, "wall_s": {"fast": 100.0, "plain": 180.0},
    }  # fmt: skip
    sheet = report.forms_sheet(record)
    assert sheet.rows == (("1", "2.0 (1.0 to 3.0)", "5.0 (4.0 to 6.0)", "no"),)
