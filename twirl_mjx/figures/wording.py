"""How the report writes numbers, and the terms it explains."""

from __future__ import annotations

import numpy as np

from twirl_mjx.figures.statistics import Interval

TERMS = """<dl>
<dt>mean [95 %], IQM [95 %]</dt><dd>Mean and interquartile mean (without the lowest and highest
quarter; the plain mean below four samples, and for shares) over all runs and episodes. In brackets
a percentile bootstrap interval, 2000 resamples, fixed seed, that draws runs first, then episodes
within each.</dd>
<dt>interval over</dt><dd>What was drawn anew. <em>episodes (1 run)</em>: the interval is about this
one policy and says nothing about training again with another seed. With two to four runs the
bounds over runs are close to their range, which is narrower than the truth: read the single runs
beside it. A single value has no interval.</dd>
<dt>each run</dt><dd>The mean of every run, in the order of the seeds.</dd>
<dt>ratio</dt><dd>IQM (mean for shares) over that of the baseline of the same task and shift, both
sides drawn anew. Compare ratios with the paper, not returns: its text does not fix their
scale.</dd>
<dt>P(better)</dt><dd>Probability that a random sample of this row is better than a random one of
the baseline, ties counted half; both sides drawn anew.</dd>
<dt>learns nothing</dt><dd>A policy that is not trained in the task, such as one that does nothing:
a level to beat, and never the best of its row.</dd>
<dt>transitions</dt><dd>Control steps summed over all worlds. Arms are compared at the
transitions that every trained run of the same task and shift has reached.</dd>
<dt>updates, wall time</dt><dd>Critic updates and time by then, of the run with the most.</dd>
</dl>"""
"""Explanations at the end of the report, as HTML."""


def interval_text(interval: Interval) -> str:
    """Write an interval as "2.9 [2.5, 3.4]", or without brackets where there are no bounds."""
    centre, low, high = numbers(interval.estimate, interval.low, interval.high)
    return centre if np.isnan(interval.low) else f"{centre} [{low}, {high}]"


def numbers(*values: float) -> list[str]:
    """Write numbers with the digits that suit the largest; NaN is a dash."""
    size = max((abs(value) for value in values if not np.isnan(value)), default=0.0)
    digits = 0 if size >= 100 else 1 if size >= 10 else 3 if 0 < size < 0.1 else 2
    return ["\N{EN DASH}" if np.isnan(value) else f"{value:,.{digits}f}" for value in values]


def duration(seconds: float) -> str:
    """Write a duration as "2 h 05 min", "17 min" or "42 s"; NaN is a dash."""
    if np.isnan(seconds):
        return "\N{EN DASH}"
    if seconds < 60:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes // 60} h {minutes % 60:02d} min" if minutes >= 60 else f"{minutes} min"
