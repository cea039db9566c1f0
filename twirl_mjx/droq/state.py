"""State of the learner, and what all forms of the update do to parameters."""

from __future__ import annotations

from typing import Any, cast

import flax.struct
import jax
import jax.numpy as jnp
import optax

from twirl_mjx.droq.networks import Params

ADAM_B1 = 0.9
ADAM_B2 = 0.999
ADAM_EPSILON = 1e-8

AdamState = optax.ScaleByAdamState
"""Adam's count, first and second moments; optax's own type, so checkpoints name it plainly."""


class DroqState(flax.struct.PyTreeNode):
    """Everything that learning changes. A leading seed axis on every leaf is allowed."""

    actor: Params
    """Actor parameters."""
    critic: Params
    """Critic parameters, leading axis E on every leaf."""
    target_critic: Params
    """Slow copy of ``critic`` (Polyak average)."""
    actor_opt: AdamState
    """Adam state of the actor."""
    critic_opt: AdamState
    """Adam state of the critic ensemble."""
    log_temperature: jax.Array
    """[] float32, log alpha."""
    temperature_opt: AdamState
    """Adam state of ``log_temperature``."""
    grad_steps: jax.Array
    """[] int32, critic updates done."""


class CriticState(flax.struct.PyTreeNode):
    """The part of ``DroqState`` that a critic step changes."""

    critic: Params
    target_critic: Params
    critic_opt: AdamState


def adam_init(params: Any) -> AdamState:
    """Return Adam moments of zero for ``params``."""
    zeros = jax.tree.map(jnp.zeros_like, params)
    return AdamState(jnp.zeros((), jnp.int32), zeros, jax.tree.map(jnp.copy, zeros))


def adam_step(
    params: Any, grads: Any, opt: AdamState, learning_rate: float
) -> tuple[Any, AdamState]:
    """Take one Adam step (Kingma and Ba 2015, Algorithm 1) with optax."""
    adam = optax.scale_by_adam(b1=ADAM_B1, b2=ADAM_B2, eps=ADAM_EPSILON)
    updates, moments = adam.update(grads, opt)
    new_params = jax.tree.map(lambda p, u: p - learning_rate * u, params, updates)
    return new_params, AdamState(*cast(AdamState, moments))


def polyak(target: Any, online: Any, tau: float) -> Any:
    """Return target + tau (online - target)."""
    return jax.tree.map(lambda t, o: t + tau * (o - t), target, online)


def squared_norm(tree: Any) -> jax.Array:
    """Return the sum of squares of all entries of all leaves."""
    return sum((jnp.sum(jnp.square(leaf)) for leaf in jax.tree.leaves(tree)), jnp.zeros(()))
