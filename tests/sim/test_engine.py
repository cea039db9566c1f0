"""Both physics engines: against each other, against a plain C loop, and world by world.

MJX takes half a minute to compile, so one compiled function of three worlds serves every test.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from twirl_mjx.sim import engine, kinematics, scene
from twirl_mjx.sim.actuation import MotorCommand
from twirl_mjx.sim.dynamics import Dynamics, broadcast, make_dynamics
from twirl_mjx.sim.robots import A1
from twirl_mjx.sim.scene import Scene, build_scene, terrain_height

N = 3
Step = Callable[..., tuple[np.ndarray, np.ndarray]]


@pytest.fixture(scope="module")
def flat() -> Scene:
    return build_scene("flat", collision="legs")


def make_step(built: Scene, name: engine.EngineName, threads: int = 1) -> Step:
    """Return ``step(qpos, qvel, command, dynamics)`` -> traces [N, S, 19], [N, S, 18]."""
    physics = engine.make_engine(name, built, 1, threads)

    @jax.jit
    def run(
        qpos: jax.Array, qvel: jax.Array, command: MotorCommand, dynamics: Dynamics
    ) -> engine.Trace:
        data = engine.make_data(built, qpos.shape[0]).replace(qpos=qpos, qvel=qvel)
        return physics.step(data, command, dynamics)[1]

    def step(qpos: Any, qvel: Any, *args: Any) -> tuple[np.ndarray, np.ndarray]:
        trace = run(jnp.asarray(qpos, jnp.float32), jnp.asarray(qvel, jnp.float32), *args)
        return np.asarray(trace.qpos), np.asarray(trace.qvel)

    return step


@pytest.fixture(scope="module")
def mjx_step(flat: Scene) -> Step:
    return make_step(flat, "mjx")


@pytest.fixture(scope="module")
def native_step(flat: Scene) -> Step:
    return make_step(flat, "native")


@pytest.fixture(params=["native", "mjx"])
def step(request: pytest.FixtureRequest) -> Step:
    return request.getfixturevalue(f"{request.param}_step")


def make_command(
    target: np.ndarray, *, gain: float = 1.0, limit: np.ndarray | float = A1.torque_limit[0]
) -> MotorCommand:
    """Return the command of worlds with ``target`` [N, 12]; ``limit`` is one number per world."""
    ones = np.ones(target.shape, np.float32)
    limits = ones * np.reshape(limit, (-1, 1))
    return MotorCommand(
        *(jnp.asarray(x, jnp.float32) for x in (target, 60 * gain * ones, 3 * gain * ones, limits))
    )


def make_worlds(**leaves: Any) -> Dynamics:
    worlds = broadcast(make_dynamics(), N)
    return worlds.replace(**{k: jnp.asarray(v, jnp.float32) for k, v in leaves.items()})


def standing(height: float, count: int = N) -> tuple[np.ndarray, np.ndarray]:
    """Return qpos and qvel of worlds at rest in the default pose, feet ``height`` m up."""
    qpos = np.zeros((count, 19))
    qpos[:, 2] = A1.home_height + height
    qpos[:, 3] = 1.0
    qpos[:, 7:] = A1.default_pose
    return qpos, np.zeros((count, 18))


def moving(height: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return qpos, qvel and joint targets of worlds in random motion near the default pose.

    The lowest foot is ``height`` m up: a foot at exactly 0 would be a tie that the engines' own
    rounding breaks either way.
    """
    rng = np.random.default_rng(seed)
    qpos, qvel = standing(0.0)
    qpos[:, 7:] += rng.uniform(-0.1, 0.1, (N, 12))
    lowest = np.asarray(kinematics.forward(A1, jnp.asarray(qpos, jnp.float32)).feet)[..., 2].min(
        axis=1
    )
    qpos[:, 2] += A1.foot_radius + height - lowest
    qvel[:] = rng.uniform(-0.5, 0.5, (N, 18))
    return qpos, qvel, qpos[:, 7:] + rng.uniform(-0.25, 0.25, (N, 12))


def test_free_fall_under_the_world_s_own_gravity(step: Step) -> None:
    """Ten semi-implicit steps of 5 ms fall 55 dt^2 g and reach 10 dt g."""
    gravity = np.array([9.81, 3.7, 1.0])
    qpos, qvel = standing(0.7)
    pos, vel = step(qpos, qvel, make_command(qpos[:, 7:]), make_worlds(gravity=gravity))
    np.testing.assert_allclose(qpos[:, 2] - pos[:, -1, 2], 55 * 0.005**2 * gravity, atol=1e-6)
    np.testing.assert_allclose(vel[:, -1, 2], -0.05 * gravity, rtol=1e-4)
    np.testing.assert_allclose(vel[:, 0, 2], -0.005 * gravity, rtol=1e-4)
    np.testing.assert_allclose(pos[:, -1, 7:], qpos[:, 7:], atol=1e-5)  # falls as one piece


def forward_momentum(built: Scene, qpos: np.ndarray, qvel: np.ndarray) -> float:
    """Return the robot's momentum along x in kg m/s, by C MuJoCo."""
    data = mujoco.MjData(built.mj_model)
    data.qpos[:], data.qvel[:] = qpos, qvel
    mujoco.mj_forward(built.mj_model, data)
    mujoco.mj_subtreeVel(built.mj_model, data)
    return A1.mass * data.subtree_linvel[built.mj_model.body(A1.trunk).id][0]


def test_friction_slows_a_sliding_robot(flat: Scene, step: Step) -> None:
    """Sliding feet brake with friction times weight; measured once the feet have settled."""
    friction = np.array([0.2, 0.4, 0.6])
    qpos, qvel = standing(-0.001)
    target = qpos[:, 7:].copy()
    qvel[:, 0] = 1.5
    momentum = []
    for _ in range(4):
        pos, vel = step(qpos, qvel, make_command(target), make_worlds(friction=friction))
        qpos, qvel = pos[:, -1], vel[:, -1]
        momentum.append([forward_momentum(flat, qpos[i], qvel[i]) for i in range(N)])
    braking = (np.array(momentum[1]) - np.array(momentum[3])) / 0.1
    # The load on the feet still swings by a tenth about the weight.
    np.testing.assert_allclose(braking, friction * A1.mass * 9.81, rtol=0.15)


def test_smaller_limits_turn_the_joints_less(step: Step) -> None:
    qpos, qvel = standing(0.7)
    command = make_command(qpos[:, 7:] + 0.3, limit=np.array([33.5, 1.0, 0.0]))
    pos, vel = step(qpos, qvel, command, make_worlds())
    moved = np.abs(pos[:, -1, 7:] - qpos[:, 7:])
    assert (moved[0] > 1.5 * moved[1]).all()
    assert (moved[1] > 0.01).all()
    np.testing.assert_allclose(moved[2], 0.0, atol=1e-5)
    # The first torques are 60 * 0.3 = 18 N m and 1 N m, and so are the accelerations in MJX, which
    # lets the velocity gain into the implicit step of both. C MuJoCo leaves it out where the
    # torque is at its limit, which makes the weak motors here up to twice as fast.
    ratio = np.abs(vel[0, 0, 6:]) / np.abs(vel[1, 0, 6:])
    assert (ratio > 6.0).all()
    assert (ratio < 18.1).all()


@pytest.mark.parametrize("height", [0.001, -0.001], ids=["landing", "in contact"])
def test_engines_agree_over_a_control_step(
    native_step: Step, mjx_step: Step, height: float
) -> None:
    """float32 against float64: 1e-6 relative, grown a hundredfold by ten stiff contact steps."""
    qpos, qvel, target = moving(height)
    args = make_command(target), make_worlds(friction=[1.0, 0.4, 0.2], gravity=[9.81, 9.81, 3.7])
    native, mjx = native_step(qpos, qvel, *args), mjx_step(qpos, qvel, *args)
    assert np.abs(native[0][:, -1] - qpos).max() > 0.02  # something happened
    np.testing.assert_allclose(mjx[0], native[0], atol=2e-5)
    np.testing.assert_allclose(mjx[1], native[1], atol=5e-3)


def plain_loop(
    built: Scene, qpos: np.ndarray, qvel: np.ndarray, target: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the traces of one world: C MuJoCo without actuators, our PD law at every substep.

    The velocity gain is written as joint damping, which the integrator treats like that of an
    actuator; the position part is an external joint torque, computed anew before every substep.
    """
    model = built.mj_model.__copy__()
    model.actuator_gainprm[:] = model.actuator_biasprm[:] = 0.0
    model.dof_damping[6:] += A1.kd[0]
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = qpos, qvel
    positions, velocities = [], []
    for _ in range(built.options.n_substeps):
        data.qfrc_applied[6:] = A1.kp[0] * (target - data.qpos[7:])
        torque = data.qfrc_applied[6:] - A1.kd[0] * data.qvel[6:]
        assert np.abs(torque).max() < A1.torque_limit[0]
        data.qacc_warmstart[:] *= len(positions) > 0
        mujoco.mj_step(model, data)
        positions.append(data.qpos.copy())
        velocities.append(data.qvel.copy())
    return np.array(positions), np.array(velocities)


def test_engine_equals_a_plain_loop_with_pd_at_every_substep(flat: Scene, step: Step) -> None:
    qpos, qvel, target = moving(0.001, seed=1)
    pos, vel = step(qpos, qvel, make_command(target), make_worlds())
    for i in range(N):
        expected = plain_loop(flat, qpos[i], qvel[i], target[i])
        np.testing.assert_allclose(pos[i], expected[0], atol=2e-5)
        np.testing.assert_allclose(vel[i], expected[1], atol=5e-3)


def test_worlds_do_not_see_each_other(step: Step) -> None:
    """A NaN in one world shows in that world, and changes no bit of the others."""
    qpos, qvel, target = moving(0.001)
    args = make_command(target), make_worlds()
    clean = step(qpos, qvel, *args)
    qpos[1, 9] = np.nan
    broken = step(qpos, qvel, *args)
    for before, after in zip(clean, broken, strict=True):
        np.testing.assert_array_equal(after[[0, 2]], before[[0, 2]])
    assert not np.isfinite(broken[0][1, -1]).all()


def test_native_is_a_function_of_its_arguments_only(native_step: Step) -> None:
    """Parameters cached per world, the order of worlds and earlier calls leave no trace."""
    qpos, qvel, target = moving(0.001)
    command, worlds = make_command(target), make_worlds(friction=[1.0, 0.4, 0.2])
    first = native_step(qpos, qvel, command, worlds)
    other = native_step(qpos, qvel, command, make_worlds(gravity=3.7 * np.ones(N)))
    assert np.abs(other[0] - first[0]).max() > 1e-3
    order = np.array([2, 0, 1])
    shuffled = native_step(
        qpos[order], qvel[order], *jax.tree.map(lambda leaf: leaf[order], (command, worlds))
    )
    again = native_step(qpos, qvel, command, worlds)
    for a, b, c in zip(first, again, shuffled, strict=True):
        np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(a[order], c)


def test_native_threads_and_vmap_change_nothing(flat: Scene, native_step: Step) -> None:
    qpos, qvel, target = moving(0.001)
    args = make_command(target), make_worlds()
    expected = native_step(qpos, qvel, *args)
    threaded = make_step(flat, "native", threads=2)(qpos, qvel, *args)
    physics = engine.make_engine("native", flat, 1, threads=1)
    data = engine.make_data(flat, N).replace(
        qpos=jnp.asarray(qpos, jnp.float32), qvel=jnp.asarray(qvel, jnp.float32)
    )
    seeds = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), (data, *args))
    trace = jax.jit(lambda tree: jax.vmap(physics.step)(*tree)[1])(seeds)
    for index, name in enumerate(("qpos", "qvel")):
        np.testing.assert_array_equal(threaded[index], expected[index])
        for seed in range(2):
            np.testing.assert_array_equal(getattr(trace, name)[seed], expected[index])


def test_overlapping_calls_wait_for_none_and_keep_their_worlds(
    flat: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Seeds on devices of their own step at once; their parameters are written once each."""
    qpos, qvel, target = moving(0.001)
    host_step, calls = engine.NativeEngine._host_step, []

    def remember(self: engine.NativeEngine, *args: Any) -> np.ndarray:
        calls.append(args)
        return host_step(self, *args)

    with monkeypatch.context() as patched:
        patched.setattr(engine.NativeEngine, "_host_step", remember)
        step = make_step(flat, "native")
        for worlds in (make_worlds(friction=[1.0, 0.4, 0.2]), make_worlds(gravity=[3.7, 5, 9])):
            step(qpos, qvel, make_command(target), worlds)
    alone = [host_step(engine.NativeEngine(flat, 1), *args) for args in calls]
    assert np.abs(alone[0] - alone[1]).max() > 1e-3

    both, write = threading.Barrier(2, timeout=60.0), engine.write_physics
    written: list[int] = []

    def write_when_both_are_in_their_calls(*args: Any) -> None:
        if threading.get_ident() not in written:
            both.wait()
        written.append(threading.get_ident())
        write(*args)

    monkeypatch.setattr(engine, "write_physics", write_when_both_are_in_their_calls)
    native = engine.NativeEngine(flat, 1)
    with ThreadPoolExecutor(2) as pool:
        together = list(pool.map(lambda args: host_step(native, *args), calls))
    assert len(written) == 2 * N
    in_turn = [host_step(native, *args) for args in calls * 2]
    assert len(written) == 2 * N
    np.testing.assert_array_equal(together + in_turn, alone * 3)


def settle(built: Scene, qpos: np.ndarray, worlds: Dynamics, steps: int = 12) -> np.ndarray:
    """Return qpos [N, 19] after standing still for some native control steps."""
    step, qvel = make_step(built, "native"), np.zeros((len(qpos), 18))
    command = make_command(np.tile(A1.default_pose, (len(qpos), 1)))
    for _ in range(steps):
        pos, vel = step(qpos, qvel, command, worlds)
        qpos, qvel = pos[:, -1], vel[:, -1]
    return qpos


def foot_gaps(built: Scene, qpos: np.ndarray, worlds: Dynamics) -> np.ndarray:
    """Return the height [N, 4] in m of the lowest point of every foot over our ground."""
    feet = kinematics.forward(A1, jnp.asarray(qpos, jnp.float32)).feet
    ground = jax.vmap(terrain_height, (None, 0, 0, 0))(
        built, feet[..., :2], worlds.incline, worlds.bump_height
    )
    return np.asarray(feet[..., 2] - ground) - A1.foot_radius


def test_robot_stands_on_the_hill_its_world_has() -> None:
    built = build_scene("sloped", collision="feet")
    angle = np.deg2rad([8.0, 4.0, 0.0])
    qpos, _ = standing(0.01)
    qpos[:, 0] = 3.0
    qpos[:, 2] += np.tan(angle) * 2.5 + 0.002
    qpos[:, 3], qpos[:, 5] = np.cos(angle / 2), -np.sin(angle / 2)
    worlds = make_worlds(incline=angle)
    gaps = foot_gaps(built, settle(built, qpos, worlds), worlds)
    np.testing.assert_allclose(gaps, 0.0, atol=0.003)  # contacts are soft


def test_robot_stands_on_bumps_of_any_strength() -> None:
    """Also on peaks above 0.05 m, which a box of the nominal height would hide from contacts."""
    built = build_scene("bumpy", collision="feet")
    row, col = np.unravel_index(built.bumps[20:-20, 20:-20].argmax(), (161, 161))
    peak = scene.BUMP_CELL * (np.array([col, row]) + 20) - scene.BUMP_HALF_SIZE
    heights = np.array([0.05, 0.1, 0.0])
    qpos, _ = standing(0.01)
    qpos[:, :2] = peak - [0.183, 0.132]  # the front left foot on the highest peak
    qpos[:, 2] += heights
    worlds = make_worlds(bump_height=heights)
    gaps = foot_gaps(built, settle(built, qpos, worlds), worlds)
    assert gaps.min() > -0.006  # no foot has sunk in
    assert (np.sort(gaps, axis=1)[:, :3] < 0.004).all()  # three feet stand


def test_unknown_engine_is_refused(flat: Scene) -> None:
    with pytest.raises(ValueError, match="unknown engine 'warp': choose auto, mjx or native"):
        engine.make_engine("warp", flat, 1)  # type: ignore[arg-type]


def test_auto_is_native_on_a_cpu(flat: Scene) -> None:
    assert jax.default_backend() == "cpu"
    for worlds in (1, 100_000):
        assert isinstance(engine.make_engine("auto", flat, worlds), engine.NativeEngine)
    assert isinstance(engine.make_engine("mjx", flat, 1), engine.MjxEngine)


def test_auto_on_an_accelerator_is_native_for_few_worlds(
    flat: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert isinstance(engine.make_engine("auto", flat, 1023), engine.NativeEngine)
    assert isinstance(engine.make_engine("auto", flat, 1024), engine.MjxEngine)
    assert isinstance(engine.make_engine("native", flat, 1024), engine.NativeEngine)


def test_native_needs_the_host_beside_an_accelerator(
    flat: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = SimpleNamespace(jax_platforms="cuda")
    monkeypatch.setattr(engine, "jax", SimpleNamespace(config=config))
    with pytest.raises(ValueError, match=r"JAX_PLATFORMS=cuda hides.*JAX_PLATFORMS=cuda,cpu"):
        engine.make_engine("native", flat, 1)
    assert isinstance(engine.make_engine("mjx", flat, 1), engine.MjxEngine)
    config.jax_platforms = "cuda,cpu"
    assert isinstance(engine.make_engine("native", flat, 1), engine.NativeEngine)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "tolerance"), [("sloped", 1e-4), ("bumpy", 1e-3)])
def test_engines_agree_on_shaped_ground(kind: scene.SceneKind, tolerance: float) -> None:
    """Less well on bumps, where a foot meets several prisms, whose contacts differ in C and MJX."""
    built = build_scene(kind, collision="feet")
    worlds = make_worlds(incline=np.deg2rad([8.0, 4.0, 0.0]), bump_height=[0.05, 0.1, 0.0])
    qpos, qvel, target = moving(0.001)
    qpos[:, :2] = [[3.0, 0.0], [2.0, 1.0], [-1.0, -1.0]]
    qpos[:, 2] -= foot_gaps(built, qpos, worlds).min(axis=1) - 0.001
    args = make_command(target), worlds
    native, mjx = (make_step(built, name)(qpos, qvel, *args) for name in ("native", "mjx"))
    np.testing.assert_allclose(mjx[0], native[0], atol=tolerance)
