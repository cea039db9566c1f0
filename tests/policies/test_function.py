from __future__ import annotations

from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from twirl_mjx.policies.function import HostPolicy, from_policy
from twirl_mjx.policies.learned import NumpyPolicy, PolicyHeader


@flax.struct.dataclass
class World:
    episode_step: jax.Array


@flax.struct.dataclass
class State:
    obs: jax.Array
    world: World


def make_state(obs: Any, steps: Any) -> State:
    return State(jnp.asarray(obs, jnp.float32), World(jnp.asarray(steps, jnp.int32)))


KEY = jax.random.key(0)


def test_stateless_function_under_jit() -> None:
    policy = HostPolicy(lambda obs: 0.1 * obs[:, :2], action_size=2)
    obs = np.arange(12.0).reshape(4, 3) / 10
    state = make_state(obs, [0, 1, 2, 3])
    action, memory = jax.jit(policy.act)(policy.init(state), state, KEY)
    np.testing.assert_allclose(action, 0.1 * obs[:, :2], rtol=1e-6)
    assert action.dtype == jnp.float32
    assert memory is None


def test_actions_are_handed_on_as_they_are() -> None:
    """The worlds clip them, and a recording counts how often."""
    policy = HostPolicy(lambda obs: obs, action_size=2)
    state = make_state([[3.0, -0.5], [0.25, -7.0]], [1, 1])
    action, _ = policy.act(None, state, KEY)
    np.testing.assert_array_equal(action, [[3.0, -0.5], [0.25, -7.0]])


def clock(obs: np.ndarray, memory: dict[str, np.ndarray]) -> tuple[np.ndarray, dict[str, Any]]:
    count = memory["count"] + 1
    return np.stack([count / 10, obs[:, 0]], axis=1), {"count": count}


def test_memory_advances_and_restarts_only_in_fresh_worlds() -> None:
    policy = HostPolicy(clock, {"count": np.int32(0)}, action_size=2)
    memory = policy.init(make_state(np.zeros((3, 1)), [0, 0, 0]))
    assert memory["count"].dtype == jnp.int32
    act = jax.jit(policy.act)
    for steps in ([0, 0, 0], [1, 1, 1]):
        _, memory = act(memory, make_state(np.zeros((3, 1)), steps), KEY)
    action, memory = act(memory, make_state(np.zeros((3, 1)), [2, 0, 2]), KEY)
    np.testing.assert_array_equal(memory["count"], [3, 1, 3])
    np.testing.assert_allclose(action[:, 0], [0.3, 0.1, 0.3], rtol=1e-6)


def test_vmap_makes_one_host_call_and_keeps_rows_apart() -> None:
    rows = []

    def function(obs: np.ndarray, memory: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rows.append(len(obs))
        return 0.01 * obs + memory[:, None], memory + 0.1

    policy = HostPolicy(function, np.float32(0.0), action_size=2)
    obs = np.arange(12.0).reshape(2, 3, 2)
    state = make_state(obs, np.ones((2, 3)))
    memory = jnp.arange(6.0).reshape(2, 3) / 10
    action, memory_after = jax.vmap(policy.act, (0, 0, None))(memory, state, KEY)
    assert rows == [6]
    np.testing.assert_allclose(action, 0.01 * obs + memory[..., None], rtol=1e-5)
    np.testing.assert_allclose(memory_after, memory + 0.1, rtol=1e-6)


def test_scan_calls_the_host_once_per_step_and_traces_once(count_traces: Any) -> None:
    policy = HostPolicy(clock, {"count": np.int32(0)}, action_size=2)
    state = make_state(np.zeros((2, 1)), [1, 1])

    def step(memory: Any, _: None) -> tuple[Any, jax.Array]:
        action, memory = policy.act(memory, state, KEY)
        return memory, action

    counter = count_traces(lambda memory: jax.lax.scan(step, memory, None, 5))
    rollout = jax.jit(counter)
    memory, actions = rollout(policy.init(state))
    memory, actions = rollout(memory)
    assert counter.traces == 1
    np.testing.assert_allclose(actions[:, 0, 0], np.arange(6, 11) / 10, rtol=1e-6)


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda obs: obs[:, :1], r"shape \(2, 1\), expected \(2, 2\)"),
        (lambda obs: obs / 0.0 * [[0, 0], [1, 1]], "non-finite action in world"),
    ],
)
@pytest.mark.filterwarnings("ignore:divide by zero:RuntimeWarning")
@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning")
def test_faulty_functions_are_named(function: Any, message: str) -> None:
    policy = HostPolicy(function, action_size=2)
    with pytest.raises(Exception, match=message):
        jax.block_until_ready(policy.act(None, make_state(np.ones((2, 2)), [1, 1]), KEY))


def test_own_observation() -> None:
    header = PolicyHeader("stand", 2, 2, 0.05)
    arrays = {"kernel": np.eye(2, dtype=np.float32), "bias": np.zeros(2, np.float32)}
    learned = NumpyPolicy(header, {"mean": arrays, "log_std": arrays})
    policy = from_policy(learned, observe=lambda state: state.obs[:, 1:])
    state = make_state([[9.0, 0.1, 0.2], [9.0, 0.3, 0.4]], [1, 1])
    action, _ = jax.jit(policy.act)(None, state, KEY)
    np.testing.assert_allclose(action, np.tanh([[0.1, 0.2], [0.3, 0.4]]), rtol=1e-5)
