"""What every registered task owes its callers (README, "From Python")."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import twirl_mjx
from twirl_mjx.sim.dynamics import make_dynamics
from twirl_mjx.sim.leaves import PAPER_SHIFTS
from twirl_mjx.tasks.registry import TASKS
from twirl_mjx.tasks.stand import StandOptions
from twirl_mjx.worlds.config import WorldConfig
from twirl_mjx.worlds.make import make
from twirl_mjx.worlds.vector import EnvState


@pytest.fixture(params=TASKS.names())
def made(request: pytest.FixtureRequest, worlds: Callable[..., Any]) -> Any:
    return worlds(request.param)


def avals(state: EnvState) -> list[tuple[Any, ...]]:
    """Return path, shape, dtype and weakness of every leaf: what a second call compiles for."""
    leaves = [
        (jax.tree_util.keystr(path), jax.typeof(leaf))
        for path, leaf in jax.tree_util.tree_leaves_with_path(state)
    ]
    return [(path, aval.shape, aval.dtype, aval.weak_type) for path, aval in leaves]


def test_reset_and_step_return_identical_avals(made: Any) -> None:
    state = made.reset(0)
    after = made.step(state, jnp.zeros((3, 12)))
    assert jax.tree.structure(state) == jax.tree.structure(after)
    assert avals(state) == avals(after)
    assert not any(weak for _, _, _, weak in avals(state))
    made.step(after, jnp.zeros((3, 12)))
    made.reset(1)
    assert made.traces == {"reset": 1, "step": 1}


def test_state_is_what_the_contract_says(made: Any, actions: Callable[..., np.ndarray]) -> None:
    env, state = made.env, made.reset(2)
    size = env.observation_size
    np.testing.assert_array_equal(state.obs, state.next_obs)
    assert not state.done.any()
    assert not state.reward.any()
    assert not state.world.episode_step.any()
    for after in made.run(state, actions(5, 3)):
        assert after.obs.shape == after.next_obs.shape == (3, size)
        assert after.obs.dtype == after.next_obs.dtype == after.reward.dtype == jnp.float32
        assert after.reward.shape == after.terminated.shape == after.truncated.shape == (3,)
        assert after.terminated.dtype == after.truncated.dtype == bool
        assert after.data.qpos.shape == (3, 19)
        assert after.data.qvel.shape == (3, 18)
        norms = np.linalg.norm(after.data.qpos[:, 3:7], axis=1)
        np.testing.assert_allclose(norms, 1.0, atol=1e-4)
        assert not after.invalid.any()
        for values in (after.obs, after.next_obs, after.reward, *after.metrics.values()):
            assert np.isfinite(values).all()
        assert set(after.metrics) == set(env.metric_names)
        for value in after.metrics.values():
            assert value.shape == (3,)
            assert value.dtype == jnp.float32


def test_sizes(made: Any) -> None:
    env = made.env
    assert env.num_envs == 3
    assert env.action_size == 12
    assert env.control_dt == 0.05
    assert (env.mj_model.nq, env.mj_model.nv, env.mj_model.nu) == (19, 18, 12)


@pytest.mark.parametrize(("task", "size"), [("stand", 101), ("biped", 101), ("hurdles", 95)])
def test_observation_sizes_of_the_paper(task: str, size: int) -> None:
    assert make(task, num_envs=2).observation_size == size


@pytest.mark.parametrize("shift", PAPER_SHIFTS)
def test_every_shift_has_its_scene_and_dynamics(shift: str) -> None:
    env = twirl_mjx.make("stand", shift, num_envs=2)
    assert env.scene.kind == {"bumpy": "bumpy", "sloped": "sloped"}.get(shift, "flat")
    expected = make_dynamics(shift)
    for have, want in zip(jax.tree.leaves(env.dynamics), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(have, [want, want])
    model = env.mj_model  # for the users of C MuJoCo: what the worlds really have
    assert model.opt.gravity[2] == pytest.approx(-3.7 if shift == "gravity" else -9.81)
    floor = model.geom("floor")
    assert floor.friction[0] == pytest.approx(0.4 if shift == "icy" else 1.0)
    if shift == "bumpy":
        assert model.hfield_data.max() * model.hfield_size[0, 2] == pytest.approx(0.05)


def test_defaults() -> None:
    env = twirl_mjx.make("stand")
    assert env.num_envs == 256
    assert env.episode_length == 400
    assert env.scene.kind == "flat"


def test_options_reach_the_worlds() -> None:
    config = WorldConfig("stand", StandOptions(height_of="front_feet"), episode_length=7)
    env = make("stand", "icy", 5, shift_strength=0.5, config=config)
    assert env.episode_length == 7
    np.testing.assert_allclose(env.dynamics.friction, [0.7] * 5)
    assert env.task.options.height_of == "front_feet"


def test_a_config_gives_what_is_not_an_argument() -> None:
    config = WorldConfig(shift="icy", num_envs=4, engine="mjx")
    env = make("stand", config=config)
    np.testing.assert_allclose(env.dynamics.friction, [0.4] * 4)
    assert type(env.engine).__name__ == "MjxEngine"
    env = make("stand", "none", 2, engine="native", config=config)
    np.testing.assert_allclose(env.dynamics.friction, [1.0] * 2)
    assert type(env.engine).__name__ == "NativeEngine"


@pytest.mark.parametrize(
    ("arguments", "options", "message"),
    [
        (("bipde",), {}, "unknown task 'bipde'.*nearest: 'biped'"),
        (("stand", "ice"), {}, "unknown shift 'ice'.*nearest: 'icy'"),
        (("stand", "none", 0), {}, r"num_envs = 0 is outside \[1, "),
        (("stand",), {"engine": "mjc"}, "unknown engine 'mjc'.*nearest: 'mjx'"),
        (("stand",), {"shift_strength": 3.0}, r"shift_strength = 3.0 is outside \[0"),
    ],
)
def test_bad_arguments_are_refused(
    arguments: tuple[Any, ...], options: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        twirl_mjx.make(*arguments, **options)
