"""Who decides in a rehearsal: a policy of this project, or any other source.

A policy of the rehearsed task is given an observation by ``deploy.reference`` and
``deploy.imitation``, written apart from the simulation's. Any other source acts as it does in the
worlds, on a state made of what the sensors say.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from twirl_mjx.checks import choose_one
from twirl_mjx.deploy.imitation import Follower, quaternion
from twirl_mjx.deploy.reference import TASKS, Observer, Reading
from twirl_mjx.motion.clip import Clip
from twirl_mjx.policies.learned import load_policy
from twirl_mjx.policies.resolve import (
    Terms,
    header_of,
    options_of_card,
    resolve_actor,
    robot_of_card,
)
from twirl_mjx.sim.robots import A1
from twirl_mjx.tasks.imitate import ImitateOptions, clip_of
from twirl_mjx.tasks.registry import TASKS as ALL_TASKS
from twirl_mjx.types import SourcePolicy
from twirl_mjx.worlds.config import WorldConfig


class Pilot(Protocol):
    """Decides, once per control step, for one robot."""

    clip: Clip | None
    """What ``imitate`` follows."""
    options: Any
    """Options of the task."""

    def reset(self, reading: Reading) -> None:
        """Begin an episode with a first reading."""
        ...

    def decide(self, reading: Reading, goal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the task's observation [O] and the action [12], unclipped."""
        ...

    def push(self, reading: Reading, action: np.ndarray) -> None:
        """Take the reading after a control step, and the clipped action [12] that led to it."""
        ...


class OwnPilot:
    """Anything with ``act(obs [O]) -> action [12]`` that sees what the task shows."""

    def __init__(self, policy: Any, task: str, options: Any) -> None:
        """Keep the policy, and load the clip of ``imitate``."""
        self.policy, self.task, self.options = policy, task, options
        self.clip = clip_of(options, A1) if isinstance(options, ImitateOptions) else None

    def reset(self, reading: Reading) -> None:
        """Begin an episode; ``policy.reset()`` is called when it has one."""
        if hasattr(self.policy, "reset"):
            self.policy.reset()
        if self.clip is None:
            self._observer = Observer(self.task, reading)
        else:
            self._observer = Follower(self.clip, reading)

    def decide(self, reading: Reading, goal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Observe and act."""
        obs = self._observer.observe(reading, goal)
        return obs, np.asarray(self.policy.act(obs))

    def push(self, reading: Reading, action: np.ndarray) -> None:
        """Hand on to the observer."""
        self._observer.push(reading, action)


class SourcePilot(OwnPilot):
    """A source policy, shown a state that holds what the sensors say."""

    def __init__(self, policy: SourcePolicy, task: str, options: Any) -> None:
        """Compile the policy for one robot."""
        super().__init__(policy, task, options)

        def act(memory: Any, seen: dict[str, jax.Array]) -> tuple[jax.Array, Any]:
            key = jax.random.fold_in(jax.random.key(0), seen["step"][0])
            return policy.act(memory, _state(seen), key)

        self._act = jax.jit(act)

    def reset(self, reading: Reading) -> None:
        """Begin an episode."""
        super().reset(reading)
        self._step, self._action = 0, np.zeros(12, np.float32)
        self._memory: Any = None

    def decide(self, reading: Reading, goal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Show the state and act."""
        obs = self._observer.observe(reading, goal)
        seen = {
            "qpos": _row([*reading.position, *quaternion(reading.rotation), *reading.joint_pos]),
            "qvel": _row([*reading.velocity, *reading.angular_velocity, *reading.joint_vel]),
            "goal": _row(goal),
            "action": _row(self._action),
            "obs": _row(obs),
            "step": jnp.full(1, self._step, jnp.int32),
        }
        if self._step == 0:
            self._memory = self.policy.init(_state(seen))
        action, self._memory = self._act(self._memory, seen)
        return obs, np.asarray(action)[0]

    def push(self, reading: Reading, action: np.ndarray) -> None:
        """Count the step."""
        super().push(reading, action)
        self._step, self._action = self._step + 1, action


def _row(values: Any) -> jax.Array:
    return jnp.asarray(values, jnp.float32)[None]


def _state(seen: dict[str, jax.Array]) -> Any:
    """Return what source policies look at of an ``EnvState``, one world."""
    return SimpleNamespace(
        data=SimpleNamespace(qpos=seen["qpos"], qvel=seen["qvel"]),
        world=SimpleNamespace(goal=seen["goal"], action=seen["action"], episode_step=seen["step"]),
        obs=seen["obs"],
    )


def find_pilot(
    policy: Any, task: str | None, options: Any, terms: Terms, say: Callable[[str], None]
) -> tuple[Pilot, str]:
    """Return who decides, and in which task; arguments and errors as ``rehearsal.rehearse``."""
    is_named = isinstance(policy, str | Path)
    header = getattr(policy, "header", None)
    if is_named and not terms.contract:
        header = header_of(str(policy))
    task = task or (header.task if header else None)
    if task is None:
        raise ValueError(f"the policy does not name its task: give one of {', '.join(TASKS)}")
    if task not in TASKS:
        raise ValueError(f"cannot rehearse task {task!r}; {choose_one(task, TASKS)}")
    if header and (robot := robot_of_card(header)) != A1.name:
        raise ValueError(
            f"{policy} moves robot {robot!r}, and the rehearsed one is the A1 (nearest: a policy"
            " trained without --robot)"
        )
    is_own = header is not None and header.task == task
    if is_own and terms.command:
        raise ValueError(
            f"--source-command {terms.command} would do nothing: {policy} says its own task and"
            " observation"
        )
    if options is None and header is not None and is_own:
        options = options_of_card(header, str(policy))
    elif options is None:
        options = ALL_TASKS.get(task).paper_options()
    if not is_named:
        return OwnPilot(policy, task, options), task
    if is_own:
        return OwnPilot(load_policy(policy), task, options), task
    source = resolve_actor(str(policy), WorldConfig(task=task, options=options), terms=terms)
    for note in source.notes:
        say(f"{policy}: {note}")
    return SourcePilot(source.policy, task, options), task
