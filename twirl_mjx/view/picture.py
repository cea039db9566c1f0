"""A MuJoCo scene as plain data for a page: what is drawn once, and poses for every frame."""

from __future__ import annotations

import base64
from typing import Any

import mujoco
import numpy as np

FIRST_HIDDEN_GROUP = 3
"""Geom groups from here on are collision shapes and are not drawn where a body has others."""
_KINDS = {
    mujoco.mjtGeom.mjGEOM_PLANE.value: "plane",
    mujoco.mjtGeom.mjGEOM_HFIELD.value: "hfield",
    mujoco.mjtGeom.mjGEOM_SPHERE.value: "sphere",
    mujoco.mjtGeom.mjGEOM_CAPSULE.value: "capsule",
    mujoco.mjtGeom.mjGEOM_ELLIPSOID.value: "ellipsoid",
    mujoco.mjtGeom.mjGEOM_CYLINDER.value: "cylinder",
    mujoco.mjtGeom.mjGEOM_BOX.value: "box",
    mujoco.mjtGeom.mjGEOM_MESH.value: "mesh",
}


class Picture:
    """How the states of one model are shown; the first two bodies are the world and the trunk."""

    def __init__(self, model: mujoco.MjModel) -> None:
        """Choose what of ``model`` is drawn."""
        self._model, self._data = model, mujoco.MjData(model)
        geoms = np.flatnonzero(
            (model.geom_group < FIRST_HIDDEN_GROUP) & np.isin(model.geom_type, list(_KINDS))
        )
        robot = {int(model.jnt_bodyid[0])} | set(map(int, model.geom_bodyid[geoms]))
        self.bodies = [0, *sorted(robot - {0})]
        """Ids of the bodies in the order of poses."""
        self.scene: dict[str, Any] = {
            "bodies": len(self.bodies),
            "geoms": [self._geom(int(i)) for i in geoms],
        }
        """JSON-ready: how many bodies, and every geom with its type, size, colour and pose in its
        body."""

    def _geom(self, i: int) -> dict[str, Any]:
        model = self._model
        kind, colour = _KINDS[int(model.geom_type[i])], _colour(model, i)
        geom: dict[str, Any] = {
            "body": self.bodies.index(int(model.geom_bodyid[i])),
            "type": kind,
            "size": model.geom_size[i].round(5).tolist(),
            "colour": colour.round(3).tolist(),
            "pose": [*model.geom_pos[i].round(5).tolist(), *model.geom_quat[i].round(6).tolist()],
        }
        if kind == "mesh":
            geom |= _mesh(model, int(model.geom_dataid[i]))
        if kind == "hfield":
            geom |= _heights(model, int(model.geom_dataid[i]))
        return geom

    def poses(self, qpos: np.ndarray) -> np.ndarray:
        """Return position and quaternion wxyz [7 B] float32 of every body at ``qpos``, world."""
        self._data.qpos[:] = qpos
        mujoco.mj_kinematics(self._model, self._data)
        places = [self._data.xpos[self.bodies], self._data.xquat[self.bodies]]
        return np.concatenate(places, axis=1).astype(np.float32).ravel()


def _colour(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """Return the colour [3] in [0, 1] of a geom: with a texture, the mean of it."""
    material = int(model.geom_matid[geom])
    if material < 0:
        return model.geom_rgba[geom, :3]
    colour = model.mat_rgba[material, :3]
    texture = int(model.mat_texid[material, mujoco.mjtTextureRole.mjTEXROLE_RGB.value])
    if texture < 0:
        return colour
    first, channels = model.tex_adr[texture], int(model.tex_nchannel[texture])
    count = int(model.tex_width[texture]) * int(model.tex_height[texture]) * channels
    pixels = model.tex_data[first : first + count].reshape(-1, channels)
    return colour * pixels[:, :3].mean(axis=0) / 255.0


def _mesh(model: mujoco.MjModel, mesh: int) -> dict[str, Any]:
    first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    face, faces = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    return {
        "points": encode(model.mesh_vert[first : first + count].astype(np.float32)),
        "faces": encode(model.mesh_face[face : face + faces].astype(np.uint32)),
    }


def _heights(model: mujoco.MjModel, field: int) -> dict[str, Any]:
    rows, columns = int(model.hfield_nrow[field]), int(model.hfield_ncol[field])
    first = int(model.hfield_adr[field])
    unit = model.hfield_data[first : first + rows * columns]
    return {
        "size": model.hfield_size[field, :3].tolist(),
        "rows": rows,
        "columns": columns,
        "heights": encode(np.round(255 * unit).astype(np.uint8)),
    }


def encode(array: np.ndarray) -> str:
    """Return an array's bytes, row by row, as base64 text."""
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode()
