"""Objects of a user's own file."""

from __future__ import annotations

from pathlib import Path

import pytest

from twirl_mjx import plugins


def test_an_object_is_loaded_once(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text(
        "import dataclasses\n@dataclasses.dataclass\nclass Options:\n    speed: float = 1.5\n"
    )
    kind = plugins.load(f"{file}:Options")
    assert kind().speed == 1.5  # type: ignore[operator]
    assert plugins.load(f"{tmp_path}/../{tmp_path.name}/mine.py:Options") is kind
    assert plugins.is_reference(f"{file}:Options")
    assert not plugins.is_reference("wandb")


@pytest.mark.parametrize(
    ("reference", "message"),
    [
        ("mine", "'mine' does not say which object: expected FILE.py:NAME"),
        ("mine.py:", "expected FILE.py:NAME"),
        ("mine.txt:Name", "expected FILE.py:NAME"),
        ("{folder}/none.py:Name", "there is no file .*none.py"),
        ("{folder}/broken.py:Name", r"broken.py does not import: ZeroDivisionError: division"),
        ("{folder}/syntax.py:Name", r"syntax.py does not import: SyntaxError: .*line 2"),
        ("{folder}/exits.py:Name", "exits.py does not import: SystemExit: 3"),
        ("{folder}/good.py:Nam", r"good.py has no object 'Nam' \(nearest: 'Name'\)"),
    ],
)
def test_what_cannot_be_loaded_is_one_line(reference: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "broken.py").write_text("1 / 0\n")
    (tmp_path / "syntax.py").write_text("\nclass\n")
    (tmp_path / "exits.py").write_text("raise SystemExit(3)\n")
    (tmp_path / "good.py").write_text("Name = 1\n")
    with pytest.raises(ValueError, match=message) as refusal:
        plugins.load(reference.format(folder=tmp_path))
    assert "\n" not in str(refusal.value)


def test_the_same_file_in_another_place_is_the_same_thing(tmp_path: Path) -> None:
    registry = plugins.Registry("shift", accept=lambda item: item, group="none")
    text = "class Mud:\n    name = 'mud'\n"
    for folder in ("here", "there", "other"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "mine.py").write_text(text)
    (tmp_path / "other" / "mine.py").write_text(text + "    depth = 1\n")
    assert registry.admit(f"{tmp_path}/here/mine.py:Mud") == "mud"
    first = registry.get("mud")
    assert registry.admit(f"{tmp_path}/there/mine.py:Mud") == "mud"
    assert registry.get("mud") is first
    with pytest.raises(ValueError, match=r"other/mine.py:Mud: there is another shift called 'mud'"):
        registry.admit(f"{tmp_path}/other/mine.py:Mud")
