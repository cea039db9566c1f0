"""What a world looks like: its robot, ground, hurdle bands and goal as an image."""

from __future__ import annotations

import mujoco
import numpy as np

from twirl_mjx.sim import look
from twirl_mjx.sim.draw import CameraView, SceneRenderer
from twirl_mjx.sim.dynamics import Dynamics
from twirl_mjx.sim.engine import world_model
from twirl_mjx.sim.robot import NUM_LEGS
from twirl_mjx.sim.scene import Bands, Scene, build_scene

FRAME_SIZE = (640, 480)
"""Width and height in pixels."""
LANE = 2.0
"""m, bands have no end across; those that are drawn are centred on a multiple of this."""
BANDS_AHEAD = 4.0
"""m, bands are drawn up to this far beyond the robot."""


class Painter:
    """Draws worlds of one scene; keeps the OpenGL context and the scene of the last bands."""

    def __init__(self, scene: Scene, dynamics: Dynamics, band_height: float = 0.0) -> None:
        """Keep the scene and the parameters (scalars) whose ground and colours are drawn.

        Args:
            scene: Robot and ground.
            dynamics: Scalars.
            band_height: m, of hurdle bands.
        """
        self._scene = scene
        self._band_height = band_height
        self._dynamics = dynamics
        self._view = CameraView()
        self._opened: tuple[tuple[tuple[float, ...], float], SceneRenderer] | None = None

    def draw(
        self, qpos: np.ndarray, bands: np.ndarray | None = None, goal: np.ndarray | None = None
    ) -> np.ndarray:
        """Return an image [480, 640, 3] uint8.

        Args:
            qpos: [7 + J] of the robot.
            bands: [H] m, world x of hurdle bands.
            goal: [2] m, world position of the goal marker.

        Raises:
            RenderError: No OpenGL backend works.
        """
        near = () if bands is None else tuple(map(float, bands[bands < qpos[0] + BANDS_AHEAD]))
        look_at = np.array([qpos[0], qpos[1], max(self._view.height, 0.6 * qpos[2])])
        lane = LANE * round(float(qpos[1]) / LANE)
        return self._open(near, lane).draw(qpos, self._view, look_at, goal)

    def close(self) -> None:
        """Free the OpenGL context; the next picture opens another."""
        if self._opened is not None:
            self._opened[1].close()
            self._opened = None

    def _open(self, bands: tuple[float, ...], lane: float) -> SceneRenderer:
        if self._opened is None or self._opened[0] != (bands, lane):
            self.close()
            self._opened = (bands, lane), SceneRenderer(self._model(bands, lane), *FRAME_SIZE)
        return self._opened[1]

    def _model(self, bands: tuple[float, ...], lane: float) -> mujoco.MjModel:
        scene, dynamics = self._scene, self._dynamics
        if bands:
            drawn = Bands(
                bands,
                y=lane,
                height=self._band_height,
                incline=float(dynamics.incline),
                bump_height=float(dynamics.bump_height),
            )
            scene = build_scene(scene.kind, robot=scene.robot, bands=drawn)
        model = world_model(scene, dynamics)
        look.paint(model, scene.robot, dynamics, np.ones(NUM_LEGS))
        return model
