"""The worlds behind other libraries' interfaces: one gymnasium environment, one brax view."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from gymnasium.error import ResetNeeded

from twirl_mjx.worlds.make import make
from twirl_mjx.worlds.vector import MAX_STATE, EnvState, VectorEnv

if TYPE_CHECKING:
    from twirl_mjx.worlds.brax_view import BraxEnv

OBSERVATION_LIMIT = 10 * MAX_STATE
"""Bound of the observation box, in the units of the layout: no finite world ever reaches it."""
FRAME_SIZE = (480, 640)
"""Height and width in pixels of a rendered frame."""


class GymnasiumEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """One world of a task as a ``gymnasium.Env``.

    Observation: float32 [O] in the task's layout. Action: float32 [A] in [-1, 1]. ``info`` has
    one float per name of the task's metrics (every reward term, unweighted) and the bool
    ``invalid``. A step that is not finite is reported as a truncation with ``invalid`` true,
    reward 0 and the previous observation.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}

    def __init__(self, env: VectorEnv, render_mode: str | None = None) -> None:
        """Wrap a batch of one world.

        Raises:
            ValueError: ``env`` has more than one world, or the render mode is unknown.
        """
        if env.num_envs != 1:
            raise ValueError(f"a gymnasium env is one world, got num_envs {env.num_envs} (need 1)")
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"unknown render_mode {render_mode!r} (nearest: 'rgb_array', or None)")
        self.env = env
        self.render_mode = render_mode
        limit, size = np.float32(OBSERVATION_LIMIT), env.observation_size
        self.observation_space = gymnasium.spaces.Box(-limit, limit, (size,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (env.action_size,), np.float32)
        self._reset = jax.jit(env.reset)
        self._step = jax.jit(self._step_and_read)
        self._state: EnvState | None = None
        self._qpos = np.zeros(env.scene.mj_model.nq)
        self._renderer: mujoco.Renderer | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode; a seed makes it and all later ones reproducible."""
        super().reset(seed=seed, options=options)
        state = self._reset(jax.random.key(int(self.np_random.integers(2**31))))
        self._state = state
        self._qpos = np.array(state.data.qpos[0], np.float64)
        obs, metrics = jax.device_get((state.obs[0], state.metrics))
        return np.array(obs), _info(metrics, invalid=False)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Advance by one control step; at an episode's end the observation is its last one.

        Raises:
            gymnasium.error.ResetNeeded: No episode is running.
            ValueError: ``action`` has another shape than [A].
        """
        if self._state is None:
            raise ResetNeeded("no episode is running: call reset() first")
        if np.shape(action) != self.action_space.shape:
            raise ValueError(f"action has shape {np.shape(action)}, need {self.action_space.shape}")
        state, read = self._step(self._state, np.asarray(action, np.float32)[None])
        obs, reward, terminated, truncated, invalid, metrics, qpos = jax.device_get(read)
        done = bool(terminated | truncated | invalid)
        self._state = None if done else state
        if not done:  # at an end the world has been reset; render() keeps the last pose before it
            self._qpos = np.array(qpos, np.float64)
        info = _info(metrics, invalid=bool(invalid))
        return np.array(obs), float(reward), bool(terminated), bool(truncated | invalid), info

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """Return the present pose as an image [480, 640, 3] uint8, or None without a render mode.

        Raises:
            RuntimeError: No OpenGL backend works in this process.
        """
        if self.render_mode is None:
            return None
        model = self.env.mj_model
        data = mujoco.MjData(model)
        data.qpos[:] = self._qpos
        mujoco.mj_forward(model, data)
        camera = mujoco.MjvCamera()
        camera.lookat[:] = self._qpos[:3]
        camera.distance, camera.azimuth, camera.elevation = 1.7, 120.0, -14.0
        renderer = self._renderer or _open_renderer(model)
        self._renderer = renderer
        renderer.update_scene(data, camera)
        return renderer.render()

    def close(self) -> None:
        """Free the drawing context."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _step_and_read(self, state: EnvState, action: jax.Array) -> tuple[EnvState, tuple]:
        """Step, and gather in one transfer what the host wants to know of world 0."""
        state = self.env.step(state, action)
        flags = jnp.stack([state.terminated, state.truncated, state.invalid])[:, 0]
        read = (state.next_obs[0], state.reward[0], *flags, state.metrics, state.data.qpos[0])
        return state, read


def _open_renderer(model: mujoco.MjModel) -> mujoco.Renderer:
    try:
        return mujoco.Renderer(model, *FRAME_SIZE)
    except Exception as error:  # drivers and PyOpenGL fail in many types
        raise RuntimeError(
            "cannot draw in this process: set the environment variable MUJOCO_GL to 'egl' "
            f"or 'osmesa' before Python starts ({type(error).__name__}: {error})"
        ) from error


def _info(metrics: dict[str, np.ndarray], *, invalid: bool) -> dict[str, Any]:
    return {name: float(value[0]) for name, value in metrics.items()} | {"invalid": invalid}


def to_gymnasium(
    task: str,
    shift: str | None = None,
    *,
    render_mode: str | None = None,
    engine: str = "native",
    **options: Any,
) -> GymnasiumEnv:
    """Return one world of a task as a ``gymnasium.Env`` that passes gymnasium's ``check_env``.

    Args:
        task: stand, biped, imitate or hurdles.
        shift: none, bumpy, icy, weakened, sloped or gravity.
        render_mode: None or ``rgb_array``.
        engine: auto, mjx or native; C MuJoCo is the faster one for a single world.
        **options: Further options of ``twirl_mjx.make`` (``shift_strength``, ``config``).

    Raises:
        ValueError: An unknown name or a value out of range, with the nearest valid choice.
    """
    return GymnasiumEnv(make(task, shift, 1, engine=engine, **options), render_mode)


def to_brax(
    task: str, shift: str | None = None, *, num_envs: int | None = None, **options: Any
) -> BraxEnv:
    """Return the worlds of a task as a ``brax.envs.base.Env``.

    Args:
        task: stand, biped, imitate or hurdles.
        shift: none, bumpy, icy, weakened, sloped or gravity.
        num_envs: N worlds stepped together, arrays [N, ...]; None is a single world without that
            axis, which brax's own wrappers vmap.
        **options: Further options of ``twirl_mjx.make`` (``engine``, ``shift_strength``,
            ``config``).

    Raises:
        ValueError: An unknown name or a value out of range, with the nearest valid choice.
    """
    from twirl_mjx.worlds.brax_view import BraxEnv  # brax takes seconds to import

    return BraxEnv(make(task, shift, num_envs or 1, **options), batched=num_envs is not None)
