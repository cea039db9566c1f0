"""What a task returns, checked by tracing it once: nothing is compiled or stepped."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from twirl_mjx.checks import nearest
from twirl_mjx.sim.dynamics import make_dynamics
from twirl_mjx.sim.scene import Scene
from twirl_mjx.tasks.base import Outcome, Start, World, make_view
from twirl_mjx.tasks.observations import layout_size
from twirl_mjx.tasks.task import Task

SIGNALS = ("reward", "step", "terminated")
"""What a measure may fold beside the metrics of its task."""


def check_task(task: Task, scene: Scene) -> tuple[str, ...]:
    """Return the names of a task's metrics after checking what its methods return.

    Raises:
        ValueError: A method fails, or a part of its result has another shape or dtype than it
            must; one line that names file, method, part and what was expected.
    """
    dynamics = make_dynamics()
    key = jax.eval_shape(lambda: jax.random.key(0))
    start = _traced(task, "start", lambda k: task.start(k, scene, dynamics), key)
    if not isinstance(start, Start):
        found = _kind(start)
        raise ValueError(f"{_where(task, 'start')} returned {found}, expected Start")
    model = scene.mj_model
    for part, size in (("qpos", model.nq), ("qvel", model.nv), ("goal", 2)):
        _expect(task, "start", part, getattr(start, part), (size,), jnp.float32)

    def judged(start: Start) -> tuple[Outcome, jax.Array]:
        zeros = jnp.zeros(model.nu)
        memory = task.observer.push(start.memory, start.qpos, start.qvel, zeros)
        world = World(
            key=jax.random.key(0),
            episode_step=jnp.zeros((), jnp.int32),
            action=zeros,
            filter=None,  # type: ignore[arg-type]
            motors=None,  # type: ignore[arg-type]
            dynamics=dynamics,
            goal=start.goal,
            memory=memory,
            task=start.task,
        )
        view = make_view(scene, dynamics, start.qpos[None], start.qvel[None])
        outcome = task.judge(world, view, scene)
        obs = task.observer.observe(memory, start.goal, start.qpos, start.qvel)
        return outcome, obs

    outcome, obs = _traced(task, "judge", judged, start)
    if not isinstance(outcome, Outcome):
        found = _kind(outcome)
        raise ValueError(f"{_where(task, 'judge')} returned {found}, expected Outcome")
    _expect(task, "judge", "reward", outcome.reward, (), jnp.float32)
    _expect(task, "judge", "terminated", outcome.terminated, (), jnp.bool_)
    _expect(task, "judge", "goal", outcome.goal, (2,), jnp.float32)
    _check_state(task, start.task, outcome.task)
    for name, metric in outcome.metrics.items():
        _expect(task, "judge", f"metric {name!r}", metric, (), None)
    size = layout_size(task.observer.layout)
    _expect(task, "observer.observe", "the observation", obs, (size,), jnp.float32)
    names = tuple(outcome.metrics)
    for name, measure in task.measures.items():
        if measure.signal not in (*names, *SIGNALS):
            known = (*names, *SIGNALS)
            raise ValueError(
                f"{_where(task, 'measures')}: {name!r} folds {measure.signal!r}, which judge does"
                f" not report: it reports {', '.join(known)} (nearest:"
                f" {nearest(measure.signal, known)!r})"
            )
    return names


def _traced(task: Task, method: str, function: Callable[..., Any], *args: Any) -> Any:
    try:
        return jax.eval_shape(function, *args)
    except Exception as error:  # a user's method may raise anything
        what = " ".join(str(error).split())
        raise ValueError(f"{_where(task, method)} fails: {type(error).__name__}: {what}") from error


def _expect(task: Task, method: str, part: str, value: Any, shape: tuple, dtype: Any) -> None:
    found_shape, found_dtype = getattr(value, "shape", None), getattr(value, "dtype", None)
    if found_shape == shape and (dtype is None or found_dtype == dtype):
        return
    wanted = f"{list(shape)}" + (f" {jnp.dtype(dtype).name}" if dtype is not None else "")
    found = f"{list(found_shape or ())} {found_dtype}" if found_dtype else repr(value)
    raise ValueError(f"{_where(task, method)}: {part} is {found}, expected {wanted}")


def _check_state(task: Task, before: Any, after: Any) -> None:
    """A task's own state keeps its form from start to judge: it is carried through a scan."""

    def form(tree: Any) -> Any:
        leaves, structure = jax.tree.flatten(tree)
        return structure, [(leaf.shape, leaf.dtype) for leaf in leaves]

    if form(before) != form(after):
        raise ValueError(
            f"{_where(task, 'judge')}: the task's state is {form(after)[1]} in"
            f" {form(after)[0]}, expected that of start: {form(before)[1]} in {form(before)[0]}"
        )


def _kind(found: Any) -> str:
    """Return what a traced method gave; numbers have become arrays."""
    is_array = isinstance(found, jax.ShapeDtypeStruct)
    return "a number or an array" if is_array else type(found).__name__


def _where(task: Task, method: str) -> str:
    try:
        file = inspect.getfile(type(task))
    except (OSError, TypeError):
        file = type(task).__module__
    return f"{file}: {type(task).__name__}.{method}"
