"""Read tidy result tables and refuse what is wrong with them.

Two kinds of table exist. A *curve* table has one row per metric and moment of training
(``metrics.csv`` of a run, ``experiments/results/<grid>/<arm>.csv``); an *episode* table has one row
per metric and evaluated episode (``eval.csv``). Both are plain CSV, so that every figure can be
rebuilt by anyone, without an accelerator and without the code that made the numbers.

Any further column is a *setting*: what tells apart arms that task, shift and variant do not, such
as ``phi``. Its cells are text, empty where an arm does not have it.

A table may open with comment lines ``# key: text``. Two keys mean something to the figures:
``reduced`` (the run was smaller than the paper's, and how) and ``command`` (the command that makes
the rows again). What more there is to know stands in ``grid.json`` beside the tables (``facts``).
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from twirl_mjx import files
from twirl_mjx.checks import choose_one
from twirl_mjx.figures.errors import TableError
from twirl_mjx.figures.facts import EVALUATION, Facts, read_facts, sort_key

CURVE_COLUMNS = (
    "run",
    "task",
    "shift",
    "variant",
    "seed",
    "metric",
    "env_steps",
    "grad_steps",
    "wall_s",
    "value",
)
"""Columns of a curve table; ``wall_s`` in seconds, the steps are counts."""

EPISODE_COLUMNS = (
    "run",
    "task",
    "shift",
    "variant",
    "seed",
    "env_steps",
    "episode",
    "metric",
    "value",
)
"""Columns of an episode table; ``env_steps`` is the age of the evaluated policy."""

ARM_COLUMN = "arm"
"""Column added while reading: the file name without its ending."""
LABEL_COLUMN = "label"
"""Column added for figures: what a line or bar stands for (``aggregate.labelled``)."""

_COUNTS = ("seed", "env_steps", "grad_steps", "episode")
_NUMBERS = ("wall_s", "value")
_ADDED = (ARM_COLUMN, LABEL_COLUMN)
_STANDARD = {*CURVE_COLUMNS, *EPISODE_COLUMNS}
RESERVED = frozenset({*_STANDARD, *_ADDED})
"""Columns that cannot be a setting."""


@dataclass(frozen=True)
class Note:
    """One comment line ``# key: text`` of a table."""

    arm: str
    """File name of the table without its ending."""
    key: str
    """What the note is about, for example ``reduced`` or ``command``; empty for free text."""
    text: str
    """The note itself."""


@dataclass(frozen=True)
class Table:
    """A validated table, column by column."""

    columns: Mapping[str, np.ndarray]
    """Name -> values [R]: text as str, counts as int64, value and wall time as float64."""
    notes: tuple[Note, ...] = ()
    """Comment lines, in reading order."""
    source: str = ""
    """The file or directory the rows came from, for error messages."""
    facts: Facts = field(default_factory=Facts)
    """What its folder says of axes and measures."""

    def __len__(self) -> int:
        return len(next(iter(self.columns.values()), ()))

    def __getitem__(self, column: str) -> np.ndarray:
        if column not in self.columns:
            known = list(self.columns)
            raise TableError(f"{self.source}: no column '{column}': {choose_one(column, known)}")
        return self.columns[column]

    @property
    def is_episodes(self) -> bool:
        """Whether a row is an evaluated episode (otherwise a moment of training)."""
        return "episode" in self.columns

    @property
    def settings(self) -> list[str]:
        """Columns of settings, in the order of the file."""
        return [name for name in self.columns if name not in RESERVED]


def read_table(path: str | Path) -> Table:
    """Read one CSV file of either kind and check every cell.

    NaN in ``value`` means "not measured" and is kept; infinities are refused.

    Args:
        path: The CSV file.

    Returns:
        The table, with the column ``arm`` added; it may have no rows.

    Raises:
        TableError: If the file is missing or empty, a column is missing, unknown or named twice,
            a row has another number of cells, or a cell is not the number it should be.
    """
    path = Path(path)
    notes = []
    try:
        text = files.read_text(path, "a result table")
        lines = io.StringIO(text, newline="").readlines()
        while lines and lines[0].startswith("#"):
            notes.append(_parse_note(path.stem, lines.pop(0)))
        rows = list(csv.reader(lines))
    except (csv.Error, files.FileError, FileNotFoundError) as error:
        message = str(error)
        raise TableError(message if str(path) in message else f"{path}: {message}") from error
    if not rows:
        raise TableError(f"{path}: empty file, expected the header {','.join(CURVE_COLUMNS)}")
    header = _check_header(path, rows[0])
    first_row = len(notes) + 2  # line number, counted from 1, of the first row below the header
    body = [(first_row + i, row) for i, row in enumerate(rows[1:]) if row]
    for line, row in body:
        if len(row) != len(header):
            raise TableError(f"{path}:{line}: {len(row)} cells, expected {len(header)} as above")
    line_numbers = [line for line, _ in body]
    columns = {
        name: _convert(path, name, [row[i].strip() for _, row in body], line_numbers)
        for i, name in enumerate(header)
    }
    columns[ARM_COLUMN] = np.full(len(body), path.stem)
    return Table(columns, tuple(notes), str(path))


def read_episodes(path: str | Path) -> Table:
    """Read an episode table (``eval.csv``); see ``read_table``.

    Raises:
        TableError: If the file is not a valid episode table.
    """
    table = read_table(path)
    if not table.is_episodes:
        raise TableError(f"{path}: a curve table, expected {','.join(EPISODE_COLUMNS)}")
    return table


def read_directory(directory: str | Path) -> tuple[Table | None, Table | None]:
    """Read every ``*.csv`` of a grid's directory, and what its ``grid.json`` says of them.

    Args:
        directory: ``experiments/results/<grid>``.

    Returns:
        The curve rows and the episode rows; None where there are none.

    Raises:
        TableError: If a file is not valid.
    """
    facts = read_facts(Path(directory))
    tables = [read_table(path) for path in sorted(Path(directory).glob("*.csv"))]
    filled = [table for table in tables if len(table)]
    kinds = ([t for t in filled if not t.is_episodes], [t for t in filled if t.is_episodes])
    curves, episodes = (
        _with_ratios(replace(concatenate(kind, source=str(directory)), facts=facts))
        if kind
        else None
        for kind in kinds
    )
    return curves, episodes


def concatenate(tables: Sequence[Table], *, source: str) -> Table:
    """Put tables of one kind below each other; a setting that one lacks is empty.

    Args:
        tables: At least one table.
        source: Name of the whole for error messages.

    Raises:
        TableError: If there is no table, or if curves and episodes would be mixed.
    """
    if not tables:
        raise TableError(f"{source}: no table to read")
    if len({table.is_episodes for table in tables}) > 1:
        raise TableError(f"{source}: curve and episode tables cannot be joined")
    names = list(dict.fromkeys(name for table in tables for name in table.columns))
    columns = {
        name: np.concatenate([t.columns.get(name, np.full(len(t), "")) for t in tables])
        for name in names
    }
    return Table(columns, tuple(note for table in tables for note in table.notes), source)


def mask(table: Table, rows: np.ndarray) -> Table:
    """Return the rows where the boolean array ``rows`` [R] holds; the notes stay."""
    return replace(table, columns={k: v[rows] for k, v in table.columns.items()})


def select(table: Table, **equals: object) -> Table:
    """Return the rows whose columns equal the given values.

    Args:
        table: Any table.
        **equals: column=value.

    Raises:
        TableError: If a column does not exist, or holds the value in no row of ``table``.
    """
    rows = np.ones(len(table), bool)
    for name, value in equals.items():
        hits = table[name] == value
        if not hits.any():
            known = unique(table, name)
            advice = choose_one(value, known)
            raise TableError(f"{table.source}: no row with {name} '{value}': {advice}")
        rows &= hits
    return mask(table, rows)


def unique(table: Table, column: str) -> list:
    """Return the distinct values of a column, sorted; numbers in text by their size."""
    return sorted(set(table[column].tolist()), key=sort_key)


def note_texts(table: Table, key: str) -> list[str]:
    """Return the distinct notes of one key, for arms that have rows in the table."""
    arms = set(unique(table, ARM_COLUMN))
    texts = (note.text for note in table.notes if note.key == key and note.arm in arms)
    return list(dict.fromkeys(texts))


def _parse_note(arm: str, line: str) -> Note:
    text = line.lstrip("#").strip()
    key, colon, rest = text.partition(":")
    if colon and key.replace("_", "").isalnum():
        return Note(arm, key.strip().lower(), rest.strip())
    return Note(arm, "reduced", "") if text.lower() == "reduced" else Note(arm, "", text)


def _check_header(path: Path, cells: Sequence[str]) -> list[str]:
    header = [cell.strip() for cell in cells]
    required = EPISODE_COLUMNS if "episode" in header else CURVE_COLUMNS
    for name in header:
        if header.count(name) > 1:
            raise TableError(f"{path}:header: column '{name}' appears {header.count(name)} times")
    for name in required:
        if name not in header:
            others = [column for column in header if column not in required]
            advice = choose_one(name, others)
            raise TableError(f"{path}:header: column '{name}' is missing: {advice}")
    for name in header:
        if not name or name in _ADDED or name in _STANDARD - {*required}:
            raise TableError(f"{path}:header: column '{name}' cannot be a setting of such a table")
    return header


def _convert(path: Path, name: str, cells: list[str], lines: list[int]) -> np.ndarray:
    if name not in _STANDARD:
        return np.array([_setting(cell) for cell in cells], dtype=str)
    if name not in _COUNTS and name not in _NUMBERS:
        return _check_text(path, name, cells, lines)
    try:
        values = np.array(cells, dtype=str).astype(np.float64)
    except ValueError:
        values = np.array([_number(path, name, *pair) for pair in zip(cells, lines, strict=True)])
    wrong = np.isinf(values)
    if name in _COUNTS:
        wrong |= ~((values >= 0) & (values <= 2**53) & (values == np.floor(values)))
    if wrong.any():
        i = int(np.argmax(wrong))
        wanted = "a whole number >= 0" if name in _COUNTS else "a finite number"
        raise TableError(f"{path}:{lines[i]}: {name} is '{cells[i]}', expected {wanted}")
    return values.astype(np.int64) if name in _COUNTS else values


def _number(path: Path, name: str, cell: str, line: int) -> float:
    try:
        return float(cell)
    except ValueError:
        raise TableError(f"{path}:{line}: {name} is '{cell}', expected a number") from None


def _setting(cell: str) -> str:
    """Return the label of a setting; numbers always written alike."""
    try:
        return f"{float(cell):g}"
    except ValueError:
        return cell


def _with_ratios(table: Table) -> Table:
    """Return the table with the rows of every measure that is the ratio of two others.

    A ratio is not measured (no row) where its denominator is not positive.
    """
    kept = [c for c in table.columns if c not in ("metric", "value")]
    keys = list(zip(*(table[c].tolist() for c in kept), strict=True))
    metric, value = table["metric"], table["value"]
    rows, names, values = [], [], []
    for name, measure in table.facts.measures.items():
        for prefix in ("", EVALUATION) if measure.ratio else ():
            top, below = (prefix + part for part in measure.ratio)
            under = {keys[i]: value[i] for i in np.flatnonzero(metric == below)}
            for i in np.flatnonzero(metric == top):
                if under.get(keys[i], 0.0) > 0:
                    rows.append(i)
                    names.append(prefix + name)
                    values.append(value[i] / under[keys[i]])
    if not rows:
        return table
    more = {c: v[rows] for c, v in table.columns.items()}
    more |= {"metric": np.array(names), "value": np.array(values)}
    joined = {c: np.concatenate([v, more[c]]) for c, v in table.columns.items()}
    return replace(table, columns=joined)


def _check_text(path: Path, name: str, cells: list[str], lines: list[int]) -> np.ndarray:
    for cell, line in zip(cells, lines, strict=True):
        if not cell:
            raise TableError(f"{path}:{line}: {name} is empty")
    return np.array(cells, dtype=str)
