"""Every leaf of ``Dynamics`` in both engines: the fields it changes, and what the robot does."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from twirl_mjx.sim import actuation, engine, kinematics
from twirl_mjx.sim.actuation import MotorCommand
from twirl_mjx.sim.dynamics import Dynamics, broadcast, make_dynamics, stack
from twirl_mjx.sim.leaves import LEAVES
from twirl_mjx.sim.robots import A1
from twirl_mjx.sim.scene import Scene, build_scene

Step = Callable[..., tuple[np.ndarray, np.ndarray]]


@pytest.fixture(scope="module")
def flat() -> Scene:
    return build_scene("flat", collision="legs")


FIELDS: dict[str, set[str]] = {
    "gravity": {"opt.gravity"},
    "friction": {"geom_friction"},
    "bump_height": {"hfield_data"},
    "incline": {"geom_quat"},
    "payload": {"body_mass", "body_subtreemass"},
    "com_x": {"body_ipos"},
    "com_y": {"body_ipos"},
    "com_z": {"body_ipos"},
    "motor_strength": {"actuator_forcerange"},
    "kp_scale": {"actuator_gainprm", "actuator_biasprm"},
    "kd_scale": {"actuator_biasprm"},
}
"""Fields of the MuJoCo model that a leaf changes; the others act outside of the engine."""


def fields_of(model: Any) -> dict[str, np.ndarray]:
    """Return every array of a model of C or MJX, by its dotted name."""
    if isinstance(model, mujoco.MjModel):
        owners = {"": model, "opt.": model.opt}
        return {
            f"{prefix}{name}": np.array(getattr(owner, name))
            for prefix, owner in owners.items()
            for name in dir(owner)
            if isinstance(getattr(owner, name, None), np.ndarray)
        }
    paths, _ = jax.tree_util.tree_flatten_with_path(model)
    return {".".join(str(key).strip(".") for key in path): np.array(leaf) for path, leaf in paths}


def changed(before: Any, after: Any) -> dict[str, np.ndarray]:
    """Return the differences of the fields that differ."""
    old, new = fields_of(before), fields_of(after)
    assert set(old) == set(new)
    return {name: new[name] - old[name] for name in old if (old[name] != new[name]).any()}


@pytest.mark.parametrize("leaf", LEAVES, ids=lambda leaf: leaf.name)
def test_a_leaf_changes_exactly_its_own_fields(leaf: Any) -> None:
    """In both engines, by the same amounts."""
    built = build_scene(leaf.scene or "flat", collision="feet")
    whole = actuation.whole_motors(A1)

    def models(dynamics: Dynamics) -> tuple[Any, Any]:
        command = actuation.motor_command(A1, whole, jnp.zeros(12), dynamics)
        return (
            engine.apply_dynamics(built, command, dynamics),
            engine.world_model(built, dynamics),
        )

    value = jnp.float32(0.5 * (leaf.nominal + leaf.high if leaf.high > leaf.nominal else leaf.low))
    nominal = make_dynamics()
    mjx, native = map(changed, models(nominal), models(nominal.replace(**{leaf.name: value})))
    assert set(mjx) == set(native) == FIELDS.get(leaf.name, set())
    for name, difference in mjx.items():
        np.testing.assert_allclose(difference, native[name], atol=1e-5, err_msg=name)


def test_leaves_stand_where_they_belong(flat: Scene) -> None:
    """Trunk, limits and gains by hand; the frames of the trunk need not coincide any more."""
    values = {"payload": 2.0, "com_x": 0.01, "com_y": 0.02, "com_z": -0.03}
    values |= {"motor_strength": 0.5, "kp_scale": 2.0, "kd_scale": 0.5}
    model = engine.world_model(flat, make_dynamics(overrides=values))
    trunk = model.body("trunk")
    assert trunk.mass[0] == pytest.approx(4.713 + 2.0)
    assert trunk.subtreemass[0] == pytest.approx(12.453 + 2.0)
    assert model.body_subtreemass[0] == pytest.approx(12.453 + 2.0)
    np.testing.assert_allclose(trunk.ipos, [0.01, 0.0241, -0.0305], atol=1e-7)
    np.testing.assert_allclose(model.actuator_forcerange, [[-16.75, 16.75]] * 12)
    np.testing.assert_allclose(model.actuator_gainprm[:, 0], 120.0)
    np.testing.assert_allclose(model.actuator_biasprm[:, 1:3], [[-120.0, -1.5]] * 12)


def test_the_centre_of_mass_moves_where_frames_coincide(flat: Scene) -> None:
    """C MuJoCo would skip ``body_ipos`` of a trunk whose inertia lies in its own frame."""
    spec = mujoco.MjSpec.from_string("""
      <mujoco><worldbody><body name="trunk"><freejoint/>
        <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/><geom size="0.1" mass="0"/>
      </body></worldbody></mujoco>""")
    plain = spec.compile()
    assert plain.body_sameframe[1] == mujoco.mjtSameFrame.mjSAMEFRAME_BODY
    assert plain.geom_sameframe[0] in (1, 2)
    model = engine.copy_model(dataclasses.replace(flat, mj_model=plain))
    model.body_ipos[1] = [0.1, 0.0, 0.0]
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.xipos[1], [0.1, 0.0, 0.0])
    np.testing.assert_allclose(data.geom_xpos[0], 0.0)


def make_late_step(built: Scene, name: engine.EngineName) -> Step:
    """Return ``step(qpos, qvel, target, previous, dynamics)`` -> the traces, motors whole."""
    physics = engine.make_engine(name, built, 1, threads=1)

    @jax.jit
    def step(
        qpos: jax.Array, qvel: jax.Array, target: jax.Array, previous: jax.Array, worlds: Dynamics
    ) -> tuple[engine.Trace, jax.Array]:
        def command(target: jax.Array, previous: jax.Array, dynamics: Dynamics) -> MotorCommand:
            command = actuation.motor_command(A1, actuation.whole_motors(A1), target, dynamics)
            return actuation.delay(command, previous, dynamics, built.options.sim_dt, 10)

        data = engine.make_data(built, qpos.shape[0]).replace(qpos=qpos, qvel=qvel)
        data, trace = physics.step(data, jax.vmap(command)(target, previous, worlds), worlds)
        return trace, data.ctrl

    def run(*args: Any) -> tuple[np.ndarray, np.ndarray]:
        *arrays, worlds = args
        trace, ctrl = step(*(jnp.asarray(array, jnp.float32) for array in arrays), worlds)
        np.testing.assert_allclose(ctrl, arrays[2], rtol=1e-6)  # what holds for the next step
        return np.asarray(trace.qpos), np.asarray(trace.qvel)

    return run


AWAY: tuple[dict[str, float], ...] = (
    {},
    {"gravity": 3.7},
    {"friction": 0.2},
    {"payload": 3.0},
    {"payload": -1.0},
    {"com_x": 0.05},
    {"com_y": 0.05},
    {"com_z": 0.05},
    {"motor_strength": 0.5},
    {"kp_scale": 1.3},
    {"kd_scale": 0.6},
    {"latency": 0.02},
)


def test_engines_agree_on_every_leaf_away_from_nominal(flat: Scene) -> None:
    """Four control steps, each from the state that C MuJoCo reached: contact is chaotic.

    The tolerance is that of ``test_engine.py``: float32 against float64 is 1e-6 relative, grown a
    hundredfold by ten stiff contact steps. Where a torque is at its limit the engines differ
    (``test_smaller_limits_turn_the_joints_less``), so the targets are near enough that no limit is
    reached, not even at half the torque.
    """
    worlds = stack([make_dynamics(overrides=values) for values in AWAY], 1)
    count, nominal = len(AWAY), broadcast(make_dynamics(), 1)
    native, mjx = make_late_step(flat, "native"), make_late_step(flat, "mjx")
    rng = np.random.default_rng(3)
    qpos = np.tile(
        [0, 0, 0, 1, 0, 0, 0, *(A1.default_pose + rng.uniform(-0.1, 0.1, 12))], (count, 1)
    )
    feet = np.asarray(kinematics.forward(A1, jnp.asarray(qpos[0], jnp.float32)).feet)
    qpos[:, 2] = A1.foot_radius + 0.001 - feet[:, 2].min()  # just above the ground
    qvel = np.tile(rng.uniform(-0.5, 0.5, 18), (count, 1))
    target = qpos[:, 7:].copy()
    for _ in range(4):
        previous, target = target, qpos[:1, 7:] + rng.uniform(-0.15, 0.15, (1, 12))
        target = np.repeat(target, count, axis=0)
        args = qpos, qvel, target, previous, worlds
        ours, theirs = native(*args), mjx(*args)
        np.testing.assert_allclose(theirs[0], ours[0], atol=2e-5)
        np.testing.assert_allclose(theirs[1], ours[1], atol=5e-3)
        plain = native(*(array[:1] for array in args[:4]), nominal)
        for a, b in zip(ours, plain, strict=True):
            np.testing.assert_array_equal(a[:1], b)  # leaves at nominal change no bit
        qpos, qvel = ours[0][:, -1], ours[1][:, -1]
    for i, values in enumerate(AWAY[1:], 1):
        moved = np.abs(qvel[i] - qvel[0]).max()
        assert (moved > 0.02) == ("motor_strength" not in values), (values, moved)
