from __future__ import annotations

import dataclasses
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import signal

from twirl_mjx.policies import scripted
from twirl_mjx.policies.scripted import BOUND, TROT, Gait, action_table
from twirl_mjx.sim.robots import A1

KEY = jax.random.key(0)
GAITS = pytest.mark.parametrize("gait", [TROT, BOUND], ids=["trot", "bound"])


@flax.struct.dataclass
class World:
    episode_step: jax.Array
    action: jax.Array


@flax.struct.dataclass
class State:
    world: World


def make_state(*steps: int) -> State:
    return State(World(jnp.array(steps, jnp.int32), jnp.zeros((len(steps), 12))))


@GAITS
def test_table_fits_the_action_box(gait: Gait) -> None:
    table = action_table(gait)
    assert table.shape == (gait.period_steps, 12)
    assert np.abs(table).max() <= 1.0
    np.testing.assert_allclose(table[:, ::3], 0.0, atol=1e-6)  # hips stay straight


def test_legs_move_in_the_order_of_the_gait() -> None:
    trot, bound = action_table(TROT), action_table(BOUND)
    half = TROT.period_steps // 2
    np.testing.assert_allclose(trot[:, 0:3], np.roll(trot[:, 3:6], half, axis=0), atol=1e-6)
    np.testing.assert_allclose(trot[:, 6:9], np.roll(trot[:, 9:12], half, axis=0), atol=1e-6)
    np.testing.assert_allclose(bound[:, 0:3], bound[:, 3:6], atol=1e-6)
    np.testing.assert_allclose(bound[:, 6:9], bound[:, 9:12], atol=1e-6)
    assert np.abs(trot[:, 0:3] - trot[:, 3:6]).max() > 0.1


def test_filter_turns_the_command_into_the_wanted_path() -> None:
    time = np.arange(10) / 10
    wanted = np.column_stack(
        [0.3 + 0.2 * np.cos(2 * np.pi * time), 0.1 * np.sin(4 * np.pi * time) - 1.0]
    )
    command = np.tile(scripted.unfilter(A1, wanted), (20, 1))
    b, a = np.asarray(signal.butter(2, 0.4))
    filtered = signal.lfilter(b, a, command, axis=0)
    np.testing.assert_allclose(filtered[-10:], wanted, atol=1e-6)
    assert np.abs(command[-10:] - wanted).max() > 0.01


def test_stance_goes_back_and_swing_is_up() -> None:
    phase = np.linspace(0.0, 1.0, 100, endpoint=False)
    x, z = scripted.foot_path(TROT, phase, 0)
    stance = phase < TROT.duty
    assert (np.diff(x[stance]) < 0).all()
    assert (np.diff(x[~stance][1:]) > 0).all()
    np.testing.assert_allclose(np.ptp(x), TROT.stride[0], atol=2e-3)
    assert z[~stance].max() - z[stance].max() == pytest.approx(TROT.lift[0], abs=2e-3)


def test_gaits_out_of_range_are_refused() -> None:
    with pytest.raises(ValueError, match=r"leg RR .* 0\.4282 m, allowed"):
        action_table(dataclasses.replace(TROT, stride=(0.6, 0.6)))
    with pytest.raises(ValueError, match=r"needs actions up to 1\.\d+"):
        action_table(dataclasses.replace(TROT, depth=(0.14, 0.14), lift=(0.04, 0.04)))


@GAITS
def test_clock_restarts_only_in_fresh_worlds_and_plays_the_table(gait: Gait) -> None:
    policy = scripted.GaitPolicy(gait)
    memory = policy.init(make_state(0, 0))
    assert memory.dtype == jnp.int32
    act = jax.jit(policy.act)
    table = action_table(gait, A1)
    fade = [min(step / max(gait.ramp_steps, 1), 1.0) for step in range(14)]
    expected = [table[step % gait.period_steps] * fade[step] for step in range(14)]
    for step in range(13):
        action, memory = act(memory, make_state(step, step), KEY)
        np.testing.assert_allclose(action[0], expected[step], atol=1e-6)
    action, memory = act(memory, make_state(13, 0), KEY)
    np.testing.assert_allclose(action, [expected[13], expected[0]], atol=1e-6)
    np.testing.assert_array_equal(memory, [14, 1])
    assert action.dtype == jnp.float32


def test_zero_and_random() -> None:
    state = make_state(*range(500))
    zero, _ = scripted.get_scripted("zero").act(None, state, KEY)
    np.testing.assert_array_equal(zero, np.zeros((500, 12)))
    noise, _ = scripted.get_scripted("random").act(None, state, KEY)
    other, _ = scripted.get_scripted("random").act(None, state, jax.random.key(1))
    assert noise.shape == (500, 12)
    assert np.abs(noise).max() <= 1.0
    assert np.var(noise) == pytest.approx(1 / 3, abs=0.02)
    assert not np.array_equal(noise, other)


def test_registry() -> None:
    assert set(scripted.SCRIPTED) == {"trot", "bound", "zero", "random"}
    for name in scripted.SCRIPTED:  # usable as a static argument of jit
        assert hash(scripted.get_scripted(name)) == hash(scripted.get_scripted(name, A1))
    assert scripted.get_scripted("trot") == scripted.GaitPolicy(TROT, A1)
    with pytest.raises(ValueError, match="nearest: 'bound'"):
        scripted.get_scripted("bounds")


@pytest.mark.parametrize("gait", ["trot", "bound"])
def test_gait_walks_forward_on_the_real_a1(gait: str) -> None:
    """10 s in C MuJoCo at 1 ms: at least 0.3 m/s, upright, nothing but legs on the ground."""
    from twirl_mjx.deploy.rehearsal import IDEAL, rehearse

    config = dataclasses.replace(IDEAL, episode_s=10.0)
    episode = rehearse(gait, task="biped", episodes=1, config=config).episodes[0]
    assert episode.cause == "time"
    assert episode.metrics["forward_speed"] >= 0.3
    assert episode.qpos[:, 2].min() > 0.7 * A1.home_height
    assert abs(episode.qpos[-1, 1]) < 0.2 * episode.qpos[-1, 0]


def test_state_needs_nothing_but_the_clock(count_traces: Any) -> None:
    counter = count_traces(scripted.get_scripted("trot").act)
    act = jax.jit(counter)
    memory = jnp.zeros(2, jnp.int32)
    for step in range(3):
        _, memory = act(memory, make_state(step, step), KEY)
    assert counter.traces == 1
