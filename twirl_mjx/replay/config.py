"""Settings of the mixed replay."""

from __future__ import annotations

import dataclasses
from typing import Final, Literal

from twirl_mjx.checks import check_range

AUTO: Final = "auto"
"""Phi that chooses itself, by the rule of ``replay.share``."""
Phi = float | Literal["auto"]


@dataclasses.dataclass(frozen=True)
class ReplayConfig:
    """The mixed replay (paper Alg. 1)."""

    phi: Phi = 0.5
    """Share of every minibatch drawn from source data; exactly round(phi * batch_size) rows.
    auto: between 0.05 and 0.75, more while source episodes earn more than the newest ones."""
    capacity: int = 1_000_000
    """Transitions the online ring holds."""
    source_size: int = 50_000
    """Transitions of the source policy collected in the target task."""
    source_noise: bool = True
    """Collect with the exploration noise of a learned source, so that its data vary in action."""

    def __post_init__(self) -> None:
        """Check every number, or raise ValueError."""
        if isinstance(self.phi, str):
            if self.phi != AUTO:
                raise ValueError(
                    f"replay.phi = {self.phi!r} is neither a number in [0, 1] nor {AUTO!r}"
                    f" (nearest: {AUTO!r})"
                )
        else:
            check_range("replay.phi", self.phi, 0.0, 1.0)
        check_range("replay.capacity", self.capacity, 1, 100_000_000)
        check_range("replay.source_size", self.source_size, 1, 100_000_000)
