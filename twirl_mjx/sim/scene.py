"""Compose and compile scenes: the A1, the ground of a scene kind, markers and hurdle bands."""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Literal

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from twirl_mjx.sim import a1
from twirl_mjx.sim.dynamics import SceneKind

CollisionSet = Literal["feet", "legs", "full"]
"""Robot geoms the contact solver sees: feet; feet and calves; or every collision geom."""

CONTROL_DT = 0.05
"""s, the policy runs at 20 Hz (paper, section "Actions")."""

HILL_START = 0.5
"""m, x at which the incline of a ``sloped`` scene begins; the robot starts at x = 0."""
BUMP_CELL = 0.3
"""m, edge of a heightfield tile (spec section 6)."""
BUMP_HALF_SIZE = 30.0
"""m, half the edge of the square heightfield patch."""
BUMP_HEIGHT = 0.05
"""m, highest point of the heightfield at strength 1 (spec section 6)."""
MAX_BUMP_HEIGHT = 0.1
"""m, highest point at strength 2, which contact detection has to allow for."""
BUMP_SEED = 7
"""Seed of the heightfield: every world walks on the same terrain, from another place."""

HURDLE_LENGTH = 0.2
"""m, extent of a hurdle band along x (paper, section "Jumping Task")."""
HURDLE_HEIGHT = 0.01
"""m, height of a hurdle band."""
HURDLE_DRAWN_HALF_WIDTH = 1.5
"""m, half the drawn extent in y of a band, which is endless for the task."""


@dataclasses.dataclass(frozen=True)
class SimOptions:
    """Physics settings; the defaults were chosen against C MuJoCo at 1 ms (docs/physics.md)."""

    sim_dt: float = 0.005
    """s, physics step; must divide the control step of 0.05 s."""
    iterations: int = 4
    """Newton solver iterations."""
    ls_iterations: int = 8
    """Line-search iterations."""

    def __post_init__(self) -> None:
        """Check the step.

        Raises:
            ValueError: The physics step does not divide the control step.
        """
        steps = CONTROL_DT / self.sim_dt if self.sim_dt > 0 else 0.0
        if steps < 1 or abs(steps - round(steps)) > 1e-6:
            valid = CONTROL_DT / max(1, round(steps))
            raise ValueError(
                f"sim_dt {self.sim_dt} s does not divide the control step of {CONTROL_DT} s"
                f" (nearest: {valid:.6g})"
            )

    @property
    def n_substeps(self) -> int:
        """Physics steps in a control step."""
        return round(CONTROL_DT / self.sim_dt)


@dataclasses.dataclass(frozen=True, eq=False)
class Scene:
    """A compiled scene, shared by all worlds that differ only in ``Dynamics``."""

    kind: SceneKind
    options: SimOptions
    mj_model: mujoco.MjModel
    ground_geoms: tuple[int, ...]
    """Geom ids of the ground, whose friction decides the contact's (they have priority)."""
    bumps: np.ndarray
    """[R, R] unit heightfield in [0, 1], rows along y; one zero cell unless kind is bumpy."""

    @functools.cached_property
    def mjx_model(self) -> mjx.Model:
        """The model on the device."""
        # First asked for inside a trace, it must hold arrays all the same: it is kept.
        with jax.ensure_compile_time_eval():
            return mjx.put_model(self.mj_model)


def unit_bumps() -> np.ndarray:
    """Return the random unit heightfield [R, R] in [0, 1], with tiles of ``BUMP_CELL``."""
    cells = round(2 * BUMP_HALF_SIZE / BUMP_CELL) + 1
    raw = np.random.default_rng(BUMP_SEED).uniform(size=(cells, cells))
    return ((raw - raw.min()) / np.ptp(raw)).astype(np.float32)


def _add_ground(spec: mujoco.MjSpec, kind: SceneKind) -> tuple[str, ...]:
    world = spec.worldbody
    common = dict(
        contype=1,
        conaffinity=0,
        priority=1,
        condim=3,
        friction=[1.0, 0.005, 0.0001],
        material="ground",
    )
    if kind == "bumpy":
        bumps = unit_bumps()
        spec.add_hfield(
            name="bumps",
            nrow=bumps.shape[0],
            ncol=bumps.shape[1],
            size=[BUMP_HALF_SIZE, BUMP_HALF_SIZE, MAX_BUMP_HEIGHT, 0.1],
            userdata=bumps.ravel(),
        )
        world.add_geom(
            name="floor", type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="bumps", **common
        )
        return ("floor",)
    world.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.05], **common)
    if kind == "flat":
        return ("floor",)
    angle = math.radians(8.0)
    # The plane is drawn 24 m long; for contacts it is endless. Both half-spaces unite.
    world.add_geom(
        name="hill",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[12.0, 6.0, 0.05],
        pos=[HILL_START, 0.0, 0.0],
        quat=[math.cos(-angle / 2), 0.0, math.sin(-angle / 2), 0.0],
        **common,
    )
    return ("floor", "hill")


def _add_look(spec: mujoco.MjSpec) -> None:
    spec.add_texture(
        name="ground",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=[0.80, 0.83, 0.86],
        rgb2=[0.70, 0.74, 0.78],
        width=256,
        height=256,
    )
    material = spec.add_material(name="ground", texrepeat=[2, 2], texuniform=True, reflectance=0.05)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "ground"
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.93, 0.96, 1.0],
        rgb2=[0.55, 0.66, 0.78],
        width=128,
        height=128,
    )
    spec.worldbody.add_light(
        pos=[0, 0, 6],
        dir=[0.2, 0.3, -1.0],
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        diffuse=[0.7, 0.7, 0.7],
        castshadow=True,
    )
    spec.visual.headlight.ambient = [0.35, 0.35, 0.35]
    spec.visual.global_.offwidth = 1280
    spec.visual.global_.offheight = 960


def ground_height(scene_kind: SceneKind, xy: np.ndarray, incline: float = 0.0) -> np.ndarray:
    """Return the height [...] in m of flat or sloped ground under ``xy`` [..., 2] (numpy)."""
    if scene_kind == "sloped":
        return np.tan(incline) * np.maximum(xy[..., 0] - HILL_START, 0.0)
    return np.zeros(xy.shape[:-1])


def _add_hurdles(spec: mujoco.MjSpec, kind: SceneKind, hurdles: tuple[float, ...]) -> None:
    angle = math.radians(8.0) if kind == "sloped" else 0.0
    for i, x in enumerate(hurdles):
        z = float(ground_height(kind, np.array([x, 0.0]), angle))
        tilt = -angle if x > HILL_START else 0.0
        spec.worldbody.add_geom(
            name=f"hurdle_{i}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[HURDLE_LENGTH / 2, HURDLE_DRAWN_HALF_WIDTH, HURDLE_HEIGHT / 2],
            pos=[x, 0.0, z + HURDLE_HEIGHT / 2],
            quat=[math.cos(tilt / 2), 0.0, math.sin(tilt / 2), 0.0],
            contype=0,
            conaffinity=0,
            rgba=[0.90, 0.33, 0.12, 1.0],
        )


def _enable_collisions(spec: mujoco.MjSpec, collision: CollisionSet) -> None:
    enabled = {"feet": (a1.FOOT,), "legs": (a1.FOOT, a1.CALF), "full": a1.BODY_CLASSES}[collision]
    for shape in a1.CONTACT_GEOMS:
        geom = spec.geom(shape.name)
        geom.contype = 0
        geom.conaffinity = int(shape.body in enabled)


def build_scene(
    kind: SceneKind = "flat",
    *,
    collision: CollisionSet = "legs",
    options: SimOptions | None = None,
    goal_marker: bool = False,
    hurdles: tuple[float, ...] = (),
) -> Scene:
    """Build and compile a scene with ``mujoco.MjSpec``.

    Args:
        kind: Ground geometry.
        collision: Robot geoms the contact solver sees.
        options: Physics settings.
        goal_marker: Add a mocap body ``goal`` with a visible, untouchable pole.
        hurdles: x positions in m of drawn hurdle bands (no contact: the task tests them).

    Returns:
        The compiled scene.
    """
    options = options or SimOptions()
    spec = mujoco.MjSpec.from_file(str(a1.xml_path()))
    _add_look(spec)
    ground = _add_ground(spec, kind)
    _enable_collisions(spec, collision)
    _add_hurdles(spec, kind, hurdles)
    if goal_marker:
        goal = spec.worldbody.add_body(name="goal", mocap=True)
        goal.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CYLINDER,
            size=[0.06, 0.005, 0],
            contype=0,
            conaffinity=0,
            rgba=[0.10, 0.65, 0.25, 0.9],
            pos=[0, 0, 0.005],
        )
        goal.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            size=[0.008, 0.15, 0],
            contype=0,
            conaffinity=0,
            rgba=[0.10, 0.65, 0.25, 0.6],
            pos=[0, 0, 0.15],
        )
    spec.option.timestep = options.sim_dt
    spec.option.iterations = options.iterations
    spec.option.ls_iterations = options.ls_iterations
    model = spec.compile()
    bumps = unit_bumps() if kind == "bumpy" else np.zeros((1, 1), np.float32)
    if kind == "bumpy":  # the compiler has scaled them to the full height
        model.hfield_data[:] = bumps.ravel() * (BUMP_HEIGHT / MAX_BUMP_HEIGHT)
    return Scene(
        kind=kind,
        options=options,
        mj_model=model,
        ground_geoms=tuple(model.geom(name).id for name in ground),
        bumps=bumps,
    )


def terrain_height(
    scene: Scene, xy: jax.Array, incline: jax.Array, bump_height: jax.Array
) -> jax.Array:
    """Return the height [...] in m of the ground under world positions ``xy`` [..., 2].

    MuJoCo splits each heightfield cell along the diagonal from (column 0, row 0) to (column 1,
    row 1); the two triangles are interpolated the same way here.
    """
    if scene.kind == "flat":
        return jnp.zeros(xy.shape[:-1], xy.dtype)
    if scene.kind == "sloped":
        return jnp.tan(incline) * jnp.maximum(xy[..., 0] - HILL_START, 0.0)
    bumps = jnp.asarray(scene.bumps)
    grid = (xy + BUMP_HALF_SIZE) / BUMP_CELL
    cell = jnp.clip(jnp.floor(grid), 0, scene.bumps.shape[0] - 2)
    fx, fy = jnp.moveaxis(jnp.clip(grid - cell, 0.0, 1.0), -1, 0)
    col, row = jnp.moveaxis(cell.astype(jnp.int32), -1, 0)
    h00, h10 = bumps[row, col], bumps[row, col + 1]
    h01, h11 = bumps[row + 1, col], bumps[row + 1, col + 1]
    right = h00 + fx * (h10 - h00) + fy * (h11 - h10)
    left = h00 + fy * (h01 - h00) + fx * (h11 - h01)
    return bump_height * jnp.where(fx >= fy, right, left)
