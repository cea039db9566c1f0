"""The gymnasium environment and the brax view, each under its own library's checks."""

from __future__ import annotations

import pickle
import warnings
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

import twirl_mjx
from twirl_mjx.sim.gl import RenderError, open_context
from twirl_mjx.worlds.adapters import (
    GymnasiumEnv,
    GymnasiumVectorEnv,
    to_brax,
    to_gymnasium,
    to_gymnasium_vector,
)
from twirl_mjx.worlds.config import WorldConfig
from twirl_mjx.worlds.vector import VectorEnv

LIMIT = 4
CONFIG = WorldConfig(episode_length=LIMIT)


@pytest.fixture(scope="module")
def gym() -> GymnasiumEnv:
    return to_gymnasium("stand", config=CONFIG)


def test_check_env(gym: GymnasiumEnv) -> None:
    """Without a warning, and with the determinism checks that need a spec."""
    gym.spec = EnvSpec("twirl_mjx/Stand-v0")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gym, skip_render_check=True, skip_close_check=True)
    gym.spec = None


def test_episode_ends_at_the_limit_with_its_last_observation(gym: GymnasiumEnv) -> None:
    obs, info = gym.reset(seed=3)
    assert obs.dtype == np.float32
    assert set(info) == {"invalid", *gym.env.metric_names}
    for step in range(1, LIMIT + 1):
        obs, reward, terminated, truncated, info = gym.step(np.full(12, 0.1, np.float32))
        assert (terminated, truncated) == (False, step == LIMIT)
        assert reward == pytest.approx(info["upright"] + info["height"], rel=1e-6)
        np.testing.assert_allclose(obs[83:95], 0.1, rtol=1e-6)  # of the step, not of a new start
    with pytest.raises(ResetNeeded, match=r"call reset\(\) first"):
        gym.step(np.zeros(12, np.float32))


def test_seeds_reproduce_episodes(gym: GymnasiumEnv) -> None:
    def episode(seed: int | None) -> np.ndarray:
        gym.action_space.seed(0)
        rows = [gym.reset(seed=seed)[0]]
        rows += [gym.step(gym.action_space.sample() * 0.3)[0] for _ in range(2)]
        return np.array(rows)

    first, follower = episode(5), episode(None)
    np.testing.assert_array_equal(episode(5), first)
    np.testing.assert_array_equal(episode(None), follower)
    assert np.abs(first - follower).max() > 1e-3


def test_a_step_that_is_not_finite_is_a_truncation(gym: GymnasiumEnv) -> None:
    before, _ = gym.reset(seed=6)
    obs, reward, terminated, truncated, info = gym.step(np.full(12, np.nan, np.float32))
    assert (reward, terminated, truncated, info["invalid"]) == (0.0, False, True, True)
    np.testing.assert_array_equal(obs, before)


def test_gymnasium_refuses(gym: GymnasiumEnv) -> None:
    gym.reset(seed=0)
    with pytest.raises(ValueError, match=r"action has shape \(11,\), need \(12,\)"):
        gym.step(np.zeros(11, np.float32))
    with pytest.raises(ValueError, match="unknown render_mode 'human'"):
        GymnasiumEnv(gym.env, render_mode="human")
    with pytest.raises(ValueError, match="nearest: 'biped'"):
        to_gymnasium("bipedal")
    assert gym.render() is None


@pytest.fixture(scope="module")
def _gl() -> None:
    try:
        open_context(16, 16).free()
    except RenderError as error:
        pytest.skip(f"no headless OpenGL on this machine: {error}")


@pytest.mark.usefixtures("_gl")
def test_rendered_frame_shows_the_robot(gym: GymnasiumEnv) -> None:
    """Without any environment variable: a backend is found as on the command line."""
    env = GymnasiumEnv(gym.env, render_mode="rgb_array")
    with pytest.raises(ResetNeeded, match="nothing to draw"):
        env.render()
    env.reset(seed=0)
    near = env.render()
    assert near is not None
    assert near.shape == (480, 640, 3)
    assert near.dtype == np.uint8
    state: Any = env._shown
    qpos = state.data.qpos.at[0, 2].add(30.0)
    far = gym.env.render(state.replace(data=state.data.replace(qpos=qpos)))
    env.close()
    assert np.abs(near.astype(float) - far).mean() > 1.0


@pytest.fixture(scope="module")
def batch() -> GymnasiumVectorEnv:
    return to_gymnasium_vector("stand", num_envs=3, engine="native", config=CONFIG)


@pytest.mark.slow
def test_vector_env_resets_in_the_same_step(batch: GymnasiumVectorEnv) -> None:
    """Two worlds fall into their time limit together; a third one a step later."""
    obs, info = batch.reset(seed=3)
    assert batch.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    assert batch.observation_space.contains(obs)
    assert batch.action_space.shape == (3, 12)
    assert info["_upright"].all()
    state: Any = batch._state
    late = state.world.episode_step.at[1].set(1)
    batch._state = state.replace(world=state.world.replace(episode_step=late))
    for step in range(1, LIMIT + 1):
        obs, reward, terminated, truncated, info = batch.step(np.full((3, 12), 0.1))
        ends = [step == LIMIT, step == LIMIT - 1, step == LIMIT]
        np.testing.assert_array_equal(truncated, ends)
        assert not terminated.any()
        assert (reward > 0.3).all()
        assert ("final_obs" in info) == any(ends)
        if any(ends):
            np.testing.assert_array_equal(info["_final_obs"], ends)
            actions = info["final_obs"][:, 83:95]  # of the old episode; no world acted in the new
            np.testing.assert_allclose(actions[ends], 0.1, rtol=1e-6)
            np.testing.assert_array_equal(obs[ends][:, 83:95], 0.0)
            np.testing.assert_array_equal(info["final_info"]["upright"], info["upright"])


@pytest.mark.slow
def test_vector_env_agrees_with_the_single_one(
    batch: GymnasiumVectorEnv, gym: GymnasiumEnv
) -> None:
    """World 0 of three draws what one world draws, whose numbers do not depend on N."""
    many, one = batch.reset(seed=8)[0], gym.reset(seed=8)[0]
    np.testing.assert_allclose(many[0], one, atol=1e-6)
    action = np.full(12, 0.2, np.float32)
    many, reward, *_ = batch.step(np.tile(action, (3, 1)))
    one, single, *_ = gym.step(action)
    np.testing.assert_allclose(many[0], one, atol=1e-5)
    assert reward[0] == pytest.approx(single, rel=1e-5)


def test_vector_env_refuses(batch: GymnasiumVectorEnv) -> None:
    batch.reset(seed=0)
    with pytest.raises(ValueError, match=r"action has shape \(3, 11\), need \(3, 12\)"):
        batch.step(np.zeros((3, 11)))
    with pytest.raises(ResetNeeded):
        GymnasiumVectorEnv(batch.env).step(np.zeros((3, 12)))
    with pytest.raises(ValueError, match="unknown render_mode 'human'"):
        GymnasiumVectorEnv(batch.env, render_mode="human")
    assert batch.render() is None


def test_ids_of_gymnasium() -> None:
    ids = twirl_mjx.register_gymnasium()
    assert ids == twirl_mjx.register_gymnasium()  # twice is once
    assert {"twirl_mjx/Stand-v0", "twirl_mjx/Hurdles-v0"} <= set(ids)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        one = gymnasium.make("twirl_mjx/Stand-v0", config=CONFIG)
        many = gymnasium.make_vec("twirl_mjx/Stand-v0", num_envs=2, shift="icy", engine="native")
    assert isinstance(one.unwrapped, GymnasiumEnv)
    assert isinstance(many.unwrapped, GymnasiumVectorEnv)
    assert many.num_envs == 2
    assert float(many.unwrapped.env.dynamics.friction[0]) < 0.5


def test_environments_are_pickled_as_what_they_were_made_of(batch: GymnasiumVectorEnv) -> None:
    again = pickle.loads(pickle.dumps(batch))
    assert (again.num_envs, again.env.episode_length) == (3, LIMIT)
    assert repr(again.env) == repr(batch.env)
    with pytest.raises(ResetNeeded):
        again.step(np.zeros((3, 12)))
    env = batch.env
    by_hand = VectorEnv(
        env.task, env.scene, env.engine, num_envs=3, episode_length=4,
        dynamics=env.dynamics, metric_names=env.metric_names,
    )  # fmt: skip
    with pytest.raises(pickle.PicklingError, match=r"only worlds of twirl_mjx\.make"):
        pickle.dumps(by_hand)


@pytest.fixture(scope="module")
def brax_view(worlds: Callable[..., Any]) -> Any:
    """The batched view over the three compiled worlds of ``stand``."""
    from twirl_mjx.worlds.brax_view import BraxEnv

    made = worlds("stand")
    compiled: Any = SimpleNamespace(
        reset=lambda key: made._reset(key, made.env.dynamics),
        step=made.step,
        engine=made.env.engine,
        observation_size=made.env.observation_size,
        action_size=made.env.action_size,
    )
    return BraxEnv(compiled, batched=True)


def test_brax_view_tells_truncation_from_termination(
    brax_view: Any, put: Callable[..., Any], fallen: np.ndarray
) -> None:
    state = brax_view.reset(jax.random.key(0))
    np.testing.assert_array_equal(state.done, np.zeros(3))
    np.testing.assert_array_equal(state.info["truncation"], np.zeros(3))
    worlds = put(state.pipeline_state, 2, fallen)
    steps = worlds.world.episode_step.at[jnp.array([1])].set(399)
    worlds = worlds.replace(world=worlds.world.replace(episode_step=steps))
    state = state.replace(
        pipeline_state=worlds, info=state.info | {"mine": jnp.ones(3)}, metrics=state.metrics
    )
    after = brax_view.step(state, jnp.zeros((3, 12)))
    np.testing.assert_array_equal(after.done, [0.0, 1.0, 1.0])
    np.testing.assert_array_equal(after.info["truncation"], [0.0, 1.0, 0.0])
    np.testing.assert_array_equal(after.info["mine"], np.ones(3))  # wrappers keep theirs
    np.testing.assert_array_equal(after.info["next_obs"][0], after.obs[0])
    assert (np.abs(after.info["next_obs"] - after.obs).max(axis=1)[1:] > 0.01).all()
    assert set(after.metrics) == set(after.pipeline_state.metrics)


def test_brax_view_takes_both_kinds_of_keys(brax_view: Any) -> None:
    raw, typed = (brax_view.reset(make(4)) for make in (jax.random.PRNGKey, jax.random.key))
    np.testing.assert_array_equal(raw.obs, typed.obs)
    assert raw.obs.shape == (3, brax_view.observation_size)
    assert (brax_view.action_size, brax_view.backend) == (12, "native")


@pytest.mark.slow
def test_brax_wrappers() -> None:
    """brax's own batching, episode and auto-reset wrappers around a single world, jitted."""
    from brax.envs.base import Env
    from brax.envs.wrappers import training

    env = to_brax("stand", engine="native")
    assert isinstance(env, Env)
    wrapped = training.wrap(env, episode_length=2)
    reset, step = jax.jit(wrapped.reset), jax.jit(wrapped.step)
    state = reset(jax.random.split(jax.random.PRNGKey(0), 2))
    first = np.asarray(state.obs)
    assert first.shape == (2, 101)
    for done in (0.0, 1.0, 0.0):
        state = step(state, jnp.zeros((2, 12)))
        np.testing.assert_array_equal(state.done, [done, done])
        np.testing.assert_array_equal(state.info["truncation"], [done, done])
        assert (np.asarray(state.reward) > 0.3).all()
        assert (np.asarray(state.obs) == first).all() == bool(done)
        assert not (np.asarray(state.info["next_obs"]) == first).all()


def test_brax_view_of_many_worlds() -> None:
    env = to_brax("biped", "icy", num_envs=2, engine="mjx")
    assert (env.backend, env.observation_size, env.action_size) == ("mjx", 101, 12)
    shapes = jax.eval_shape(env.reset, jax.random.key(0))
    assert shapes.obs.shape == (2, 101)
    single = jax.eval_shape(to_brax("biped").reset, jax.random.key(0))
    assert single.obs.shape == (101,)
    assert single.done.shape == ()


def test_brax_wrappers_count_on_raw_keys() -> None:
    """As docs/adapters.md says: typed keys lack the axis that brax's episode wrapper drops."""
    from brax.envs.wrappers import training

    wrapped = training.wrap(to_brax("stand", engine="native"), episode_length=2)
    counts = [
        jax.eval_shape(wrapped.reset, jax.random.split(make(0), 2)).info["steps"].shape
        for make in (jax.random.PRNGKey, jax.random.key)
    ]
    assert counts == [(2,), ()]
