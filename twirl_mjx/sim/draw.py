"""States of a scene as pictures, without a display.

Frames are drawn by MuJoCo's own renderer through EGL (graphics card or Mesa), or OSMesa where
EGL does not exist; see ``sim.gl``.
"""

from __future__ import annotations

import copy
import dataclasses

import mujoco
import numpy as np

from twirl_mjx.sim.gl import open_context

SHADOW_HALF_SIZE = 1.6
"""m, half the edge of the square around the robot in which shadows are drawn."""
LIGHT_DISTANCE = 4.0
"""m, from the light to the robot."""

GOAL_RGBA = (0.10, 0.65, 0.25, 0.9)


@dataclasses.dataclass(frozen=True)
class CameraView:
    """A camera that follows the base."""

    distance: float = 2.1
    """Distance from the look-at point, m; more where robot and goal are far apart."""
    azimuth: float = 120.0
    """Direction of view about world z, deg; 90 looks along +y, so +x is to the right."""
    elevation: float = -14.0
    """Direction of view over the horizon, deg."""
    height: float = 0.25
    """Look-at height over the world's origin, m."""
    smoothing_s: float = 0.3
    """Time constant with which the look-at point follows the base, s."""


class SceneRenderer:
    """Draws states of one model into RGB arrays; a context manager that frees the context."""

    def __init__(
        self,
        model: mujoco.MjModel,
        width: int = 640,
        height: int = 480,
        *,
        antialias: bool = False,
    ) -> None:
        """Open a context of ``width`` x ``height`` pixels.

        Args:
            model: the scene; a copy with drawing settings of its own is used.
            width: pixels.
            height: pixels.
            antialias: smooth edges; about twice the time where a processor draws.

        Raises:
            RenderError: no OpenGL backend works.
        """
        model = copy.copy(model)
        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
        model.vis.quality.offsamples = 4 if antialias else 0
        model.vis.quality.shadowsize = 2048
        model.vis.map.shadowclip = SHADOW_HALF_SIZE / model.stat.extent
        model.mat_reflectance[:] = 0.0  # a mirrored floor is a third of the drawing time
        self.model, self.data = model, mujoco.MjData(model)
        self._context = open_context(width, height)
        self._scene = mujoco.MjvScene(model, maxgeom=2000)
        self._option = mujoco.MjvOption()
        self._camera = mujoco.MjvCamera()
        self._rect = mujoco.MjrRect(0, 0, width, height)
        self._gl = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._gl)

    def __enter__(self) -> SceneRenderer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def draw(
        self,
        qpos: np.ndarray,
        view: CameraView,
        look_at: np.ndarray,
        goal: np.ndarray | None = None,
    ) -> np.ndarray:
        """Draw one state.

        Args:
            qpos: [7 + J] MuJoCo layout.
            view: camera.
            look_at: [3] m, world point at the centre of the picture.
            goal: [2] or [3] m, world position of a goal marker; ``None`` for none.

        Returns:
            [H, W, 3] uint8.
        """
        self.data.qpos[:] = qpos
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        self._aim_lights(np.asarray(look_at))
        mujoco.mj_camlight(self.model, self.data)
        self._camera.lookat[:] = look_at
        self._camera.distance = view.distance
        self._camera.azimuth, self._camera.elevation = view.azimuth, view.elevation
        mujoco.mjv_updateScene(
            self.model,
            self.data,
            self._option,
            None,
            self._camera,
            mujoco.mjtCatBit.mjCAT_ALL.value,
            self._scene,
        )
        if goal is not None:
            self._add_goal(np.asarray(goal, float))
        mujoco.mjr_render(self._rect, self._scene, self._gl)
        pixels = np.empty((self._rect.height, self._rect.width, 3), np.uint8)
        mujoco.mjr_readPixels(pixels, None, self._rect, self._gl)
        return pixels[::-1].copy()

    def close(self) -> None:
        """Free the OpenGL context; harmless when repeated."""
        if self._context is not None:
            self._gl.free()
            self._context.free()
            self._context = None

    def _aim_lights(self, look_at: np.ndarray) -> None:
        """Move the world's directional lights so that their shadow maps surround ``look_at``."""
        directional = self.model.light_type == mujoco.mjtLightType.mjLIGHT_DIRECTIONAL.value
        for i in np.flatnonzero(directional & (self.model.light_bodyid == 0)):
            self.model.light_pos[i] = look_at - LIGHT_DISTANCE * self.model.light_dir[i]

    def _add_goal(self, goal: np.ndarray) -> None:
        """Put a disc and a pole at ``goal`` into the scene about to be drawn."""
        base = np.array([goal[0], goal[1], goal[2] if goal.size == 3 else 0.0])
        cylinder = mujoco.mjtGeom.mjGEOM_CYLINDER
        for radius, half in ((0.07, 0.004), (0.01, 0.15)):
            geom = self._scene.geoms[self._scene.ngeom]
            size = np.array([radius, half, 0.0])
            centre = np.array([base[0], base[1], base[2] + half])
            rgba = np.array(GOAL_RGBA, np.float32)
            mujoco.mjv_initGeom(geom, cylinder, size, centre, np.eye(3).ravel(), rgba)
            self._scene.ngeom += 1
