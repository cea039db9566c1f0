"""What a scene looks like: ground, light, and the colours of a dynamics shift.

Nothing here touches the physics. A condition should be recognised in a still picture: ice is
blue and glossy, bumps are coloured by height under a low sun, a hill has a colour of its own,
low gravity is Mars, and a weakened leg is red.
"""

from __future__ import annotations

import math

import mujoco
import numpy as np

from twirl_mjx.sim.dynamics import Dynamics, leaf_value
from twirl_mjx.sim.leaves import LEAVES, NOMINAL_VALUES, PAPER_SHIFTS, SceneKind, get_shift
from twirl_mjx.sim.robot import Robot

LOW, HIGH = np.array([0.36, 0.27, 0.20]), np.array([0.97, 0.91, 0.76])
"""Colours of the lowest and the highest point of the heightfield."""
ICE = np.array([0.72, 0.90, 1.08])
MARS = np.array([1.08, 0.66, 0.47])
"""Factors on the colour of the ground."""
WEAK = np.array([0.95, 0.12, 0.10])
"""Colour of a leg without any strength."""


def add_look(spec: mujoco.MjSpec, kind: SceneKind, bumps: np.ndarray) -> None:
    """Add the materials ``ground`` and ``hill``, sky and sun.

    Args:
        spec: Changed in place.
        kind: Ground geometry.
        bumps: [R, R] unit heightfield in [0, 1] of a bumpy scene.
    """
    if kind == "bumpy":
        _add_relief(spec, bumps)
    else:
        _add_checker(spec, "ground", [0.80, 0.83, 0.86], [0.70, 0.74, 0.78])
    if kind == "sloped":
        _add_checker(spec, "hill", [0.86, 0.74, 0.52], [0.74, 0.61, 0.40])
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
        dir=[0.8, 0.5, -0.6] if kind == "bumpy" else [0.2, 0.3, -1.0],
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        diffuse=[0.7, 0.7, 0.7],
        castshadow=True,
    )
    spec.visual.headlight.ambient = [0.35, 0.35, 0.35]
    spec.visual.global_.offwidth = 1280
    spec.visual.global_.offheight = 960


def _add_checker(spec: mujoco.MjSpec, name: str, rgb1: list[float], rgb2: list[float]) -> None:
    spec.add_texture(
        name=name,
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=rgb1,
        rgb2=rgb2,
        width=256,
        height=256,
    )
    # Without a highlight: on a plane it is lit by the corners and flickers as the camera moves.
    material = spec.add_material(
        name=name, texrepeat=[2, 2], texuniform=True, reflectance=0.05, specular=0.0
    )
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name


def _add_relief(spec: mujoco.MjSpec, bumps: np.ndarray) -> None:
    """Colour the heightfield by height: one texel per point, the first row of it farthest in y."""
    colours = LOW + bumps[::-1, :, None] * (HIGH - LOW)
    texture = spec.add_texture(
        name="ground",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        width=bumps.shape[1],
        height=bumps.shape[0],
        nchannel=3,
    )
    texture.data = np.round(255 * colours).astype(np.uint8).tobytes()
    material = spec.add_material(name="ground", texrepeat=[1, 1], texuniform=False)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "ground"


def paint(
    model: mujoco.MjModel, robot: Robot, dynamics: Dynamics, leg_strength: np.ndarray
) -> None:
    """Colour a model by the condition of its world.

    Args:
        model: Changed in place.
        robot: The robot in it.
        dynamics: Scalars. Ice and Mars are fully there at the shift's own value.
        leg_strength: [4] in [0, 1], order ``robot.legs``; a whole leg keeps its colours.
    """
    ice, mars = (_progress(dynamics, name, leaf) for name, leaf in PAINTED)
    ground = model.mat("ground").id
    model.mat_rgba[ground, :3] *= 1.0 + ice * (ICE - 1.0) + mars * (MARS - 1.0)
    model.mat_specular[ground] += 0.5 * ice
    model.mat_shininess[ground] += 0.5 * ice
    for links, strength in zip(robot.links, leg_strength, strict=True):
        if strength >= 1.0:
            continue
        for link in links:
            body = model.body(link)
            for geom in range(body.geomadr[0], body.geomadr[0] + body.geomnum[0]):
                model.geom_matid[geom] = -1
                model.geom_rgba[geom, :3] = WEAK + 0.5 * strength * (1.0 - WEAK)


PAINTED = (("icy", "friction"), ("gravity", "gravity"))


def _progress(dynamics: Dynamics, shift: str, leaf: str) -> float:
    """Return how far a leaf is from nominal (0) towards the value of a shift (1), in [0, 1]."""
    nominal, shifted = NOMINAL_VALUES[leaf], dict(get_shift(shift).values)[leaf]
    return float(np.clip((getattr(dynamics, leaf) - nominal) / (shifted - nominal), 0.0, 1.0))


def describe(shift: str, robot: Robot, dynamics: Dynamics, leg_strength: np.ndarray) -> str:
    """Return the conditions of an episode with their numbers, for a caption; empty if nominal."""
    weakest = int(np.argmin(leg_strength))
    shown = {
        "none": "",
        "bumpy": f"bumps to {100 * float(dynamics.bump_height):.0f} cm",
        "icy": f"friction {float(dynamics.friction):.2g}",
        "weakened": f"{robot.legs[weakest]} leg at {100 * float(leg_strength[weakest]):.0f} %",
        "sloped": f"hill of {math.degrees(float(dynamics.incline)):.2g} deg",
        "gravity": f"gravity {float(dynamics.gravity):.2g} m/s^2",
    }.get(shift, shift)
    told = {name for name, _ in get_shift(shift).values} if shift in PAPER_SHIFTS else set()
    others = [
        f"{leaf.name} {float(leaf_value(dynamics, leaf.name)):.3g}{leaf.unit.replace('1', '')}"
        for leaf in LEAVES
        if leaf.name not in told
        and float(leaf_value(dynamics, leaf.name)) != np.float32(leaf.nominal)
    ]
    return ", ".join(filter(None, [shown, *others]))
