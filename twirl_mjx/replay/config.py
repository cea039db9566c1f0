"""Settings of the mixed replay."""

from __future__ import annotations

import dataclasses

from twirl_mjx.checks import check_range


@dataclasses.dataclass(frozen=True)
class ReplayConfig:
    """The mixed replay (paper Alg. 1)."""

    phi: float = 0.5
    """Share of every minibatch drawn from source data; exactly round(phi * batch_size) rows."""
    capacity: int = 1_000_000
    """Transitions the online ring holds."""
    source_size: int = 50_000
    """Transitions of the source policy collected in the target task."""
    source_noise: bool = True
    """Collect with the exploration noise of a learned source, so that its data vary in action."""

    def __post_init__(self) -> None:
        """Check every number, or raise ValueError."""
        check_range("replay.phi", self.phi, 0.0, 1.0)
        check_range("replay.capacity", self.capacity, 1, 100_000_000)
        check_range("replay.source_size", self.source_size, 1, 100_000_000)
