"""Domain randomisation: leaves that are drawn anew for every episode (``dynamics.draw``)."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from twirl_mjx.sim.leaves import LEAF, SceneKind, check_leaf


@dataclasses.dataclass(frozen=True)
class Ranges:
    """The leaves that are drawn; without any it is false. Hashable, in the order of ``LEAVES``."""

    bounds: tuple[tuple[str, float, float], ...] = ()
    """(leaf, lowest, highest value)."""

    def __post_init__(self) -> None:
        """Check and sort.

        Raises:
            ValueError: A leaf is unknown or given twice; a bound is not a number or not within
                the leaf's range; the bounds are reversed.
        """
        checked: dict[str, tuple[str, float, float]] = {}
        for name, low, high in self.bounds:
            low = check_leaf("range of ", name, low)
            high = check_leaf("range of ", name, high)
            if name in checked:
                raise ValueError(f"range of {name} is given twice: give it once")
            if low > high:
                raise ValueError(
                    f"range {name}={low!r}:{high!r} is reversed (nearest: {name}={high!r}:{low!r})"
                )
            checked[name] = (name, low, high)
        object.__setattr__(self, "bounds", tuple(checked[name] for name in LEAF if name in checked))

    def __bool__(self) -> bool:
        """Return whether anything is drawn."""
        return bool(self.bounds)

    def texts(self) -> tuple[str, ...]:
        """Return what ``parse_ranges`` reads back, exactly."""
        return tuple(f"{name}={low!r}:{high!r}" for name, low, high in self.bounds)

    def check_scene(self, kind: SceneKind) -> None:
        """Refuse leaves that do nothing in a scene.

        Raises:
            ValueError: With the leaf and the kind of scene it needs.
        """
        for name, low, _ in self.bounds:
            check_leaf("range of ", name, low, kind)


NO_RANGES = Ranges()
"""Nothing is drawn."""


def parse_ranges(texts: Sequence[str]) -> Ranges:
    """Read ranges from texts such as ``friction=0.4:1.25``.

    Raises:
        ValueError: A text of another form, or a range that :class:`Ranges` refuses.
    """
    bounds = []
    for text in texts:
        name, equals, ends = text.partition("=")
        low, colon, high = ends.partition(":")
        try:
            bounds.append((name.strip(), float(low), float(high)))
        except ValueError:
            what = "is not a pair of numbers" if equals and colon else "is not a range"
            raise ValueError(
                f"{text!r} {what}: write leaf=low:high, for example friction=0.4:1.25"
            ) from None
    return Ranges(tuple(bounds))
