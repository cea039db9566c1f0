"""Every link of the pages leads to a file, and every committed result picture is shown by one."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("", "docs", "assets", "experiments")
PAGES = sorted(
    {p for f in FOLDERS for p in (ROOT / f).glob("*.md" if not f else "**/*.md")},
    key=str,
)
LINK = re.compile(r"\]\(([^)\s]+)\)")


def targets(page: Path) -> list[Path]:
    """Return the files a page links to, without anchors and addresses of the web."""
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.S)
    links = (link.split("#")[0] for link in LINK.findall(text))
    return [page.parent / link for link in links if link and "://" not in link]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_to_files(page: Path) -> None:
    missing = [str(t) for t in targets(page) if not t.exists()]
    assert missing == []


def test_links_are_found_at_all() -> None:
    assert len(PAGES) > 10
    assert sum(len(targets(page)) for page in PAGES) > 50


def test_every_result_picture_is_shown() -> None:
    shown = {target.resolve() for page in PAGES for target in targets(page)}
    pictures = set((ROOT / "docs" / "images" / "results").glob("*.png"))
    assert pictures and pictures <= shown


def test_the_front_page_stays_short() -> None:
    lines = (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
    assert len(lines) <= 115
    assert [line for line in lines if len(line) > 100] == []
