"""What lies in a folder of runs, read without jax: names, states, best returns, sizes.

Nothing here judges whether a run may go on; that is ``rundir.RunDir.status``.
"""

from __future__ import annotations

import csv
import dataclasses
import io
import re
import shutil
import time
from collections.abc import Collection, Iterable, Iterator, Sequence
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, Literal

from twirl_mjx import files
from twirl_mjx.checks import check_choice, choose_one
from twirl_mjx.machine import try_lock
from twirl_mjx.plugins import MINARI, is_reference

State = Literal["running", "finished", "stopped", "empty", "damaged"]
STATES: tuple[State, ...] = ("running", "finished", "stopped", "empty", "damaged")
"""A process works there; closed by its evaluation; can be resumed; nothing done yet; no config."""
CONFIG, METRICS, EPISODES = "config.json", "metrics.csv", "eval.csv"
CHECKPOINTS, DATASET = "checkpoints", "source.npz"
PRUNED = (CHECKPOINTS, DATASET)
"""What a finished run can do without: training states with the replay, and collected experience."""


@dataclasses.dataclass(frozen=True)
class Overview:
    """One run as it lies on disk."""

    path: Path
    """Its directory."""
    state: State
    """See ``STATES``."""
    settings: dict[str, Any]
    """Its config, flat, by public names; empty when that cannot be read."""
    env_steps: int
    """Transitions so far."""
    best_return: float | None
    """Highest mean return of an evaluation while it trained, or of the closing one."""
    measures: dict[str, float]
    """Means over the closing episodes."""
    wall_s: float
    """s, time it has trained."""
    changed: float
    """Time of the newest change, s since the epoch."""
    size: int
    """Bytes of all its files."""
    prunable: int
    """Bytes of ``PRUNED`` among them."""

    @property
    def name(self) -> str:
        """Name of the run."""
        return self.path.name

    def setting(self, name: str) -> Any:
        """Return a setting, ``?`` where it is not known."""
        return self.settings.get(name, "?")


def known(folder: Path) -> list[Path]:
    """Return the run directories of a folder, by name."""
    return sorted(path.parent for path in folder.glob(f"*/{CONFIG}"))


def condition(word: str) -> tuple[str, str] | None:
    """Return setting and value of a word such as ``task:biped``, None where it is no such word."""
    match = re.fullmatch(r"([a-z][a-z0-9_.]*):([^/]+)", word)
    if match is None or is_reference(word) or word.startswith(MINARI) or Path(word).exists():
        return None
    return match[1], match[2]


def find(folder: Path, words: Sequence[str] = ()) -> list[Path]:
    """Return the run directories that words select; without words all of a folder.

    A word is a name, a shell pattern of names, the path of a run directory, or a condition:
    ``task:biped``, ``status:finished``, ``droq.utd:0.5``, ``name:*-s0``. All conditions hold.

    Raises:
        FileNotFoundError: A name or pattern matches nothing; the message has the nearest.
        ValueError: A condition on what no run has; the message has the nearest.
    """
    conditions = [pair for word in words if (pair := condition(word))]
    found: dict[Path, None] = {}
    names = [word for word in words if not condition(word)]
    for name in names:
        path = Path(name)
        here = [path] if (path / CONFIG).exists() else _matching(folder, name)
        if not here:
            choices = choose_one(path.name, [p.name for p in known(folder)])
            raise FileNotFoundError(f"no run {name!r} in {folder}: {choices}")
        found |= dict.fromkeys(here)
    chosen = list(found) if names else known(folder)
    facts = {path: _facts(path) for path in chosen} if conditions else {}
    asked = tuple(dict.fromkeys(key for fact in facts.values() for key in fact))
    for key, value in conditions if chosen else ():
        check_choice("condition on runs", key, asked)
        chosen = [path for path in chosen if fnmatch(str(facts[path].get(key)), value)]
    return chosen


def _matching(folder: Path, pattern: str) -> list[Path]:
    return [p for p in known(folder) if fnmatch(p.name, pattern) or fnmatch(str(p), pattern)]


def _facts(path: Path) -> dict[str, Any]:
    """Return what conditions may ask of a run."""
    settings = _settings(path / CONFIG)
    return {"name": path.name, "status": _state(path, settings)} | settings


def expand(words: Sequence[str], folder: Path, but: Collection[str] = ()) -> list[str]:
    """Return policies to load: words that select runs give way to the paths of these.

    Args:
        words: Names, patterns and conditions as in :func:`find`; whatever else there is stays.
        folder: Of all runs.
        but: Names of something else.

    Raises:
        FileNotFoundError: Conditions, and no run that fits.
        ValueError: A condition on what no run has.
    """
    conditions = [word for word in words if condition(word)]
    names = [
        word
        for word in words
        if word not in (*conditions, *but) and not Path(word).exists() and _matching(folder, word)
    ]
    selected = list(map(str, find(folder, [*names, *conditions]))) if names or conditions else []
    if conditions and not selected:
        raise FileNotFoundError(f"no run in {folder} fits {' '.join([*names, *conditions])}")
    out: list[str] = []
    for word in words:
        out += selected if word in (*names, *conditions) else [word]
    return list(dict.fromkeys(out))


def look(path: Path) -> Overview:
    """Return how a run stands."""
    settings = _settings(path / CONFIG)
    state, measures = _state(path, settings), means(path / EPISODES)
    last, best = _curve(path / METRICS)
    closing = measures.get("return")
    sizes = {p: p.stat() for p in path.rglob("*") if p.is_file() and not p.is_symlink()}
    closed = _first_row(path / EPISODES)
    return Overview(
        path=path,
        state=state,
        settings=settings,
        env_steps=int(float((closed if state == "finished" else last).get("env_steps", 0))),
        best_return=max((v for v in (best, closing) if v is not None), default=None),
        measures=measures,
        wall_s=float(last.get("wall_s", 0.0)),
        changed=max((s.st_mtime for s in sizes.values()), default=path.stat().st_mtime),
        size=sum(s.st_size for s in sizes.values()),
        prunable=sum(s.st_size for p, s in sizes.items() if p.relative_to(path).parts[0] in PRUNED),
    )


def _state(path: Path, settings: dict[str, Any]) -> State:
    return "running" if is_held(path) else _standing(path, settings)


def _standing(path: Path, settings: dict[str, Any]) -> State:
    """Return how a run stands in which nobody works."""
    if not settings:
        return "damaged"
    closed = _first_row(path / EPISODES)
    if closed and not _goes_on(settings, int(float(closed.get("env_steps") or 0))):
        return "finished"
    work = (CHECKPOINTS, METRICS, DATASET)
    return "stopped" if any((path / name).exists() for name in work) else "empty"


def _goes_on(settings: dict[str, Any], closed_at: int) -> bool:
    """Return whether a run that was closed has been given more transitions since."""
    budget = settings.get("total_env_steps", 0)
    is_trained = settings.get("variant") != "zero-shot"
    return is_trained and isinstance(budget, int) and budget > closed_at


def is_held(path: Path) -> bool:
    """Return whether a process works in a run directory."""
    lock = path / ".lock"
    if not lock.is_file():
        return False
    with lock.open() as file:
        return not try_lock(file, shared=True)


def _settings(path: Path) -> dict[str, Any]:
    try:
        record = files.read_json(path, "the config of a run")
    except (OSError, ValueError):  # shown as damaged
        return {}
    return dict(_flat(record)) if isinstance(record, dict) else {}


def _flat(record: dict[str, Any], before: str = "") -> Iterable[tuple[str, Any]]:
    for key, value in record.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{before}{key}.")
        else:
            yield f"{before}{key}", value


def means(path: Path) -> dict[str, float]:
    """Return the means of a table of episodes by measure; empty where there is none."""
    if not path.is_file():
        return {}
    values: dict[str, list[float]] = {}
    for row in _rows(path):
        values.setdefault(row["metric"], []).append(float(row["value"]))
    return {name: sum(column) / len(column) for name, column in values.items()}


def _curve(path: Path) -> tuple[dict[str, str], float | None]:
    """Return the last row of a run's metrics and the best mean return of an evaluation."""
    if not path.is_file():
        return {}, None
    last: dict[str, str] = {}
    best: float | None = None
    for row in _rows(path):
        if row["value"] in (None, ""):  # being written
            break
        last = row
        if row["metric"] == "eval/return":
            value = float(row["value"])
            best = value if best is None else max(best, value)
    return last, best


def _rows(path: Path) -> Iterator[dict[str, str]]:
    """Yield the rows of a table; the last may be cut where it is being written."""
    text = files.read_text(path, "a table of a run", files.SIZE_LIMIT)
    return iter(csv.DictReader(io.StringIO(text, newline="")))


def _first_row(path: Path) -> dict[str, str]:
    if not path.is_file():
        return {}
    return next(_rows(path), {})


def differences(runs: Sequence[Overview]) -> dict[str, list[Any]]:
    """Return the settings in which runs differ: name -> value in every run, None where unknown."""
    names = dict.fromkeys(name for run in runs for name in run.settings)
    rows = {name: [run.settings.get(name) for run in runs] for name in names}
    return {name: row for name, row in rows.items() if any(v != row[0] for v in row[1:])}


def prune(run: Overview) -> int:
    """Delete what a finished run can do without; never a policy, table or config.

    Whether it is finished is looked at again once nobody else can work there.

    Returns:
        Bytes that were deleted.

    Raises:
        ValueError: The run is not finished: it could not be resumed any more.
        RuntimeError: A process works there.
    """
    if run.state != "finished":
        raise ValueError(f"{run.path} is {run.state}, and only finished runs are pruned")
    with (run.path / ".lock").open("a+") as file:
        if not try_lock(file):
            raise RuntimeError(f"{run.path} is in use by another process")
        if (now := _standing(run.path, _settings(run.path / CONFIG))) != "finished":
            raise ValueError(f"{run.path} is {now}, and only finished runs are pruned")
        for name in PRUNED:
            target = run.path / name
            if target.is_symlink() or target.is_file():
                target.unlink()
            elif target.is_dir():
                shutil.rmtree(target)
    return run.prunable


def age(seconds: float) -> str:
    """Return a time span briefly: 40 s, 5 min, 3 h, 12 d."""
    for limit, unit, name in ((120, 1, "s"), (7200, 60, "min"), (172_800, 3600, "h")):
        if seconds < limit:
            return f"{seconds / unit:.0f} {name}"
    return f"{seconds / 86_400:.0f} d"


def age_of(run: Overview) -> str:
    """Return how long ago a run changed."""
    return age(max(0.0, time.time() - run.changed))


def size_text(count: int) -> str:
    """Return a number of bytes briefly: 3 kB, 12 MB, 0.8 GB."""
    for limit, unit, form in ((1e6, "kB", "{:.0f}"), (1e8, "MB", "{:.0f}"), (1e12, "GB", "{:.1f}")):
        if count < limit:
            return f"{form.format(count / {'kB': 1e3, 'MB': 1e6, 'GB': 1e9}[unit])} {unit}"
    return f"{count / 1e12:.1f} TB"
