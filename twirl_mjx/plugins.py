"""Named things, built in or from a user's own file, and how such a file is loaded.

A reference is ``path/to/file.py:Name``. A registry holds one kind of thing (tasks, shifts, ...) by
name; a thing enters it by being registered where it is defined, by a reference, or through a
package's entry point.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.metadata
import importlib.util
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType, ModuleType
from typing import Any

from twirl_mjx import files
from twirl_mjx.checks import check_choice, nearest

MINARI = "minari:"
"""How the name of a dataset of Minari begins, where a source is named."""


def is_reference(text: str) -> bool:
    """Return whether a text is of the form ``file.py:Name`` (not whether that exists)."""
    return ".py:" in text or text.endswith(".py")


def split(reference: str, kind: str = "object") -> tuple[Path, str]:
    """Return file and name of a reference; the file exists.

    Raises:
        ValueError: No name is given, or there is no such file.
    """
    path_text, _, name = reference.rpartition(":")
    if not path_text.endswith(".py") or not name:
        file = (path_text or reference).removesuffix(".py") + ".py"
        raise ValueError(
            f"{reference!r} does not say which {kind}: expected FILE.py:NAME"
            f" (nearest: {file}:{name if path_text and name else 'Name'})"
        )
    path = Path(path_text).expanduser().resolve()
    if not path.is_file():
        beside = [p.name for p in path.parent.glob("*.py")] if path.parent.is_dir() else []
        hint = f" (nearest: {path.parent / nearest(path.name, beside)})" if beside else ""
        raise ValueError(f"there is no file {path_text} to take the {kind} {name!r} from{hint}")
    return path, name


def load(reference: str, kind: str = "object") -> Any:
    """Return the object a reference names; its file is run once in a process.

    Args:
        reference: ``path/to/file.py:Name``.
        kind: What errors call the object.

    Raises:
        ValueError: No such file or name, or the file does not import. One line that names it.
    """
    path, name = split(reference, kind)
    module = _module(path)
    if not hasattr(module, name):
        public = [key for key, value in vars(module).items()
                  if not key.startswith("_") and not isinstance(value, ModuleType)]  # fmt: skip
        hint = f" (nearest: {nearest(name, public)!r})" if public else ""
        raise ValueError(f"{path} has no {kind} {name!r}{hint}")
    return getattr(module, name)


def required(package: str, purpose: str, extra: str = "") -> ModuleType:
    """Import an optional package.

    Args:
        package: Its name.
        purpose: What needs it, the beginning of the message.
        extra: The extra of this project that brings it, by default of the same name.

    Raises:
        ValueError: It is not installed; the message says what to install.
    """
    try:
        return importlib.import_module(package)
    except ImportError as error:
        raise ValueError(
            f"{purpose} needs the package {package}, which is not installed: pip install"
            f" 'twirl-mjx[{extra or package}]' ({error})"
        ) from error


def _module(path: Path) -> ModuleType:
    name = f"_twirl_{path.stem}_{hashlib.sha256(str(path).encode()).hexdigest()[:8]}"
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ValueError(f"{path} is no Python file (nearest: a file that ends in .py)")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their module up
    sys.path.insert(0, str(path.parent))  # what lies beside the file can be imported
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:  # whatever a user's file may raise
        del sys.modules[name]
        what = " ".join(str(error).split())
        raise ValueError(f"{path} does not import: {type(error).__name__}: {what}") from error
    finally:
        sys.path.remove(str(path.parent))
    return module


class Registry[T]:
    """Things of one kind by name."""

    def __init__(
        self,
        kind: str,
        *,
        accept: Callable[[Any], T],
        group: str,
        shipped: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        """Make an empty registry.

        Args:
            kind: What messages call one of them, ``task`` say.
            accept: Returns the thing to keep for what was given; raises ValueError, saying what
                was expected, where it does not fit.
            group: Entry point group in which packages offer more.
            shipped: Name -> ``module:object`` of built-in ones that are loaded when they are asked
                for; others are registered where they are defined.
        """
        self.kind = kind
        self._accept = accept
        self._group = group
        self._shipped = dict(shipped)
        self._items: dict[str, T] = {}
        self._references: dict[str, str] = {}
        self._points: dict[str, importlib.metadata.EntryPoint] | None = None

    def register(self, item: Any) -> Any:
        """Add a thing under its ``name`` and return it; usable as a decorator.

        Raises:
            ValueError: It does not fit, or another one has that name.
        """
        self._add(item, None)
        return item

    def _add(self, item: Any, reference: str | None) -> str:
        where = f"{reference}: " if reference else ""
        try:
            accepted = self._accept(item)
        except ValueError as error:
            raise ValueError(f"{where}{error}") from None
        name: str = accepted.name  # type: ignore[attr-defined]
        known = self._find(name)
        home = self._references.get(name, "registered before")
        if reference and known is not None and _is_copy(reference, home):
            return name
        if known is not None and known != accepted:
            raise ValueError(
                f"{where}there is another {self.kind} called {name!r} ({home})"
                f" (nearest: {'my_' + name!r})"
            )
        self._items[name] = accepted
        if reference:
            self._references[name] = reference
        return name

    def admit(self, text: str) -> str:
        """Return the name of what a text names: a name, or a reference that is loaded now.

        Raises:
            ValueError: Nothing there, or nothing that fits; one line.
        """
        if is_reference(text):
            path, name = split(text, self.kind)
            return self._add(load(text, self.kind), f"{path}:{name}")
        if text not in self._shipped:
            self.get(text)
        return text

    def admit_if_fits(self, reference: str) -> str | None:
        """Return the name of what a reference names, None where that is of another kind.

        Raises:
            ValueError: There is nothing to load.
        """
        try:
            self._accept(load(reference))
        except ValueError:
            load(reference)  # refuses what cannot be loaded at all
            return None
        return self.admit(reference)

    def get(self, name: str) -> T:
        """Return the thing of that name.

        Raises:
            ValueError: Unknown name, with the nearest.
        """
        if self._find(name) is None and (point := self._entry_points().get(name)) is not None:
            self._add(point.load(), point.value)
            self._references.pop(name, None)  # it is found by its name, in every process
        if name not in self._items:
            check_choice(self.kind, name, self.names())
        return self._items[name]

    def names(self) -> tuple[str, ...]:
        """Return all names: the built-in ones, then what was registered or is installed."""
        return tuple(dict.fromkeys([*self._shipped, *self._items, *self._entry_points()]))

    def builtin_names(self) -> tuple[str, ...]:
        """Return the names of those that are loaded when they are asked for."""
        return tuple(self._shipped)

    def reference(self, name: str) -> str | None:
        """Return ``file.py:Name`` of a thing that came from a file, else None."""
        return self._references.get(name)

    def _find(self, name: str) -> T | None:
        """Return what is registered or shipped under a name, None where there is neither."""
        if name not in self._items and name in self._shipped:
            module, _, attribute = self._shipped[name].partition(":")
            self._items[name] = getattr(importlib.import_module(module), attribute)
        return self._items.get(name)

    def _entry_points(self) -> dict[str, importlib.metadata.EntryPoint]:
        if self._points is None:  # looking through all installed packages takes 0.05 s
            found = importlib.metadata.entry_points(group=self._group)
            self._points = {point.name: point for point in found}
        return self._points


def _is_copy(reference: str, other: str) -> bool:
    """Return whether two references name the same object of files with the same content."""
    if not is_reference(other):
        return False
    (path, name), (other_path, other_name) = split(reference), split(other)
    return name == other_name and files.checksum(path) == files.checksum(other_path)
