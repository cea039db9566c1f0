"""Names and meanings of what a run reports."""

from __future__ import annotations

from collections.abc import Mapping

from twirl_mjx.checks import nearest
from twirl_mjx.types import MetricInfo

FIRST_DROP = "first_drop"

METRICS: dict[str, MetricInfo] = {
    # Means over the episodes that ended during the epoch, exploring policy.
    "return": MetricInfo("undiscounted return of an episode", "1"),
    "episode_length": MetricInfo("control steps of an episode", "control steps"),
    "episodes": MetricInfo("number of episodes that ended in the epoch", "1"),
    "terminated": MetricInfo("share of episodes the task ended, not the time limit", "share"),
    "success": MetricInfo("share of episodes that met the task's success criterion", "share"),
    # Means over the transitions of the epoch.
    "reward": MetricInfo("reward of one transition", "1"),
    "dropped_transitions": MetricInfo(
        "transitions dropped because a state, observation, reward or action was not finite", "1"
    ),
    FIRST_DROP: MetricInfo(
        "why the first of them was: 1 state not finite, 2 state out of bounds, 3 observation,"
        " 4 reward, 5 action; only in epochs that dropped any",
        "1",
    ),
    # With --guide only.
    "guided": MetricInfo("share of transitions in which the source acted", "share"),
    # Bookkeeping.
    "env_steps_per_s": MetricInfo(
        "transitions per second; undefined for an epoch with a compilation", "1/s"
    ),
    "updates_per_s": MetricInfo(
        "critic updates per second; undefined for an epoch with a compilation", "1/s"
    ),
    "replay_ratio": MetricInfo("replayed rows per transition, utd * batch size", "1"),
    "source_rows": MetricInfo("filled rows of the source ring", "1"),
    "online_rows": MetricInfo("filled rows of the online ring", "1"),
    # Of a run whose phi chooses itself (replay/share.py).
    "phi": MetricInfo("share of source rows in the minibatches of the epoch", "share"),
    "source_worth": MetricInfo("mean reward times mean length of an episode of source data", "1"),
    "online_worth": MetricInfo("the same of the transitions of the last epochs", "1"),
    "compile_s": MetricInfo("time spent compiling (and running once) in the epoch", "s"),
}
"""What training itself reports; a task adds its measures, a learner its ``metrics``."""

FAMILIES: dict[str, MetricInfo] = {
    "eval/": MetricInfo(
        "the metric after the slash, over evaluation episodes on separate seeds with the "
        "deterministic policy",
        "as named",
    ),
    "world/": MetricInfo(
        "mean per transition of what the task reports: unweighted reward terms and measures",
        "as in the task",
    ),
}
"""Prefixes under which a task or an evaluation may add names of its own."""


def describe(name: str, declared: Mapping[str, MetricInfo]) -> MetricInfo:
    """Return the meaning of a metric.

    Args:
        name: Name under which it is reported.
        declared: What the task and the learner of the run declare, beside ``METRICS``.

    Raises:
        ValueError: unknown name; the message gives the closest known one.
    """
    if name in METRICS:
        return METRICS[name]
    if name in declared:
        return declared[name]
    for prefix, info in FAMILIES.items():
        if name.startswith(prefix) and len(name) > len(prefix):
            return info
    closest = nearest(name, [*METRICS, *declared, *FAMILIES])
    raise ValueError(
        f"unknown metric {name!r}; the closest known name is {closest!r}. A task declares its own"
        f" among its measures, a learner in its metrics; or name it under one of"
        f" {', '.join(FAMILIES)}"
    )
