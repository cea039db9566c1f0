"""Worlds under conditions of their own: randomised, noisy, late and pushed; nominal ones as ever.

The worlds of one structure compile once; what a test wants of them are values per world.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from twirl_mjx.sim.dynamics import Dynamics, broadcast, draw, make_dynamics
from twirl_mjx.sim.ranges import NO_RANGES, Ranges, parse_ranges
from twirl_mjx.sim.robots import A1
from twirl_mjx.tasks.observations import layout_noise, layout_slices, proprioceptive
from twirl_mjx.worlds.vector import EnvState, VectorEnv

LIMIT = 400
ACTIVE = {"obs_noise": 0.0, "push": 0.0, "push_interval": 5.0, "latency": 0.0}
"""Leaves that the worlds here have, nominal where a test does not say."""
N = 3

HEIGHTS = [0.24765, 0.2777, 0.265818]
"""m, of three worlds of ``stand`` with seed 21 after ten random steps."""
JOINTS = [
    *(0.065888, 1.280449, -1.787355),
    *(-0.069618, 0.881044, -1.769525),
    *(0.047102, 0.945396, -1.836596),
    *(0.148501, 0.767722, -1.550633),
]
"""rad, of the second of them."""
GOALS = [-0.519221, 0.455299, 0.988703]
"""m, x of their goals."""


class Conditions:
    """Icy worlds of ``stand``: compiled ``reset(dynamics, index)`` and ``step``.

    They are made without the leaves ``ACTIVE``, which a reset may bring all the same.
    """

    def __init__(self, plain: VectorEnv, ranges: Ranges = NO_RANGES) -> None:
        self.env = VectorEnv(
            plain.task,
            plain.scene,
            plain.engine,
            num_envs=N,
            episode_length=LIMIT,
            dynamics=make_dynamics("icy"),
            metric_names=plain.metric_names,
            ranges=ranges,
        )
        self.reset = jax.jit(functools.partial(self.env.reset, jax.random.key(5)))
        self.step: Callable[[EnvState, Any], EnvState] = jax.jit(self.env.step)

    def run(self, state: EnvState, actions: np.ndarray) -> list[EnvState]:
        """Return the states after every one of ``actions`` [T, N, 12]."""
        states = []
        for action in actions:
            state = self.step(state, jnp.asarray(action))
            states.append(state)
        return states


@pytest.fixture(scope="module")
def made(worlds: Callable[..., Any]) -> Conditions:
    return Conditions(worlds("stand").env)


@pytest.fixture(scope="module")
def ranged(worlds: Callable[..., Any]) -> Conditions:
    ranges = parse_ranges(["friction=0.4:1.25", "payload=-1:2", "latency=0:0.03"])
    return Conditions(worlds("stand").env, ranges)


def conditions(leaves: Mapping[str, Any]) -> Dynamics:
    """Return icy worlds with the leaves ``ACTIVE``, each a number or one for every world."""
    values = {k: jnp.asarray(v, jnp.float32) for k, v in (ACTIVE | dict(leaves)).items()}
    return broadcast(make_dynamics("icy").replace(**values), N)


def arrays(tree: Any) -> list[np.ndarray]:
    """Return every leaf as numpy, keys as their raw words."""

    def raw(leaf: jax.Array) -> jax.Array:
        is_key = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        return jax.random.key_data(leaf) if is_key else leaf

    return [np.asarray(raw(leaf)) for leaf in jax.tree.leaves(tree)]


def assert_same_but_for_dynamics(a: EnvState, b: EnvState, which: list[int]) -> None:
    """Check that some worlds are bit-identical in everything else."""
    bare = [x.replace(world=x.world.replace(dynamics=None)) for x in (a, b)]
    for x, y in zip(*map(arrays, bare), strict=True):
        np.testing.assert_array_equal(x[which], y[which])


def at_limit(state: EnvState, world: int) -> EnvState:
    steps = state.world.episode_step.at[world].set(LIMIT - 1)
    return state.replace(world=state.world.replace(episode_step=steps))


def test_leaves_at_their_nominal_values_change_nothing(
    made: Conditions, worlds: Callable[..., Any], actions: Callable[..., np.ndarray]
) -> None:
    """Compiled in or not: the same draws, over a restart too; to the rounding of other code."""
    plain, taken = worlds("stand"), actions(4, N, scale=0.8)
    states = plain.reset(5, broadcast(make_dynamics("icy"), N)), made.reset(conditions({}))
    assert_same_but_for_dynamics(*states, [0, 1, 2])
    bare, active = (
        run(at_limit(x, 1), taken) for run, x in zip((plain.run, made.run), states, strict=True)
    )
    np.testing.assert_array_equal(bare[0].done, [False, True, False])
    for a, b in zip(bare, active, strict=True):
        np.testing.assert_array_equal(a.done, b.done)
        np.testing.assert_allclose(a.data.qpos, b.data.qpos, atol=2e-5)
        np.testing.assert_allclose(a.obs, b.obs, atol=5e-3)  # rates of joints in contact
        np.testing.assert_allclose(a.reward, b.reward, atol=1e-3)


def test_a_rollout_gives_the_numbers_it_always_gave(
    worlds: Callable[..., Any], actions: Callable[..., np.ndarray]
) -> None:
    """Recorded at d06aa54, before there were optional leaves; to the rounding of other CPUs."""
    made = worlds("stand")
    state = made.run(made.reset(21), actions(10, 3, scale=0.5, seed=4))[-1]
    np.testing.assert_allclose(state.data.qpos[:, 2], HEIGHTS, atol=2e-4)
    np.testing.assert_allclose(state.data.qpos[1, 7:], JOINTS, atol=2e-3)
    np.testing.assert_allclose(state.world.goal[:, 0], GOALS, atol=1e-5)


def test_ranges_draw_for_every_world_and_change_nothing_else(
    worlds: Callable[..., Any], ranged: Conditions
) -> None:
    """Same keys, same draws of everything else: the stream of randomisation is its own."""
    plain, drawn = worlds("stand").reset(5, broadcast(make_dynamics("icy"), N)), ranged.reset()
    assert_same_but_for_dynamics(plain, drawn, [0, 1, 2])
    dynamics = drawn.world.dynamics
    for name, low, high in ranged.env.ranges.bounds:
        values = np.asarray(getattr(dynamics, name))
        assert len(np.unique(values)) == N
        assert (values >= low).all()
        assert (values <= high).all()
    np.testing.assert_array_equal(dynamics.gravity, plain.world.dynamics.gravity)
    assert dynamics.push is None


def test_an_episode_keeps_its_draw_and_the_next_has_another(ranged: Conditions) -> None:
    first = ranged.reset()
    kept = ranged.step(first, jnp.zeros((N, 12)))
    after = ranged.step(at_limit(kept, 1), jnp.zeros((N, 12)))
    np.testing.assert_array_equal(after.done, [False, True, False])
    for name, _, _ in ranged.env.ranges.bounds:
        a, b, c = (np.asarray(getattr(s.world.dynamics, name)) for s in (first, kept, after))
        np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(a[[0, 2]], c[[0, 2]])
        assert a[1] != c[1]


def test_worlds_of_one_key_differ_by_their_dynamics_alone(made: Conditions) -> None:
    """One state after reset, as many as worlds after some steps: physics did it."""
    ranges = parse_ranges(["friction=0.2:1.0", "gravity=5:9", "latency=0:0.05"])
    keys = jax.random.split(jax.random.key(1), N)
    drawn = jax.vmap(lambda key, world: draw(key, world, ranges))(keys, conditions({}))
    state = made.reset(drawn, jnp.zeros(N, jnp.int32))
    assert len(np.unique(np.asarray(state.data.qpos), axis=0)) == 1
    assert len(np.unique(np.asarray(state.obs), axis=0)) == 1
    state = made.step(state, jnp.tile(jnp.array([0.3, 0.5, -0.5]), (N, 4)))
    assert len(np.unique(np.asarray(state.data.qpos), axis=0)) == N


def test_ranges_without_effect_in_the_scene_are_refused(worlds: Callable[..., Any]) -> None:
    with pytest.raises(ValueError, match="incline acts in a sloped scene only, not in a flat"):
        Conditions(worlds("stand").env, parse_ranges(["incline=0:0.1"]))


def test_noise_of_every_entry_by_hand() -> None:
    noise, at = (
        layout_noise(proprioceptive(A1, axes=True)),
        layout_slices(proprioceptive(A1, axes=True)),
    )
    assert noise.shape == (101,)
    for name, expected in (
        ("goal_displacement_w", 0.02),
        ("roll_pitch[-2]", 0.01),
        ("roll_pitch_rate_b[0]", 0.05),
        ("joint_pos[-1]", 0.005),
        ("base_displacement_w[0]", 0.01),
        ("previous_action[0]", 0.0),
        ("base_z_axis_w", 0.01),
    ):
        np.testing.assert_allclose(noise[at[name]], expected)


def test_noise_is_on_what_the_policy_sees_and_on_nothing_else(
    made: Conditions, actions: Callable[..., np.ndarray]
) -> None:
    """World 0 is clean, world 2 twice as noisy as world 1; the restarted one too."""
    taken = actions(30, N)
    noisy = made.reset(conditions({"obs_noise": [0.0, 1.0, 2.0]}))
    clean = made.reset(conditions({}))
    seen, true = [noisy, *made.run(noisy, taken)], [clean, *made.run(clean, taken)]
    deviation = layout_noise(proprioceptive(A1, axes=True))
    units = []
    for a, b in zip(seen, true, strict=True):
        np.testing.assert_array_equal(a.data.qpos, b.data.qpos)
        np.testing.assert_array_equal(a.reward, b.reward)
        np.testing.assert_array_equal(a.done, b.done)
        alive = ~np.asarray(a.done)
        np.testing.assert_array_equal(a.obs[alive], a.next_obs[alive])  # one reading, not two
        difference = np.asarray(a.obs - b.obs)
        assert (difference[:, deviation == 0.0] == 0.0).all()
        units.append(difference[:, deviation > 0.0] / deviation[deviation > 0.0])
    errors = np.stack(units)  # [T, N, K] in deviations, about 2000 for every world
    assert (errors[:, 0] == 0.0).all()
    assert errors[:, 1].std() == pytest.approx(1.0, abs=0.06)
    assert errors[:, 2].std() == pytest.approx(2.0, abs=0.12)
    assert np.abs(errors[:, 1:].mean(axis=(0, 2))).max() < 0.15
    again = np.corrcoef(errors[:-1, 1].ravel(), errors[1:, 1].ravel())[0, 1]
    other = np.corrcoef(errors[:, 1].ravel(), errors[:, 2].ravel())[0, 1]
    assert max(abs(again), abs(other)) < 0.08


def test_a_push_comes_every_interval(made: Conditions, actions: Callable[..., np.ndarray]) -> None:
    """0.2 s are four control steps: the fifth and the ninth begin with 0.5 m/s more."""
    world = made.reset(
        conditions({"push": [0.5, 0.5, 0.0], "push_interval": [0.2, 0.3, 0.2]})
    ).world
    velocity = jnp.ones((N, 18))
    pushed = jax.jit(jax.vmap(made.env._push))
    for step in range(13):
        now = world.replace(episode_step=jnp.full(N, step, jnp.int32))
        change = np.asarray(pushed(now, velocity) - velocity)
        size = [0.5 * (step in (4, 8, 12)), 0.5 * (step in (6, 12)), 0.0]
        np.testing.assert_allclose(np.linalg.norm(change, axis=1), size, atol=1e-6)
        assert (change[:, 2:] == 0.0).all()
    keys = jax.random.split(jax.random.key(2), 2000)
    one = jax.tree.map(lambda leaf: leaf[0], world).replace(episode_step=jnp.int32(4))
    many = jax.jit(jax.vmap(lambda key: made.env._push(one.replace(key=key), jnp.zeros(18))))(keys)
    np.testing.assert_allclose(np.linalg.norm(many, axis=1), 0.5, rtol=1e-5)
    assert np.abs(np.asarray(many).mean(axis=0)).max() < 0.03  # from all around
    taken = actions(5, N)
    still = made.run(made.reset(conditions({})), taken)
    moved = made.run(made.reset(conditions({"push": 0.5, "push_interval": 0.2})), taken)
    np.testing.assert_array_equal(still[3].data.qpos, moved[3].data.qpos)
    speeds = np.asarray(moved[4].data.qvel - still[4].data.qvel)[:, :2]
    assert (np.linalg.norm(speeds, axis=1) > 0.1).all()


def test_actions_come_as_late_as_the_latency(made: Conditions) -> None:
    """One control step late, the first action acts in the second step only; half, at once."""
    dynamics = conditions({"latency": [0.05, 0.025, 0.0]})
    first, second = (jnp.full((N, 12), x) for x in (0.4, -0.4))
    a = made.run(made.reset(dynamics), np.stack([first, second]))
    b = made.run(made.reset(dynamics), np.stack([second, second]))
    np.testing.assert_array_equal(a[0].data.qpos[0], b[0].data.qpos[0])
    changes = np.abs(np.asarray(a[0].data.qpos - b[0].data.qpos)[:, 7:]).max(axis=1)
    assert 0.01 < changes[1] < 0.6 * changes[2]
    assert np.abs(np.asarray(a[1].data.qpos - b[1].data.qpos))[0, 7:].max() > 0.01
