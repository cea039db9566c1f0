"""Which policy an object is: a digest of what it holds, since it has no file that could tell."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import pickle
import types
from collections.abc import Callable, Mapping, Set
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

Put = Callable[[bytes], object]


def digest_of(thing: Any) -> str:
    """Return the class of an object and a digest of what decides what it does.

    That is what its attributes hold (of a dataclass its fields; no cached properties), all the way
    down: numbers, text, arrays, and the code, defaults and closures of functions. Not looked into:
    what functions call by a global name, and objects of C extensions that cannot be pickled.
    """
    found = hashlib.sha256()
    _feed(thing, found.update, ())
    kind = type(thing)
    return f"{kind.__module__}.{kind.__qualname__} {found.hexdigest()[:12]}"


def _feed(thing: Any, put: Put, above: tuple[int, ...]) -> None:
    """Put an object and what it holds; ``above`` are the objects that hold it."""
    if id(thing) in above:
        put(b"itself;")
        return
    put(f"{type(thing).__module__}.{type(thing).__qualname__};".encode())
    for part in _parts(thing):
        if isinstance(part, bytes):
            put(b"%d:" % len(part) + part)
        else:
            _feed(part, put, (*above, id(thing)))


def _parts(thing: Any) -> list[Any]:
    """Return what is in an object, as bytes or as objects that are looked into."""
    match thing:
        case bytes():
            return [bytes(thing)]
        case None | bool() | int() | float() | complex() | str() | Path():
            return [str(thing).encode()]
        case type() | types.ModuleType():
            return [repr(thing).encode()]
        case jax.Array() if jnp.issubdtype(thing.dtype, jax.dtypes.prng_key):
            return [np.asarray(jax.random.key_data(thing))]
        case np.ndarray() | np.generic() | jax.Array():
            values = np.asarray(thing)
            return [str((values.dtype, values.shape)).encode(), values.tobytes()]
        case Mapping():
            return [each for pair in thing.items() for each in pair]
        case list() | tuple():
            return list(thing)
        case Set():
            return [text.encode() for text in sorted(map(repr, thing))]
        case types.CodeType():
            return [thing.co_code, *thing.co_names, *thing.co_consts]
        case types.FunctionType():
            held = [cell.cell_contents for cell in thing.__closure__ or () if _is_filled(cell)]
            name = thing.__qualname__
            return [name, thing.__code__, thing.__defaults__, thing.__kwdefaults__, *held]
        case types.MethodType():
            return [thing.__func__, thing.__self__]
        case functools.partial():
            return [thing.func, thing.args, thing.keywords]
    if (wrapped := getattr(thing, "__wrapped__", None)) is not None:
        return [wrapped]
    if dataclasses.is_dataclass(thing):
        return [{field.name: getattr(thing, field.name) for field in dataclasses.fields(thing)}]
    slots = [name for kind in type(thing).__mro__ for name in getattr(kind, "__slots__", ())]
    held = {name: getattr(thing, name) for name in slots if hasattr(thing, name)}
    own = getattr(thing, "__dict__", {})
    held |= {name: value for name, value in own.items() if not _is_cached(thing, name)}
    return [held] if held else _frozen(thing)


def _is_cached(thing: Any, name: str) -> bool:
    """Return whether an attribute follows from the others and was found when it was asked for."""
    return isinstance(getattr(type(thing), name, None), functools.cached_property)


def _frozen(thing: Any) -> list[bytes]:
    """Return an object of which Python sees no part (a tensor, say) as it is pickled, if it is."""
    with contextlib.suppress(Exception):  # whatever a foreign class raises
        return [pickle.dumps(thing, protocol=4)]
    return []


def _is_filled(cell: types.CellType) -> bool:
    """Return whether the variable of a closure has a value yet."""
    try:
        cell.cell_contents  # noqa: B018
    except ValueError:
        return False
    return True
