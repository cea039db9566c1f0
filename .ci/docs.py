"""Lay the pages out for mkdocs, as they lie in the repository, with a page for every part's code.

Usage: ``python .ci/docs.py FOLDER``; the folder is made anew.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGES = ("*.md", "docs/**/*", "assets/**/*.md", "experiments/**/*", "examples/*", "tests/*.py",
         "twirl_mjx/**/*.py", "assets/a1/*", "LICENSE", ".ci/*", "pyproject.toml",
         "requirements.lock", "Makefile")  # fmt: skip
"""What pages are, and what they link to."""


def copy_pages(folder: Path) -> None:
    """Copy every page, and what pages link to."""
    for pattern in PAGES:
        for path in ROOT.glob(pattern):
            if path.is_file() and "__pycache__" not in path.parts:
                target = folder / path.relative_to(ROOT)
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(path, target)


def write_reference(folder: Path) -> None:
    """Write ``api/<part>.md`` for every module and folder of the package, and their list."""
    package, parts = ROOT / "twirl_mjx", {}
    for path in sorted(package.rglob("*.py")):
        words = path.relative_to(ROOT).with_suffix("").parts
        if words[-1] not in ("__init__", "__main__"):
            parts.setdefault(words[1], []).append(".".join(words))
    api = folder / "api"
    api.mkdir()
    for part, modules in parts.items():
        text = "\n\n".join(f"::: {module}" for module in modules)
        (api / f"{part}.md").write_text(f"# {part}\n\n{text}\n", encoding="utf-8")
    rows = "\n".join(f"- [{part}]({part}.md)" for part in parts)
    about = "What each part is for: [architecture](../docs/architecture.md)."
    (api / "index.md").write_text(f"# API reference\n\n{about}\n\n{rows}\n", encoding="utf-8")


def main() -> None:
    """Lay out the pages; a README is the index of its folder."""
    folder = Path(sys.argv[1])
    shutil.rmtree(folder, ignore_errors=True)
    copy_pages(folder)
    write_reference(folder)
    readme = folder / "README.md"
    readme.rename(folder / "index.md")
    for page in folder.rglob("*.md"):
        text = page.read_text(encoding="utf-8")
        page.write_text(text.replace("README.md)", "index.md)").replace("README.md#", "index.md#"),
                        encoding="utf-8")  # fmt: skip
    for page in list(folder.rglob("README.md")):
        page.rename(page.with_name("index.md"))


main()
