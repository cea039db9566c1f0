"""Samples and their summary, with a clock of our own; stdout that holds JSON only."""

from __future__ import annotations

import subprocess
import sys

import jax.numpy as jnp
import numpy as np
import pytest

from twirl_mjx.bench import measure
from twirl_mjx.machine import usable_cores


class Clock:
    """A clock that only moves when told to."""

    def __init__(self) -> None:
        self.now = 100.0
        self.calls = 0

    def __call__(self) -> float:
        return self.now

    def work(self) -> None:
        self.calls += 1
        self.now += 0.125


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(measure.time, "perf_counter", clock)
    return clock


def test_rate_is_work_over_time(clock: Clock) -> None:
    samples = measure.sample_rates(clock.work, work=4.0, seconds=10.0)
    assert samples == [32.0] * len(samples)
    assert len(samples) == 10  # one second each
    assert clock.calls == 1 + 8 * 10  # the first one finds out how long a call takes


def test_short_measurement_still_has_three_samples(clock: Clock) -> None:
    assert measure.sample_rates(clock.work, work=1.0, seconds=0.01) == [8.0] * 3


def test_slower_calls_give_lower_samples(clock: Clock) -> None:
    lengths = iter([1.0, 1.0, 2.0, 4.0])

    def work() -> None:
        clock.now += next(lengths)

    assert measure.sample_rates(work, work=2.0, seconds=0.1) == [2.0, 1.0, 0.5]


def test_functions_are_measured_in_turn(clock: Clock) -> None:
    order = []

    def take(name: str, length: float) -> None:
        order.append(name)
        clock.now += length

    fast, slow = measure.sample_in_turn(
        [lambda: take("fast", 0.125), lambda: take("slow", 0.25)], work=1.0, seconds=0.5
    )
    assert (fast, slow) == ([8.0] * 3, [4.0] * 3)
    assert order == ["fast", "slow"] * 4  # once to see how long a call takes


def test_summary() -> None:
    found = measure.summary([4.0, 1.0, 2.0])
    assert found == {"median": 2.0, "spread": 1.5, "samples": [4.0, 1.0, 2.0]}


def test_chain_feeds_its_result_back() -> None:
    chain = measure.Chain(lambda x, step: x + step, jnp.zeros(3), jnp.float32(2.0))
    for _ in range(3):
        chain()
    np.testing.assert_array_equal(chain.state, [6.0, 6.0, 6.0])
    assert chain.compile_s > 0


def test_machine_names_what_matters() -> None:
    found = measure.machine()
    assert found["cpus"] == len(usable_cores()) >= 1
    assert found["memory_gb"] > 0.1
    assert found["devices"] == ["cpu cpu"]
    assert {"jax", "mujoco", "python", "commit"} <= set(found["versions"])


def test_only_json_reaches_stdout() -> None:
    code = """
import os
from twirl_mjx.bench.measure import only_json_on_stdout
print("before")
with only_json_on_stdout() as out:
    print("python noise")
    os.write(1, b"native noise\\n")
    print('{"a": 1}', file=out)
print("after")
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=250, check=True
    )
    # What libraries print while they are imported is the command line's to catch.
    assert done.stdout.splitlines()[-3:] == ["before", '{"a": 1}', "after"]
    assert "python noise\n" in done.stderr
    assert "native noise\n" in done.stderr
