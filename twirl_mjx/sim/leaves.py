"""What of the physics may be changed, by name: the table of leaves, and named shifts of them.

Every quantity that a shift, an override or a randomisation may change is one row of ``LEAVES`` and
one field of ``dynamics.Dynamics``. Nothing here needs jax or MuJoCo, so that options are parsed
without them.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal, get_args

from etils import epy

from twirl_mjx.checks import check_choice, check_range
from twirl_mjx.plugins import Registry

with epy.lazy_imports():  # needed by worlds, not by options
    import numpy as np

if TYPE_CHECKING:
    from twirl_mjx.sim.scene import Scene

SceneKind = Literal["flat", "bumpy", "sloped"]
"""Ground geometry compiled into a scene; see ``sim.scene``."""
HILL_ANGLE = math.radians(8.0)
"""rad, hill of the ``sloped`` shift at strength 1."""


def _as_it_is(base: Any, value: Any, scene: Scene, xp: Any) -> Any:
    del base, scene, xp
    return value


def _added(base: Any, value: Any, scene: Scene, xp: Any) -> Any:
    del scene, xp
    return base + value


@dataclasses.dataclass(frozen=True)
class Place:
    """Where a value goes in a MuJoCo model, of C or of MJX."""

    field: str
    """Dotted name of the field."""
    index: Callable[[Scene], Any] | None = None
    """The entries to write, as a numpy index; without it the whole field."""
    entry: Callable[[Any, Any, Scene, Any], Any] = _as_it_is
    """(the scene's own entry, the value, the scene, numpy or jax.numpy) -> the new entry."""


def trunk(scene: Scene) -> int:
    """Return the id of the body that carries the free joint."""
    return int(scene.mj_model.jnt_bodyid[0])


def _down(base: Any, value: Any, scene: Scene, xp: Any) -> Any:
    del base, scene
    return value * xp.array([0.0, 0.0, -1.0])


def _hill(base: Any, value: Any, scene: Scene, xp: Any) -> Any:
    del base, scene
    half = -value / 2
    return xp.stack([xp.cos(half), 0.0 * half, xp.sin(half), 0.0 * half])


def _bumps(base: Any, value: Any, scene: Scene, xp: Any) -> Any:
    del base
    return xp.asarray(scene.bumps.ravel()) * (value / scene.mj_model.hfield_size[0, 2])


_GRAVITY = Place("opt.gravity", None, _down)
_FRICTION = Place("geom_friction", lambda s: (np.array(s.ground_geoms), 0))
_HILL = Place("geom_quat", lambda s: s.ground_geoms[1], _hill)
_BUMPS = Place("hfield_data", None, _bumps)
_MASSES = (
    Place("body_mass", trunk, _added),
    Place("body_subtreemass", lambda s: np.array([0, trunk(s)]), _added),  # the world's, its own
)
_COM_X, _COM_Y, _COM_Z = (
    Place("body_ipos", lambda s, axis=axis: (trunk(s), axis), _added) for axis in range(3)
)


@dataclasses.dataclass(frozen=True)
class Leaf:
    """One row of ``LEAVES``."""

    name: str
    nominal: float
    unit: str
    low: float
    """Lowest allowed value."""
    high: float
    """Highest allowed value."""
    about: str
    places: tuple[Place, ...] = ()
    """What of the MuJoCo model it is; nothing for what acts outside of the physics engine."""
    scene: SceneKind | None = None
    """The only kind of scene in which it acts; any by default."""


LEAVES: tuple[Leaf, ...] = (
    Leaf("gravity", 9.81, "m/s^2", 0.01, 30.0, "down the world z-axis", (_GRAVITY,)),
    Leaf("friction", 1.0, "1", 0.01, 4.0, "sliding friction of the ground", (_FRICTION,)),
    Leaf("leg_strength_min", 1.0, "1", 0.05, 1.0, "one random leg per episode gets U(this, 1)"),
    Leaf("heat_rate", 0.0, "K/(N^2 m^2 s)", 0.0, 1.0, "motor heat by squared torque and second"),
    Leaf("bump_height", 0.0, "m", 0.0, 0.1, "highest point of the bumps", (_BUMPS,), "bumpy"),
    Leaf("incline", 0.0, "rad", 0.0, 0.35, "angle of the hill", (_HILL,), "sloped"),
    Leaf("payload", 0.0, "kg", -1.0, 10.0, "mass added at the trunk's centre of mass", _MASSES),
    Leaf("com_x", 0.0, "m", -0.1, 0.1, "the trunk's centre of mass moved forwards", (_COM_X,)),
    Leaf("com_y", 0.0, "m", -0.1, 0.1, "the trunk's centre of mass moved to the left", (_COM_Y,)),
    Leaf("com_z", 0.0, "m", -0.1, 0.1, "the trunk's centre of mass moved up", (_COM_Z,)),
    Leaf("motor_strength", 1.0, "1", 0.05, 2.0, "scale of all torque limits"),
    Leaf("kp_scale", 1.0, "1", 0.05, 3.0, "scale of all position gains"),
    Leaf("kd_scale", 1.0, "1", 0.05, 3.0, "scale of all velocity gains"),
    Leaf("latency", 0.0, "s", 0.0, 0.05, "joint targets come late, by whole physics substeps"),
    Leaf("obs_noise", 0.0, "1", 0.0, 10.0, "scale of the Gaussian noise on what the policy sees"),
    Leaf("push", 0.0, "m/s", 0.0, 3.0, "the base is pushed in a random horizontal direction"),
    Leaf("push_interval", 5.0, "s", 0.05, 60.0, "time between pushes"),
)
"""Every leaf of :class:`Dynamics`, in its order."""
LEAF: Mapping[str, Leaf] = MappingProxyType({leaf.name: leaf for leaf in LEAVES})
"""The rows of ``LEAVES`` by name."""
NOMINAL_VALUES: Mapping[str, float] = MappingProxyType({x.name: x.nominal for x in LEAVES})


def check_leaf(what: str, name: str, value: Any, scene: SceneKind | None = None) -> float:
    """Return the value of a leaf as a float.

    Args:
        what: Start of the refusal, for example ``shift 'muddy': ``.
        name: Leaf.
        value: A number in its range.
        scene: Kind of scene it shall act in, any by default.

    Raises:
        ValueError: Unknown name, not a number, out of range, or without effect in that scene.
    """
    check_choice(f"{what}leaf", name, tuple(LEAF))
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ValueError(f"{what}{name} = {value!r} is not a number")
    leaf = LEAF[name]
    check_range(f"{what}{name}", value, leaf.low, leaf.high)
    if None not in (scene, leaf.scene) and scene != leaf.scene:
        raise ValueError(f"{what}{name} acts in a {leaf.scene} scene only, not in a {scene} one")
    return float(value)


@dataclasses.dataclass(frozen=True, init=False)
class Shift:
    """A named dynamics shift: some leaves away from nominal, in one kind of scene."""

    name: str
    scene: SceneKind
    about: str
    values: tuple[tuple[str, float], ...]
    """(leaf of Dynamics, value at strength 1)."""

    def __init__(
        self, name: str, *, scene: SceneKind = "flat", about: str = "", **leaves: float
    ) -> None:
        """Check and keep: ``Shift("muddy", friction=0.5, payload=1.5)``.

        Raises:
            ValueError: A name that is not one word, an unknown scene or leaf, or a value that is
                out of range or has no effect in the scene.
        """
        if not re.fullmatch(r"\w+", name):
            valid = re.sub(r"\W+", "_", name) or "mine"
            raise ValueError(f"shift name {name!r} is not one word (nearest: {valid!r})")
        check_choice(f"shift {name!r}: scene", scene, get_args(SceneKind))
        values = {k: check_leaf(f"shift {name!r}: ", k, v, scene) for k, v in leaves.items()}
        vars(self).update(name=name, scene=scene, about=about, values=tuple(values.items()))


def _accept(item: Any) -> Shift:
    if not isinstance(item, Shift):
        raise ValueError(f"{item!r} is no shift: expected an object of Shift")
    return item


SHIFTS: Registry[Shift] = Registry("shift", accept=_accept, group="twirl_mjx.shifts")
"""The one list of shifts."""

register_shift = SHIFTS.register
get_shift = SHIFTS.get
shift_names = SHIFTS.names

_PAPER = (
    Shift("none", about="training conditions"),
    Shift("bumpy", scene="bumpy", about="random heightfield, at most 0.05 m", bump_height=0.05),
    Shift("icy", about="friction 0.4", friction=0.4),
    Shift(
        "weakened",
        about="one random leg at U(0.5, 1) of its strength, motors derate as they heat",
        leg_strength_min=0.5,
        heat_rate=0.02,
    ),
    Shift("sloped", scene="sloped", about="8 degree hill 0.5 m ahead", incline=HILL_ANGLE),
    Shift("gravity", about="gravity 3.7 m/s^2", gravity=3.7),
)  # paper, section "Transfer to New Environments"
for _shift in _PAPER:
    register_shift(_shift)

PAPER_SHIFTS = tuple(_shift.name for _shift in _PAPER)
"""Nominal conditions and the five shifts of the paper, which evaluation goes through."""


def leaf_values(
    shift: str = "none",
    strength: float = 1.0,
    overrides: Mapping[str, float] = MappingProxyType({}),
) -> dict[str, float]:
    """Return the value of every leaf under a shift at a given strength.

    Args:
        shift: Name of a shift.
        strength: 0 is nominal, 1 the shift's own values, in [0, 2]; lines between and beyond.
        overrides: Leaves that get these values after the shift, whatever its strength.

    Raises:
        ValueError: Unknown shift or leaf, strength outside [0, 2], a value out of its range or
            without effect in the shift's scene.
    """
    check_range("shift_strength", strength, 0, 2)
    chosen, values = get_shift(shift), dict(NOMINAL_VALUES)
    for name, shifted in chosen.values:
        leaf = LEAF[name]
        value = leaf.nominal + strength * (shifted - leaf.nominal)
        if name == "leg_strength_min":
            value = max(value, leaf.low)
        if not leaf.low <= value <= leaf.high:
            end = leaf.low if value < leaf.low else leaf.high
            most = math.floor(1000 * (end - leaf.nominal) / (shifted - leaf.nominal)) / 1000
            raise ValueError(
                f"{shift} at strength {strength} gives {name} {value:.3g}, outside"
                f" [{leaf.low}, {leaf.high}] (nearest: strength {most})"
            )
        values[name] = value
    for name, value in overrides.items():
        values[name] = check_leaf("dynamics.", name, value, chosen.scene)
    return values
