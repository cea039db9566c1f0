"""A policy as strangers have them: 48 inputs of legged_gym, 12 outputs, learned by imitation.

    python examples/foreign_trot.py trot48.onnx
    twirl render trot48.onnx --task biped --source-contract legged_gym_48 --source-command 0.7,0,0

Teacher: the scripted trot, its strides turned into a joystick (m/s forward, m/s left, rad/s yaw).
Pupil: an ELU network as rsl_rl trains them. Of what it is shown it uses the command and its own
last output, from which it knows where in the gait it is.
"""

import argparse

import jax
import jax.numpy as jnp
import numpy as np
import onnx
import optax
from onnx import helper, numpy_helper

from twirl_mjx.policies.contract import Contract
from twirl_mjx.policies.ready import LEGGED_GYM_48
from twirl_mjx.policies.scripted import TROT, foot_path, unfilter
from twirl_mjx.sim import kinematics
from twirl_mjx.sim.robots import A1

TROT_SPEED = 0.7
"""m/s of the scripted trot at its full stride."""
FULL_LIFT = 0.2
"""m/s of command from which feet are lifted all the way."""
UNITS = 96
EXAMPLES, BATCH, UPDATES, LEARNING_RATE = 40_000, 128, 3000, 3e-3


def teacher(forward: float, left: float, yaw: float) -> np.ndarray:
    """Return one period of joint targets [8, 12] in rad, before the worlds' low-pass."""
    feet = np.zeros((TROT.period_steps, 4, 3))
    lifted = min(1.0, (abs(forward) + abs(left) + 0.2 * abs(yaw)) / FULL_LIFT)
    for leg, offset in enumerate(TROT.offsets):
        phase = (np.arange(TROT.period_steps) / TROT.period_steps + offset) % 1.0
        hind, (hip_x, hip_y, _) = int(leg in A1.hind_legs), A1.hip_offsets[leg]
        x, z = foot_path(TROT, phase, hind)
        step = (x - TROT.centre[hind]) / TROT_SPEED
        feet[:, leg, 0] = TROT.centre[hind] + step * (forward - yaw * hip_y)
        feet[:, leg, 1] = A1.side_signs[leg] * A1.thigh_offset + step * (left + yaw * hip_x)
        feet[:, leg, 2] = lifted * (z + TROT.depth[hind]) - TROT.depth[hind]
    return unfilter(A1, kinematics.leg_inverse(A1, feet + A1.hip_offsets))


def lessons(contract: Contract) -> tuple[np.ndarray, np.ndarray]:
    """Return what the pupil is shown [M, O], and what the teacher would answer [M, 12].

    The last output is that of any phase and strength of the gait, with noise, under the present
    command or another: so what strays from the gait is led back to it.
    """
    rng = np.random.default_rng(0)
    order, scale = contract.joint_order(A1), np.asarray(contract.action.scale)
    menu = np.array([(v, s, w) for v in (0.0, 0.15, 0.3, 0.5, 0.7) for s in (-0.1, 0.0, 0.1)
                     for w in (-1.0, -0.5, -0.2, 0.0, 0.2, 0.5, 1.0)])  # fmt: skip
    cycles = np.array([teacher(*command)[:, order] for command in menu])
    cycles = (cycles - np.array(contract.default_pose)) / scale
    rest = cycles[np.flatnonzero(~menu.any(axis=1))[0], 0]
    before, now = rng.integers(len(menu), size=(2, EXAMPLES))
    now = np.where(rng.random(EXAMPLES) < 0.7, before, now)
    phase, strength = rng.integers(8, size=EXAMPLES), rng.uniform(0.0, 1.3, (EXAMPLES, 1))
    last = rest + strength * (cycles[before, phase] - rest)
    grown = np.minimum(1.0, strength + 0.25)
    answer = rest + grown * (cycles[now, (phase + 1) % 8] - rest)
    unit = np.abs(cycles - rest).max()
    begins = np.abs(last - rest).max(axis=1) < 0.07 * unit  # no gait to be seen
    answer[begins] = rest + 0.4 * (cycles[now[begins], 0] - rest)
    shown = {
        "commands": menu[now],
        "previous_action": last + 0.035 * unit * rng.standard_normal(last.shape),
    }
    zeros = {term.name: np.zeros((EXAMPLES, term.size)) for term in contract.observation}
    parts = [(zeros | shown)[term.name] * term.scale for term in contract.observation]
    return np.concatenate(parts, axis=1), answer


def network(weights: list[dict[str, jax.Array]], obs: jax.Array) -> jax.Array:
    """Return outputs [..., 12] at observations [..., O]."""
    *hidden, last = weights
    for layer in hidden:
        obs = jax.nn.elu(obs @ layer["w"] + layer["b"])
    return obs @ last["w"] + last["b"]


def learn(contract: Contract) -> list[dict[str, np.ndarray]]:
    """Return the pupil's layers after ``UPDATES`` of Adam on the mean squared error."""
    obs, answer = (jnp.asarray(array, jnp.float32) for array in lessons(contract))
    sizes = [(obs.shape[1], UNITS), (UNITS, UNITS), (UNITS, 12)]
    keys = jax.random.split(jax.random.key(0), 3)
    used = jnp.any(obs != 0.0, axis=0)  # it is deaf to the rest: command and last output only
    weights = [
        {"w": jax.random.normal(key, size) / jnp.sqrt(size[0]), "b": jnp.zeros(size[1])}
        for key, size in zip(keys, sizes, strict=True)
    ]
    weights[0]["w"] *= jnp.sqrt(obs.shape[1] / used.sum()) * used[:, None]
    adam = optax.adam(optax.cosine_decay_schedule(LEARNING_RATE, UPDATES))

    def update(carry: tuple, key: jax.Array) -> tuple[tuple, None]:
        weights, state = carry
        rows = jax.random.randint(key, (BATCH,), 0, EXAMPLES)
        slope = jax.grad(lambda w: jnp.mean((network(w, obs[rows]) - answer[rows]) ** 2))(weights)
        change, state = adam.update(slope, state)
        return (optax.apply_updates(weights, change), state), None

    start = (weights, adam.init(weights))
    keys = jax.random.split(jax.random.key(1), UPDATES)
    (weights, _), _ = jax.jit(lambda carry: jax.lax.scan(update, carry, keys))(start)
    return jax.tree.map(np.asarray, weights)


def graph(contract: Contract) -> onnx.ModelProto:
    """Return the ONNX graph ``obs`` [1, O] -> ``actions`` [1, 12], as rsl_rl exports one."""
    nodes, arrays, at = [], [], "obs"
    for index, layer in enumerate(learn(contract)):
        end = f"elu.{index}" if index < 2 else ""
        arrays += [numpy_helper.from_array(v, f"{k}.{index}") for k, v in layer.items()]
        nodes.append(helper.make_node("MatMul", [at, f"w.{index}"], [f"product.{index}"]))
        out = f"sum.{index}" if end else "actions"
        nodes.append(helper.make_node("Add", [f"product.{index}", f"b.{index}"], [out]))
        nodes += [helper.make_node("Elu", [out], [end])] if end else []
        at = end
    sizes = {"obs": contract.observation_size, "actions": contract.action_size}
    source, target = (
        helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, [1, size])
        for name, size in sizes.items()
    )
    made = helper.make_graph(nodes, "foreign trot", [source], [target], arrays)
    return helper.make_model(made, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", help="ONNX file to write")
    onnx.save(graph(LEGGED_GYM_48), parser.parse_args().out)
