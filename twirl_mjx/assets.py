"""Where the files under ``assets/`` are, in a checkout and in an installed wheel."""

from __future__ import annotations

from pathlib import Path

_PACKAGE = Path(__file__).resolve().parent
_ROOTS = (_PACKAGE / "_assets", _PACKAGE.parent / "assets")
"""Inside a wheel, and at the top level of a checkout; the first that has the file wins."""


def asset_path(*parts: str) -> Path:
    """Return the path of an asset file or folder.

    Args:
        *parts: Path components below ``assets/``, for example ``"policies", "stand.npz"``.

    Returns:
        The existing path.

    Raises:
        ValueError: If the components lead out of the assets folder.
        FileNotFoundError: If neither place has it; the message names both.
    """
    relative = Path(*parts)
    if relative.is_absolute() or ".." in relative.parts:
        raise ValueError(f"asset path {relative} must stay below the assets folder")
    candidates = [root / relative for root in _ROOTS]
    for candidate in candidates:
        if candidate.exists():
            return candidate
    places = " nor ".join(str(candidate) for candidate in candidates)
    raise FileNotFoundError(f"no asset {relative}: neither {places} exists")
