"""``twirl export``."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro

from twirl_mjx.commands.console import parse, say


@dataclasses.dataclass(frozen=True)
class ExportOptions:
    """Write a policy as an ONNX file, checked against the original before it is kept."""

    policy: Annotated[Path, tyro.conf.Positional]
    """Run directory or policy file (.npz)."""
    out: Path = Path("policy.onnx")
    """File to write."""


def main(argv: list[str]) -> int:
    """Export."""
    options = parse(ExportOptions, argv, "twirl export")
    from twirl_mjx.deploy.export import export_onnx

    say(f"wrote {export_onnx(options.policy, options.out)}")
    return 0
