"""The gymnasium environment and the brax view, each under its own library's checks."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env

from twirl_mjx.worlds.adapters import GymnasiumEnv, to_brax, to_gymnasium
from twirl_mjx.worlds.config import WorldConfig

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


def test_rendered_frame_shows_the_robot(gym: GymnasiumEnv, monkeypatch: pytest.MonkeyPatch) -> None:
    try:  # what MUJOCO_GL=egl does, which is read when mujoco is imported
        from mujoco.egl import GLContext
    except Exception as error:  # drivers and PyOpenGL fail in many types
        pytest.skip(f"no headless OpenGL on this machine: {error}")
    monkeypatch.setattr("mujoco.rendering.classic.gl_context.GLContext", GLContext)
    env = GymnasiumEnv(gym.env, render_mode="rgb_array")
    env._qpos = gym.env.mj_model.key("home").qpos.copy()
    near = env.render()
    env._qpos[2] += 3.0
    far = env.render()
    env.close()
    assert near is not None
    assert near.shape == (480, 640, 3)
    assert near.dtype == np.uint8
    assert far is not None
    assert np.abs(near.astype(float) - far).mean() > 1.0


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
