"""``imitate`` three times: the simulation's, the rehearsal's in numpy, and its contract's."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from twirl_mjx.assets import asset_path
from twirl_mjx.deploy.conditions import IDEAL
from twirl_mjx.deploy.imitation import Follower, FollowScore, Reference
from twirl_mjx.deploy.reference import Reading, quaternion_matrix
from twirl_mjx.deploy.rehearsal import rehearse
from twirl_mjx.policies import ready
from twirl_mjx.policies.function import Brain
from twirl_mjx.policies.meeting import Command, ContractPolicy
from twirl_mjx.sim.dynamics import make_dynamics
from twirl_mjx.sim.robots import A1
from twirl_mjx.sim.scene import build_scene
from twirl_mjx.tasks import base
from twirl_mjx.tasks.imitate import Imitate, ImitateOptions, ImitateState, clip_of

STEPS = 30
"""Control steps of a test; a cycle of the leap has 25."""
NOMINAL = make_dynamics()
FLAT = build_scene("flat", collision="feet")


@pytest.fixture(scope="module")
def task() -> Imitate:
    return Imitate(ImitateOptions())


@pytest.fixture(scope="module")
def states(task: Imitate) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Return qpos, qvel and action of a robot that follows the leap badly and drifts left."""
    rng = np.random.default_rng(0)
    still = np.array([1.0, 2.0, A1.home_height, 1.0, 0.0, 0.0, 0.0, *A1.default_pose])
    reference = Reference(clip_of(task.options, A1), still[:3])
    found = [(still, np.zeros(18), np.zeros(12))]
    for step in range(1, STEPS + 1):
        reference.advance(found[-1][0][:3])
        qpos, qvel = reference.poses(0)[0] + 0.03 * rng.standard_normal(19), reference.velocity()
        qpos[1] += 0.01 * step
        qpos[3:7] /= np.linalg.norm(qpos[3:7])
        found.append((qpos, qvel + rng.standard_normal(18), rng.uniform(-1, 1, 12)))
    return found


def reading_of(qpos: np.ndarray, qvel: np.ndarray) -> Reading:
    return Reading(quaternion_matrix(qpos[3:7]), qvel[3:6], qpos[7:], qpos[:3])


@pytest.mark.slow
def test_the_observation_is_the_simulation_s_and_the_contract_s(
    task: Imitate, states: list[tuple[np.ndarray, ...]]
) -> None:
    observer, clip = task.follower, clip_of(task.options, A1)
    ours = Follower(clip, reading_of(*states[0][:2]))
    contract = ready.find_contract("imitate", A1)
    brain = Brain(lambda obs, ticks, memory: (obs[:, :12], memory), None, 160)
    policy = ContractPolicy(contract, brain, A1, Command(contract.commands))

    def state(qpos: jax.Array, qvel: jax.Array, step: jax.Array) -> Any:
        return SimpleNamespace(
            data=SimpleNamespace(qpos=qpos[None], qvel=qvel[None]),
            world=SimpleNamespace(episode_step=step[None], goal=jnp.zeros((1, 2))),
        )

    @jax.jit
    def contracted(memory: Any, *seen: jax.Array) -> Any:
        obs, after, history = policy.observe(memory, state(*seen))
        return obs[0], memory._replace(history=history, offset=after.offset)

    push, observe = jax.jit(observer.push), jax.jit(observer.observe)
    memory = other = None
    for step, (qpos, qvel, action) in enumerate(states):
        q, v, a = (jnp.asarray(x, jnp.float32) for x in (qpos, qvel, action))
        if step:
            memory = push(memory, q, v, a)
            ours.push(reading_of(qpos, qvel), action)
            other = other.replace(previous=a[None])
        else:
            memory, other = observer.init(q, v), policy.init(state(q, v, jnp.int32(0)))
        expected = observe(memory, jnp.zeros(2), q, v)
        found = ours.observe(reading_of(qpos, qvel), np.zeros(2))
        assert found.shape == (160,)
        np.testing.assert_allclose(found, expected, atol=5e-5)
        seen, other = contracted(other, q, v, jnp.int32(step))
        np.testing.assert_allclose(seen, expected, atol=5e-5)


def test_the_score_is_the_simulation_s(task: Imitate, states: list[tuple[np.ndarray, ...]]) -> None:
    observer = task.follower
    none: Any = None
    zero = jnp.zeros((), jnp.int32)

    @jax.jit
    def judge(memory: Any, qpos: jax.Array, qvel: jax.Array) -> Any:
        world = base.World(
            key=none, episode_step=zero, action=jnp.zeros(12), filter=none, motors=none,
            dynamics=NOMINAL, goal=jnp.zeros(2), memory=memory,
            task=ImitateState(airborne_steps=zero, flew=jnp.zeros((), bool), flights=zero),
        )  # fmt: skip
        view = base.make_view(FLAT, NOMINAL, qpos[None], qvel[None])
        out = task.judge(world, view, FLAT)
        return out.reward, out.metrics["lost"], out.metrics["leaps"]

    score = FollowScore("imitate", np.zeros(0), clip=clip_of(task.options, A1))
    start = jnp.asarray(states[0][0], jnp.float32)
    memory = observer.init(start, jnp.zeros(18))
    score.start(states[0][0][:3], np.zeros(2))
    push = jax.jit(observer.push)
    for qpos, qvel, action in states[1:]:
        q, v, a = (jnp.asarray(x, jnp.float32) for x in (qpos, qvel, action))
        memory = push(memory, q, v, a)
        reward, lost, leaps = judge(memory, q, v)
        ours = score.step(qpos, qvel, np.full(4, 0.1), np.zeros(2))
        assert ours == pytest.approx(float(reward), rel=2e-3, abs=1e-6)
        assert score.cause() == ("lost" if lost else None)
        assert score.extra(1)["leaps"] == float(leaps)
    assert score.extra(1)["leaps"] == 1.0
    assert score.extra(1)["flights"] == 1.0  # no foot was on the ground
    far = states[-1][0] + np.eye(19)[0] * 2.0
    score.step(far, states[-1][1], np.full(4, 0.1), np.zeros(2))
    assert score.cause() == "lost"


def test_the_shipped_policy_follows_the_leap_in_a_rehearsal() -> None:
    config = dataclasses.replace(IDEAL, episode_s=1.5, sim_dt=0.005)
    found = rehearse(asset_path("policies", "imitate.npz"), episodes=1, config=config)
    episode = found.episodes[0]
    assert found.task == "imitate"
    assert episode.observations.shape[1] == 160
    assert {"tracking", "leaps", "flights"} <= episode.metrics.keys()
    assert "min_distance" not in episode.metrics
    assert episode.metrics["tracking"] == pytest.approx(
        episode.metrics["return"] / episode.metrics["episode_length"]
    )
    assert episode.metrics["tracking"] > 0.3
