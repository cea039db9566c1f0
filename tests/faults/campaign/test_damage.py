"""Every file of a run is damaged: the run ends equal, or the file is named; nothing is silent."""

from __future__ import annotations

import random
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from twirl_mjx import faults

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]

KIND = "{} of a file of a {} run"
Damage = Callable[[Path, random.Random], None]


def flip(path: Path, rng: random.Random) -> None:
    content = bytearray(path.read_bytes())
    content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
    path.write_bytes(content)


def cut(path: Path, rng: random.Random) -> None:
    path.write_bytes(path.read_bytes()[: rng.randrange(path.stat().st_size)])


def empty(path: Path, rng: random.Random) -> None:
    path.write_bytes(b"")


def gone(path: Path, rng: random.Random) -> None:
    path.unlink()


DAMAGES: dict[str, Damage] = {
    "flip": flip, "truncation": cut, "loss of content": empty, "loss": gone,
}  # fmt: skip


@pytest.mark.parametrize("state", ["finished", "stopped"])
@pytest.mark.parametrize("damage", DAMAGES)
def test_damage(
    damage: str, state: str, small: Any, tally: Any, spread: Any, tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    """A file that is named as damaged is as good as an equal end; a third end is silent.

    ``metrics.csv`` is a log without checksum: a digit that was changed stays so.
    """
    whole = tmp_path / "whole" / "a"
    shutil.copytree(small.runs / "a", whole)
    if state == "stopped":  # as it was before its last evaluation
        for name in ("eval.csv", "eval.sums.json"):
            (whole / name).unlink()
    names = sorted(str(p.relative_to(whole)) for p in whole.rglob("*") if p.is_file())
    rng, harm, kind = random.Random(damage), DAMAGES[damage], KIND.format(damage, state)
    for number, name in enumerate(spread(names)):
        runs = tmp_path / f"{number:04d}"
        shutil.copytree(whole.parent, runs)
        if not (runs / "a" / name).stat().st_size and harm is not gone:
            continue
        harm(runs / "a" / name, rng)
        capsys.readouterr()
        try:
            equal = small.ends_equal(runs, but="metrics" if name == "metrics.csv" else "")
        except Exception as error:
            text = faults.explain(error).text
            clear = "a fault of this program" not in text and str(runs / "a") in text
            tally.add(kind, "refused clearly" if clear else "fell short", f"{name}: {text}")
            continue
        named = name in "".join(capsys.readouterr().out.split())  # the terminal breaks lines
        outcome = "survived equal" if equal else "refused clearly" if named else "fell short"
        tally.add(kind, outcome, f"{name} in {runs}: another end, and nothing said")
        shutil.rmtree(runs)
    tally.check()
