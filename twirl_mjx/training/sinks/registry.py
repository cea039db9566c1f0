"""Sinks by name, and from a user's own file."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from twirl_mjx import plugins
from twirl_mjx.checks import check_choice
from twirl_mjx.training.sinks.base import Sink
from twirl_mjx.training.sinks.services import Trackio, Wandb

SINKS: dict[str, Callable[[], Sink]] = {"wandb": Wandb, "trackio": Trackio}
"""What a run may log to beside the table, TensorBoard and the terminal."""


def resolve(chosen: Sequence[str | Sink]) -> tuple[Sink, ...]:
    """Return sinks given by name, as ``FILE.py:NAME`` (a class or an object), or as objects.

    Raises:
        ValueError: An unknown name, one given twice, a package that is not installed, or an object
            that is no sink; one line.
    """
    names = [name for name in chosen if isinstance(name, str)]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"--log names {name!r} {names.count(name)} times: once is enough")
    return tuple(_sink(one) for one in chosen)


def resolve_each(chosen: Sequence[str | Sink], num_runs: int) -> list[tuple[Sink, ...]]:
    """Return sinks of their own for every one of several runs that are under way together.

    Raises:
        ValueError: As :func:`resolve`, or a sink that can serve one run at a time only.
    """
    sinks = [resolve(chosen) for _ in range(num_runs)]
    for one, *others in zip(*sinks, strict=True):
        if others and (one is others[0] or isinstance(one, (Wandb, Trackio))):
            what = type(one).__name__.lower()
            raise ValueError(
                f"sink {what} serves one run at a time, not {num_runs} seeds in one program"
                " (nearest: --seed, one run after the other; or a class of your own, FILE.py:NAME)"
            )
    return sinks


def _sink(chosen: str | Sink) -> Sink:
    made: object = chosen
    if isinstance(chosen, str):
        if plugins.is_reference(chosen):
            made = plugins.load(chosen)
        else:
            check_choice("sink", chosen, (*SINKS, "FILE.py:NAME"))
            made = SINKS[chosen]
    if isinstance(made, type):
        try:
            made = made()
        except TypeError as error:
            raise ValueError(f"sink {chosen}: {made.__name__}() fails with {error}") from error
    missing = [name for name in ("open", "log", "close") if not callable(getattr(made, name, None))]
    if missing:
        raise ValueError(
            f"sink {chosen} is {type(made).__name__} without {', '.join(missing)}: expected a class"
            " or an object with open(run), log(env_steps, grad_steps, wall_s, values) and close()"
        )
    return made  # pyright: ignore[reportReturnType]
