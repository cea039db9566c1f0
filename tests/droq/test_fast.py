"""The fast forms are the plain one: same masks and noise in, same parameters out."""

from __future__ import annotations

import dataclasses
from types import ModuleType

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from twirl_mjx.droq import (
    accelerator,
    dropout,
    fast,
    forms,
    fused,
    kernels,
    learner,
    packing,
    plain,
)
from twirl_mjx.droq.config import DroqConfig
from twirl_mjx.droq.state import CriticState

OBS_SIZE, ACTION_SIZE, U = 5, 2, 4

# All forms do the same float32 arithmetic in another order; Adam divides small gradients by
# their own size, so the relative error of a parameter is set by its step (1e-2), not its value.
TOLERANCE = {"rtol": 1e-4, "atol": 2e-5}


FAST_FORMS = pytest.mark.parametrize("form", [fast, accelerator], ids=["fast", "accelerator"])

plain_step = jax.jit(plain.critic_step, static_argnums=3)


def plain_masks(form, masks):
    """Turn masks of a fast form, [E, H, B] in that for CPUs, into [E, B, H]."""
    return [jnp.swapaxes(mask, 1, 2) if form is fast else mask for mask in masks]


def assert_trees_close(actual, expected, **tolerance):
    for (path, want), have in zip(
        jax.tree_util.tree_leaves_with_path(expected), jax.tree.leaves(actual), strict=True
    ):
        assert have.dtype == want.dtype
        np.testing.assert_allclose(
            have, want, err_msg=jax.tree_util.keystr(path), **(tolerance or TOLERANCE)
        )


def critic_state(state):
    return CriticState(state.critic, state.target_critic, state.critic_opt)


@pytest.mark.parametrize(
    ("form", "hidden_sizes", "num_critics", "rows"),
    [
        (fast, (32, 16), 2, 8),
        (fast, (24,), 1, 8),
        pytest.param(fast, (16, 20, 8), 3, 8, marks=pytest.mark.slow),
        (accelerator, (32, 16), 2, 8),
        (accelerator, (24,), 1, 8),
        pytest.param(accelerator, (16, 20, 8), 3, 8, marks=pytest.mark.slow),
        (kernels, (32, 16), 2, 32),
        pytest.param(kernels, (64,), 1, 16, marks=pytest.mark.slow),
        pytest.param(kernels, (64, 32, 128), 3, 32, marks=pytest.mark.slow),
    ],
    ids=lambda value: value.__name__.split(".")[-1] if isinstance(value, ModuleType) else None,
)  # fmt: skip
def test_block_equals_explicit_plain_steps_with_the_same_masks(
    small_config, transitions, form, hidden_sizes, num_critics, rows
):
    config = dataclasses.replace(
        small_config, hidden_sizes=hidden_sizes, num_critics=num_critics, batch_size=rows
    )
    keys = jax.random.split(jax.random.key(0), 4)
    state = learner.init(keys[0], config, OBS_SIZE, ACTION_SIZE)
    batch = transitions(keys[1], U, config.batch_size)
    noise = jax.random.normal(keys[2], (U, config.batch_size, ACTION_SIZE))
    temperature = jnp.float32(0.3)
    block = jax.jit(form.critic_block, static_argnums=3)
    actual, metrics = block(
        critic_state(state), state.actor, temperature, config, batch, noise, keys[3]
    )

    seeds = dropout.seeds(keys[3], (U, 2, len(hidden_sizes)))
    expected, history = critic_state(state), []
    for i in range(U):
        masks = [
            plain_masks(form, form.LAYOUT.masks(seeds[i, j], config.batch_size, config))
            for j in range(2)
        ]
        minibatch = jax.tree.map(lambda x, i=i: x[i], batch)
        expected, step_metrics = plain_step(
            expected, state.actor, temperature, config, minibatch, noise[i], keys[3], tuple(masks)
        )
        history.append(step_metrics)
    assert_trees_close(actual, expected)
    assert int(actual.critic_opt.count) == U
    for name in metrics:
        want = np.mean([float(m[name]) for m in history])
        np.testing.assert_allclose(metrics[name], want, rtol=1e-4)
    # The comparison is not between two states that never moved.
    change = jax.tree.map(lambda a, b: float(jnp.abs(a - b).max()), actual.critic, state.critic)
    assert min(jax.tree.leaves(change)) > 1e-3


@pytest.mark.slow
def test_kernels_are_the_same_for_several_learners_at_once(small_config, transitions):
    """Learners side by side (``vmap``) become what each becomes alone."""
    config = dataclasses.replace(small_config, batch_size=16, form="kernels")
    keys = jax.random.split(jax.random.key(0), 2)
    states = jax.vmap(lambda key: learner.init(key, config, OBS_SIZE, ACTION_SIZE))(keys)
    batches = jax.vmap(lambda key: transitions(key, U, 16))(keys)
    noise = jax.random.normal(keys[1], (2, U, 16, ACTION_SIZE))

    def block(state, batch, noise, key):
        temperature = jnp.float32(0.3)
        critics = critic_state(state)
        return kernels.critic_block(critics, state.actor, temperature, config, batch, noise, key)

    together, _ = jax.jit(jax.vmap(block))(states, batches, noise, keys)
    for i in range(2):
        alone, _ = jax.jit(block)(
            *jax.tree.map(lambda x, i=i: x[i], (states, batches, noise, keys))
        )
        assert_trees_close(jax.tree.map(lambda x, i=i: x[i], together), alone, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        ({"hidden_sizes": (256, 100)}, r"powers of two from 16 to 512, not 100 \(nearest: 128\)"),
        ({"hidden_sizes": (1024,)}, r"not 1024 \(nearest: 512\)"),
        ({"hidden_sizes": (8,)}, r"not 8 \(nearest: 16\)"),
        ({"batch_size": 250}, r"multiple of 16, not 250 \(nearest: 256\)"),
    ],
)
def test_kernels_refuse_what_they_cannot_cut_into_blocks(settings, reason):
    with pytest.raises(ValueError, match=reason):
        DroqConfig(form="kernels", **settings)
    DroqConfig(form="accelerator", **settings)


@FAST_FORMS
def test_action_gradient_of_q_equals_the_plain_one(small_config, transitions, form):
    keys = jax.random.split(jax.random.key(1), 3)
    state = learner.init(keys[0], small_config, OBS_SIZE, ACTION_SIZE)
    batch = transitions(keys[1], small_config.batch_size)
    seeds = dropout.seeds(keys[2], (2,))
    masks = form.LAYOUT.masks(seeds, small_config.batch_size, small_config)

    def total(form, action, keep):
        q = form.critic_q(state.critic, batch.obs, action, small_config, keys[2], keep)
        return jnp.sum(jnp.sin(q)), q

    gradient = jax.value_and_grad(total, argnums=1, has_aux=True)
    (_, fast_q), fast_grad = gradient(form, batch.action, masks)
    (_, plain_q), plain_grad = gradient(plain, batch.action, plain_masks(form, masks))
    np.testing.assert_allclose(fast_q, plain_q, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(fast_grad, plain_grad, rtol=1e-4, atol=1e-5)
    assert float(jnp.abs(plain_grad).min()) > 0


def test_zero_preactivations_keep_their_gradient():
    """A kept unit whose input is exactly 0 is not mistaken for a dropped one."""
    z = jnp.zeros((1, 4, 3)).at[0, 2, :].set(1.0)
    keep = jnp.ones_like(z, bool).at[0, 1, 0].set(False)
    weight = jax.random.normal(jax.random.key(0), z.shape)

    def by_hand(z):
        kept = jnp.where(keep, z / 0.75, 0.0)
        mean = kept.mean(1, keepdims=True)
        std = jnp.sqrt(jnp.square(kept - mean).mean(1, keepdims=True) + 1e-6)
        return jnp.sum(weight * jnp.maximum((kept - mean) / std + 1.0, 0.0))

    def ours(z):
        ones = jnp.ones((1, 4))
        return jnp.sum(weight * fused.dropout_norm_relu(z, ones, ones, keep, 0.25))

    np.testing.assert_allclose(ours(z), by_hand(z), rtol=1e-5)
    grad = jax.grad(ours)(z)
    np.testing.assert_allclose(grad, jax.grad(by_hand)(z), rtol=1e-4, atol=1e-5)
    assert grad[0, 1, 0] == 0.0
    assert float(jnp.abs(grad[0, 0]).min()) > 1e-3


def test_transpose_in_blocks_is_a_transpose():
    for shape in ((2, 32, 7), (1, 256, 256), (3, 20, 8)):
        kernel = jax.random.normal(jax.random.key(0), shape)
        np.testing.assert_array_equal(fused.transpose(kernel), kernel.transpose(0, 2, 1))


@FAST_FORMS
def test_unpack_undoes_pack(small_config, form):
    for hidden_sizes in ((8,), (16, 8, 4)):
        config = dataclasses.replace(small_config, hidden_sizes=hidden_sizes, num_critics=3)
        state = learner.init(jax.random.key(0), config, OBS_SIZE, ACTION_SIZE)
        noisy = jax.tree.map(
            lambda x: x + jax.random.normal(jax.random.key(x.size), x.shape), state.critic
        )
        packed = form.LAYOUT.restore(form.LAYOUT.arrange(packing.pack(noisy, hidden_sizes)))
        assert_trees_close(packing.unpack(packed, hidden_sizes), noisy, rtol=0, atol=0)


def test_the_backend_chooses_the_form(monkeypatch):
    assert [forms.name_of(DroqConfig(form=f)) for f in ("auto", "fast", "accelerator")] == [
        "fast", "fast", "accelerator",
    ]  # fmt: skip
    assert forms.name_of(DroqConfig(fast=False, form="accelerator")) == "plain"
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert forms.form_of(DroqConfig()) is accelerator
    assert forms.form_of(DroqConfig(form="fast")) is fast
    assert forms.form_of(DroqConfig(fast=False)) is plain
    with pytest.raises(ValueError, match=r"droq.form.*'gpu'.*accelerator"):
        DroqConfig(form="gpu")


@pytest.mark.parametrize(
    ("capabilities", "settings", "form"),
    [
        (["9.0"], {}, "kernels"),
        (["12.0"], {"batch_size": 512}, "kernels"),
        (["7.5"], {}, "accelerator"),
        (["gfx90a"], {}, "accelerator"),
        ([None], {}, "accelerator"),
        (["9.0", "9.0"], {}, "accelerator"),
        (["9.0"], {"batch_size": 1024}, "accelerator"),
        (["9.0"], {"batch_size": 250}, "accelerator"),
        (["9.0"], {"hidden_sizes": (256, 200)}, "accelerator"),
        (["9.0"], {"hidden_sizes": (512, 256)}, "accelerator"),
    ],
)
def test_kernels_are_chosen_where_they_were_timed(monkeypatch, capabilities, settings, form):
    class Device:
        def __init__(self, capability):
            if capability:
                self.compute_capability = capability

    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(jax, "devices", lambda: [Device(c) for c in capabilities])
    assert forms.name_of(DroqConfig(**settings)) == form


@pytest.mark.slow
def test_bfloat16_products_stay_close_and_parameters_stay_float32(transitions):
    config = DroqConfig(hidden_sizes=(32, 16), batch_size=8, matmul_dtype="bfloat16")
    reference = dataclasses.replace(config, matmul_dtype="float32")
    state = learner.init(jax.random.key(0), config, OBS_SIZE, ACTION_SIZE)
    batch = transitions(jax.random.key(1), U, config.batch_size)
    update = jax.jit(learner.update, static_argnums=1)
    results = [update(state, c, batch, jax.random.key(2)) for c in (config, reference)]
    # bfloat16 keeps 8 bits of each factor: 0.4 % each, less in the sum of 16 to 32 products.
    assert_trees_close(results[0][1], results[1][1], rtol=0.05, atol=0.02)
    assert jax.tree.map(lambda x: x.dtype, results[0][0]) == jax.tree.map(lambda x: x.dtype, state)
    critic = [jax.tree.leaves(r[0].critic)[0] for r in results]
    assert not np.array_equal(critic[0], critic[1])
