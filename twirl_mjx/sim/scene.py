"""Compose and compile scenes: a robot, the ground of a scene kind, markers and hurdle bands."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Iterator
from typing import Literal

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from twirl_mjx.sim import look, mjx
from twirl_mjx.sim.leaves import HILL_ANGLE, SceneKind
from twirl_mjx.sim.mjcf import robot_spec
from twirl_mjx.sim.robot import BODY_CLASSES, CALF, CONTROL_DT, FOOT, Robot
from twirl_mjx.sim.robots import A1

CollisionSet = Literal["feet", "legs", "full"]
"""Robot geoms the contact solver sees: feet; feet and calves; or every collision geom."""
COLLIDING: dict[CollisionSet, tuple[str, ...]] = {
    "feet": (FOOT,),
    "legs": (FOOT, CALF),
    "full": BODY_CLASSES,
}
"""Body classes of a collision set."""

HILL_START = 0.5
"""m, x at which the incline of a ``sloped`` scene begins; the robot starts at x = 0."""
BUMP_CELL = 0.3
"""m, edge of a heightfield tile (docs/shifts.md)."""
BUMP_HALF_SIZE = 30.0
"""m, half the edge of the square heightfield patch."""
BUMP_HEIGHT = 0.05
"""m, highest point of the heightfield at strength 1 (docs/shifts.md)."""
MAX_BUMP_HEIGHT = 0.1
"""m, highest point at strength 2, which contact detection has to allow for."""
BUMP_SEED = 7
"""Seed of the heightfield: every world walks on the same terrain, from another place."""

HURDLE_LENGTH = 0.2
"""m, extent of a hurdle band along x (paper, section "Jumping Task")."""
DRAWN_HALF_WIDTH = 1.5
"""m, half the drawn extent in y of a band, which is endless for the task."""
BUMPY_PIECES = (2, 20)
"""Pieces in x and y of which a band on a heightfield is drawn, each lying on its own ground."""


HeightOf = Callable[[np.ndarray], np.ndarray]
"""Ground height [K] in m under world positions [K, 2]."""


@dataclasses.dataclass(frozen=True)
class SimOptions:
    """Physics settings; the defaults were chosen against C MuJoCo at 1 ms (docs/physics.md)."""

    sim_dt: float = 0.005
    """s, physics step; must divide the control step."""
    iterations: int = 4
    """Newton solver iterations."""
    ls_iterations: int = 8
    """Line-search iterations."""
    control_dt: float = CONTROL_DT
    """s, control step; a scene takes its robot's."""

    def __post_init__(self) -> None:
        """Check the step.

        Raises:
            ValueError: The physics step does not divide the control step.
        """
        steps = self.control_dt / self.sim_dt if self.sim_dt > 0 else 0.0
        if steps < 1 or abs(steps - round(steps)) > 1e-6:
            valid = self.control_dt / max(1, round(steps))
            raise ValueError(
                f"sim_dt {self.sim_dt} s does not divide the control step of {self.control_dt} s"
                f" (nearest: {valid:.6g})"
            )

    @property
    def n_substeps(self) -> int:
        """Physics steps in a control step."""
        return round(self.control_dt / self.sim_dt)


@dataclasses.dataclass(frozen=True)
class Bands:
    """Hurdle bands to draw; the task tests contact with them itself."""

    x: tuple[float, ...]
    """m, world x of the centres."""
    y: float = 0.0
    """m, world y of the middle of the drawn part."""
    height: float = 0.01
    """m, of the paper's bands (section "Jumping Task"), flat on the ground."""
    incline: float = HILL_ANGLE
    """rad, of the hill of a ``sloped`` scene."""
    bump_height: float = 0.05
    """m, of a ``bumpy`` scene."""


@dataclasses.dataclass(frozen=True, eq=False)
class Scene:
    """A compiled scene, shared by all worlds that differ only in ``Dynamics``."""

    kind: SceneKind
    robot: Robot
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
            name="floor",
            type=mujoco.mjtGeom.mjGEOM_HFIELD,
            hfieldname="bumps",
            material="ground",
            **common,
        )
        return ("floor",)
    plane = mujoco.mjtGeom.mjGEOM_PLANE
    world.add_geom(name="floor", type=plane, size=[0, 0, 0.05], material="ground", **common)
    if kind == "flat":
        return ("floor",)
    angle = HILL_ANGLE
    # The plane is drawn 24 m long; for contacts it is endless. Both half-spaces unite.
    world.add_geom(
        name="hill",
        type=plane,
        size=[12.0, 6.0, 0.05],
        pos=[HILL_START, 0.0, 0.0],
        quat=[math.cos(-angle / 2), 0.0, math.sin(-angle / 2), 0.0],
        material="hill",
        **common,
    )
    return ("floor", "hill")


def _add_bands(spec: mujoco.MjSpec, kind: SceneKind, bands: Bands, height_of: HeightOf) -> None:
    """Add boxes ``hurdle_<band>`` (or ``_<piece>``) on the ground, without contact."""
    pieces = BUMPY_PIECES if kind == "bumpy" else (1, 1)
    half = np.array([HURDLE_LENGTH / 2, DRAWN_HALF_WIDTH]) / pieces
    for i, x in enumerate(bands.x):
        for j, centre in enumerate(_centres(np.array([x, bands.y]), half, pieces)):
            around = centre + np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]]) * half
            height = height_of(around)
            slope_x = math.atan2(height[1] - height[2], 2 * half[0])
            slope_y = math.atan2(height[3] - height[4], 2 * half[1])
            name = f"hurdle_{i}" if pieces == (1, 1) else f"hurdle_{i}_{j}"
            spec.worldbody.add_geom(
                name=name,
                type=mujoco.mjtGeom.mjGEOM_BOX,
                size=[*half, bands.height / 2],
                pos=[*centre, height[0] + bands.height / 2],
                quat=_tilt(slope_x, slope_y),
                contype=0,
                conaffinity=0,
                rgba=[0.90, 0.33, 0.12, 1.0],
            )


def _centres(middle: np.ndarray, half: np.ndarray, pieces: tuple[int, int]) -> Iterator[np.ndarray]:
    for ix in range(pieces[0]):
        for iy in range(pieces[1]):
            yield middle + (2 * np.array([ix, iy]) + 1 - np.array(pieces)) * half


def _tilt(slope_x: float, slope_y: float) -> np.ndarray:
    """Return the quaternion [4] of a plate that rises by these angles in rad along x and y."""
    about_y = np.array([math.cos(-slope_x / 2), 0.0, math.sin(-slope_x / 2), 0.0])
    about_x = np.array([math.cos(slope_y / 2), math.sin(slope_y / 2), 0.0, 0.0])
    quat = np.empty(4)
    mujoco.mju_mulQuat(quat, about_y, about_x)
    return quat


def build_scene(
    kind: SceneKind = "flat",
    *,
    robot: Robot = A1,
    collision: CollisionSet = "legs",
    options: SimOptions | None = None,
    goal_marker: bool = False,
    bands: Bands | None = None,
    meshes: bool = False,
) -> Scene:
    """Build and compile a scene with ``mujoco.MjSpec``.

    Args:
        kind: Ground geometry.
        robot: Who walks on it.
        collision: Robot geoms the contact solver sees.
        options: Physics settings; the control step is the robot's.
        goal_marker: Add a mocap body ``goal`` with a visible, untouchable pole.
        bands: Hurdle bands to draw.
        meshes: Keep the robot's meshes, for pictures.

    Returns:
        The compiled scene.

    Raises:
        FileNotFoundError: The robot's MJCF does not exist.
        ValueError: It is not that of the record, or the physics step does not divide the
            robot's control step.
    """
    options = dataclasses.replace(options or SimOptions(), control_dt=robot.control_dt)
    bumps = unit_bumps() if kind == "bumpy" else np.zeros((1, 1), np.float32)
    spec = robot_spec(robot, COLLIDING[collision], meshes)
    look.add_look(spec, kind, bumps)
    ground = _add_ground(spec, kind)
    if goal_marker:
        _add_goal_marker(spec)
    spec.option.timestep = options.sim_dt
    spec.option.iterations = options.iterations
    spec.option.ls_iterations = options.ls_iterations

    def compiled() -> Scene:
        model = spec.compile()
        if kind == "bumpy":  # the compiler has scaled them to the full height
            model.hfield_data[:] = bumps.ravel() * (BUMP_HEIGHT / MAX_BUMP_HEIGHT)
        ids = tuple(model.geom(name).id for name in ground)
        return Scene(kind, robot, options, model, ids, bumps)

    scene = compiled()
    if bands is None:
        return scene
    shape = jnp.float32(bands.incline), jnp.float32(bands.bump_height)
    _add_bands(
        spec, kind, bands, lambda xy: np.asarray(terrain_height(scene, jnp.asarray(xy), *shape))
    )
    return compiled()


def _add_goal_marker(spec: mujoco.MjSpec) -> None:
    goal = spec.worldbody.add_body(name="goal", mocap=True)
    cylinder, capsule = mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_CAPSULE
    for shape, size, alpha in ((cylinder, [0.06, 0.005, 0], 0.9), (capsule, [0.008, 0.15, 0], 0.6)):
        goal.add_geom(
            type=shape,
            size=size,
            contype=0,
            conaffinity=0,
            rgba=[0.10, 0.65, 0.25, alpha],
            pos=[0, 0, size[1]],
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
