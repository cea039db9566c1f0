"""Comparison of the forms of the learner: what counts as agreement, and what is refused."""

from __future__ import annotations

import dataclasses

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
    fast, plain, narrow = (options.config(form) for form in ("fast", "plain", "bfloat16"))
    assert (fast.droq.fast, plain.droq.fast, narrow.droq.fast) == (True, False, True)
    assert narrow.droq.matmul_dtype == "bfloat16"
    for other in (plain, narrow):
        assert dataclasses.replace(other, droq=fast.droq) == fast
    assert dataclasses.replace(narrow.droq, matmul_dtype="float32") == fast.droq
    assert fast.variant == "scratch"


def test_too_short_runs_and_single_seeds_are_refused() -> None:
    with pytest.raises(ValueError, match=r"env_steps = 3200 is outside \[12800, "):
        FormsBench(env_steps=3200)
    with pytest.raises(ValueError, match="seeds = 1 is outside"):
        FormsBench(seeds=1)


def test_unknown_forms_and_none_are_refused() -> None:
    with pytest.raises(ValueError, match="bfloat16"):
        FormsBench(forms=("bfloat8",))
    with pytest.raises(ValueError, match="forms is empty, expected some of fast, bfloat16"):
        FormsBench(forms=())


def test_sheet_shows_means_and_ranges() -> None:
    quarter = {
        "plain": [4.0, 6.0], "fast": [1.0, 3.0], "overlap": {"plain": True, "fast": False},
    }  # fmt: skip
    record = {
        "quarters": [quarter], "seeds": 2, "task": "stand", "preset": "cpu", "env_steps": 48_000,
        "critic_updates": 20_800, "wall_s": {"plain": 180.0, "fast": 100.0},
    }  # fmt: skip
    sheet = report.forms_sheet(record)
    assert sheet.rows == (("1", "5.0 (4.0 to 6.0)", "2.0 (1.0 to 3.0, apart)"),)
