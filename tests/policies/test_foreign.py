"""Foreign graphs and functions roll out in ``biped``; their transitions are source data."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from onnx import TensorProto, helper

from twirl_mjx.policies import contract as schema
from twirl_mjx.policies import ready
from twirl_mjx.policies.contract import Action, ContractError, Term
from twirl_mjx.policies.function import Brain
from twirl_mjx.policies.learned import PolicyFileError
from twirl_mjx.policies.meeting import Command, ContractPolicy
from twirl_mjx.policies.onnx_file import load_onnx
from twirl_mjx.policies.resolve import Terms, resolve_policy
from twirl_mjx.sim.robots import A1
from twirl_mjx.training.presets import make_config
from twirl_mjx.training.source import Collector
from twirl_mjx.worlds.make import make_env
from twirl_mjx.worlds.vector import VectorEnv

GO1 = ready.GO1_JOYSTICK
KEY = jax.random.key(0)
CONFIG = dataclasses.replace(make_config("biped", "debug").evaluation, engine="native")
F16, F64, I64 = TensorProto.FLOAT16, TensorProto.DOUBLE, TensorProto.INT64


@pytest.fixture(scope="module")
def env() -> VectorEnv:
    return make_env(CONFIG, num_envs=2)


def a_state(count: int = 3, step: int = 0, seed: int = 0) -> Any:
    """Return what policies see of ``count`` worlds in motion."""
    rng = np.random.default_rng(seed)
    quat = rng.standard_normal((count, 4))
    qpos = np.concatenate(
        [rng.standard_normal((count, 3)), quat / np.linalg.norm(quat, axis=1, keepdims=True),
         A1.default_pose + 0.3 * rng.standard_normal((count, 12))], axis=1,
    )  # fmt: skip
    qvel = rng.standard_normal((count, 18))
    return SimpleNamespace(
        data=SimpleNamespace(qpos=jnp.asarray(qpos), qvel=jnp.asarray(qvel)),
        world=SimpleNamespace(
            episode_step=jnp.full(count, step, jnp.int32),
            goal=jnp.asarray(rng.standard_normal((count, 2)), jnp.float32),
            action=jnp.zeros((count, 12)),
        ),
        obs=jnp.asarray(rng.standard_normal((count, 101)), jnp.float32),
    )


def echo(size: int) -> Brain:
    """Return a brain whose outputs are the first numbers that it sees."""
    return Brain(lambda obs, ticks, memory: (obs[:, :12], memory), None, size)


def meet(contract: schema.Contract, brain: Brain | None = None) -> ContractPolicy:
    return ContractPolicy(
        contract, brain or echo(contract.observation_size), A1, Command(contract.commands)
    )


def seen_by(policy: ContractPolicy, state: Any) -> np.ndarray:
    return np.asarray(policy.observe(policy.init(state), state)[0])


def test_what_a_joystick_policy_is_shown() -> None:
    """Component by component, with scipy for the rotations."""
    from scipy.spatial.transform import Rotation

    state = a_state()
    obs = seen_by(meet(ready.LEGGED_GYM_48), state)
    qpos, qvel = np.asarray(state.data.qpos), np.asarray(state.data.qvel)
    to_body = Rotation.from_quat(qpos[:, 3:7], scalar_first=True).inv()
    np.testing.assert_allclose(obs[:, :3], 2.0 * to_body.apply(qvel[:, :3]), atol=1e-5)
    np.testing.assert_allclose(obs[:, 3:6], 0.25 * qvel[:, 3:6], atol=1e-6)
    np.testing.assert_allclose(obs[:, 6:9], to_body.apply([0.0, 0.0, -1.0]), atol=1e-6)
    np.testing.assert_allclose(obs[:, 9:12], [[1.0, 0.0, 0.0]] * 3)
    left_first = qpos[:, [10, 11, 12, 7, 8, 9, 16, 17, 18, 13, 14, 15]]
    np.testing.assert_allclose(
        obs[:, 12:24], left_first - ready.LEGGED_GYM_48.default_pose, atol=1e-6
    )
    velocity = qvel[:, [9, 10, 11, 6, 7, 8, 15, 16, 17, 12, 13, 14]]
    np.testing.assert_allclose(obs[:, 24:36], 0.05 * velocity, atol=1e-6)
    assert not obs[:, 36:].any()


def test_the_action_reaches_the_same_joint_targets() -> None:
    contract = ready.UNITREE_RL_LAB_GO2
    output = np.linspace(-1.5, 2.0, 24, dtype=np.float32).reshape(2, 12)
    brain = Brain(lambda obs, ticks, memory: (jnp.asarray(output), memory), None, 45)
    state = a_state(2)
    policy = meet(contract, brain)
    action, memory = policy.act(policy.init(state), state, KEY)
    target = A1.default_pose + np.asarray(action) * A1.action_half_range
    for column, joint in enumerate(contract.joints):
        expected = contract.default_pose[column] + 0.25 * output[:, column]
        np.testing.assert_allclose(target[:, A1.joints.index(joint)], expected, atol=1e-6)
    np.testing.assert_array_equal(memory.previous, output)
    absolute = dataclasses.replace(contract, action=Action("absolute", 1.0, (-1.0, 1.0)))
    policy = meet(absolute, brain)
    action, memory = policy.act(policy.init(state), state, KEY)
    target = A1.default_pose + np.asarray(action) * A1.action_half_range
    hips = [A1.joints.index(joint) for joint in contract.joints[:4]]
    np.testing.assert_allclose(target[:, hips], np.clip(output[:, :4], -1, 1), atol=1e-6)
    assert np.abs(memory.previous).max() == 1.0


@pytest.mark.slow
def test_own_tasks_as_contracts_show_what_their_observers_show(env: VectorEnv) -> None:
    """Two control steps of a real episode, histories included."""
    policy = meet(ready.find_contract("biped", A1))
    state = jax.jit(env.reset)(KEY)
    memory, step = policy.init(state), jax.jit(env.step)
    for _ in range(3):
        obs, _, history = policy.observe(memory, state)
        np.testing.assert_allclose(obs, state.obs, atol=1e-5)
        action = jnp.full((2, 12), 0.3)
        memory = memory.replace(history=history, previous=action)
        state = step(state, action)


def test_histories_and_clocks() -> None:
    terms = (Term("time_step", 1, history=3), Term("time", 1, history=3), Term("gait_sin", 2))
    contract = dataclasses.replace(
        GO1, observation=terms, gait_period=0.4, gait_offsets=(0.0, 0.25)
    )
    expected = {
        ("term", "oldest"): [0, 2, 5, 0.0, 0.05, 0.1, 1.0, 0.0],
        ("frame", "oldest"): [0, 0.0, 2, 0.05, 5, 0.1, 1.0, 0.0],
        ("term", "newest"): [5, 2, 0, 0.1, 0.05, 0.0, 1.0, 0.0],
        ("frame", "newest"): [5, 0.1, 2, 0.05, 0, 0.0, 1.0, 0.0],
    }
    for (layout, order), numbers in expected.items():
        policy = meet(
            dataclasses.replace(contract, history_layout=layout, history_order=order),
            Brain(lambda obs, ticks, memory: (jnp.zeros((1, 12)), memory), None, 8),
        )
        memory = policy.init(a_state(1))
        for step in (0, 1):
            _, memory = policy.act(memory, a_state(1, step), KEY)
        obs, _, _ = policy.observe(memory, a_state(1, 2))
        np.testing.assert_allclose(obs[0], numbers, atol=1e-5)  # 0.1 s are 5 steps of 20 ms
        first = seen_by(policy, a_state(1, 0))
        assert not first[0, :6].any()


def test_a_memory_restarts_with_its_world() -> None:
    def run(obs: jax.Array, ticks: jax.Array, memory: jax.Array) -> Any:
        return jnp.broadcast_to(memory[:, None], (2, 12)), memory + 1.0

    policy = meet(GO1, Brain(run, np.float32(0.0), 48))
    state = a_state(2)
    memory = policy.init(state)
    for steps in ([0, 0], [1, 1], [0, 2]):
        state.world.episode_step = jnp.asarray(steps, jnp.int32)
        _, memory = policy.act(memory, state, KEY)
    np.testing.assert_array_equal(memory.brain, [1.0, 3.0])
    np.testing.assert_array_equal(memory.previous[:, 0], [0.0, 2.0])


def test_a_recurrent_graph_keeps_a_memory_for_every_world(
    env: VectorEnv, graphs: SimpleNamespace, tmp_path: Path
) -> None:
    one, many = graphs.lstm(tmp_path / "one.onnx"), graphs.lstm(tmp_path / "many.onnx", "n")
    found = []
    for path in (one, many):
        source = resolve_policy(str(path), CONFIG, terms=Terms("go1_joystick"))
        state, memory = a_state(3), source.policy.init(a_state(3))
        assert [leaf.shape for leaf in memory.brain] == [(3, 1, 8)] * 2
        actions = []
        for step in range(3):
            state.world.episode_step = jnp.asarray([step, step, 0], jnp.int32)
            action, memory = source.policy.act(memory, state, KEY)
            actions.append(np.asarray(action))
        found.append(actions)
        np.testing.assert_array_equal(actions[0][2], actions[2][2])  # always fresh
        assert np.abs(actions[0][0] - actions[1][0]).max() > 1e-4
    np.testing.assert_allclose(found[0], found[1], atol=1e-6)
    data, _ = Collector(env, source.policy)(KEY, 8)
    assert data.obs.shape == (8, 101)
    with pytest.raises(ValueError, match="keeps a memory or a clock"):
        load_onnx(one).act(np.zeros(48))


@pytest.mark.parametrize("kind", [TensorProto.FLOAT, I64])
def test_a_graph_with_a_time_step_counts_its_own_steps(
    kind: int, graphs: SimpleNamespace, tmp_path: Path
) -> None:
    """A motion tracker: what it does depends on how often it was asked; more outputs than one."""
    path = graphs.tracker(tmp_path / "tracker.onnx", GO1, kind)
    source = resolve_policy(str(path), CONFIG, terms=Terms("go1_joystick"))
    motion = graphs.teacher(0.7, 0.0, 0.0)
    for step in (0, 4, 9):  # 0.2 s are 10 steps of 20 ms, and 4 of the motion
        state = a_state(2, step)
        action, _ = source.policy.act(source.policy.init(state), state, KEY)
        target = A1.default_pose + np.asarray(action) * A1.action_half_range
        np.testing.assert_allclose(target, [motion[step % 8]] * 2, atol=1e-5)


@pytest.mark.parametrize("kind", [F16, F64])
def test_half_and_double_graphs_and_flat_inputs(
    kind: int, graphs: SimpleNamespace, tmp_path: Path
) -> None:
    dtype = {F16: np.float16, F64: np.float64}[kind]
    weights = {"w": np.full((101, 12), 0.01).astype(dtype)}
    node = [helper.make_node("MatMul", ["obs", "w"], ["action"])]
    kinds = {"obs": kind, "action": kind}
    state, found = a_state(), []
    for name, shape in (("flat", []), ("rows", ["n"])):
        path = graphs.save(
            tmp_path / f"{name}.onnx", node, {"obs": [*shape, 101]}, {"action": [*shape, 12]},
            weights, kinds=kinds,
        )  # fmt: skip
        policy = resolve_policy(str(path), CONFIG).policy
        action, _ = policy.act(policy.init(state), state, KEY)
        found.append(np.asarray(action))
        expected = 0.01 * np.asarray(state.obs).sum(axis=1)
        np.testing.assert_allclose(action[:, 0], expected, atol=5e-3)
    np.testing.assert_allclose(found[0], found[1], atol=2e-3)


def linear(graphs: SimpleNamespace, path: Path, size: int, scale: float, **more: Any) -> Path:
    weights = {"w": np.zeros((size, 12), np.float32), "b": np.full(12, scale, np.float32)}
    nodes = [
        helper.make_node("MatMul", ["obs", "w"], ["p"]),
        helper.make_node("Add", ["p", "b"], ["actions"]),
    ]
    ends = ({"obs": ["n", size]}, {"actions": ["n", 12]})
    return graphs.save(path, nodes, *ends, weights, **more)


def test_a_graph_that_does_not_say_what_it_wants_is_refused(
    graphs: SimpleNamespace, tmp_path: Path
) -> None:
    path = str(linear(graphs, tmp_path / "f.onnx", 48, 0.1))
    with pytest.raises(ValueError, match=r"takes observations of 48 numbers, task biped shows 101.*"
                       "nearest: --source-contract legged_gym_48 or go1_joystick"):  # fmt: skip
        resolve_policy(path, CONFIG)
    with pytest.raises(ContractError, match="of 48 numbers, contract 'legged_gym_45' shows 45"):
        resolve_policy(path, CONFIG, terms=Terms("legged_gym_45"))
    with pytest.raises(ValueError, match="source-command 1,0,0 would do nothing"):
        resolve_policy(path, CONFIG, terms=Terms(command="1,0,0"))
    raw = str(linear(graphs, tmp_path / "raw.onnx", 101, 7.0))
    with pytest.raises(ValueError, match=r"outputs up to 7, 100% of them outside \[-1, 1\]"):
        resolve_policy(raw, CONFIG)
    assert resolve_policy(raw, CONFIG, terms=Terms(allow_clipping=True)).policy


def test_contracts_travel_in_the_file(graphs: SimpleNamespace, tmp_path: Path) -> None:
    """Ours as JSON, mjlab's as its own keys."""
    mjlab = {
        "joint_names": ",".join(GO1.joints),
        "default_joint_pos": ",".join(map(str, GO1.default_pose)),
        "action_scale": "0.5",
        "observation_names": "base_lin_vel,base_ang_vel,projected_gravity,joint_pos,joint_vel,"
        "actions,command",
    }
    for metadata in ({schema.METADATA_KEY: GO1.to_json()}, mjlab):
        path = linear(graphs, tmp_path / "f.onnx", 48, 0.1, metadata=metadata)
        source = resolve_policy(str(path), CONFIG, terms=Terms(command="towards-goal:0.5"))
        assert isinstance(source.policy, ContractPolicy)
        assert source.policy.contract.observation == GO1.observation
        other = resolve_policy(str(path), CONFIG, terms=Terms(command="1,0,0"))
        assert other.digest != source.digest  # another command is another source
    path = linear(graphs, tmp_path / "f.onnx", 48, 0.1, metadata={schema.METADATA_KEY: "{}"})
    with pytest.raises(ContractError, match=r"f\.onnx: not marked"):
        resolve_policy(str(path), CONFIG)


def test_clipping_is_counted_and_refused(
    env: VectorEnv, graphs: SimpleNamespace, tmp_path: Path
) -> None:
    """Three of twelve joints out of reach: 25 %."""
    far = np.where(np.arange(12) < 3, 10.0, 0.1)
    policy = meet(GO1, Brain(lambda o, t, m: (jnp.tile(jnp.float32(far), (2, 1)), m), None, 48))
    with pytest.raises(ValueError, match=r"25% of the source's joint targets.*--allow-clipping"):
        Collector(env, policy)(KEY, 8, max_clipped=0.2)
    data, means = Collector(env, policy)(KEY, 8)
    assert means["clipped"] == pytest.approx(0.25)
    assert np.abs(data.action).max() == 1.0


@pytest.mark.parametrize(
    ("inputs", "outputs", "message"),
    [
        ({"a": ["n", 3], "b": ["n", 3]}, {"u": ["n", 3]}, "which input of a .* is the policy's"),
        ({"obs": ["n", 3], "b": ["n", 3]}, {"u": ["n", 3]}, "input b .* is neither an observation"),
        ({"obs": [2, 3], "h_in": [2, 3]}, {"u": [2, 3], "h_out": [2, 3]}, "takes 2 worlds at once"),
        ({"obs": ["n", "k"]}, {"u": ["n", 3]}, "with a fixed size"),
    ],
)
def test_graphs_whose_parts_are_unclear_are_refused(
    inputs: dict, outputs: dict, message: str, graphs: SimpleNamespace, tmp_path: Path
) -> None:
    sums = [helper.make_node("Sum", list(inputs), [name]) for name in outputs]
    path = graphs.save(tmp_path / "f.onnx", sums, inputs, outputs, {})
    with pytest.raises(PolicyFileError, match=message):
        load_onnx(path)


FUNCTIONS = """
import jax.numpy as jnp
import numpy as np

def hosted(obs):
    return np.clip(np.asarray(obs)[:, :12].copy(), -1, 1)

def traced(obs):
    return jnp.clip(obs[:, :12], -1, 1)

def count(obs, memory):
    return np.asarray(obs)[:, :12] * 0 + memory["n"][:, None], {"n": memory["n"] + 0.125}

clock = (lambda: {"n": np.float32(0)}, count)
wrong = lambda obs: obs[:, :3]
broken = lambda obs: obs.nothing
number = 3

class Own:
    def init(self, state):
        return ()

    def act(self, memory, state, key):
        return jnp.zeros_like(state.world.action), memory
"""


def test_functions_of_a_file(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text(FUNCTIONS)
    state = a_state()
    expected = np.clip(np.asarray(state.obs)[:, :12], -1, 1)
    for name in ("hosted", "traced"):
        policy = resolve_policy(f"{file}:{name}", CONFIG).policy
        action, _ = policy.act(policy.init(state), state, KEY)
        np.testing.assert_allclose(action, expected)
    under = resolve_policy(f"{file}:traced", CONFIG, terms=Terms("go1_joystick"))
    action, memory = under.policy.act(under.policy.init(state), state, KEY)
    first = seen_by(meet(GO1), state)[:, :12]
    np.testing.assert_allclose(memory.previous, np.clip(first, -1, 1), atol=1e-6)
    own = resolve_policy(f"{file}:Own", CONFIG).policy
    assert not np.asarray(own.act((), state, KEY)[0]).any()
    clock = resolve_policy(f"{file}:clock", CONFIG).policy
    memory, first = clock.init(state), []
    for step in range(3):
        action, memory = clock.act(memory, a_state(step=step), KEY)
        first.append(float(action[0, 0]))
    assert first == [0.0, 0.125, 0.25]


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("wrong", r"outputs of shape \(2, 3\) of observations \(2, 101\)"),
        ("broken", "failed when it was tried on zeros: AttributeError"),
        ("number", "is int: need function"),
        ("hoste", "nearest: 'hosted'"),
    ],
)
def test_functions_that_are_none_are_refused(name: str, message: str, tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text(FUNCTIONS)
    with pytest.raises(ValueError, match=message):
        resolve_policy(f"{file}:{name}", CONFIG)
