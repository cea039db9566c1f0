"""The rehearsal's world: the robot's MJCF file on a plane, a hill or bumps, with hurdle bands."""

from __future__ import annotations

import functools

import mujoco
import numpy as np

from twirl_mjx.assets import asset_path
from twirl_mjx.deploy.conditions import CONTACTS, RehearsalConfig

TRUNK_MASS = 4.713
"""kg, without payload (assets/a1/README.md)."""
BAND_HALF_LENGTH, BAND_HALF_WIDTH = 0.1, 20.0
"""m, half extents of a hurdle band: 0.2 m long, endless for the robot."""
HILL_START = 0.5
"""m, x at which the hill begins."""
BUMP_CELL, BUMP_HALF_SIZE, BUMP_SEED = 0.3, 30.0, 7
"""m, tile of the bumpy ground; m, half the edge of the patch; seed of its heights."""
GROUND = {"contype": 1, "conaffinity": 0, "priority": 1}
"""Contact settings of ground and bands: they decide, and the robot does not touch itself."""


@functools.cache
def unit_bumps() -> np.ndarray:
    """Return the heights [R, R] in [0, 1] of the bumpy ground at its tiles' corners, rows in y."""
    cells = round(2 * BUMP_HALF_SIZE / BUMP_CELL) + 1
    raw = np.random.default_rng(BUMP_SEED).uniform(size=(cells, cells))
    return (raw - raw.min()) / np.ptp(raw)


def ground_height(config: RehearsalConfig, points: np.ndarray) -> np.ndarray:
    """Return the height of the ground [K] m under ``points`` [K, 2] m, world frame.

    Between the corners of a bump's tile it is bilinear, which differs by millimetres from the
    two triangles of the physics.
    """
    if not config.bump_height:
        rise = np.tan(np.radians(config.incline_deg))
        return rise * np.maximum(points[:, 0] - HILL_START, 0.0)
    heights = config.bump_height * unit_bumps()
    place = np.clip((points + BUMP_HALF_SIZE) / BUMP_CELL, 0.0, len(heights) - 1.001)
    column, row = place.astype(int).T
    u, v = (place - np.stack([column, row], axis=1)).T
    below = (1 - u) * heights[row, column] + u * heights[row, column + 1]
    above = (1 - u) * heights[row + 1, column] + u * heights[row + 1, column + 1]
    return (1 - v) * below + v * above


def build_model(config: RehearsalConfig, hurdles: np.ndarray) -> mujoco.MjModel:
    """Compile robot, ground and hurdle bands; the actuators become plain torque motors.

    Args:
        config: physics step and conditions.
        hurdles: [K] m, x of the band centres.

    Raises:
        ValueError: Hurdles on bumps, on which a flat band would be buried.
    """
    if config.bump_height and len(hurdles):
        raise ValueError(
            f"bump_height {config.bump_height} m under hurdles is not rehearsed (nearest: 0)"
        )
    spec = mujoco.MjSpec.from_file(str(asset_path("a1", "a1.xml")))
    spec.option.timestep = config.sim_dt
    spec.option.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{config.integrator.upper()}")
    spec.option.iterations, spec.option.ls_iterations = 50, 50
    for geom in spec.geoms:
        if geom.name.endswith(("_collision", "_foot")):
            geom.conaffinity = 1
    _add_ground(spec, config)
    tilt = -0.5 * np.radians(config.incline_deg)
    for i, x in enumerate(hurdles):
        on_hill = x > HILL_START
        height = float(ground_height(config, np.array([[x, 0.0]]))[0])
        spec.worldbody.add_geom(
            name=f"hurdle_{i}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[BAND_HALF_LENGTH, BAND_HALF_WIDTH, config.hurdle_height / 2],
            pos=[x, 0.0, height + config.hurdle_height / 2],
            quat=[np.cos(tilt), 0.0, np.sin(tilt), 0.0] if on_hill else [1.0, 0.0, 0.0, 0.0],
            rgba=[0.90, 0.33, 0.12, 1.0],
            **GROUND,
        )
    _add_sky(spec)
    model = spec.compile()
    # A divergence must be seen, not restarted from the first pose without a word.
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    model.actuator_gainprm[:], model.actuator_biasprm[:] = 0.0, 0.0
    model.actuator_gainprm[:, 0] = 1.0
    model.actuator_ctrllimited[:] = model.actuator_forcelimited[:] = 0
    ground = model.geom_bodyid == 0
    model.geom_solref[ground], model.geom_solimp[ground, :3] = CONTACTS[config.contact]
    set_conditions(model, config)
    return model


def err_bodies(model: mujoco.MjModel, config: RehearsalConfig, rng: np.random.Generator) -> float:
    """Give every body of the robot an error of mass and of inertia, as ``config`` says.

    Returns:
        The mass of the trunk in kg, without payload.
    """
    robot, count = slice(1, None), model.nbody - 1
    mass = 1.0 + config.mass_error * rng.uniform(-1.0, 1.0, count)
    shape = 1.0 + config.inertia_error * rng.uniform(-1.0, 1.0, count)
    model.body_mass[robot] *= mass
    model.body_inertia[robot] *= (mass * shape)[:, None]
    return TRUNK_MASS * mass[model.body("trunk").id - 1]


def _add_ground(spec: mujoco.MjSpec, config: RehearsalConfig) -> None:
    """Add the floor (a plane, or a heightfield of bumps) and the hill, a second plane."""
    plane, grey = mujoco.mjtGeom.mjGEOM_PLANE, [0.78, 0.81, 0.84, 1.0]
    floor = {"type": plane, "size": [0, 0, 0.05], "rgba": grey}
    if config.bump_height:
        heights = unit_bumps()
        size = [BUMP_HALF_SIZE, BUMP_HALF_SIZE, config.bump_height, 0.1]
        rows, columns = heights.shape
        spec.add_hfield(name="bumps", nrow=rows, ncol=columns, size=size, userdata=heights.ravel())
        floor = {"type": mujoco.mjtGeom.mjGEOM_HFIELD, "hfieldname": "bumps", "rgba": grey}
    spec.worldbody.add_geom(name="floor", **floor, **GROUND)
    if config.incline_deg:
        half = -0.5 * np.radians(config.incline_deg)
        spec.worldbody.add_geom(
            name="hill",
            type=plane,
            size=[0, 0, 0.05],
            pos=[HILL_START, 0.0, 0.0],
            quat=[np.cos(half), 0.0, np.sin(half), 0.0],
            rgba=[0.86, 0.74, 0.52, 1.0],
            **GROUND,
        )


def _add_sky(spec: mujoco.MjSpec) -> None:
    sun = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    spec.worldbody.add_light(pos=[0, 0, 5], dir=[0.2, 0.3, -1.0], type=sun, castshadow=True)
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.93, 0.96, 1.0],
        rgb2=[0.55, 0.66, 0.78],
        width=64,
        height=64,
    )


def set_conditions(
    model: mujoco.MjModel, config: RehearsalConfig, trunk_mass: float = TRUNK_MASS
) -> None:
    """Write gravity, friction and payload into a model; all of them may change while it runs.

    Args:
        model: changed in place.
        config: conditions.
        trunk_mass: kg, without payload.
    """
    model.opt.gravity[:] = 0.0, 0.0, -config.gravity
    model.geom_friction[model.geom_bodyid == 0] = config.friction, 0.005, 0.0001
    trunk = model.body("trunk").id
    model.body_mass[trunk] = trunk_mass + config.payload
    mujoco.mj_setConst(model, mujoco.MjData(model))
