"""Count GPU operations in the list of thunks that XLA writes with ``--xla_dump_to``.

Kernels, copies and library calls count as one operation each. Command buffers (CUDA graphs),
sequences and markers of asynchronous work hold others and count nothing themselves; a loop is
counted apart from what surrounds it, once and not per turn.
"""

from __future__ import annotations

import collections
import dataclasses
import re
from collections.abc import Iterator

CONTAINERS = {
    "kCommandBuffer",
    "kAsyncStart",
    "kAsyncDone",
    "kSequential",
    "kDynamicSliceFusion",
}
"""Thunks that launch nothing themselves."""
BRANCHES = {"kWhile", "kConditional"}
"""Thunks whose parts are blocks of their own."""

_THUNK = re.compile(r"^(\s*)\d{3,}: (k\w+)(.*)$")
_MARK = re.compile(r"^\s*(condition|body|\w*branch\w*|computation[^:]*):\s*$")
_INNER = re.compile(r"\d{3,}: (k\w+)")


@dataclasses.dataclass
class Block:
    """A run of operations without loops: a whole program, or one part of a loop."""

    name: str
    operations: collections.Counter[str] = dataclasses.field(default_factory=collections.Counter)
    """Kind of thunk -> how many are launched."""
    graphs: int = 0
    """CUDA graphs among them."""
    blocks: list[Block] = dataclasses.field(default_factory=list)
    """Parts of the loops and conditionals inside."""

    @property
    def count(self) -> int:
        """Operations that are launched."""
        return sum(self.operations.values())

    def walk(self, depth: int = 0) -> Iterator[tuple[int, Block]]:
        """Yield this block and all inside it, with their depths."""
        yield depth, self
        for block in self.blocks:
            yield from block.walk(depth + 1)

    def innermost(self) -> Block:
        """Return the deepest loop body, the first of several: the critic update of a learner."""
        bodies = [(depth, b) for depth, b in self.walk() if b.name == "body" or not depth]
        return max(bodies, key=lambda each: each[0])[1]


def parse(text: str) -> Block:
    """Return the blocks of a program.

    Args:
        text: Content of ``*.thunk_sequence_after_thunk_passes.txt``; a line is a thunk, and what
            it holds is indented below it.
    """
    program = Block("program")
    holders = [_Holder(-1, program)]
    mark = ""
    for line in text.splitlines():
        if marked := _MARK.match(line):
            mark = marked[1]
            continue
        if not (found := _THUNK.match(line)):
            continue
        indent, kind, rest = len(found[1]), found[2], found[3]
        while holders[-1].indent >= indent:
            holders.pop()
        holder = holders[-1]
        if mark and holder.branches:
            holder.block = Block(mark)
            holder.owner.blocks.append(holder.block)
        mark = ""
        block = holder.block
        block.graphs += kind == "kCommandBuffer"
        if kind == "kSequential" and (inner := _INNER.search(rest)):
            kind = inner[1]
        if kind not in CONTAINERS | BRANCHES:
            block.operations[kind] += 1
        holders.append(_Holder(indent, block, kind in BRANCHES))
    return program


class _Holder:
    """A thunk that others may follow inside."""

    def __init__(self, indent: int, block: Block, branches: bool = False) -> None:
        self.indent, self.branches = indent, branches
        self.owner = self.block = block
