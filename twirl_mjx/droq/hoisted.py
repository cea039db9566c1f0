"""The same critic updates as ``plain``, with everything that a block shares ahead of its loop.

- Dropout bits come from a counter hash (``dropout``) instead of threefry.
- Actor and temperature are constant during a block of U updates, so next actions and log-densities
  of all U minibatches are one large matrix product ahead of the scan.
- Adam and the Polyak average run over a handful of packed arrays (``packing``).

How arrays lie in memory is left to a :class:`Layout`: ``fast`` has that of CPUs, ``accelerator``
that of GPUs and TPUs.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import cast

import jax
import jax.numpy as jnp

from twirl_mjx.droq import dropout, losses, packing
from twirl_mjx.droq.config import DroqConfig
from twirl_mjx.droq.networks import Params, act
from twirl_mjx.droq.packing import PackedCritic
from twirl_mjx.droq.state import (
    ADAM_B1,
    ADAM_B2,
    ADAM_EPSILON,
    AdamState,
    CriticState,
    squared_norm,
)
from twirl_mjx.types import Metrics, Transition

Masks = Sequence[jax.Array]
"""One bool keep mask per hidden layer, in the shape of its activations."""


@dataclasses.dataclass(frozen=True)
class Layout:
    """Where the axes of critic, rows and unit stand, and the products that suit them.

    Activations have E critics, B rows and H units, in the layout's own order.
    """

    arrange: Callable[[PackedCritic], PackedCritic]
    """Put kernels as ``packing.pack`` returns them into this layout."""
    restore: Callable[[PackedCritic], PackedCritic]
    """Undo ``arrange``."""
    inputs: Callable[[jax.Array, jax.Array], jax.Array]
    """Return critic inputs of obs [..., B, O] and action [..., B, A] with a feature of ones last
    (it meets the biases)."""
    shape: Callable[[int, int, int], tuple[int, int, int]]
    """Return the shape of activations of E critics, B rows and H units."""
    mask: Callable[[jax.Array, tuple[int, int, int], float], jax.Array]
    """Return a keep mask of (hash seed [2], shape, rate)."""
    first: Callable[[jax.Array, jax.Array, int, str], jax.Array]
    """Return kernel 0 times the inputs of one minibatch, for E critics, in a ``matmul_dtype``."""
    dense: Callable[[jax.Array, jax.Array, jax.Array, str], jax.Array]
    """Return kernel times activations plus bias [E, H], in a ``matmul_dtype``."""
    norm: Callable[[jax.Array, jax.Array, jax.Array, jax.Array, float], jax.Array]
    """Return ReLU(LayerNorm(Dropout(z))) of (z, scale [E, H], bias [E, H], keep mask, rate)."""
    out: Callable[[jax.Array, jax.Array], jax.Array]
    """Return weights [E, H] times activations: [E, B]."""

    def masks(self, seeds: jax.Array, rows: int, config: DroqConfig) -> list[jax.Array]:
        """Return the keep masks of all hidden layers from hash seeds [layers, 2]."""
        return [
            self.mask(seeds[i], self.shape(config.num_critics, rows, size), config.dropout_rate)
            for i, size in enumerate(config.hidden_sizes)
        ]

    def ensemble_q(
        self,
        kernels: Sequence[jax.Array],
        vectors: Sequence[jax.Array],
        inputs: jax.Array,
        masks: Masks,
        config: DroqConfig,
    ) -> jax.Array:
        """Return Q [E, B].

        Args:
            kernels: In this layout.
            vectors: As cut by ``packing.split_vectors``.
            inputs: Of one minibatch.
            masks: Keep masks of the hidden layers.
            config: Learner settings.
        """
        num_layers = len(config.hidden_sizes)
        rate = dropout.quantised_rate(config.dropout_rate)
        h = self.first(kernels[0], inputs, config.num_critics, config.matmul_dtype)
        for i in range(num_layers):
            if i:
                h = self.dense(kernels[i], h, vectors[i - 1], config.matmul_dtype)
            scale, bias = vectors[num_layers - 1 + 2 * i : num_layers + 1 + 2 * i]
            h = self.norm(h, scale, bias, masks[i], rate)
        return self.out(vectors[-2], h) + vectors[-1]

    def critic_q(
        self,
        critic: Params,
        obs: jax.Array,
        action: jax.Array,
        config: DroqConfig,
        key: jax.Array,
        keep: Masks | None = None,
    ) -> jax.Array:
        """Return Q [E, B] under fresh dropout; arguments as in ``plain.critic_q``.

        Only ``keep`` differs: masks here are in this layout.
        """
        packed = self.arrange(packing.pack(critic, config.hidden_sizes))
        vectors = packing.split_vectors(packed.vectors, config.hidden_sizes)
        seeds = dropout.seeds(key, (len(config.hidden_sizes),))
        masks = self.masks(seeds, obs.shape[0], config) if keep is None else keep
        return self.ensemble_q(packed.kernels, vectors, self.inputs(obs, action), masks, config)

    def critic_block(
        self,
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
        next_action, next_log_prob = act(
            actor, minibatches.next_obs, next_noise, config.matmul_dtype
        )
        done = cast(jax.Array, state.critic_opt.count)
        xs = (
            self.inputs(minibatches.obs, minibatches.action),
            self.inputs(minibatches.next_obs, next_action),
            minibatches.reward,
            minibatches.terminated,
            next_log_prob,
            dropout.seeds(key, (num_steps, 2, len(config.hidden_sizes))),
            bias_corrections(done, num_steps, config.learning_rate),
        )
        moments = cast(tuple[Params, Params], (state.critic_opt.mu, state.critic_opt.nu))
        trees = (state.critic, state.target_critic, *moments)
        packed = tuple(self.arrange(packing.pack(tree, config.hidden_sizes)) for tree in trees)

        def body(carry: tuple, step: tuple) -> tuple[tuple, tuple]:
            critic, target_critic, mu, nu = carry
            inputs, next_inputs, reward, terminated, log_prob, seeds, corrections = step
            masks = [self.masks(seeds[i], rows, config) for i in range(2)]
            vectors = packing.split_vectors(target_critic.vectors, config.hidden_sizes)
            next_q = self.ensemble_q(target_critic.kernels, vectors, next_inputs, masks[1], config)
            target = losses.td_target(
                reward, terminated, next_q, log_prob, temperature, config.discount
            )
            q, grad = self.critic_gradient(critic, inputs, target, masks[0], config)
            packed = _adam_polyak(critic, target_critic, mu, nu, grad, corrections, config.tau)
            return packed, (q, target, squared_norm(grad))

        packed, (q, target, squares) = jax.lax.scan(body, packed, xs)
        critic, target_critic, mu, nu = (
            packing.unpack(self.restore(p), config.hidden_sizes) for p in packed
        )
        metrics = {
            "critic_loss": jnp.mean(jnp.square(q - target[:, None])),
            "q_mean": jnp.mean(q),
            "target_q_mean": jnp.mean(target),
            "critic_grad_norm": jnp.mean(jnp.sqrt(squares)),
        }
        return CriticState(critic, target_critic, AdamState(done + num_steps, mu, nu)), metrics

    def critic_gradient(
        self,
        critic: PackedCritic,
        inputs: jax.Array,
        target: jax.Array,
        masks: Masks,
        config: DroqConfig,
    ) -> tuple[jax.Array, PackedCritic]:
        """Return Q [E, B] and the gradient of the critic loss.

        Args:
            critic: Packed parameters in this layout.
            inputs: Of one minibatch.
            target: [B] TD targets.
            masks: Keep masks of the hidden layers.
            config: Learner settings.
        """

        def loss_fn(kernels: Sequence[jax.Array], vectors: Sequence[jax.Array]) -> tuple:
            q = self.ensemble_q(kernels, vectors, inputs, masks, config)
            return losses.critic_loss(q, target), q

        vectors = packing.split_vectors(critic.vectors, config.hidden_sizes)
        grads, q = jax.grad(loss_fn, argnums=(0, 1), has_aux=True)(critic.kernels, vectors)
        return q, PackedCritic(kernels=grads[0], vectors=jnp.concatenate(grads[1], axis=1))


def bias_corrections(
    count: jax.Array, num_steps: int, learning_rate: float
) -> tuple[jax.Array, jax.Array]:
    """Return what Adam's bias corrections come to in U steps after ``count``, [U] each.

    The step size over 1 - beta_1^t, and 1 / sqrt(1 - beta_2^t).
    """
    step = (count + 1 + jnp.arange(num_steps)).astype(jnp.float32)
    return learning_rate / (1.0 - ADAM_B1**step), jax.lax.rsqrt(1.0 - ADAM_B2**step)


def _adam_polyak(
    critic: PackedCritic,
    target_critic: PackedCritic,
    mu: PackedCritic,
    nu: PackedCritic,
    grad: PackedCritic,
    corrections: tuple[jax.Array, jax.Array],
    tau: float,
) -> tuple[PackedCritic, PackedCritic, PackedCritic, PackedCritic]:
    """Take one Adam step with the two scalars of ``bias_corrections``, then one Polyak step."""
    step_size, root_scale = corrections

    def move(p: jax.Array, m: jax.Array, n: jax.Array) -> jax.Array:
        return p - step_size * m / (jnp.sqrt(n) * root_scale + ADAM_EPSILON)

    mu = jax.tree.map(lambda m, g: ADAM_B1 * m + (1.0 - ADAM_B1) * g, mu, grad)
    nu = jax.tree.map(lambda n, g: ADAM_B2 * n + (1.0 - ADAM_B2) * jnp.square(g), nu, grad)
    critic = jax.tree.map(move, critic, mu, nu)
    target_critic = jax.tree.map(lambda t, p: t + tau * (p - t), target_critic, critic)
    return critic, target_critic, mu, nu
