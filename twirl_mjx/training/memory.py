"""Memory a run needs against memory there is, judged before anything is allocated.

What is counted is what grows with settings: rings, networks, minibatches and worlds. Sizes of rings
and networks are exact, the others measured; all of it is refused or none.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import jax

from twirl_mjx import files
from twirl_mjx.replay.ring import row_size
from twirl_mjx.sim.engine import resolve_engine
from twirl_mjx.tasks.observations import layout_size
from twirl_mjx.training.config import TrainConfig
from twirl_mjx.training.learners import learner_of

RING_COPIES = 2
"""A ring that is restored from a checkpoint is in host memory and on the device at once."""
SOURCE_COPIES = 3
"""Recorded transitions are there in pieces, joined and as a ring."""
LEARNER_COPIES = 3
"""Networks with their optimisers are there before and after an update, with gradients between."""
BATCH_COPIES = 2
"""Minibatches of a block of updates are gathered as rows, and cut into fields."""
WORLD_BYTES = {"mjx": 70_000, "native": 55_000}
"""Bytes of one world: its state before and after a step, and what that computes on the way, as the
compiled step of ``biped`` has them on a CPU."""
MARGIN = 0.9
"""Share of the memory there that the nearest setting may need."""
GROUPS = (
    ("", "/sys/fs/cgroup", ("memory.max", "memory.current")),
    ("memory", "/sys/fs/cgroup/memory", ("memory.limit_in_bytes", "memory.usage_in_bytes")),
)
"""Controller, mount, and files with limit and use of control groups, version 2 and 1."""


@dataclasses.dataclass(frozen=True)
class Need:
    """What one setting asks for."""

    setting: str
    """Its public name."""
    value: Any
    """What it is set to: a count, or the sizes of layers."""
    size: int
    """Bytes."""


def needs(config: TrainConfig, seeds: int = 1) -> list[Need]:
    """Return what a run needs, by the settings that decide it.

    Args:
        config: The run.
        seeds: How many of it train in one program.
    """
    row = 4 * row_size(*_sizes(config))
    replay, droq, name = config.replay, config.droq, config.learner
    block = droq.updates_per_block * droq.batch_size
    found = [
        Need("replay.capacity", replay.capacity, RING_COPIES * replay.capacity * row),
        Need(f"{name}.batch_size", droq.batch_size, BATCH_COPIES * block * row),
        Need("num_envs", config.num_envs, _worlds(config, config.num_envs)),
        Need("eval.episodes", config.eval.episodes, _worlds(config, config.eval.episodes)),
        Need("eval.final_episodes", config.eval.final_episodes,
             _worlds(config, config.eval.final_episodes)),
        Need(f"{name}.hidden_sizes", getattr(droq, "hidden_sizes", ()), _learner(config, droq)),
    ]  # fmt: skip
    if config.uses_source_data:
        found.append(collecting(config))
    return [dataclasses.replace(need, size=seeds * need.size) for need in found]


def collecting(config: TrainConfig) -> Need:
    """Return what recording a source needs."""
    size = config.replay.source_size
    return Need("replay.source_size", size, SOURCE_COPIES * size * 4 * row_size(*_sizes(config)))


def acting(setting: str, count: int, worlds: int, engine: Any) -> Need:
    """Return what ``count`` episodes in ``worlds`` worlds at once need."""
    return Need(setting, count, worlds * WORLD_BYTES[resolve_engine(engine, worlds)])


def _sizes(config: TrainConfig) -> tuple[int, int]:
    task = config.make_task()
    return layout_size(task.observer.layout), task.robot.num_joints


def _worlds(config: TrainConfig, count: int) -> int:
    return acting("", count, count, config.engine).size


def _learner(config: TrainConfig, settings: Any) -> int:
    """Return the bytes of a learner's state; nothing is allocated."""
    sizes = _sizes(config)
    state = jax.eval_shape(
        lambda key: learner_of(settings).init(key, settings, *sizes), jax.random.key(0)
    )
    leaves = jax.tree.leaves(state)
    return LEARNER_COPIES * sum(4 * math.prod(leaf.shape) for leaf in leaves)


def check_run(config: TrainConfig, seeds: int = 1) -> None:
    """Refuse a run that does not fit into memory; see :func:`check`."""
    check(needs(config, seeds))


def check(found: Sequence[Need]) -> None:
    """Refuse what does not fit into memory.

    Raises:
        ValueError: Both numbers, the setting that needs most and the nearest that fits.
    """
    total, (there, where) = sum(need.size for need in found), room()
    if total <= there:
        return
    most = max(found, key=lambda need: need.size)
    left = MARGIN * there - (total - most.size)
    nearest = _nearest(most, left)
    remedy = (
        f"nearest: {most.setting} {nearest}"
        if nearest
        else f"the other settings alone need {_text(total - most.size)}"
    )
    raise ValueError(
        f"{_text(total)} of memory are needed, {_text(most.size)} of them for {most.setting}"
        f" {_shown(most.value)}, and {where} has {_text(there)} ({remedy})"
    )


def _nearest(most: Need, left: float) -> str:
    """Return the largest round value of a setting that needs at most ``left`` bytes, or nothing."""
    if isinstance(most.value, int):
        count = int(most.value * max(left, 0.0) / most.size)
        if count < 1:
            return ""
        unit = 10 ** max(0, len(str(count)) - 2)  # two digits
        is_power = most.setting == "num_envs"  # which utd divides as before
        return _shown(1 << count.bit_length() - 1 if is_power else count // unit * unit)
    sizes = most.value
    while max(sizes, default=0) > 1:
        sizes = tuple(max(1, 1 << (size - 1).bit_length() - 1) for size in sizes)
        if most.size * _weights(sizes) <= left * _weights(most.value):
            return " ".join(map(str, sizes))
    return ""


def _weights(sizes: Sequence[int]) -> int:
    """Return what the weights of layers grow with; the first sees some hundred numbers."""
    return sum(a * b for a, b in itertools.pairwise((100, *sizes)))


def _shown(value: Any) -> str:
    return f"{value:,}" if isinstance(value, int) else " ".join(map(str, value))


def _text(size: float) -> str:
    for unit, power in (("GB", 1e9), ("MB", 1e6)):
        if size >= power:
            return f"{size / power:,.1f} {unit}"
    return f"{max(size, 0.0) / 1e3:.0f} kB"


def room() -> tuple[int, str]:
    """Return the bytes that can still be had where a run computes, and what has them."""
    told = [device.memory_stats() or {} for device in jax.local_devices()]
    if rooms := [stats["bytes_limit"] - stats["bytes_in_use"] for stats in told if stats]:
        return sum(rooms), "the accelerator"
    return host_room(), "this machine"


def host_room() -> int:
    """Return the bytes this process can still have: of the machine, its groups and its limits."""
    import psutil

    rooms = [psutil.virtual_memory().available, *_rooms_of_groups()]
    with contextlib.suppress(ImportError):  # Windows has no such limits
        import resource

        limit, _ = resource.getrlimit(resource.RLIMIT_AS)
        if limit != resource.RLIM_INFINITY:
            rooms.append(limit - psutil.Process().memory_info().vms)
    return max(0, min(rooms))


def _rooms_of_groups(mounts: str = "") -> Iterator[int]:
    """Yield what is left to each control group that this process is in; see ``GROUPS``.

    Args:
        mounts: Folder in which the files of the system are looked for.
    """
    with contextlib.suppress(OSError, ValueError):
        lines = files.read_text(f"{mounts}/proc/self/cgroup", "control groups").splitlines()
        for _, names, path in (line.split(":", 2) for line in lines):
            for controller, mount, (limit, used) in GROUPS:
                if controller not in names.split(","):
                    continue
                inner = Path(f"{mounts}{mount}{path}")
                for folder in (inner, *inner.parents):
                    if not folder.is_relative_to(f"{mounts}{mount}"):
                        break
                    with contextlib.suppress(OSError, ValueError):  # no such file, or "max"
                        yield _number(folder / limit) - _number(folder / used)


def _number(path: Path) -> int:
    return int(files.read_text(path, "a number"))
