"""Vectorised worlds: how episodes end and restart, guards, determinism, and shifts per world."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from twirl_mjx.sim.dynamics import make_dynamics, stack
from twirl_mjx.sim.gl import RenderError, open_context
from twirl_mjx.worlds.vector import EnvState, make_transition

Place = Callable[[EnvState, int, np.ndarray], EnvState]
LIMIT = 400


@pytest.fixture(scope="module")
def made(worlds: Callable[..., Any]) -> Any:
    """Three compiled worlds of ``stand``."""
    return worlds("stand")


@pytest.fixture(scope="module")
def midway(made: Any, actions: Callable[..., np.ndarray]) -> EnvState:
    """The worlds after a few steps, all alive."""
    state = made.run(made.reset(1), actions(3, 3))[-1]
    assert not state.done.any()
    return state


def at_limit(state: EnvState, world: int) -> EnvState:
    """Return ``state`` with one world in the last step before its time limit."""
    steps = state.world.episode_step.at[world].set(LIMIT - 1)
    return state.replace(world=state.world.replace(episode_step=steps))


def numbers(tree: Any) -> list[np.ndarray]:
    """Return every leaf as a numpy array, keys as their raw words."""
    leaves = jax.tree.leaves(tree)
    keys = [jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) for leaf in leaves]
    return [
        np.asarray(jax.random.key_data(leaf) if is_key else leaf)
        for leaf, is_key in zip(leaves, keys, strict=True)
    ]


def assert_same_worlds(a: EnvState, b: EnvState, which: list[int]) -> None:
    """Check that worlds are bit-identical in every leaf."""
    for x, y in zip(numbers(a), numbers(b), strict=True):
        np.testing.assert_array_equal(x[which], y[which])


def zeros() -> jax.Array:
    return jnp.zeros((3, 12))


def test_limit_truncates_and_keeps_the_last_observation(made: Any, midway: EnvState) -> None:
    """A time limit does not terminate, and next_obs is what the world would have shown anyway."""
    ended, free = made.step(at_limit(midway, 1), zeros()), made.step(midway, zeros())
    np.testing.assert_array_equal(ended.truncated, [False, True, False])
    assert not ended.terminated.any()
    assert not ended.invalid.any()
    np.testing.assert_array_equal(ended.next_obs, free.next_obs)
    np.testing.assert_array_equal(ended.reward, free.reward)
    assert np.abs(ended.obs[1] - ended.next_obs[1]).max() > 0.01
    np.testing.assert_array_equal(ended.obs[jnp.array([0, 2])], ended.next_obs[jnp.array([0, 2])])


def test_limit_is_reached_after_the_episode_length(made: Any, midway: EnvState) -> None:
    early = midway.world.episode_step.at[1].set(LIMIT - 2)
    state = midway.replace(world=midway.world.replace(episode_step=early))
    first = made.step(state, zeros())
    assert not first.done.any()
    second = made.step(first, zeros())
    np.testing.assert_array_equal(second.truncated, [False, True, False])
    np.testing.assert_array_equal(second.world.episode_step, [5, 0, 5])


def test_fall_terminates(made: Any, midway: EnvState, put: Place, fallen: np.ndarray) -> None:
    state = made.step(put(midway, 2, fallen), zeros())
    np.testing.assert_array_equal(state.terminated, [False, False, True])
    assert not state.truncated.any()
    np.testing.assert_array_equal(state.metrics["fall"], [0.0, 0.0, 1.0])
    assert float(state.next_obs[2, 98:][2]) < -0.9  # the last z-axis points down
    assert float(state.obs[2, 98:][2]) == 1.0  # the new episode's up


def test_a_world_can_terminate_at_its_limit(
    made: Any, midway: EnvState, put: Place, fallen: np.ndarray
) -> None:
    state = made.step(at_limit(put(midway, 0, fallen), 0), zeros())
    np.testing.assert_array_equal(state.terminated, [True, False, False])
    np.testing.assert_array_equal(state.truncated, [True, False, False])
    np.testing.assert_array_equal(state.done, [True, False, False])


def test_an_ended_world_starts_afresh(made: Any, midway: EnvState) -> None:
    state = made.step(at_limit(midway, 1), zeros())
    qpos = np.asarray(state.data.qpos[1])
    np.testing.assert_array_equal(state.data.qvel[1], np.zeros(18))
    np.testing.assert_array_equal(qpos[[0, 1, 3, 4, 5, 6]], [0, 0, 1, 0, 0, 0])
    np.testing.assert_array_equal(state.data.time[1], 0.0)
    np.testing.assert_array_equal(state.data.ctrl[1], qpos[7:])
    np.testing.assert_array_equal(state.world.filter.inputs[1], np.tile(qpos[7:], (2, 1)))
    np.testing.assert_array_equal(state.world.filter.outputs[1], np.tile(qpos[7:], (2, 1)))
    np.testing.assert_array_equal(state.world.action[1], np.zeros(12))
    assert int(state.world.episode_step[1]) == 0
    history = np.asarray(state.obs[1, 2:95]).reshape(3, 31)
    np.testing.assert_array_equal(history[:, 4:16], np.tile(qpos[7:], (3, 1)))
    np.testing.assert_array_equal(history[:, 16:], np.zeros((3, 15)))


def test_episodes_of_a_world_differ(made: Any, midway: EnvState) -> None:
    starts = []
    state = midway
    for _ in range(3):
        state = made.step(at_limit(state, 1), zeros())
        starts.append(np.asarray(jnp.concatenate([state.data.qpos[1], state.world.goal[1]])))
    assert len(np.unique(starts, axis=0)) == 3


def test_reset_of_one_world_leaves_the_others_bit_identical(
    made: Any, midway: EnvState, actions: Callable[..., np.ndarray]
) -> None:
    ended, free = at_limit(midway, 1), midway
    for action in actions(3, 3, seed=9):
        ended, free = (made.step(s, jnp.asarray(action)) for s in (ended, free))
        assert_same_worlds(ended, free, [0, 2])
    assert np.abs(np.asarray(ended.data.qpos[1] - free.data.qpos[1])).max() > 0.01


def broken(state: EnvState, what: str) -> tuple[EnvState, jax.Array]:
    """Return a state, or an action, that is no longer finite in world 1."""
    data, action = state.data, zeros()
    if what == "nan position":
        data = data.replace(qpos=data.qpos.at[1, 9].set(jnp.nan))
    elif what == "inf velocity":
        data = data.replace(qvel=data.qvel.at[1, 4].set(jnp.inf))
    elif what == "far away":
        data = data.replace(qpos=data.qpos.at[1, 0].set(2e4))
    elif what == "fast joint":
        data = data.replace(qvel=data.qvel.at[1, 9].set(2e3))
    elif what == "joint far beyond its limit":
        data = data.replace(qpos=data.qpos.at[1, 9].set(20.0))
    elif what == "nan view":
        return state.replace(obs=state.obs.at[1, 7].set(jnp.nan)), action
    elif what == "inf view":
        return state.replace(obs=state.obs.at[1, 7].set(-jnp.inf)), action
    elif what == "nan goal":
        goal = state.world.goal.at[1, 0].set(jnp.nan)
        return state.replace(world=state.world.replace(goal=goal)), action
    else:
        action = action.at[1, 3].set(jnp.nan if what == "nan action" else -jnp.inf)
    return state.replace(data=data), action


@pytest.mark.parametrize(
    "what",
    ["nan position", "inf velocity", "far away", "fast joint", "joint far beyond its limit",
     "nan view", "inf view", "nan goal", "nan action", "inf action"],
)  # fmt: skip
def test_a_world_that_is_not_finite_is_flagged_and_restarted(
    made: Any, midway: EnvState, what: str
) -> None:
    """Only that world; nothing of it reaches a learner, and the others do not notice."""
    result, clean = made.step(*broken(midway, what)), made.step(midway, zeros())
    np.testing.assert_array_equal(result.invalid, [False, True, False])
    assert not (result.terminated | result.truncated).any()
    assert_same_worlds(result, clean, [0, 2])
    assert float(result.reward[1]) == 0.0
    assert all(float(value[1]) == 0.0 for value in result.metrics.values())
    if "view" not in what:
        np.testing.assert_array_equal(result.next_obs[1], midway.obs[1])
    assert all(np.isfinite(x).all() for x in numbers(result) if x.dtype.kind == "f")
    assert int(result.world.episode_step[1]) == 0
    after = made.step(result, zeros())
    assert not after.invalid.any()


def test_infinite_actions_aside_actions_are_clipped(made: Any, midway: EnvState) -> None:
    wild = made.step(midway, 7.0 * jnp.ones((3, 12)))
    full = made.step(midway, jnp.ones((3, 12)))
    assert_same_worlds(wild, full, [0, 1, 2])


@pytest.mark.parametrize("shape", [(3, 11), (12,), (2, 12)])
def test_wrong_action_shape_is_refused(made: Any, midway: EnvState, shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"need \(3, 12\)"):
        made.env.step(midway, jnp.zeros(shape))


def test_same_key_same_trajectory(made: Any, actions: Callable[..., np.ndarray]) -> None:
    taken = actions(6, 3, scale=1.0, seed=2)
    first, second = (made.run(made.reset(11), taken) for _ in range(2))
    for a, b in zip(first, second, strict=True):
        assert_same_worlds(a, b, [0, 1, 2])
    other = made.reset(12)
    assert np.abs(np.asarray(other.data.qpos - made.reset(11).data.qpos)).max() > 1e-3


def test_world_i_draws_from_its_own_key(made: Any) -> None:
    """fold_in(key, i), whatever the number of worlds."""
    state, env = made.reset(13), made.env
    start = jax.jit(lambda key: env.task.start(key, env.scene, make_dynamics()))
    for i in range(3):
        keys = jax.random.split(jax.random.fold_in(jax.random.key(13), i), 3)
        expected = start(keys[1])
        np.testing.assert_allclose(state.data.qpos[i], expected.qpos, atol=1e-6)
        np.testing.assert_allclose(state.world.goal[i], expected.goal, atol=1e-6)
    assert len(np.unique(np.asarray(state.data.qpos), axis=0)) == 3


def test_a_batch_equals_its_worlds_one_by_one(
    made: Any, worlds: Callable[..., Any], actions: Callable[..., np.ndarray]
) -> None:
    """To rounding: other batch sizes vectorise sums in another order. Includes an auto-reset."""
    single = worlds("stand", 1)
    batch = made.reset(14)
    np.testing.assert_allclose(single.reset(14).obs[0], batch.obs[0], atol=1e-6)
    batch = at_limit(batch, 2)
    take = jax.jit(lambda state, i: jax.tree.map(lambda leaf: leaf[i][None], state))
    alone = [take(batch, i) for i in range(3)]
    for action in actions(3, 3, seed=3):
        batch = made.step(batch, jnp.asarray(action))
        for i in range(3):
            alone[i] = single.step(alone[i], jnp.asarray(action[i : i + 1]))
            for name in ("obs", "next_obs", "reward", "terminated", "truncated"):
                ours, theirs = getattr(alone[i], name)[0], getattr(batch, name)[i]
                np.testing.assert_allclose(ours, theirs, atol=2e-5, err_msg=f"{name} of {i}")


def test_shifts_act_through_physics_only(made: Any) -> None:
    """Same key under four shifts: one state after reset, four after some steps."""
    shifts = [make_dynamics(name) for name in ("none", "icy", "weakened", "gravity")]
    states = [made.reset(15, stack([shift], 3)) for shift in shifts]
    assert len(np.unique([np.asarray(s.data.qpos) for s in states], axis=0)) == 1
    assert len(np.unique([np.asarray(s.obs) for s in states], axis=0)) == 1
    push = jnp.tile(jnp.array([0.3, 0.5, -0.5]), (3, 4))
    for _ in range(3):
        states = [made.step(state, push) for state in states]
    for world in range(3):
        assert len(np.unique([np.asarray(s.data.qpos[world]) for s in states], axis=0)) == 4


def test_one_call_runs_worlds_under_different_shifts(made: Any) -> None:
    """Each world of a mixed batch moves as in a batch of its own shift."""
    shifts = [make_dynamics(name) for name in ("none", "icy", "gravity")]
    mixed = made.step(made.reset(16, stack(shifts, 1)), zeros())
    for i, shift in enumerate(shifts):
        alone = made.step(made.reset(16, stack([shift], 3)), zeros())
        np.testing.assert_array_equal(mixed.data.qpos[i], alone.data.qpos[i])


def test_weakened_motors_warm_up_and_others_do_not(
    made: Any, actions: Callable[..., np.ndarray]
) -> None:
    for name, heats in (("weakened", True), ("none", False)):
        first = made.reset(17, stack([make_dynamics(name)], 3))
        last = made.run(first, actions(5, 3, scale=0.8))[-1]
        alive = ~np.asarray(last.done)
        change = np.asarray(last.world.motors.temperature - first.world.motors.temperature)[alive]
        assert change.size
        assert (change.max() > 0.05) == heats
        np.testing.assert_array_equal(
            last.world.motors.strength[alive], first.world.motors.strength[alive]
        )


def test_transition_is_what_a_learner_needs(made: Any, midway: EnvState) -> None:
    action = 2.0 * jnp.ones((3, 12))
    result = made.step(at_limit(midway, 0), action)
    transition = make_transition(midway, action, result)
    np.testing.assert_array_equal(transition.obs, midway.obs)
    np.testing.assert_array_equal(transition.next_obs, result.next_obs)
    np.testing.assert_array_equal(transition.action, jnp.ones((3, 12)))
    np.testing.assert_array_equal(transition.terminated, [False] * 3)  # a limit is no end
    np.testing.assert_array_equal(transition.reward, result.reward)


def test_eager_calls_are_compiled_once_and_traced_ones_are_not_nested(
    made: Any, midway: EnvState, count_traces: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    env = copy.copy(made.env)
    counter = count_traces(env._step)
    monkeypatch.setattr(env, "_step", counter)
    first = env.step(midway, np.zeros((3, 12)))
    env.step(first, jnp.ones((3, 12)))
    assert counter.traces == 1
    wanted = made.step(midway, zeros())
    assert_same_worlds(first, wanted, [0, 1, 2])
    text = str(jax.make_jaxpr(lambda s: env.step(s, zeros()).reward)(midway))
    assert counter.traces == 2
    assert "name=_step" not in text  # the caller's program holds the step itself
    assert_same_worlds(env.reset(jax.random.key(1)), made.reset(1), [0, 1, 2])


def test_worlds_say_what_they_are(made: Any) -> None:
    assert repr(made.env) == (
        "<VectorEnv stand: 3 worlds on flat ground, robot a1, engine native; observation [101],"
        " action [12] in [-1, 1], 20 Hz, episodes of 400 steps>"
    )
    assert made.env.observation_space.shape == (101,)
    assert made.env.action_space.contains(np.ones(12, np.float32))
    assert not made.env.action_space.contains(np.full(12, 1.1, np.float32))


def test_render_refuses_a_world_that_is_not_there(made: Any, midway: EnvState) -> None:
    with pytest.raises(ValueError, match=r"world = 3 is outside \[0, 2\]"):
        made.env.render(midway, 3)


def test_pictures_show_goal_and_bands(worlds: Callable[..., Any]) -> None:
    try:
        open_context(16, 16).free()
    except RenderError as error:
        pytest.skip(f"no headless OpenGL on this machine: {error}")
    hurdles = worlds("hurdles", num_envs=2)
    state = hurdles.reset(0)
    near = state.world.task.positions - state.world.task.positions[:, :1] + 0.6
    task = state.world.task._replace(positions=near)  # the first is in view
    state = state.replace(world=state.world.replace(task=task))
    far = state.replace(
        world=state.world.replace(task=task._replace(positions=task.positions + 50.0))
    )
    orange = []
    for aside in (0.0, 16.0):  # m; bands have no end across, and bumpy ground is used all over
        moved = state.data.qpos.at[:, 1].add(aside)
        shown, bare = (
            hurdles.env.render(s.replace(data=s.data.replace(qpos=moved)), 1).astype(int)
            for s in (state, far)
        )
        assert shown.shape == (480, 640, 3)
        share = [(image[..., 0] > image[..., 2] + 100).mean() for image in (shown, bare)]
        orange.append(share[0] - share[1])
    assert orange[0] > 0.002 and orange[1] == pytest.approx(orange[0], rel=0.1)
    hurdles.env.painter.close()
