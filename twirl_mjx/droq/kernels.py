"""The critic updates of a block as a few hand-written GPU kernels (Pallas, by way of Triton).

What bounds one learner on a GPU is the number of launches, so an update is 3 L + 1 of them for L
hidden layers (7 for the paper's two), and nothing is sliced, stacked or copied in between:

- ``_forward``, one a layer: product, dropout, layer norm and ReLU of online and target critics
  together. Rows are local to a program, so the layer norm is too.
- ``_backward``, one a layer, from the last to the first: TD target and loss, or the product with
  the next layer's kernel; then through ReLU, layer norm and dropout. Each program leaves its share
  of the gradients of all vectors.
- ``_update_kernel``, one a layer, and ``_update_vectors``: the gradient's product or sum, with
  Adam and the Polyak average as its last step, in place.

Minibatches stay stacked; a kernel is told which update it is. The masks are those of
``accelerator``, so the two forms are equal up to the order of sums, and the sums are in a fixed
order: nothing is added atomically. Actor and temperature use ``accelerator``.

On an H200 it agrees with the CPU to the same digits as the other forms do, and one learner makes
2.2 times the updates of ``accelerator`` (docs/accelerators.md), so ``forms`` chooses it there. On a
CPU Pallas interprets it, which is right and far too slow to train with.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
from etils import epy

from twirl_mjx.droq import accelerator, dropout, losses, packing
from twirl_mjx.droq.config import DroqConfig
from twirl_mjx.droq.hoisted import bias_corrections
from twirl_mjx.droq.networks import LAYER_NORM_EPSILON, Params, act
from twirl_mjx.droq.packing import PackedCritic
from twirl_mjx.droq.state import ADAM_B1, ADAM_B2, ADAM_EPSILON, AdamState, CriticState
from twirl_mjx.types import Metrics, Transition

with epy.lazy_imports():  # 0.2 s that hardly any run needs
    from jax.experimental import pallas as pl

ROWS = 16
"""Rows of a minibatch that one program of ``_forward`` and ``_backward`` takes."""
DEPTH = 32
"""Terms of a product that are loaded together."""
TILE = 64
"""Most rows and columns of a weight kernel that one program of ``_update_kernel`` takes."""
LANES = 128
"""Vector entries that one program of ``_update_vectors`` takes."""

ONLINE, TARGET = 0, 1

LAYOUT = accelerator.LAYOUT
critic_q = accelerator.critic_q


@dataclasses.dataclass(frozen=True)
class _Plan:
    """Sizes of a block of updates, and where the vectors of each layer stand."""

    config: DroqConfig
    rows: int
    inputs: int
    """Features with the one for the bias, without padding."""

    @property
    def sizes(self) -> tuple[int, ...]:
        return self.config.hidden_sizes

    @property
    def critics(self) -> int:
        return self.config.num_critics

    @property
    def fan_in(self) -> list[int]:
        """Rows of each weight kernel; the first is padded to whole ``DEPTH``."""
        return [-(-self.inputs // DEPTH) * DEPTH, *self.sizes[:-1]]

    @property
    def blocks(self) -> int:
        return self.rows // ROWS

    @property
    def vectors(self) -> int:
        """Vector entries, padded to whole ``LANES``."""
        return -(-sum(packing.vector_sizes(self.sizes)) // LANES) * LANES

    def columns(self, layer: int) -> tuple[int, int, int]:
        """Return where a layer's dense bias (none for the first), scale and bias begin."""
        ends = [0]
        for size in packing.vector_sizes(self.sizes):
            ends.append(ends[-1] + size)
        norm = len(self.sizes) - 1 + 2 * layer
        return ends[max(layer - 1, 0)], ends[norm], ends[norm + 1]

    @property
    def out(self) -> int:
        """Where the output layer's weights begin; its bias follows."""
        return sum(packing.vector_sizes(self.sizes)[:-2])

    def depth(self, layer: int) -> int:
        """Return how many terms of a layer's product are loaded together."""
        return min(DEPTH, self.fan_in[layer])

    def tile(self, layer: int) -> tuple[int, int]:
        """Return rows and columns of a tile of a layer's weight kernel."""
        height = min(TILE, self.fan_in[layer]) if layer else DEPTH
        return height, min(TILE, self.sizes[layer])

    def tiles(self, layer: int) -> tuple[int, int]:
        """Return how many tiles a layer's weight kernel has down and across."""
        height, width = self.tile(layer)
        return self.fan_in[layer] // height, self.sizes[layer] // width


def _dot(a: jax.Array, b: jax.Array, matmul_dtype: str) -> jax.Array:
    a, b = a.astype(matmul_dtype), b.astype(matmul_dtype)
    return jax.lax.dot(a, b, preferred_element_type=jnp.float32)


def _keep(
    plan: _Plan,
    seed: tuple[jax.Array, jax.Array],
    critic: jax.Array,
    first_row: jax.Array,
    units: int,
) -> jax.Array:
    """Return the keep mask [ROWS, units] of some rows of one critic."""
    shape = (ROWS, units)
    row = jax.lax.broadcasted_iota(jnp.uint32, shape, 0) + first_row.astype(jnp.uint32)
    column = jax.lax.broadcasted_iota(jnp.uint32, shape, 1)
    return dropout.keep_at(
        seed, critic.astype(jnp.uint32), row, column, (plan.rows, units), plan.config.dropout_rate
    )


def _forward(plan: _Plan, layer: int, step_ref: Any, x_ref: Any, w_ref: Any, v_ref: Any,
             seed_ref: Any, *rest: Any) -> None:  # fmt: skip
    """Compute a layer of one network for some rows: grid (2, E, blocks)."""
    which, critic, block = (pl.program_id(i) for i in range(3))
    units, last = plan.sizes[layer], layer == len(plan.sizes) - 1
    h_ref, normal_ref, rstd_ref, *q_ref = rest[1:] if last else rest
    step, rows = step_ref[0], pl.ds(block * ROWS, ROWS)

    def add(k: jax.Array, total: jax.Array) -> jax.Array:
        terms = pl.ds(k * depth, depth)
        x = x_ref[step, which, rows, terms] if layer == 0 else x_ref[which, critic, rows, terms]
        return total + _dot(x, w_ref[which, critic, terms, :], plan.config.matmul_dtype)

    depth = plan.depth(layer)
    z = jax.lax.fori_loop(0, plan.fan_in[layer] // depth, add, jnp.zeros((ROWS, units)))
    dense, scale, bias = (
        v_ref[which, critic, pl.ds(start, units)] for start in plan.columns(layer)
    )
    if layer:
        z = z + dense[None]
    seed = seed_ref[step, which, layer, 0], seed_ref[step, which, layer, 1]
    kept = jnp.where(_keep(plan, seed, critic, block * ROWS, units), z, 0.0)
    centred = kept - jnp.sum(kept, axis=1, keepdims=True) / units
    variance = jnp.sum(centred * centred, axis=1) / units
    rate = dropout.quantised_rate(plan.config.dropout_rate)
    rstd = jax.lax.rsqrt(variance + LAYER_NORM_EPSILON * (1.0 - rate) ** 2)
    normal = centred * rstd[:, None]
    h = jnp.maximum(normal * scale[None] + bias[None], 0.0)
    h_ref[which, critic, rows, :] = h
    normal_ref[which, critic, rows, :] = normal
    rstd_ref[which, critic, rows] = rstd
    if last:
        weights = v_ref[which, critic, pl.ds(plan.out, units)]
        q = jnp.sum(h * weights[None], axis=1) + v_ref[which, critic, plan.out + units]
        q_ref[0][step, which, critic, rows] = q


def _backward(plan: _Plan, layer: int, step_ref: Any, h_ref: Any, normal_ref: Any, rstd_ref: Any,
              v_ref: Any, seed_ref: Any, *rest: Any) -> None:  # fmt: skip
    """Go back through a layer of one online critic for some rows: grid (E, blocks).

    The last layer gets Q and what the target is made of, the others the next one's dz and kernel.
    """
    critic, block = pl.program_id(0), pl.program_id(1)
    units, last = plan.sizes[layer], layer == len(plan.sizes) - 1
    *given, _, dz_ref, share_ref = rest
    step, rows = step_ref[0], pl.ds(block * ROWS, ROWS)
    h, normal = h_ref[ONLINE, critic, rows, :], normal_ref[ONLINE, critic, rows, :]
    if last:
        dq = _loss_gradient(plan, step, critic, rows, *given)
        weights = v_ref[ONLINE, critic, pl.ds(plan.out, units)]
        dh = dq[:, None] * weights[None]
        share_ref[critic, block, pl.ds(plan.out, units)] = jnp.sum(dq[:, None] * h, axis=0)
        share_ref[critic, block, plan.out + units] = jnp.sum(dq)
    else:
        next_dz_ref, w_ref = given

        def add(k: jax.Array, total: jax.Array) -> jax.Array:
            terms = pl.ds(k * depth, depth)
            w = w_ref[ONLINE, critic, :, terms]
            return total + _dot(next_dz_ref[critic, rows, terms], w.T, plan.config.matmul_dtype)

        depth = min(DEPTH, plan.sizes[layer + 1])
        start = jnp.zeros((ROWS, units))
        dh = jax.lax.fori_loop(0, plan.sizes[layer + 1] // depth, add, start)
    dense_at, scale_at, bias_at = plan.columns(layer)
    dy = jnp.where(h > 0.0, dh, 0.0)
    share_ref[critic, block, pl.ds(scale_at, units)] = jnp.sum(dy * normal, axis=0)
    share_ref[critic, block, pl.ds(bias_at, units)] = jnp.sum(dy, axis=0)
    dn = dy * v_ref[ONLINE, critic, pl.ds(scale_at, units)][None]
    mean = jnp.sum(dn, axis=1, keepdims=True) / units
    along = jnp.sum(dn * normal, axis=1, keepdims=True) / units
    dkept = (dn - mean - normal * along) * rstd_ref[ONLINE, critic, rows][:, None]
    seed = seed_ref[step, ONLINE, layer, 0], seed_ref[step, ONLINE, layer, 1]
    dz = jnp.where(_keep(plan, seed, critic, block * ROWS, units), dkept, 0.0)
    dz_ref[critic, rows, :] = dz
    if layer:
        share_ref[critic, block, pl.ds(dense_at, units)] = jnp.sum(dz, axis=0)


def _loss_gradient(plan: _Plan, step: Any, critic: Any, rows: Any, q_ref: Any, reward_ref: Any,
                   terminated_ref: Any, log_prob_ref: Any,
                   temperature_ref: Any) -> jax.Array:  # fmt: skip
    """Return dL/dQ of some rows; see ``losses.td_target`` and ``losses.critic_loss``."""
    next_q = q_ref[step, TARGET, 0, rows]
    for other in range(1, plan.critics):
        next_q = jnp.minimum(next_q, q_ref[step, TARGET, other, rows])
    next_value = next_q - temperature_ref[0] * log_prob_ref[step, rows]
    going_on = jnp.where(terminated_ref[step, rows] > 0.0, 0.0, next_value)
    target = reward_ref[step, rows] + plan.config.discount * going_on
    return (q_ref[step, ONLINE, critic, rows] - target) * (2.0 / (plan.critics * plan.rows))


def _adam_polyak(plan: _Plan, step: Any, corrections_ref: Any, grad: jax.Array, values: Any) -> Any:
    """Return (online, target, mu, nu) after ``grad``; see ``hoisted``."""
    critic, target, mu, nu = values
    mu = ADAM_B1 * mu + (1.0 - ADAM_B1) * grad
    nu = ADAM_B2 * nu + (1.0 - ADAM_B2) * grad * grad
    size, root_scale = corrections_ref[step, 0], corrections_ref[step, 1]
    critic = critic - size * mu / (jnp.sqrt(nu) * root_scale + ADAM_EPSILON)
    return critic, target + plan.config.tau * (critic - target), mu, nu


def _update_kernel(plan: _Plan, layer: int, step_ref: Any, x_ref: Any, dz_ref: Any,
                   corrections_ref: Any, _: Any, *rest: Any) -> None:  # fmt: skip
    """Move one tile of a weight kernel by its gradient: grid (E, tiles down, tiles across)."""
    critic, down, across = (pl.program_id(i) for i in range(3))
    w_ref, mu_ref, nu_ref, square_ref = rest[4:]
    height, width = plan.tile(layer)
    step, terms = step_ref[0], pl.ds(down * height, height)
    units = pl.ds(across * width, width)

    def add(k: jax.Array, total: jax.Array) -> jax.Array:
        rows = pl.ds(k * ROWS, ROWS)
        x = x_ref[step, ONLINE, rows, terms] if layer == 0 else x_ref[ONLINE, critic, rows, terms]
        return total + _dot(x.T, dz_ref[critic, rows, units], plan.config.matmul_dtype)

    grad = jax.lax.fori_loop(0, plan.blocks, add, jnp.zeros((height, width)))
    values = (w_ref[ONLINE, critic, terms, units], w_ref[TARGET, critic, terms, units],
              mu_ref[critic, terms, units], nu_ref[critic, terms, units])  # fmt: skip
    online, target, mu, nu = _adam_polyak(plan, step, corrections_ref, grad, values)
    w_ref[ONLINE, critic, terms, units], w_ref[TARGET, critic, terms, units] = online, target
    mu_ref[critic, terms, units], nu_ref[critic, terms, units] = mu, nu
    square_ref[step, critic, down, across] = jnp.sum(grad * grad)


def _update_vectors(plan: _Plan, step_ref: Any, share_ref: Any, corrections_ref: Any,
                    *rest: Any) -> None:  # fmt: skip
    """Move some vector entries by their gradient: grid (E, lanes)."""
    critic, lane = pl.program_id(0), pl.program_id(1)
    v_ref, mu_ref, nu_ref, square_ref = rest[4:]
    step, at = step_ref[0], pl.ds(lane * LANES, LANES)

    def add(block: jax.Array, total: jax.Array) -> jax.Array:
        return total + share_ref[critic, block, at]

    grad = jax.lax.fori_loop(0, plan.blocks, add, jnp.zeros(LANES))
    values = (
        v_ref[ONLINE, critic, at],
        v_ref[TARGET, critic, at],
        mu_ref[critic, at],
        nu_ref[critic, at],
    )
    online, target, mu, nu = _adam_polyak(plan, step, corrections_ref, grad, values)
    v_ref[ONLINE, critic, at], v_ref[TARGET, critic, at] = online, target
    mu_ref[critic, at], nu_ref[critic, at] = mu, nu
    square_ref[step, critic, lane] = jnp.sum(grad * grad)


class _Moving(NamedTuple):
    """What an update changes, all in place."""

    weights: tuple[jax.Array, ...]
    """[2, E, in, out] online and target kernels, one a layer."""
    weights_mu: tuple[jax.Array, ...]
    weights_nu: tuple[jax.Array, ...]
    vectors: jax.Array
    """[2, E, V]."""
    vectors_mu: jax.Array
    vectors_nu: jax.Array
    share: jax.Array
    """[E, blocks, V] gradients of the vectors by some rows."""
    q: jax.Array
    """[U, 2, E, B] of every update."""
    squares: tuple[jax.Array, ...]
    """[U, E, ...] squared gradients of every update, by program; one a layer, then the vectors."""


class _Given(NamedTuple):
    """What the updates of a block read; see ``hoisted.Layout.critic_block``."""

    inputs: jax.Array
    """[U, 2, B, F] of online and target critics."""
    reward: jax.Array
    terminated: jax.Array
    """[U, B] float32."""
    log_prob: jax.Array
    temperature: jax.Array
    """[1]."""
    seeds: jax.Array
    """[U, 2, L, 2]."""
    corrections: jax.Array
    """[U, 2]."""


def _launch(
    interpret: bool,
    step: jax.Array,
    body: Callable[..., None],
    grid: tuple[int, ...],
    args: Sequence[jax.Array],
    new: Sequence[tuple[int, ...]],
    in_place: Sequence[jax.Array],
) -> Any:
    """Launch a kernel for update ``step`` [1]: its results are new arrays, then those in place."""
    shapes = [*new, *(x.shape for x in in_place)]
    return pl.pallas_call(
        body,
        grid=grid,
        out_shape=[jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes],
        input_output_aliases={1 + len(args) + i: len(new) + i for i in range(len(in_place))},
        interpret=interpret,
    )(step, *args, *in_place)


def _update(plan: _Plan, given: _Given, interpret: bool, step: jax.Array, now: _Moving) -> _Moving:
    """Take update number ``step``: 3 L + 1 launches."""
    call = functools.partial(_launch, interpret, jnp.full(1, step, jnp.int32))
    critics, rows, layers = plan.critics, plan.rows, range(len(plan.sizes))
    acts, x, q = [], given.inputs, now.q
    for layer in layers:
        units = plan.sizes[layer]
        h, normal, rstd, *done = call(
            functools.partial(_forward, plan, layer),
            (2, critics, plan.blocks),
            (x, now.weights[layer], now.vectors, given.seeds),
            [(2, critics, rows, units)] * 2 + [(2, critics, rows)],
            [q] if layer == layers[-1] else [],
        )
        acts.append((x, h, normal, rstd))
        x, q = h, done[0] if done else q
    share, dz, dzs = now.share, None, {}
    for layer in reversed(layers):
        _, *kept = acts[layer]
        last = (q, given.reward, given.terminated, given.log_prob, given.temperature)
        above = last if dz is None else (dz, now.weights[layer + 1])
        dz, share = call(
            functools.partial(_backward, plan, layer),
            (critics, plan.blocks),
            (*kept, now.vectors, given.seeds, *above),
            [(critics, rows, plan.sizes[layer])],
            [share],
        )
        dzs[layer] = dz
    moved = [
        call(
            functools.partial(_update_kernel, plan, layer),
            (critics, *plan.tiles(layer)),
            # With the last dz at hand every kernel has been read: it can be overwritten.
            (acts[layer][0], dzs[layer], given.corrections, dzs[0]),
            [],
            [now.weights[layer], now.weights_mu[layer], now.weights_nu[layer], now.squares[layer]],
        )
        for layer in layers
    ]
    vectors, vectors_mu, vectors_nu, square = call(
        functools.partial(_update_vectors, plan),
        (critics, plan.vectors // LANES),
        (share, given.corrections),
        [],
        [now.vectors, now.vectors_mu, now.vectors_nu, now.squares[-1]],
    )
    weights, weights_mu, weights_nu, squares = (tuple(part) for part in zip(*moved, strict=True))
    return _Moving(weights, weights_mu, weights_nu, vectors, vectors_mu, vectors_nu, share, q,
                   (*squares, square))  # fmt: skip


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
    next_action, next_log_prob = act(actor, minibatches.next_obs, next_noise, config.matmul_dtype)
    done = cast(jax.Array, state.critic_opt.count)
    inputs = jnp.stack(
        [
            LAYOUT.inputs(minibatches.obs, minibatches.action),
            LAYOUT.inputs(minibatches.next_obs, next_action),
        ],
        axis=1,
    )
    plan = _Plan(config, rows, inputs.shape[-1])
    given = _Given(
        inputs=_padded(inputs, plan.fan_in[0], axis=-1),
        reward=minibatches.reward,
        terminated=minibatches.terminated.astype(jnp.float32),
        log_prob=next_log_prob,
        temperature=temperature.reshape(1),
        seeds=dropout.seeds(key, (num_steps, 2, len(plan.sizes))),
        corrections=jnp.stack(bias_corrections(done, num_steps, config.learning_rate), axis=1),
    )
    moments = cast(tuple[Params, Params], (state.critic_opt.mu, state.critic_opt.nu))
    begin = _begin(plan, num_steps, (state.critic, state.target_critic, *moments))

    def run(given: _Given, begin: _Moving, *, interpret: bool) -> _Moving:
        return jax.lax.fori_loop(
            0, num_steps, functools.partial(_update, plan, given, interpret), begin
        )

    end = jax.lax.platform_dependent(
        given,
        begin,
        cpu=functools.partial(run, interpret=True),
        default=functools.partial(run, interpret=False),
    )
    target = jax.vmap(losses.td_target, in_axes=(0, 0, 0, 0, None, None))(
        minibatches.reward, minibatches.terminated, end.q[:, TARGET], next_log_prob, temperature,
        config.discount,
    )  # fmt: skip
    squares = sum((jnp.sum(s.reshape(num_steps, -1), axis=1) for s in end.squares), jnp.zeros(()))
    metrics = {
        "critic_loss": jnp.mean(jnp.square(end.q[:, ONLINE] - target[:, None])),
        "q_mean": jnp.mean(end.q[:, ONLINE]),
        "target_q_mean": jnp.mean(target),
        "critic_grad_norm": jnp.mean(jnp.sqrt(squares)),
    }
    critic, target_critic, mu, nu = _unpack(plan, end)
    return CriticState(critic, target_critic, AdamState(done + num_steps, mu, nu)), metrics


def _padded(x: jax.Array, size: int, axis: int) -> jax.Array:
    """Return x with zeros behind, up to ``size`` along an axis."""
    widths = [(0, 0)] * x.ndim
    widths[axis] = (0, size - x.shape[axis])
    return jnp.pad(x, widths)


def _begin(plan: _Plan, num_steps: int, trees: Sequence[Params]) -> _Moving:
    packs = [packing.pack(tree, plan.sizes) for tree in trees]
    kernels = [
        [_padded(kernel, size, axis=1) for kernel, size in zip(p.kernels, plan.fan_in, strict=True)]
        for p in packs
    ]
    vectors = [_padded(p.vectors, plan.vectors, axis=1) for p in packs]
    critics, layers = plan.critics, range(len(plan.sizes))
    squares = [jnp.zeros((num_steps, critics, *plan.tiles(i))) for i in layers]
    return _Moving(
        weights=tuple(jnp.stack(pair) for pair in zip(*kernels[:2], strict=True)),
        weights_mu=tuple(kernels[2]),
        weights_nu=tuple(kernels[3]),
        vectors=jnp.stack(vectors[:2]),
        vectors_mu=vectors[2],
        vectors_nu=vectors[3],
        share=jnp.zeros((critics, plan.blocks, plan.vectors)),
        q=jnp.zeros((num_steps, 2, critics, plan.rows)),
        squares=(*squares, jnp.zeros((num_steps, critics, plan.vectors // LANES))),
    )


def _unpack(plan: _Plan, end: _Moving) -> list[Params]:
    """Return critic, target critic and Adam's moments."""
    kernels = (*([w[i] for w in end.weights] for i in (ONLINE, TARGET)), end.weights_mu,
               end.weights_nu)  # fmt: skip
    vectors = end.vectors[ONLINE], end.vectors[TARGET], end.vectors_mu, end.vectors_nu
    width = sum(packing.vector_sizes(plan.sizes))
    return [
        packing.unpack(PackedCritic((first[:, : plan.inputs], *others), v[:, :width]), plan.sizes)
        for (first, *others), v in zip(kernels, vectors, strict=True)
    ]
