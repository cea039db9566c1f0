"""Settings of the leap (see ``leap``)."""

from __future__ import annotations

from dataclasses import dataclass

from twirl_mjx.sim.robots import A1

ROBOT = A1
"""The only robot the leap planner knows: its start, bounds and weights were tried for this one."""


@dataclass(frozen=True)
class LeapConfig:
    """What the leap shall be like; the defaults made the shipped clip."""

    speed: float = 1.68
    """m/s, mean forward speed."""
    cycle_length: float = 2.1
    """m from one leap to the next: the mean hurdle spacing of the paper."""
    flight_time: float = 0.33
    """s with all four feet off the ground during the leap; the centre of mass is ballistic."""
    run_up_strides: int = 2
    """Short bounds between landing and take-off, the landing one included."""
    band_length: float = 0.3
    """m, length of the strip of ground under the leap that every foot must clear by
    ``foot_clearance``: a hurdle's 0.2 m and room for a badly timed take-off."""
    foot_clearance: float = 0.06
    """m, least height of the feet's lowest point over that strip."""
    run_up_foot_height: float = 0.1
    """m, lower bound of the inner control points of the feet's height in every swing."""
    max_pitch: float = 0.35
    """rad, largest nose-up or nose-down angle."""
    friction: float = 0.5
    """Largest ratio of horizontal to vertical ground force."""
    torque_share: float = 0.8
    """Share of the motors' torque limit the plan may use."""
    frame_rate: float = 80.0
    """Frames per second of plan and clip; the nearest rate with whole frames is taken."""

    def __post_init__(self) -> None:
        """Check ranges.

        Raises:
            ValueError: a value is outside the range in which the planner was tried.
        """
        ranges = {
            "speed": (1.2, 2.4),
            "cycle_length": (1.4, 3.2),
            "flight_time": (0.2, 0.5),
            "run_up_strides": (1, 4),
            "band_length": (0.2, 0.5),
            "foot_clearance": (0.02, 0.15),
            "run_up_foot_height": (0.0, 0.2),
            "max_pitch": (0.1, 0.8),
            "friction": (0.2, 1.0),
            "torque_share": (0.3, 1.0),
            "frame_rate": (50.0, 200.0),
        }
        for name, (low, high) in ranges.items():
            value = getattr(self, name)
            if not low <= value <= high:
                nearest = low if value < low else high
                raise ValueError(f"{name} {value} is outside [{low}, {high}] (nearest: {nearest})")
        ground = self.duration - self.flight_time
        if not 0.2 <= ground / (1 + self.run_up_strides) <= 0.5:
            raise ValueError(
                f"a cycle of {self.cycle_length} m at {self.speed} m/s leaves {ground:.2f} s for "
                f"{self.run_up_strides + 1} bounds beside the flight of {self.flight_time} s; "
                "0.2 to 0.5 s each are needed: change run_up_strides, speed or cycle_length"
            )

    @property
    def duration(self) -> float:
        """Duration of a cycle in s."""
        return self.cycle_length / self.speed

    @property
    def num_frames(self) -> int:
        """Frame intervals in a cycle."""
        return round(self.duration * self.frame_rate)
