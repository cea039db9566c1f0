"""How far a rehearsal is from the ideal loop: its settings, their ranges and the paper's shifts."""

from __future__ import annotations

import dataclasses
from typing import Literal

from twirl_mjx.checks import check_range

CONTROL_HZ = 20

RANGES = {
    "latency_ms": (0.0, 200.0),
    "noise": (0.0, 20.0),
    "torque_limit": (0.1, 200.0),
    "leg_strength": (0.05, 1.0),
    "friction": (0.01, 4.0),
    "gravity": (0.01, 30.0),
    "payload": (-1.0, 10.0),
    "mass_error": (0.0, 0.5),
    "inertia_error": (0.0, 0.5),
    "encoder_delay_ms": (0.0, 20.0),
    "encoder_step": (0.0, 0.1),
    "incline_deg": (0.0, 20.0),
    "bump_height": (0.0, 0.1),
    "goal_speed": (0.0, 2.0),
    "hurdle_gap": (0.3, 10.0),
    "hurdle_height": (0.001, 0.2),
}
"""Lowest and highest values of a rehearsal's conditions, in the units of its fields."""

CONTACTS = {
    "plain": ((0.02, 1.0), (0.9, 0.95, 0.001)),
    "soft": ((0.03, 1.0), (0.85, 0.95, 0.002)),
    "hard": ((0.004, 1.0), (0.97, 0.995, 0.0005)),
}
"""Contact -> MuJoCo's ``solref`` (time constant in s, damping ratio) and ``solimp`` (least and
largest impedance, m of depth between them) of ground and bands; ``plain`` is its default."""


@dataclasses.dataclass(frozen=True)
class RehearsalConfig:
    """How far the rehearsal is from the ideal loop; the defaults are like the real robot's."""

    sim_dt: float = 0.001
    """Physics step, s; the control step of 0.05 s must be a multiple of it."""
    integrator: Literal["implicitfast", "implicit", "Euler", "RK4"] = "implicitfast"
    """How MuJoCo advances the state; training uses the first."""
    contact: Literal["plain", "soft", "hard"] = "plain"
    """How the ground and the bands give way; ``plain`` as in training."""
    latency_ms: float = 15.0
    """Time from reading the sensors to the motors' new targets, ms."""
    orientation_noise: float = 0.01
    """Standard deviation of the measured orientation per axis, rad."""
    rate_noise: float = 0.05
    """Standard deviation of the measured angular velocity, rad/s."""
    joint_noise: float = 0.005
    """Standard deviation of the measured joint angles, rad."""
    encoder_delay_ms: float = 0.0
    """Age of the joint angles and speeds that the motors' PD law and the policy get, ms."""
    encoder_step: float = 0.0
    """What their angles are rounded to a multiple of, rad; 0 rounds nothing."""
    position_noise: float = 0.005
    """Standard deviation of the estimated base position per reading, m."""
    velocity_noise: float = 0.05
    """Standard deviation of the estimated base velocity per axis, m/s; of foreign policies only."""
    joint_velocity_noise: float = 0.2
    """Standard deviation of the measured joint velocities, rad/s; of foreign policies only."""
    position_drift: float = 0.01
    """Random walk of the estimated base position, m per square root of a second."""
    noise: float = 1.0
    """Scale of all noise and drift."""
    torque_limit: float = 33.5
    """Motor torque limit, N m (URDF)."""
    full_torque_speed: float = 10.5
    """Joint speed up to which the full torque is available, rad/s; half the no-load speed."""
    no_load_speed: float = 21.0
    """Joint speed at which no torque is left to accelerate further, rad/s (URDF)."""
    kp: float = 60.0
    """Position gain, N m/rad."""
    kd: float = 3.0
    """Velocity gain, N m s/rad."""
    weak_leg: Literal["none", "FR", "FL", "RR", "RL"] = "none"
    """Leg whose motors are weak."""
    leg_strength: float = 0.5
    """Torque limit and gains of the weak leg, as a share of the others'."""
    friction: float = 1.0
    """Friction coefficient between feet and ground."""
    gravity: float = 9.81
    """Downward acceleration, m/s^2."""
    payload: float = 0.0
    """Mass added at the trunk's centre of mass, kg."""
    mass_error: float = 0.0
    """Largest error of a body's mass; per episode and body times U(1 - error, 1 + error)."""
    inertia_error: float = 0.0
    """The same of its moments of inertia, beside the error that its mass makes in them."""
    incline_deg: float = 0.0
    """Angle of the hill that begins 0.5 m ahead, deg."""
    bump_height: float = 0.0
    """Highest point of a ground of random bumps, m; not with hurdles, nor with a hill."""
    episode_s: float = 20.0
    """Length of an episode, s."""
    goal_distance: float | None = 1.0
    """Distance of the biped's goal, m, in a random direction; ``None`` draws it as in training."""
    goal_speed: float = 0.0
    """Speed of the biped's goal, m/s, straight on in a direction drawn per episode."""
    hurdle_gap: float | None = None
    """Distance between hurdles, m; ``None`` draws every gap from U(1.6, 2.6) m."""
    hurdle_height: float = 0.01
    """Height of a hurdle band, m; the paper's are 1 cm."""
    height_of: Literal["root", "front_feet"] = "front_feet"
    """Height that ``stand`` rewards."""

    def __post_init__(self) -> None:
        """Check the steps and ranges."""
        steps = 1.0 / (CONTROL_HZ * self.sim_dt) if self.sim_dt > 0.0 else 0.0
        if steps < 1.0 or abs(steps - round(steps)) > 1e-6:
            nearest = 1.0 / (CONTROL_HZ * max(1, round(steps or 50.0)))
            raise ValueError(
                f"sim_dt {self.sim_dt} s does not divide the control step of 0.05 s (nearest:"
                f" {nearest:.6g})"
            )
        if 2.0 * self.sim_dt > CONTACTS[self.contact][0][0]:
            raise ValueError(
                f"contact {self.contact} needs steps of at most {CONTACTS[self.contact][0][0] / 2}"
                f" s, sim_dt is {self.sim_dt} s (nearest: contact plain)"
            )
        if not 0.0 <= self.full_torque_speed < self.no_load_speed:
            raise ValueError(
                f"full_torque_speed {self.full_torque_speed} rad/s must be at least 0 and below "
                f"no_load_speed {self.no_load_speed} rad/s"
            )
        for name in (f.name for f in dataclasses.fields(self) if f.name.endswith("_noise")):
            if getattr(self, name) < 0.0:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}")
        for name, (low, high) in RANGES.items():
            if (value := getattr(self, name)) is not None:
                check_range(name, value, low, high)
        if self.bump_height and self.incline_deg:
            raise ValueError(
                f"bump_height {self.bump_height} m and incline_deg {self.incline_deg} exclude each"
                " other (nearest: incline_deg 0)"
            )

    @property
    def n_substeps(self) -> int:
        """Physics steps per control step."""
        return round(1.0 / (CONTROL_HZ * self.sim_dt))

    @property
    def latency_steps(self) -> int:
        """Latency in physics steps, rounded."""
        return round(0.001 * self.latency_ms / self.sim_dt)

    @property
    def encoder_steps(self) -> int:
        """Age of what the encoders say in physics steps, rounded."""
        return round(0.001 * self.encoder_delay_ms / self.sim_dt)


IDEAL = RehearsalConfig(
    latency_ms=0.0,
    orientation_noise=0.0,
    rate_noise=0.0,
    joint_noise=0.0,
    position_noise=0.0,
    velocity_noise=0.0,
    joint_velocity_noise=0.0,
    position_drift=0.0,
    full_torque_speed=1e6,
    no_load_speed=2e6,
    goal_distance=None,
)
"""No latency, no noise, torque limit only: the training task in C MuJoCo at 1 ms."""

SHIFTS: dict[str, dict[str, float | str]] = {
    "none": {},
    "bumpy": {"bump_height": 0.05},
    "icy": {"friction": 0.4},
    "weakened": {"weak_leg": "RR", "leg_strength": 0.5},
    "sloped": {"incline_deg": 8.0},
    "gravity": {"gravity": 3.7},
}
"""The paper's conditions as changes of a config (docs/shifts.md; the weak leg is always the same
one at its weakest, and motors do not heat)."""
LIVE = (
    "latency_ms", "torque_limit", "full_torque_speed", "no_load_speed", "kp", "kd", "weak_leg",
    "leg_strength", "friction", "gravity", "payload", "orientation_noise", "rate_noise",
    "joint_noise", "position_noise", "velocity_noise", "joint_velocity_noise", "position_drift",
    "noise", "episode_s",
)  # fmt: skip
"""Settings that may change while an episode runs; the others shape the scene or its score."""
