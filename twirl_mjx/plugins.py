"""Objects of a user's own file: ``my_sink.py:MySink``."""

from __future__ import annotations

import hashlib
import importlib.util
import sys
from pathlib import Path
from types import ModuleType

from twirl_mjx.checks import check_choice


def is_reference(text: str) -> bool:
    """Return whether a text is a reference to a file's object, not a plain name."""
    return ".py:" in text


def load(reference: str) -> object:
    """Return the object ``FILE.py:NAME`` refers to; a file is run once in a process.

    Raises:
        ValueError: Not such a reference, no such file or name, or a file that does not import;
            one line that names the file, the object and what was expected.
    """
    file, _, name = reference.rpartition(":")
    if not file.endswith(".py") or not name.isidentifier():
        raise ValueError(f"{reference!r} is no reference to an object: expected FILE.py:NAME")
    path = Path(file).expanduser().resolve()
    if not path.is_file():
        raise ValueError(f"{reference}: there is no file {path}")
    module = _run(path, reference)
    public = tuple(key for key in vars(module) if not key.startswith("_"))
    check_choice(f"object in {path.name}", name, public)
    return getattr(module, name)


def _run(path: Path, reference: str) -> ModuleType:
    """Import a file under a name of its own; a class of it is the same class ever after."""
    name = f"{path.stem}_{hashlib.sha256(str(path).encode()).hexdigest()[:12]}"
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None, "a .py file has a loader"
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        del sys.modules[name]
        why = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise ValueError(f"{reference}: {path} does not import: {why}") from error
    return module
