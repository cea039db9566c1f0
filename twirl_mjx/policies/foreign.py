"""What is known of a foreign graph before it acts: its contract, its size, its outputs."""

from __future__ import annotations

import hashlib

import jax
import jax.numpy as jnp
import numpy as np

from twirl_mjx.policies import contract as schema
from twirl_mjx.policies import ready
from twirl_mjx.policies.contract import Contract
from twirl_mjx.policies.function import Brain, HostCall
from twirl_mjx.policies.onnx_file import OnnxPolicy
from twirl_mjx.sim.robot import Robot
from twirl_mjx.sim.robots import ROBOTS
from twirl_mjx.tasks.observations import layout_size
from twirl_mjx.worlds.config import WorldConfig

OUTSIDE = 1.05
"""Outputs up to this count as within the action box: rounding, or a last bias."""
MAX_CLIPPED = 0.2
"""Largest share of joint targets that may lie outside the action box."""
PROBES = 64
"""Observations on which a graph without a contract is tried."""


def embedded_contract(policy: OnnxPolicy, origin: str) -> Contract | None:
    """Return the contract in a file's metadata, ours or mjlab's; None if there is none.

    Raises:
        ContractError: There is one, and it cannot be.
    """
    if schema.METADATA_KEY in policy.metadata:
        return schema.from_json(policy.metadata[schema.METADATA_KEY], origin)
    return ready.from_mjlab(policy.metadata, origin)


def brain_of_graph(policy: OnnxPolicy) -> Brain:
    """Return a graph as a brain; it runs on the host, once for all worlds."""
    initial = policy.initial_memory
    size = policy.observation_size

    def step(rows: np.ndarray, memory: tuple[np.ndarray, ...]) -> tuple:
        return policy.step(rows[:, :size], rows[:, size], memory)

    call = HostCall(step, True, policy.action_size)

    def run(obs: jax.Array, ticks: jax.Array, memory: tuple) -> tuple[jax.Array, tuple]:
        # One array goes to the host: the time step is its last column.
        return call(jnp.concatenate([obs, ticks[:, None].astype(obs.dtype)], axis=-1), memory)

    return Brain(run, initial, size, policy.action_size)


def check_size(origin: str, brain: Brain, config: WorldConfig) -> None:
    """Refuse a graph without a contract that cannot take what the task shows.

    Raises:
        ValueError: The message lists the contracts of that size.
    """
    shown = layout_size(config.make_task().observer.layout)
    joints = ROBOTS.get(config.robot).num_joints
    if brain.action_size != joints:
        raise ValueError(
            f"{origin} makes {brain.action_size} numbers, the robot has {joints} joints"
        )
    if brain.observation_size == shown:
        return
    fits = [c.name for c in ready.READY.values() if c.observation_size == brain.observation_size]
    hint = f"--source-contract {' or '.join(fits)}" if fits else "--source-contract FILE.json"
    raise ValueError(
        f"{origin} takes observations of {brain.observation_size} numbers, task {config.task} shows"
        f" {shown}, and the file does not say what it wants to see (nearest: {hint};"
        " docs/sources.md)"
    )


def check_outputs(origin: str, policy: OnnxPolicy, config: WorldConfig) -> None:
    """Refuse a graph without a contract whose outputs are no actions, tried near the start.

    Raises:
        ValueError: More than ``MAX_CLIPPED`` of the outputs lie outside [-1, 1].
    """
    robot, observer = ROBOTS.get(config.robot), config.make_task().observer
    qpos = jnp.asarray([0.0, 0.0, robot.home_height, 1.0, 0.0, 0.0, 0.0, *robot.default_pose])
    qvel = jnp.zeros(robot.nq - 1)
    start = np.asarray(observer.observe(observer.init(qpos, qvel), qpos[:2] + 1.0, qpos, qvel))
    noise = 0.1 * np.random.default_rng(0).standard_normal((PROBES, len(start)))
    rows = np.asarray(start + noise, np.float32)
    memory = [np.repeat(m[None], PROBES, axis=0) for m in policy.initial_memory]
    if policy.batch_size not in (None, 1):
        rows = rows[: policy.batch_size]
        memory = [m[: policy.batch_size] for m in memory]
    if policy.batch_size is not None and len(rows) % policy.batch_size:
        return
    outputs, _ = policy.step(rows, np.zeros(len(rows)), memory)
    share = float((np.abs(outputs) > OUTSIDE).mean())
    if share > MAX_CLIPPED:
        raise ValueError(
            f"{origin} makes outputs up to {np.abs(outputs).max():.3g}, {share:.0%} of them outside"
            " [-1, 1]: these are no actions of this robot but in another scale (nearest:"
            " --source-contract FILE.json that says its action scale and default pose, or"
            " --allow-clipping)"
        )


def terms_digest(contract: Contract, command: str) -> str:
    """Return what changes with a contract or a command."""
    return hashlib.sha256(f"{contract.to_json()} {command}".encode()).hexdigest()[:8]


def describe(contract: Contract, robot: Robot) -> tuple[str, ...]:
    """Return what a person should know of a contract in the worlds of a robot."""
    lines = [f"contract {contract.name}: {contract.observation_size} inputs"]
    own, here = 1.0 / contract.control_dt, 1.0 / robot.control_dt
    if abs(own - here) > 1e-6:
        lines.append(
            f"it was made for {own:g} Hz and is asked at {here:g} Hz, its targets held meanwhile"
        )
    lines.append(
        f"its joint targets pass the {robot.cutoff_hz:g} Hz low-pass of these worlds as all do"
    )
    return tuple(lines)
