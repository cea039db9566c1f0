"""One training program on several devices: seeds side by side, or the worlds of one run.

Each device steps its own worlds by itself (``shard_map``), so solvers and auto-resets never wait
for another device. With worlds spread, learner and replay are copies on every device, and the
compiler gathers the new transitions into each of them.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from twirl_mjx.machine import usable_cores
from twirl_mjx.training import seeds
from twirl_mjx.training.config import TrainConfig
from twirl_mjx.training.guidance import Guide
from twirl_mjx.training.state import TrainState, train_epoch
from twirl_mjx.types import Metrics
from twirl_mjx.worlds.vector import EnvState, VectorEnv

Epoch = Callable[[TrainState], tuple[TrainState, Metrics]]
Place = Callable[[TrainState], TrainState]

SEEDS = "seeds"
WORLDS = "worlds"


def device_mesh(axis: str, count: int | None = None) -> Mesh:
    """Return ``count`` devices of the default backend (all of them) in a row called ``axis``."""
    return Mesh(np.asarray(jax.devices()[:count]), (axis,))


def make_cpu_devices(num_seeds: int) -> None:
    """Ask jax for several CPU devices, so that the seeds of a batch train side by side on cores.

    To jax a CPU is one device whatever its cores, and then the products of a batch of seeds are
    computed one after another by all of them, which small ones are not worth. Does nothing where
    jax has computed something before, or where the number was set (``JAX_NUM_CPU_DEVICES=1``
    keeps one).
    """
    if jax.config.jax_num_cpu_devices >= 0:
        return
    with contextlib.suppress(RuntimeError):  # its devices are fixed by now
        jax.config.update("jax_num_cpu_devices", num_cpu_devices(num_seeds, len(usable_cores())))


def num_cpu_devices(num_seeds: int, cores: int) -> int:
    """Return how many CPU devices a batch of seeds gets: each has equally many seeds.

    As many as fill the cores, with less than two devices for a core (three seeds on two cores
    are faster on three devices than on one, four are slower on four than on two); else as many as
    there are cores for.
    """
    even = [n for n in range(1, num_seeds + 1) if num_seeds % n == 0]
    filling = [n for n in even if min(num_seeds, cores) <= n < 2 * cores]
    return min(filling) if filling else max(n for n in even if n <= cores)


def devices_for(num_seeds: int) -> int:
    """Return the largest number of devices that are there and among which seeds divide evenly."""
    return max(n for n in range(1, jax.device_count() + 1) if num_seeds % n == 0)


def threads_for(num_seeds: int) -> int:
    """Return the host threads that step the worlds of one device: the devices share the cores."""
    return max(1, len(usable_cores()) // devices_for(num_seeds))


def worlds_pay() -> bool:
    """Return whether the worlds of one run are worth several devices, which CPU devices are not.

    C MuJoCo steps them with threads on all cores, and every device repeats the learner's work.
    """
    return jax.default_backend() != "cpu"


def spread_seeds(
    config: TrainConfig,
    env: VectorEnv,
    mesh: Mesh,
    *,
    own_sources: bool = False,
    guide: Guide | None = None,
) -> tuple[Epoch, Place]:
    """Return the epoch of a batch of seeds on the devices of a mesh, and what puts it there.

    Args:
        config: The run.
        env: The worlds of one seed.
        mesh: Devices, with the axis ``SEEDS``.
        own_sources: Whether every seed has a source ring of its own.
        guide: Who else acts, one for all seeds, or None.

    Returns:
        The jitted epoch, which donates its argument, and a function that spreads a state evenly;
        it raises ValueError where the number of seeds is no multiple of the number of devices.
    """
    specs = seeds.per_field(PartitionSpec(SEEDS), _EVERYWHERE, own_sources=own_sources)
    epoch = jax.shard_map(
        seeds.batch_epoch(config, env, own_sources=own_sources, guide=guide),
        mesh=mesh,
        in_specs=(specs,),
        out_specs=(specs, PartitionSpec(SEEDS)),
        check_vma=False,  # that env_steps stays equal on all devices is ours to know
    )

    def place(states: TrainState) -> TrainState:
        check_even("seeds", seeds.num_seeds(states), mesh.size)
        return jax.device_put(states, _named(specs, mesh))

    return _jit_on_mesh(epoch, specs, PartitionSpec(SEEDS), mesh), place


def spread_worlds(config: TrainConfig, env: VectorEnv, mesh: Mesh) -> tuple[Epoch, Place]:
    """Return the epoch of one run with its worlds on the devices of a mesh, and what puts it there.

    Args:
        config: The run.
        env: All its worlds.
        mesh: Devices, with the axis ``WORLDS``.

    Returns:
        The jitted epoch, which donates its argument, and a function that spreads a state evenly.

    Raises:
        ValueError: The number of worlds is not a multiple of the number of devices.
    """
    specs = _world_specs()
    epoch = functools.partial(train_epoch, config, ShardedEnv(env, mesh))

    def place(state: TrainState) -> TrainState:
        return jax.device_put(state, _named(specs, mesh))

    return _jit_on_mesh(epoch, specs, _EVERYWHERE, mesh), place


class ShardedEnv(VectorEnv):
    """The worlds of another env, stepped on the devices of a mesh, an equal part on each."""

    def __init__(self, env: VectorEnv, mesh: Mesh) -> None:
        """Divide the worlds.

        Args:
            env: All worlds.
            mesh: Devices, with the axis ``WORLDS``.

        Raises:
            ValueError: The number of worlds is not a multiple of the number of devices.
        """
        check_even("num_envs", env.num_envs, mesh.size)
        part = env.num_envs // mesh.size

        def make(num_envs: int) -> dict[str, Any]:
            dynamics = jax.tree.map(lambda leaf: leaf[:num_envs], env.dynamics)
            return {
                "num_envs": num_envs,
                "episode_length": env.episode_length,
                "dynamics": dynamics,
                "metric_names": env.metric_names,
                "ranges": env.ranges,
            }

        super().__init__(env.task, env.scene, env.engine, **make(env.num_envs))
        local = VectorEnv(env.task, env.scene, env.engine, **make(part))
        self._step = jax.shard_map(
            local.step_and_fault,
            mesh=mesh,
            in_specs=(PartitionSpec(WORLDS), PartitionSpec(WORLDS)),
            out_specs=(PartitionSpec(WORLDS), PartitionSpec(WORLDS)),
            check_vma=False,  # the solver's loops carry plain constants
        )

    def step(self, state: EnvState, action: jax.Array) -> EnvState:
        """Advance every world by one control step; see :class:`VectorEnv`."""
        return self._step(state, action)[0]


_EVERYWHERE = PartitionSpec()


def _world_specs() -> TrainState:
    """Return a prefix tree of specs: worlds divided, everything else on every device."""
    worlds: Any = PartitionSpec(WORLDS)
    everywhere: Any = _EVERYWHERE
    return TrainState(
        learner=everywhere,
        env=worlds,
        replay=everywhere,
        tracker=worlds,
        key=everywhere,
        env_steps=everywhere,
        inserted=everywhere,
        share=everywhere,
    )


def _named(specs: Any, mesh: Mesh) -> Any:
    return jax.tree.map(
        lambda spec: NamedSharding(mesh, spec),
        specs,
        is_leaf=lambda node: isinstance(node, PartitionSpec),
    )


def _jit_on_mesh(epoch: Epoch, specs: TrainState, metrics: PartitionSpec, mesh: Mesh) -> Epoch:
    """Compile an epoch; without a fixed place for its results a second call compiles anew."""
    state = _named(specs, mesh)
    places = (state, NamedSharding(mesh, metrics))
    return jax.jit(epoch, in_shardings=(state,), out_shardings=places, donate_argnums=0)


def check_even(what: str, number: int, devices: int) -> None:
    """Refuse a number of seeds or worlds that does not divide evenly.

    Raises:
        ValueError: It is not a multiple of the number of devices; the nearest one is named.
    """
    if number % devices:
        nearest = max(1, round(number / devices)) * devices
        raise ValueError(
            f"{what} is {number}, not a multiple of the {devices} devices (nearest: {nearest})"
        )
