"""Networks of a source, taken over by a new run (variants ``weights`` and ``twirl+weights``)."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from twirl_mjx.droq.learner import LEARNER
from twirl_mjx.droq.state import DroqState
from twirl_mjx.policies.learned import NumpyPolicy, hidden_layers
from twirl_mjx.policies.resolve import Source, config_of_source
from twirl_mjx.tasks.observations import Entry
from twirl_mjx.tasks.registry import TASKS
from twirl_mjx.training.checkpoint import load_learner
from twirl_mjx.training.config import TrainConfig
from twirl_mjx.training.learners import learner_of
from twirl_mjx.training.presets import source_task_of
from twirl_mjx.training.source_rules import AtPath, RunOf, source_of


def check_weights_fit(config: TrainConfig, preset: str) -> None:
    """Refuse a variant that needs the networks of a source that cannot fit, before any stage.

    Raises:
        ValueError: The default source observes differently, or the learner is not DroQ.
    """
    if not config.uses_source_weights:
        return
    if (learner := learner_of(config.droq)) is not LEARNER:
        raise ValueError(
            f"variant {config.variant!r} takes over the networks of {LEARNER.name}, not those of"
            f" learner {learner.name} (nearest variant: 'twirl')"
        )
    match source_of(config, preset):
        case AtPath(is_shipped=True) | RunOf():
            task = source_task_of(config)
            layout = TASKS.get(task)(config.source_options).observer.layout
            check_layouts(config, task, layout, f"the source task {task}")


def check_layouts(config: TrainConfig, task: str, layout: tuple[Entry, ...], origin: str) -> None:
    """Check that a policy of ``task`` that observes ``layout`` observes what ``config.task`` shows.

    Raises:
        ValueError: It does not; the message names ``origin``.
    """
    if layout != config.make_task().observer.layout:
        raise ValueError(
            f"{origin} observes as task {task}, not as {config.task}:"
            " its weights do not fit (nearest variant: 'twirl')"
        )


def source_weights(
    config: TrainConfig, source: Source, say: Callable[[str], None]
) -> Callable[[DroqState], DroqState]:
    """Return a function that writes the source's networks into a fresh learner.

    A run directory gives the actor of its best policy, as it is evaluated and shipped, and the
    critics and the temperature of its end; a policy file has only the actor.

    Raises:
        ValueError: The source has no networks, or observations, layer sizes or critics differ.
    """
    policy = source.loaded
    if not isinstance(policy, NumpyPolicy):
        raise ValueError(f"{source.origin} has no network weights (nearest variant: 'twirl')")
    own = config_of_source(config, policy.header, source.origin)
    check_layouts(config, own.task, own.make_task().observer.layout, source.origin)
    sizes = tuple(
        len(policy.actor_params[name]["bias"]) for name in hidden_layers(policy.actor_params)
    )
    if sizes != config.droq.hidden_sizes:
        raise ValueError(
            f"{source.origin} has hidden layers of {sizes} units, this run"
            f" {config.droq.hidden_sizes} (nearest: --droq.hidden-sizes"
            f" {' '.join(map(str, sizes))})"
        )
    actor = jax.tree.map(jnp.asarray, dict(policy.actor_params))
    learner = load_learner(source.run_dir) if source.run_dir else None
    if learner is None:
        say(f"weights: the actor of {source.origin}; a policy file has no critics")
    else:
        critics = jax.tree.leaves(learner["critic"])[0].shape[0]
        if critics != config.droq.num_critics:
            raise ValueError(
                f"{source.origin} has {critics} critics, this run {config.droq.num_critics}"
                f" (nearest: --droq.num-critics {critics})"
            )

    def initial(fresh: DroqState) -> DroqState:
        if learner is None:
            return fresh.replace(actor=actor)
        return fresh.replace(
            actor=actor,
            critic=learner["critic"],
            target_critic=learner["target_critic"],
            log_temperature=learner["log_temperature"],
        )

    return initial
