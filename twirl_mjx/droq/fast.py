"""The same critic updates as ``plain``, arranged for few and large operations on a CPU.

- Dropout bits come from a counter hash (``dropout``) instead of threefry.
- Actor and temperature are constant during a block of U updates, so next actions and log-densities
  of all U minibatches are one large matrix product ahead of the scan.
- Dropout, layer norm and ReLU have a hand-written gradient (``fused``); activations are [E, H, B].
- Adam and the Polyak average run over a handful of packed arrays (``packing``).

``docs/performance_learner.md`` has the gain of each.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import jax
import jax.numpy as jnp

from twirl_mjx.droq import dropout, fused, losses, packing
from twirl_mjx.droq.config import DroqConfig
from twirl_mjx.droq.networks import Params, actor_distribution, squash
from twirl_mjx.droq.packing import PackedCritic
from twirl_mjx.droq.state import ADAM_B1, ADAM_B2, ADAM_EPSILON, AdamState, CriticState
from twirl_mjx.types import Metrics, Transition

Masks = Sequence[jax.Array]
"""One bool keep mask [E, H, B] per hidden layer."""


def critic_q(
    critic: Params,
    obs: jax.Array,
    action: jax.Array,
    config: DroqConfig,
    key: jax.Array,
    keep: Masks | None = None,
) -> jax.Array:
    """Return Q [E, B] under fresh dropout; arguments as in ``plain.critic_q``.

    Only ``keep`` differs: masks here are [E, H, B].
    """
    packed = packing.pack(critic, config.hidden_sizes)
    vectors = packing.split_vectors(packed.vectors, config.hidden_sizes)
    seeds = dropout.seeds(key, (len(config.hidden_sizes),))
    masks = _masks(seeds, obs.shape[0], config) if keep is None else keep
    return ensemble_q(packed.kernels, vectors, columns(obs, action), masks, config)


def columns(obs: jax.Array, action: jax.Array) -> jax.Array:
    """Return critic inputs [..., O + A + 1, B] with a last row of ones (it meets the biases)."""
    ones = jnp.ones((*action.shape[:-1], 1))
    return jnp.swapaxes(jnp.concatenate([obs, action, ones], axis=-1), -1, -2)


def ensemble_q(
    kernels: Sequence[jax.Array],
    vectors: Sequence[jax.Array],
    inputs: jax.Array,
    masks: Masks,
    config: DroqConfig,
) -> jax.Array:
    """Return Q [E, B].

    Args:
        kernels: As in ``PackedCritic``.
        vectors: As cut by ``packing.split_vectors``.
        inputs: [O + A + 1, B] from ``columns``.
        masks: Keep masks of the hidden layers.
        config: Learner settings.
    """
    num_layers = len(config.hidden_sizes)
    rate = dropout.quantised_rate(config.dropout_rate)
    z = fused.matmul(kernels[0], inputs[None], config.matmul_dtype)
    h = z.reshape(config.num_critics, -1, inputs.shape[-1])
    for i in range(num_layers):
        if i:
            h = fused.matmul(kernels[i], h, config.matmul_dtype) + vectors[i - 1][..., None]
        scale, bias = vectors[num_layers - 1 + 2 * i : num_layers + 1 + 2 * i]
        h = fused.dropout_norm_relu(h, scale, bias, masks[i], rate)
    return jnp.einsum("eh,ehb->eb", vectors[-2], h) + vectors[-1]


def critic_block(
    state: CriticState,
    actor: Params,
    temperature: jax.Array,
    config: DroqConfig,
    minibatches: Transition,
    next_noise: jax.Array,
    key: jax.Array,
) -> tuple[CriticState, Metrics]:
    """Take U critic steps; arguments and result as in ``plain.critic_block``."""
    num_steps, rows = minibatches.reward.shape
    mean, log_std = actor_distribution(actor, minibatches.next_obs, config.matmul_dtype)
    next_action, next_log_prob = squash(mean, log_std, next_noise)
    xs = (
        columns(minibatches.obs, minibatches.action),
        columns(minibatches.next_obs, next_action),
        minibatches.reward,
        minibatches.terminated,
        next_log_prob,
        dropout.seeds(key, (num_steps, 2, len(config.hidden_sizes))),
    )
    moments = cast(tuple[Params, Params], (state.critic_opt.mu, state.critic_opt.nu))
    trees = (state.critic, state.target_critic, *moments)
    packed = tuple(packing.pack(tree, config.hidden_sizes) for tree in trees)

    def body(carry: tuple, step: tuple) -> tuple[tuple, tuple]:
        (critic, target_critic, mu, nu), count = carry
        inputs, next_inputs, reward, terminated, log_prob, seeds = step
        masks = [_masks(seeds[i], rows, config) for i in range(2)]
        vectors = packing.split_vectors(target_critic.vectors, config.hidden_sizes)
        next_q = ensemble_q(target_critic.kernels, vectors, next_inputs, masks[1], config)
        target = losses.td_target(
            reward, terminated, next_q, log_prob, temperature, config.discount
        )
        q, grad = critic_gradient(critic, inputs, target, masks[0], config)
        count = count + 1
        packed = _adam_polyak(critic, target_critic, mu, nu, grad, count, config)
        return (packed, count), (q, target, _squared_norm(grad))

    carry = (packed, state.critic_opt.count)
    (packed, count), (q, target, squared_norm) = jax.lax.scan(body, carry, xs)
    critic, target_critic, mu, nu = (packing.unpack(p, config.hidden_sizes) for p in packed)
    metrics = {
        "critic_loss": jnp.mean(jnp.square(q - target[:, None])),
        "q_mean": jnp.mean(q),
        "target_q_mean": jnp.mean(target),
        "critic_grad_norm": jnp.mean(jnp.sqrt(squared_norm)),
    }
    return CriticState(critic, target_critic, AdamState(count, mu, nu)), metrics


def critic_gradient(
    critic: PackedCritic, inputs: jax.Array, target: jax.Array, masks: Masks, config: DroqConfig
) -> tuple[jax.Array, PackedCritic]:
    """Return Q [E, B] and the gradient of the critic loss.

    Args:
        critic: Packed parameters.
        inputs: [O + A + 1, B] from ``columns``.
        target: [B] TD targets.
        masks: Keep masks of the hidden layers.
        config: Learner settings.
    """

    def loss_fn(kernels: Sequence[jax.Array], vectors: Sequence[jax.Array]) -> tuple:
        q = ensemble_q(kernels, vectors, inputs, masks, config)
        return losses.critic_loss(q, target), q

    vectors = packing.split_vectors(critic.vectors, config.hidden_sizes)
    grads, q = jax.grad(loss_fn, argnums=(0, 1), has_aux=True)(critic.kernels, vectors)
    return q, PackedCritic(kernels=grads[0], vectors=jnp.concatenate(grads[1], axis=1))


def _masks(seeds: jax.Array, rows: int, config: DroqConfig) -> list[jax.Array]:
    """Return keep masks [E, H, B] of all hidden layers from hash seeds [layers, 2]."""
    return fused.ensemble_masks(
        seeds, config.num_critics, config.hidden_sizes, rows, config.dropout_rate
    )


def _squared_norm(grad: PackedCritic) -> jax.Array:
    """Return the sum of squares of all entries."""
    return sum((jnp.sum(jnp.square(leaf)) for leaf in jax.tree.leaves(grad)), jnp.zeros(()))


def _adam_polyak(
    critic: PackedCritic,
    target_critic: PackedCritic,
    mu: PackedCritic,
    nu: PackedCritic,
    grad: PackedCritic,
    count: jax.Array,
    config: DroqConfig,
) -> tuple[PackedCritic, PackedCritic, PackedCritic, PackedCritic]:
    """Take one Adam step (bias corrections folded into two scalars), then one Polyak step."""
    step = count.astype(jnp.float32)
    step_size = config.learning_rate / (1.0 - ADAM_B1**step)
    root_scale = jax.lax.rsqrt(1.0 - ADAM_B2**step)

    def move(p: jax.Array, m: jax.Array, n: jax.Array) -> jax.Array:
        return p - step_size * m / (jnp.sqrt(n) * root_scale + ADAM_EPSILON)

    mu = jax.tree.map(lambda m, g: ADAM_B1 * m + (1.0 - ADAM_B1) * g, mu, grad)
    nu = jax.tree.map(lambda n, g: ADAM_B2 * n + (1.0 - ADAM_B2) * jnp.square(g), nu, grad)
    critic = jax.tree.map(move, critic, mu, nu)
    target_critic = jax.tree.map(lambda t, p: t + config.tau * (p - t), target_critic, critic)
    return critic, target_critic, mu, nu
