"""The Python loop around the compiled epoch: logging, evaluation, checkpoints, signals."""

from __future__ import annotations

import dataclasses
import math
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from twirl_mjx.evaluation.rollout import ActFn, make_evaluate
from twirl_mjx.policies.learned import NumpyPolicy, PolicyHeader, load_policy, save_policy
from twirl_mjx.replay.ring import RingBuffer
from twirl_mjx.tasks.measures import episode_means, measures_of
from twirl_mjx.tasks.observations import layout_slices
from twirl_mjx.training import config_json, rundir, state
from twirl_mjx.training.checkpoint import Checkpoints
from twirl_mjx.training.config import TrainConfig
from twirl_mjx.training.guards import check_experience, check_finite
from twirl_mjx.training.learners import check_learner, learner_of
from twirl_mjx.training.logger import RunLogger
from twirl_mjx.training.rundir import RunDir
from twirl_mjx.training.signals import stop_on_signal
from twirl_mjx.training.sinks.base import RunInfo, Sink
from twirl_mjx.training.sinks.table import FINAL
from twirl_mjx.training.state import TrainState
from twirl_mjx.types import Learner, MetricInfo
from twirl_mjx.worlds.make import make_env
from twirl_mjx.worlds.vector import VectorEnv


@dataclasses.dataclass(frozen=True)
class Outcome:
    """How a call of :func:`train` ended."""

    finished: bool
    """False when a signal stopped the run; the same command resumes it."""
    env_steps: int
    final: dict[str, float]
    """Mean measures of the closing evaluation of the best policy; empty unless finished."""


def act_mean(learner: Learner) -> ActFn:
    """Return how a learner's actor acts in evaluation: deterministically, without memory."""

    def act(params: Any, memory: Any, env_state: Any, key: jax.Array) -> tuple[jax.Array, Any]:
        return learner.mean(params, env_state.obs), memory

    return act


def no_memory(env_state: Any) -> tuple[()]:
    """Return the memory of a policy that has none."""
    return ()


def make_header(config: TrainConfig, env: VectorEnv, card: dict[str, Any]) -> PolicyHeader:
    """Return the header of a policy file of this run."""
    layout = env.task.observer.layout
    slices = layout_slices(layout)
    return PolicyHeader(
        task=config.task,
        observation_size=env.observation_size,
        action_size=env.action_size,
        control_dt=env.control_dt,
        observation_layout=tuple(
            (e.name, slices[e.name].start, slices[e.name].stop, e.unit) for e in layout
        ),
        config_digest=rundir.digest(config),
        versions=rundir.versions(),
        card=card,
    )


class Run:
    """One training run: owns the directory, the compiled functions and the loop's bookkeeping."""

    def __init__(
        self, config: TrainConfig, run_dir: RunDir, source: RingBuffer | None, stage: str
    ) -> None:
        """Build (not compile) everything.

        Raises:
            ValueError: A function of the learner does not do what ``types.Learner`` says.
        """
        self.config = config
        self.run_dir = run_dir
        self.env = make_env(config)
        check_learner(config.droq, self.env.observation_size, self.env.action_size)
        self.replay_ratio = config.droq.utd * config.droq.batch_size
        self.checkpoints = Checkpoints(run_dir.path)
        self.stage = stage
        self.source = source
        self.source_rows = 0.0 if source is None else float(source.size)
        self.resumed_at: int | None = None
        self.took_weights = False
        self.progress: dict[str, Any] = {"best": -math.inf, "wall_s": 0.0, "inserted": 0}
        env = make_env(config.evaluation)
        self._evaluate = make_evaluate(env, no_memory, act_mean(learner_of(config.droq)))
        self._epoch = state.compile_epoch(config, self.env)

    def info(self) -> RunInfo:
        """Return what sinks are told; call it after :meth:`start`, which may resume."""
        measures = measures_of(self.env.task).items()
        return RunInfo(
            directory=self.run_dir.path,
            identity=self.run_dir.identity(self.config),
            total_env_steps=self.config.total_env_steps,
            stage=self.stage,
            resume_env_steps=self.resumed_at,
            measures={name: MetricInfo(measure.about, measure.unit) for name, measure in measures},
            learning=learner_of(self.config.droq).metrics,
            config=config_json.flatten(self.config),
        )

    def start(self, initial: Callable[[Any], Any] | None) -> TrainState:
        """Return the state to begin or resume from.

        Args:
            initial: Changes the fresh learner, e.g. to start from source networks.
        """

        def fresh(key: jax.Array) -> TrainState:
            return state.init(self.config, self.env, key, None)

        key = jax.random.key(self.config.seed)
        if self.checkpoints.latest() is None:
            made = jax.jit(fresh)(key)
            if initial is not None:
                made = made.replace(learner=initial(made.learner))
                self.took_weights = True
        else:
            made, progress = self.checkpoints.restore(jax.eval_shape(fresh, key))
            self.resumed_at = int(made.env_steps)
            self.progress |= progress
        return made.replace(replay=made.replay.replace(source=self.source))

    def evaluate(self, train_state: TrainState) -> dict[str, float]:
        """Evaluate the deterministic policy on the evaluation seed; keep the best policy."""
        values = self._evaluate(train_state.learner.actor, jax.random.key(self.config.eval.seed))
        means = episode_means(values)
        self.save_policy(self.run_dir.last_policy, train_state, means)
        if means["return"] > self.progress["best"]:
            self.progress["best"] = means["return"]
            self.save_policy(self.run_dir.policy, train_state, means)
        return {f"eval/{name}": v for name, v in means.items()}

    def save_policy(self, path: Path, train_state: TrainState, means: dict[str, float]) -> None:
        """Write the present actor as a policy file of the run."""
        card = {
            "seed": self.config.seed,
            "variant": self.config.variant,
            "shift": self.config.shift,
            "env_steps": int(train_state.env_steps),
            "grad_steps": int(train_state.learner.grad_steps),
            "replay_ratio": self.replay_ratio,
            "wall_s": round(self.progress["wall_s"], 1),
            "options": dataclasses.asdict(self.config.options),
            "evaluation": means,
        }
        actor = jax.tree.map(np.asarray, train_state.learner.actor)
        save_policy(path, actor, make_header(self.config, self.env, card))

    def save(self, train_state: TrainState) -> None:
        """Write a checkpoint; refuses a state that is not finite."""
        check_finite(train_state.learner)
        self.progress["inserted"] = int(train_state.inserted)
        self.checkpoints.save(train_state, self.progress)

    def close(self) -> None:
        """Release the checkpoint manager."""
        self.checkpoints.close()

    def loop(self, train_state: TrainState, logger: RunLogger, stop: threading.Event) -> TrainState:
        """Run epochs until the budget is spent or ``stop`` is set; checkpoints on the way."""
        config = self.config
        saved = began = time.monotonic()
        before = self.progress["wall_s"]
        first = True
        if self.took_weights:  # what training has to beat
            with logger.aside("evaluating the weights taken over ..."):
                logger.log(0, 0, self.evaluate(train_state))
        while (steps := int(train_state.env_steps)) < config.total_env_steps and not stop.is_set():
            if first:
                with logger.compiling("train_epoch"):
                    train_state, metrics = self._epoch(train_state)
                    jax.block_until_ready(metrics)
                first = False
            else:
                train_state, metrics = self._epoch(train_state)
            values = {name: float(value) for name, value in metrics.items()}
            values |= {"replay_ratio": self.replay_ratio, "source_rows": self.source_rows}
            check_finite(train_state.learner)
            check_experience(train_state)
            self.progress["wall_s"] = before + time.monotonic() - began
            now = int(train_state.env_steps)
            if now // config.eval.every > steps // config.eval.every or (
                now >= config.total_env_steps
            ):
                with logger.aside("evaluating ..."):
                    values |= self.evaluate(train_state)
            logger.log(now, int(train_state.learner.grad_steps), values)
            if time.monotonic() - saved > 60.0 * config.checkpoint_minutes:
                self.save(train_state)
                saved = time.monotonic()
        self.save(train_state)
        return train_state


def train(
    config: TrainConfig,
    run_dir: RunDir,
    *,
    source: RingBuffer | None = None,
    initial: Callable[[Any], Any] | None = None,
    stage: str = "train",
    sinks: Sequence[Sink] = (),
) -> Outcome:
    """Train (or resume) one run to its budget.

    Args:
        config: The run; its ``total_env_steps`` is rounded up to whole epochs.
        run_dir: Its directory, judged to be new or resumable (``RunDir.status``).
        source: Frozen source experience; needed when ``config.uses_source_data``.
        initial: Changes the fresh learner before the first transition.
        stage: Name shown with the progress.
        sinks: Where metrics go beside ``metrics.csv``, TensorBoard and the terminal.

    Raises:
        DivergedError: The learner is no longer finite.
        ValueError: Source data are needed and missing.
    """
    if config.uses_source_data and source is None:
        raise ValueError(f"variant {config.variant} with phi {config.replay.phi} needs source data")
    run_dir.open(config)
    run = Run(config, run_dir, source, stage)
    try:
        train_state = run.start(initial)
        steps = run.resumed_at or 0
        with stop_on_signal() as stop, RunLogger(run.info(), sinks) as logger:
            if steps:
                logger.announce(f"resuming {run_dir.name} at {steps:,} transitions")
            if run.checkpoints.stepped_over:
                logger.announce(run.checkpoints.stepped_over)
            train_state = run.loop(train_state, logger, stop)
            steps = int(train_state.env_steps)
            if steps < config.total_env_steps:
                logger.announce(f"stopped at {steps:,} transitions; the same command resumes")
                return Outcome(False, steps, {})
            with logger.aside("final evaluation ..."):
                values = final_evaluation(config, run_dir)
            final = episode_means(values)
            last = {FINAL + name: value for name, value in final.items()}
            logger.log(steps, int(train_state.learner.grad_steps), last)
            run_dir.write_episodes(config, steps, values)  # last: it says that the run is finished
            return Outcome(True, steps, final)
    finally:
        run.close()


def final_evaluation(config: TrainConfig, run_dir: RunDir) -> dict[str, np.ndarray]:
    """Evaluate the best policy of a run on fresh seeds; return measures [E]."""
    policy = load_policy(run_dir.policy)
    assert isinstance(policy, NumpyPolicy), "a run writes .npz policies"
    actor = jax.tree.map(jnp.asarray, dict(policy.actor_params))
    env = make_env(config.evaluation, num_envs=config.eval.final_episodes)
    evaluate = make_evaluate(env, no_memory, act_mean(learner_of(config.droq)))
    return evaluate(actor, jax.random.key(config.eval.seed + 1))
