"""Objects that act differently have another digest, and the same object always the same."""

from __future__ import annotations

import dataclasses
import datetime
import functools
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from twirl_mjx.policies.function import HostPolicy
from twirl_mjx.policies.identity import digest_of
from twirl_mjx.policies.scripted import get_scripted


@dataclasses.dataclass
class Mine:
    gain: Any
    other: Any = None


class Slotted:
    __slots__ = ("gain", "unset")

    def __init__(self, gain: float) -> None:
        self.gain = gain


def scaled(gain: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda obs: gain * obs


def with_default(obs: np.ndarray, gain: float = 1.0) -> np.ndarray:
    return gain * obs


PAIRS: dict[str, tuple[Any, Any]] = {
    "gaits": (get_scripted("trot"), get_scripted("bound")),
    "numbers": (Mine(1.0), Mine(2.0)),
    "types": (Mine(1), Mine(1.0)),
    "text and bytes": (Mine("a"), Mine(b"a")),
    "none and its name": (Mine(None), Mine("None")),
    "borders": (Mine("ab", "c"), Mine("a", "bc")),
    "arrays": (Mine(np.zeros(3)), Mine(np.array([0.0, 0.0, 1e-9]))),
    "shapes": (Mine(np.zeros((2, 3))), Mine(np.zeros((3, 2)))),
    "jax arrays": (Mine(jnp.zeros(3)), Mine(jnp.ones(3))),
    "keys": (Mine(jax.random.key(0)), Mine(jax.random.key(1))),
    "deep": (Mine({"a": [Mine(1)]}), Mine({"a": [Mine(2)]})),
    "sets": (Mine({"a", "b"}), Mine({"a", "c"})),
    "slots": (Slotted(1.0), Slotted(2.0)),
    "closures": (HostPolicy(scaled(1.0)), HostPolicy(scaled(2.0))),
    "code": (HostPolicy(lambda obs: obs + 1), HostPolicy(lambda obs: obs * 1)),
    "constants": (HostPolicy(lambda obs: obs + 1), HostPolicy(lambda obs: obs + 2)),
    "attributes": (HostPolicy(lambda obs: obs.T), HostPolicy(lambda obs: obs.real)),
    "partial": (Mine(functools.partial(with_default, gain=1.0)), Mine(with_default)),
    "jitted": (Mine(jax.jit(scaled(1.0))), Mine(jax.jit(scaled(2.0)))),
    "opaque": (Mine(datetime.date(2026, 1, 1)), Mine(datetime.date(2026, 1, 2))),
    "methods": (Mine(Mine(1).__repr__), Mine(Mine(2).__repr__)),
}


@pytest.mark.parametrize("name", PAIRS)
def test_what_acts_differently_has_another_digest(name: str) -> None:
    a, b = PAIRS[name]
    assert digest_of(a) != digest_of(b)
    assert digest_of(a) == digest_of(a)


def test_equal_objects_have_the_same_digest() -> None:
    for make in (lambda: Mine({"a": np.arange(3)}), lambda: HostPolicy(scaled(2.0))):
        assert digest_of(make()) == digest_of(make())
    assert digest_of(get_scripted("trot")).startswith("twirl_mjx.policies.scripted.GaitPolicy ")


def test_cached_properties_are_none_of_it() -> None:
    class Lazy:
        def __init__(self, gain: float) -> None:
            self.gain = gain

        @functools.cached_property
        def table(self) -> list[float]:
            return [self.gain]

    lazy = Lazy(1.0)
    before = digest_of(lazy)
    assert lazy.table == [1.0]
    assert digest_of(lazy) == before != digest_of(Lazy(2.0))


def test_what_a_dataclass_caches_is_none_of_it() -> None:
    trot: Any = get_scripted("trot")
    before = digest_of(trot)
    vars(trot.robot)["found_later"] = 1
    try:
        assert digest_of(trot) == before
    finally:
        del vars(trot.robot)["found_later"]


def test_objects_that_hold_themselves_end() -> None:
    mine = Mine(1.0)
    mine.other = [mine]
    assert digest_of(mine) != digest_of(Mine(1.0, [Mine(1.0)]))


def test_a_digest_is_that_of_another_process() -> None:
    """Neither addresses nor the order of sets, which differs from process to process."""
    program = (
        "from twirl_mjx.policies.identity import digest_of\n"
        "from twirl_mjx.policies.function import HostPolicy\n"
        "print(digest_of(HostPolicy(lambda obs: obs if 'a' in {'a', 'b', 'c'} else -obs)))"
    )
    words = [sys.executable, "-c", program]
    first, second = (
        subprocess.run(words, capture_output=True, text=True, check=True).stdout for _ in range(2)
    )
    assert first == second and "HostPolicy " in first
