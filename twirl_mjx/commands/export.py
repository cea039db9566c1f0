"""``twirl export``."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro

from twirl_mjx.commands.console import parse, say
from twirl_mjx.commands.selection import the_one


@dataclasses.dataclass(frozen=True)
class ExportOptions:
    """Write a policy as an ONNX file, checked against the original, and its contract.json."""

    policy: Annotated[str, tyro.conf.Positional]
    """Run (name or directory) or policy file (.npz)."""
    out: Path = Path("policy.onnx")
    """File to write; contract.json, which says how the policy meets its robot, goes beside it."""
    robot: str = ""
    """Robot of the policy, by name or file.py:NAME; that on its card by default."""
    overwrite: bool = False
    """Replace files that are not exports of this policy."""


def main(argv: list[str]) -> int:
    """Export."""
    options = parse(ExportOptions, argv, "twirl export")
    from twirl_mjx.deploy.export import export

    policy = Path(the_one(options.policy))
    done = export(policy, options.out, robot=options.robot, overwrite=options.overwrite)
    say(f"wrote {done.onnx}")
    say(f"wrote {done.contract}" if done.contract else f"no contract: {done.why}")
    return 0
