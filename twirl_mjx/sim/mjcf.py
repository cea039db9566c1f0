"""Any quadruped's MJCF put into a scene.

What a scene needs is the bodies with their masses and visible shapes. Everything else of the file
(floor, lights, props, motors, sensors, collision shapes) is replaced by what the record says, so
that every robot meets the ground and its motors in the same way.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import mujoco
import numpy as np

from twirl_mjx.sim.read_mjcf import TOLERANCE, Frame, load, read_frame
from twirl_mjx.sim.robot import CALF, FOOT, ROOT_SIZE, ContactGeom, Robot

HIDDEN_GROUP = 3
"""Geoms of this group and above are not drawn: in most files the collision shapes."""
RESERVED = {"textures": ("ground", "sky"), "materials": ("ground", "hill")}
"""Names that scenes give out; those of a robot's file get ``robot_`` in front."""


@functools.cache
def source_model(robot: Robot) -> mujoco.MjModel:
    """Return the compiled file of a robot, after checking that it is the robot of the record.

    Raises:
        ValueError: Names or lengths differ from the record's.
    """
    _, raw = load(robot.name, robot.model)
    frame = read_frame(robot.name, raw, robot.joints)
    for field in fields(Frame):
        mine, found = getattr(robot, field.name), getattr(frame, field.name)
        named = field.name in ("trunk", "links")
        if not (mine == found if named else np.allclose(mine, found, atol=TOLERANCE)):
            raise ValueError(
                f"robot {robot.name!r}: {field.name} is {mine} in the record, {found} in its MJCF"
            )
    return raw


def robot_spec(robot: Robot, colliding: Sequence[str], meshes: bool = False) -> mujoco.MjSpec:
    """Return a specification with the robot and nothing else, ready for a scene.

    Args:
        robot: The record.
        colliding: Body classes whose shapes can meet the ground.
        meshes: Keep the meshes of the file. They are seen, but nothing meets them, and every
            world of a batch would hold its own copy.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file is not that of the record, or not of the family.
    """
    source_model(robot)
    spec, raw = load(robot.name, robot.model)
    _keep_masses(spec, raw)
    _strip(spec, robot)
    if not meshes:
        _delete_meshes(spec)
    for shape in robot.contact_geoms:
        _add_shape(spec.body(robot.body_of(shape)), shape, shape.body in colliding)
    if not spec.body(robot.trunk).joints:
        spec.body(robot.trunk).add_freejoint(name="root")
    _set_joints(spec, robot)
    _set_keys(spec, robot)
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    spec.option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    spec.option.impratio = 1.0
    return spec


def robot_model(robot: Robot) -> mujoco.MjModel:
    """Return the compiled robot without a scene, feet and calves able to meet a ground."""
    return robot_spec(robot, (FOOT, CALF)).compile()


def _keep_masses(spec: mujoco.MjSpec, raw: mujoco.MjModel) -> None:
    """Write down what the compiler takes from shapes, before these are changed."""
    infer = mujoco.mjtInertiaFromGeom
    for body in spec.bodies[1:]:
        if body.explicitinertial and spec.compiler.inertiafromgeom != infer.mjINERTIAFROMGEOM_TRUE:
            continue
        i = raw.body(body.name).id
        body.mass, body.ipos, body.iquat = raw.body_mass[i], raw.body_ipos[i], raw.body_iquat[i]
        body.inertia, body.explicitinertial = raw.body_inertia[i], True
        body.fullinertia = [np.nan, 0, 0, 0, 0, 0]
    spec.compiler.inertiafromgeom = infer.mjINERTIAFROMGEOM_FALSE


def _strip(spec: mujoco.MjSpec, robot: Robot) -> None:
    """Delete what scenes bring along; what stays visible no longer collides."""
    for kind in ("sensors", "pairs", "excludes", "actuators", "lights"):
        for element in list(getattr(spec, kind)):
            spec.delete(element)
    for body in list(spec.worldbody.bodies):
        if body.name != robot.trunk:
            spec.delete(body)
    shapes = {shape.name for shape in robot.contact_geoms}
    for geom in list(spec.geoms):
        if geom.parent.name == "world" or geom.group >= HIDDEN_GROUP:
            spec.delete(geom)
            continue
        geom.contype = geom.conaffinity = 0
        if geom.name in shapes:
            geom.name = ""
        if geom.material in RESERVED["materials"]:
            geom.material = f"robot_{geom.material}"
    for texture in list(spec.textures):
        if texture.type == mujoco.mjtTexture.mjTEXTURE_SKYBOX:
            spec.delete(texture)
    for material in spec.materials:
        roles = list(material.textures)
        material.textures = [f"robot_{t}" if t in RESERVED["textures"] else t for t in roles]
    for kind, names in RESERVED.items():
        for element in getattr(spec, kind):
            if element.name in names:
                element.name = f"robot_{element.name}"


def _delete_meshes(spec: mujoco.MjSpec) -> None:
    for geom in [g for g in spec.geoms if g.type == mujoco.mjtGeom.mjGEOM_MESH]:
        spec.delete(geom)
    for mesh in list(spec.meshes):
        spec.delete(mesh)


def _add_shape(body: mujoco.MjsBody, shape: ContactGeom, meets_ground: bool) -> None:
    start, end = shape.endpoints
    sphere = start == end
    kind = mujoco.mjtGeom.mjGEOM_SPHERE if sphere else mujoco.mjtGeom.mjGEOM_CAPSULE
    place: dict[str, Any] = {"pos": start} if sphere else {"fromto": [*start, *end]}
    body.add_geom(
        name=shape.name,
        type=kind,
        size=[shape.radius, 0, 0],
        group=HIDDEN_GROUP,
        contype=0,
        conaffinity=int(meets_ground),
        condim=3,
        friction=[1.0, 0.005, 0.0001],
        rgba=[0.3, 0.9, 0.3, 0.4] if sphere else [0.9, 0.3, 0.3, 0.4],
        **place,
    )


def _set_joints(spec: mujoco.MjSpec, robot: Robot) -> None:
    """Give the joints the record's limits and PD motors in their order."""
    in_degrees = bool(spec.compiler.degree)
    always = mujoco.mjtLimited.mjLIMITED_TRUE
    for i, name in enumerate(robot.joints):
        joint, limits = spec.joint(name), robot.joint_limits[i]
        joint.range = np.degrees(limits) if in_degrees else limits
        joint.limited = always
        joint.armature = robot.armature[i]
        joint.damping = [robot.damping[i], 0.0, 0.0]
        motor = spec.add_actuator(
            name=robot.actuators[i], target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT
        )
        motor.set_to_position(kp=robot.kp[i], kv=robot.kd[i])
        motor.ctrlrange, motor.ctrllimited = limits, always
        limit = robot.torque_limit[i]
        motor.forcerange, motor.forcelimited = [-limit, limit], always


def _set_keys(spec: mujoco.MjSpec, robot: Robot) -> None:
    """Keep the file's keyframes that fit, and see that ``home`` is the record's."""
    home = np.array([0.0, 0.0, robot.home_height, 1.0, 0.0, 0.0, 0.0, *robot.default_pose])
    names = []
    for key in list(spec.keys):
        qpos = np.array(key.qpos)
        fits = len(qpos) == robot.nq
        if not fits or (key.name == "home" and not np.allclose(qpos, home, atol=TOLERANCE)):
            spec.delete(key)
            continue
        key.ctrl = qpos[ROOT_SIZE:]
        names.append(key.name)
    if "home" not in names:
        spec.add_key(name="home", qpos=home, ctrl=robot.default_pose)
