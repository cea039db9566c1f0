"""The worlds behind other libraries' interfaces: gymnasium's two environments, one brax view."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from twirl_mjx.sim import mjx
from twirl_mjx.tasks.registry import TASKS
from twirl_mjx.worlds.make import make
from twirl_mjx.worlds.vector import EnvState, VectorEnv

if TYPE_CHECKING:
    from twirl_mjx.worlds.brax_view import BraxEnv

NAMESPACE = "twirl_mjx"
"""What ids in gymnasium's registry begin with: ``twirl_mjx/Biped-v0``."""
METADATA = {"render_modes": ["rgb_array"], "render_fps": 20}


def _check_render_mode(render_mode: str | None) -> None:
    if render_mode not in (None, "rgb_array"):
        raise ValueError(f"unknown render_mode {render_mode!r} (nearest: 'rgb_array', or None)")


class GymnasiumEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """One world of a task as a ``gymnasium.Env``.

    Observation: float32 [O] in the task's layout. Action: float32 [A] in [-1, 1]. ``info`` has
    one float per name of the task's metrics (every reward term, unweighted) and the bool
    ``invalid``. A step that is not finite is reported as a truncation with ``invalid`` true,
    reward 0 and the previous observation. A pickled environment is made anew: it starts without
    an episode.
    """

    metadata = METADATA

    def __init__(self, env: VectorEnv, render_mode: str | None = None) -> None:
        """Wrap a batch of one world.

        Raises:
            ValueError: ``env`` has more than one world, or the render mode is unknown.
        """
        if env.num_envs != 1:
            raise ValueError(f"a gymnasium env is one world, got num_envs {env.num_envs} (need 1)")
        _check_render_mode(render_mode)
        self.env = env
        self.render_mode = render_mode
        self.observation_space = env.observation_space
        self.action_space = env.action_space
        self._step = jax.jit(self._step_and_read)
        self._state: EnvState | None = None
        self._shown: EnvState | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.env, self.render_mode)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode; a seed makes it and all later ones reproducible."""
        super().reset(seed=seed, options=options)
        state = self.env.reset(jax.random.key(int(self.np_random.integers(2**31))))
        self._state = self._shown = state
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
        obs, reward, terminated, truncated, invalid, metrics = jax.device_get(read)
        done = bool(terminated | truncated | invalid)
        self._state = None if done else state
        if not done:  # at an end the world has been reset; render() keeps the last pose before it
            self._shown = state
        info = _info(metrics, invalid=bool(invalid))
        return np.array(obs), float(reward), bool(terminated), bool(truncated | invalid), info

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """Return the present pose as an image [480, 640, 3] uint8, or None without a render mode.

        Raises:
            gymnasium.error.ResetNeeded: There has been no episode.
            RenderError: No OpenGL backend works.
        """
        if self.render_mode is None:
            return None
        if self._shown is None:
            raise ResetNeeded("there is nothing to draw: call reset() first")
        return self.env.render(self._shown)

    def close(self) -> None:
        """Free the drawing context."""
        self.env.painter.close()

    def _step_and_read(self, state: EnvState, action: jax.Array) -> tuple[EnvState, tuple]:
        """Step, and gather in one transfer what the host wants to know of world 0."""
        state = self.env.step(state, action)
        flags = jnp.stack([state.terminated, state.truncated, state.invalid])[:, 0]
        return state, (state.next_obs[0], state.reward[0], *flags, state.metrics)


class GymnasiumVectorEnv(gymnasium.vector.VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """All worlds of a task as one ``gymnasium.vector.VectorEnv``: a step is one compiled call.

    Autoreset is ``SAME_STEP``: where an episode ends, the observation returned is the first of the
    next one, and the last one of the old stands in ``info["final_obs"]`` [N, O], its metrics in
    ``info["final_info"]``; both are valid where ``info["_final_obs"]`` [N] is true. Otherwise
    ``info`` has the metrics of the task, float32 [N], and ``invalid`` [N]; such steps are
    truncations with reward 0. A pickled environment is made anew: it starts without episodes.
    """

    metadata = METADATA | {"autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(self, env: VectorEnv, render_mode: str | None = None) -> None:
        """Wrap worlds.

        Raises:
            ValueError: The render mode is unknown.
        """
        _check_render_mode(render_mode)
        self.env = env
        self.num_envs = env.num_envs
        self.render_mode = render_mode
        self.single_observation_space = env.observation_space
        self.single_action_space = env.action_space
        self.observation_space = batch_space(env.observation_space, env.num_envs)
        self.action_space = batch_space(env.action_space, env.num_envs)
        self._step = jax.jit(self._step_and_read)
        self._state: EnvState | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.env, self.render_mode)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode in every world; a seed makes these and all later ones reproducible."""
        super().reset(seed=seed, options=options)
        self._state = self.env.reset(jax.random.key(int(self.np_random.integers(2**31))))
        obs, metrics = jax.device_get((self._state.obs, self._state.metrics))
        return np.array(obs), _infos(metrics, np.zeros(self.num_envs, bool))

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Advance every world by one control step.

        Raises:
            gymnasium.error.ResetNeeded: No episode is running.
            ValueError: ``actions`` has another shape than [N, A].
        """
        if self._state is None:
            raise ResetNeeded("no episode is running: call reset() first")
        self._state, read = self._step(self._state, np.asarray(actions, np.float32))
        obs, last, reward, terminated, truncated, invalid, metrics = jax.device_get(read)
        truncated = truncated | invalid
        info = _infos(metrics, invalid)
        if (done := terminated | truncated).any():
            info |= {"final_obs": np.where(done[:, None], last, 0.0), "_final_obs": done}
            info |= {"final_info": _infos(metrics, invalid), "_final_info": done}
        return np.array(obs), np.array(reward), np.array(terminated), truncated, info

    def render(self) -> tuple[np.ndarray, ...] | None:  # type: ignore[override]
        """Return an image [480, 640, 3] uint8 of every world, or None without a render mode.

        Raises:
            gymnasium.error.ResetNeeded: There has been no episode.
            RenderError: No OpenGL backend works.
        """
        if self.render_mode is None:
            return None
        if self._state is None:
            raise ResetNeeded("there is nothing to draw: call reset() first")
        return tuple(self.env.render(self._state, world) for world in range(self.num_envs))

    def close_extras(self, **kwargs: Any) -> None:
        """Free the drawing context."""
        del kwargs
        self.env.painter.close()

    def _step_and_read(self, state: EnvState, action: jax.Array) -> tuple[EnvState, tuple]:
        state = self.env.step(state, action)
        flags = (state.terminated, state.truncated, state.invalid)
        return state, (state.obs, state.next_obs, state.reward, *flags, state.metrics)


def _infos(metrics: dict[str, np.ndarray], invalid: np.ndarray) -> dict[str, Any]:
    """Return values [N] and, as gymnasium's vector environments do, who has one: everybody."""
    values = {name: np.array(value) for name, value in metrics.items()} | {"invalid": invalid}
    return values | {f"_{name}": np.ones(len(invalid), bool) for name in values}


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


def to_gymnasium_vector(
    task: str,
    shift: str | None = None,
    *,
    num_envs: int = 64,
    render_mode: str | None = None,
    **options: Any,
) -> GymnasiumVectorEnv:
    """Return the worlds of a task as one ``gymnasium.vector.VectorEnv``.

    Args:
        task: stand, biped, imitate or hurdles.
        shift: none, bumpy, icy, weakened, sloped or gravity.
        num_envs: N, worlds that are stepped together in one compiled call.
        render_mode: None or ``rgb_array``.
        **options: Further options of ``twirl_mjx.make`` (``engine``, ``shift_strength``,
            ``config``).

    Raises:
        ValueError: An unknown name or a value out of range, with the nearest valid choice.
    """
    return GymnasiumVectorEnv(make(task, shift, num_envs, **options), render_mode)


def register_gymnasium() -> tuple[str, ...]:
    """Enter every task into gymnasium's registry and return the ids, ``twirl_mjx/Biped-v0`` ...

    ``gymnasium.make(id)`` is then :func:`to_gymnasium`, ``gymnasium.make_vec(id, num_envs=64)``
    is :func:`to_gymnasium_vector`; both take their options by name.
    """
    ids = {f"{NAMESPACE}/{name.title().replace('_', '')}-v0": name for name in TASKS.names()}
    for key, task in ids.items():
        if key not in gymnasium.registry:
            gymnasium.register(
                id=key,
                entry_point="twirl_mjx.worlds.adapters:to_gymnasium",
                vector_entry_point="twirl_mjx.worlds.adapters:to_gymnasium_vector",
                kwargs={"task": task},
            )
    return tuple(ids)


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
    mjx.load()  # before brax does, and quietly
    from twirl_mjx.worlds.brax_view import BraxEnv  # brax takes seconds to import

    return BraxEnv(make(task, shift, num_envs or 1, **options), batched=num_envs is not None)
