"""What is compiled for a batch of seeds; a batch of one is the program of a single run.

A single seed has no batch axis: a conditional stays a conditional, and a run is bit for bit what
it is without the words "batch" and "seed axis". Two seeds and more are the ``seeds`` axis.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from twirl_mjx.evaluation.rollout import ActFn, first_episodes, make_evaluate
from twirl_mjx.replay import ring
from twirl_mjx.replay import share as share_lib
from twirl_mjx.replay.config import AUTO
from twirl_mjx.replay.mixed import MixedReplay
from twirl_mjx.replay.ring import RingBuffer
from twirl_mjx.replay.share import Share
from twirl_mjx.training import seeds as batch
from twirl_mjx.training import sharding
from twirl_mjx.training import state as single
from twirl_mjx.training.config import TrainConfig
from twirl_mjx.training.guidance import Guide
from twirl_mjx.training.learners import learner_of
from twirl_mjx.training.state import TrainState
from twirl_mjx.types import Learner
from twirl_mjx.worlds.make import make_env
from twirl_mjx.worlds.vector import EnvState

REFILL = 2
"""What is folded into a state's key for the actions that refill its ring."""
Evaluate = Callable[[Any, jax.Array], list[dict[str, np.ndarray]]]
"""(actors of S seeds, key) -> the measures [E] of every seed."""


def act_mean(learner: Learner) -> ActFn:
    """Return how a learner's actor acts in evaluation: deterministically, without memory."""

    def act(params: Any, memory: Any, env_state: Any, key: jax.Array) -> tuple[jax.Array, Any]:
        return learner.mean(params, env_state.obs), memory

    return act


def no_memory(env_state: EnvState) -> tuple[()]:
    """Return the memory of a policy that has none."""
    return ()


def split[T](tree: T, num_seeds: int) -> list[T]:
    """Return every seed's part of arrays [S, ...]; one seed's arrays have no such axis."""
    if num_seeds == 1:
        return [tree]
    return [jax.tree.map(lambda leaf, i=i: leaf[i], tree) for i in range(num_seeds)]


def join[T](trees: Sequence[T]) -> T:
    """Return the arrays [S, ...] of several seeds, the inverse of :func:`split`."""
    if len(trees) == 1:
        return trees[0]
    return jax.tree.map(lambda *leaves: jax.numpy.stack(leaves), *trees)


def compile_evaluation(
    config: TrainConfig, num_seeds: int, num_envs: int | None = None
) -> Evaluate:
    """Return the evaluation of the actors of all seeds, in one compiled call.

    Args:
        config: The run; it is evaluated in ``config.evaluation``.
        num_seeds: S.
        num_envs: Episodes E of every seed, ``config.eval.episodes`` by default.
    """
    env = make_env(config.evaluation, num_envs=num_envs)
    act = act_mean(learner_of(config.droq))
    if num_seeds == 1:
        one = make_evaluate(env, no_memory, act)
        return lambda actor, key: [one(actor, key)]
    episodes = functools.partial(first_episodes, env, no_memory, act)
    run = jax.jit(jax.vmap(episodes, in_axes=(0, None)))

    def evaluate(actors: Any, key: jax.Array) -> list[dict[str, np.ndarray]]:
        return split({k: np.asarray(v) for k, v in run(actors, key).items()}, num_seeds)

    return evaluate


class Program:
    """Everything that is compiled to train S seeds of one config."""

    def __init__(
        self,
        configs: Sequence[TrainConfig],
        *,
        own_sources: bool = False,
        guide: Guide | None = None,
    ) -> None:
        """Build (not compile) the functions.

        Args:
            configs: S runs that are alike (``config.of_program``).
            own_sources: Whether every seed has a source ring of its own.
            guide: Who acts beside the learner, one for all seeds, or None.
        """
        config = configs[0]
        self.num_seeds = len(configs)
        self._guide = guide
        self.env = make_env(config, threads=sharding.threads_for(self.num_seeds))
        self.evaluate = compile_evaluation(config, self.num_seeds)
        self._configs = configs
        self._counts_differ = len({each.effective_phi for each in configs}) > 1
        self._own_sources = own_sources
        self.idle_devices: str | None = None
        """Why devices that are there are not used, as a line."""
        self.epoch, self._place = self._compile()
        self._refill: Any = None

    def _compile(self) -> tuple[sharding.Epoch, sharding.Place]:
        """Return the epoch and what puts a state where it runs: seeds or worlds on all devices."""
        config, env, own, guide = self._configs[0], self.env, self._own_sources, self._guide
        if self.num_seeds > 1:
            used = sharding.devices_for(self.num_seeds)
            self._note_idle("seeds", self.num_seeds, used)
            if used > 1:
                mesh = sharding.device_mesh(sharding.SEEDS, used)
                return sharding.spread_seeds(config, env, mesh, own_sources=own, guide=guide)
            epoch = batch.compile_epoch_seeds(config, env, own_sources=own, guide=guide)
            return epoch, lambda states: states
        if jax.device_count() > 1 and sharding.worlds_pay():
            if guide is not None:
                self.idle_devices = f"one device is used: guide {config.guide} works on one"
            elif env.num_envs % jax.device_count():
                self._note_idle("num_envs", env.num_envs, 1)
            else:
                mesh = sharding.device_mesh(sharding.WORLDS)
                return sharding.spread_worlds(config, env, mesh)
        return single.compile_epoch(config, env, guide), lambda state: state

    def _note_idle(self, what: str, number: int, used: int) -> None:
        """Say why not all devices are used, where that is so."""
        try:
            sharding.check_even(what, number, jax.device_count())
        except ValueError as error:
            of = "one device is" if used == 1 else f"{used} devices are"
            self.idle_devices = f"{of} used: {error}"

    def init(self) -> TrainState:
        """Return the states of all seeds before the first transition, without source rings."""
        config, env = self._configs[0], self.env
        if self.num_seeds == 1:
            return jax.jit(lambda key: single.init(config, env, key, None, self._guide))(
                jax.random.key(config.seed)
            )
        seeds = [each.seed for each in self._configs]
        states = batch.init_seeds(config, env, seeds, None, self._guide)
        return states.replace(share=join([self._share(each) for each in self._configs]))

    def _share(self, config: TrainConfig) -> Share | None:
        """Return the share of a seed before its first epoch, where it is data."""
        if self._counts_differ or config.effective_phi == AUTO:
            return share_lib.init(config.effective_phi, config.droq.batch_size)
        return None

    def template(self, index: int) -> TrainState:
        """Return shapes and dtypes of the state of one seed, as it is alone."""
        config, env = self._configs[index], self.env
        return jax.eval_shape(
            lambda key: single.init(config, env, key, None, self._guide), jax.random.key(0)
        )

    def refill(self, state: TrainState) -> jax.Array:
        """Return rows [C, W] of an online ring, as many as it held, gathered with a state's actor.

        Args:
            state: Of one seed, as it is alone; its ring has no rows. It is not changed.

        Raises:
            ValueError: The worlds fail too often.
        """
        config, env = self._configs[0], self.env

        def act(online: RingBuffer, state: TrainState) -> tuple[RingBuffer, TrainState]:
            def step(state: TrainState, _: None) -> tuple[TrainState, None]:
                key, act_key = jax.random.split(state.key)
                return single.collect_step(
                    config, env, state.replace(key=key), act_key, self._guide
                )[0], None

            bare = state.replay
            full = state.replace(replay=MixedReplay(source=None, online=online))
            full, _ = jax.lax.scan(step, full, length=config.steps_per_epoch)
            return full.replay.online, full.replace(replay=bare)

        if self._refill is None:
            self._refill = jax.jit(act, donate_argnums=0)
        wanted = int(state.replay.online.size)
        sizes = (env.observation_size, env.action_size)
        online = ring.init(config.replay.capacity, *sizes)
        state = state.replace(key=jax.random.fold_in(state.key, REFILL))
        most = 2 * -(-wanted // (config.steps_per_epoch * env.num_envs))
        for _ in range(most):
            online, state = self._refill(online, state)
            if int(online.size) >= wanted:
                return online.rows
        if wanted:
            raise ValueError(
                f"--refill: only {int(online.size):,} of {wanted:,} transitions could be gathered,"
                " the worlds failed in the others (nearest: another --name, begun anew)"
            )
        return online.rows

    def stack(self, states: Sequence[TrainState]) -> TrainState:
        """Return the states of S seeds, each as it is alone, as one.

        Raises:
            ValueError: They are not equally far.
        """
        if self.num_seeds == 1:
            return states[0]
        return batch.stack_states(
            [
                state if state.share is not None else state.replace(share=self._share(config))
                for state, config in zip(states, self._configs, strict=True)
            ]
        )

    def seed_state(self, states: TrainState, index: int) -> TrainState:
        """Return the state of one seed of the batch as it is alone, for a checkpoint."""
        if self.num_seeds == 1:
            return states
        state = batch.seed_state(states, index)
        is_auto = self._configs[index].effective_phi == AUTO
        return state if is_auto else state.replace(share=None)

    def place(self, states: TrainState, sources: Sequence[RingBuffer | None]) -> TrainState:
        """Return the states where they are trained, with their source rings or the shared one.

        A seed without a source (phi 0) beside others draws no row of the ring it is given.
        """
        first = next((source for source in sources if source is not None), None)
        source = first
        if self._own_sources and first is not None:
            source = batch.stack_rings([first if ring is None else ring for ring in sources])
        return self._place(states.replace(replay=states.replay.replace(source=source)))
