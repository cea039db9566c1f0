"""How a policy meets a robot: what it is shown, and what its outputs mean.

A contract is data: JSON (``contract.json``), or the metadata property ``twirl_contract`` of an ONNX
file. ``meeting`` acts on one; ``ready`` has those of layouts that many policies share. The format,
version 1, is documented in ``docs/sources.md``.
"""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from twirl_mjx import files, records
from twirl_mjx.checks import check_choice, check_range, nearest
from twirl_mjx.sim.robot import Robot

FORMAT = "twirl_mjx contract"
FORMAT_VERSION = 1
METADATA_KEY = "twirl_contract"
"""Name of the ONNX metadata property that holds a contract as JSON."""
WHAT = "a policy contract"
TEXT_LIMIT = 4 << 20
"""Bytes, largest contract that is read."""

Numbers = float | tuple[float, ...]
"""One number for all components, or one each."""


class ContractError(ValueError):
    """A contract that cannot be, or that does not fit; the message says why."""


class Word(NamedTuple):
    """A quantity that a policy may be shown."""

    size: int | Literal["joints", "commands", "gait", "any"]
    unit: str
    about: str


VOCABULARY: dict[str, Word] = {
    "base_lin_vel": Word(3, "m/s", "linear velocity of the base, body frame"),
    "base_ang_vel": Word(3, "rad/s", "angular velocity of the base, body frame"),
    "projected_gravity": Word(3, "1", "direction of gravity, body frame; (0, 0, -1) when level"),
    "commands": Word("commands", "m/s, rad/s", "what is asked for: forward, left, yaw rate, ..."),
    "joint_pos_rel": Word("joints", "rad", "joint angles minus the default pose"),
    "joint_pos": Word("joints", "rad", "joint angles"),
    "joint_vel": Word("joints", "rad/s", "joint velocities"),
    "previous_action": Word("joints", "1", "the policy's last output, zero at reset"),
    "gait_sin": Word("gait", "1", "sine of every gait clock"),
    "gait_cos": Word("gait", "1", "cosine of every gait clock"),
    "time_step": Word(1, "1", "the policy's own control steps since reset"),
    "time": Word(1, "s", "time since reset"),
    "constant": Word("any", "1", "zeros; -scale x offset is what the policy sees"),
    "roll_pitch": Word(2, "rad", "roll and pitch of the base (ZYX)"),
    "roll_pitch_rate_b": Word(2, "rad/s", "first two parts of base_ang_vel"),
    "base_displacement_w": Word(3, "m", "way of the base since reset, world frame"),
    "goal_displacement_w": Word(2, "m", "from the base to the task's goal, world frame"),
    "base_x_axis_w": Word(3, "1", "forward axis of the base, world frame"),
    "base_z_axis_w": Word(3, "1", "upward axis of the base, world frame"),
    "base_quat_h": Word(4, "1", "orientation of the base without its yaw, w x y z, w >= 0"),
    "target_base_displacement_h": Word(3, "m", "from the base to that of the motion, heading"),
    "target_base_quat_h": Word(4, "1", "orientation of the motion's base, seen from the heading"),
    "target_joint_pos": Word("joints", "rad", "joint angles of the motion"),
}
"""Every term that ``meeting`` can fill; heading: the world turned by the base's yaw."""
OF_MOTION = "target_"
"""How the words begin that show a contract's motion."""


@dataclasses.dataclass(frozen=True)
class Term:
    """One part of an observation; the policy sees ``clip(scale * (value - offset))``."""

    name: str
    """A word of ``VOCABULARY``."""
    size: int
    """Numbers per control step."""
    scale: Numbers = 1.0
    offset: Numbers = 0.0
    clip: tuple[float, float] | None = None
    """Lowest and highest number shown, after scaling."""
    history: int = 1
    """Control steps shown; before the first one, the first one repeated."""
    ahead: int = 0
    """Control steps from now, of a word about the motion."""


@dataclasses.dataclass(frozen=True)
class Action:
    """What an output means: the joint target is ``scale * output``, around the pose or not."""

    kind: Literal["offset", "absolute"] = "offset"
    """Around the default pose, or an angle."""
    scale: Numbers = 1.0
    """rad per unit of output."""
    clip: tuple[float, float] | None = None
    """Outputs are clipped to this before scaling."""


@dataclasses.dataclass(frozen=True)
class Gains:
    """Gains the policy was trained with: information, the target world has its own."""

    kp: Numbers
    """N m/rad."""
    kd: Numbers
    """N m s/rad."""


@dataclasses.dataclass(frozen=True)
class Lowpass:
    """A second-order filter on the joint targets, at rest at the measured angles at reset.

    ``y = b0 x + b1 x' + b2 x" - a1 y' - a2 y"``, once per control step; information, the target
    world has its own.
    """

    cutoff_hz: float
    """Hz."""
    b: tuple[float, float, float]
    """Of the targets: now, one and two steps ago."""
    a: tuple[float, float, float]
    """Of what came out, the first one 1."""


@dataclasses.dataclass(frozen=True)
class Motion:
    """A motion that a policy was trained to follow, cycle after cycle.

    Its clock starts at reset; then, and whenever a cycle begins, the motion is moved to where the
    base is (x and y).
    """

    frame_dt: float
    """s between frames; the last frame is the first one of the next cycle."""
    frames: tuple[tuple[float, ...], ...]
    """[F, 7 + J] position in m, orientation w x y z, rad in the order of ``joints``."""
    start: float = 0.0
    """s, time within the motion at reset."""
    travels: bool = True
    """Whether a cycle begins at the (x, y) where the last one ended."""
    turns: bool = False
    """Whether it begins with the heading with which the last one ended."""


@dataclasses.dataclass(frozen=True)
class Contract:
    """How one policy meets a robot."""

    name: str
    """What it is called."""
    control_dt: float
    """s, control step of the policy."""
    observation: tuple[Term, ...]
    """In the order of the input."""
    joints: tuple[str, ...]
    """[J] names in the policy's order, with or without ``_joint``."""
    default_pose: tuple[float, ...]
    """[J] rad, in the order of ``joints``."""
    action: Action = Action()
    """Meaning of the output [J], in the order of ``joints``."""
    history_layout: Literal["term", "frame"] = "term"
    """``term``: all steps of a term, then the next; ``frame``: neighbouring terms with a history
    step by step, all of them in each."""
    history_order: Literal["oldest", "newest"] = "oldest"
    """Which step comes first."""
    gains: Gains | None = None
    memory: tuple[tuple[str, str], ...] = ()
    """Names (input, output) of recurrent states; zero at reset."""
    commands: tuple[float, ...] = (0.5, 0.0, 0.0)
    """Filled in unless told otherwise: m/s forward, m/s left, rad/s yaw, then the policy's own."""
    gait_period: float = 0.0
    """s, of the gait clocks; 0 where there are none."""
    gait_offsets: tuple[float, ...] = (0.0,)
    """Phase of every gait clock at reset, in periods."""
    robot: str = ""
    """Robots it was made for."""
    facts_from: str = ""
    """Where the numbers were published."""
    lowpass: Lowpass | None = None
    """What the joint targets pass on their way to the motors."""
    joint_limits: tuple[tuple[float, float], ...] = ()
    """[J] rad, (low, high), to which targets are clipped after the low-pass; empty for none.
    Information."""
    torque_limit: Numbers | None = None
    """N m. Information."""
    motion: Motion | None = None
    """What the words that begin with ``target_`` show."""

    def __post_init__(self) -> None:
        """Check names, sizes and ranges.

        Raises:
            ContractError: One line that names the contract, the field and what would fit.
        """
        try:
            _check(self)
        except ContractError:
            raise
        except (TypeError, ValueError) as error:
            raise ContractError(f"contract {self.name!r}: {error}") from error

    @property
    def observation_size(self) -> int:
        """O, numbers of the input."""
        return sum(term.size * term.history for term in self.observation)

    @property
    def action_size(self) -> int:
        """J."""
        return len(self.joints)

    def to_record(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        head = {"format": FORMAT, "format_version": FORMAT_VERSION}
        return head | dataclasses.asdict(self)

    def to_json(self) -> str:
        """Return one line of JSON."""
        return json.dumps(self.to_record(), sort_keys=True, allow_nan=False)

    def joint_order(self, robot: Robot) -> np.ndarray:
        """Return [J] int, where the contract's joints are among the robot's.

        Raises:
            ContractError: The robot has other joints.
        """
        short = [joint.removesuffix("_joint") for joint in robot.joints]
        found = []
        for joint in self.joints:
            if joint.removesuffix("_joint") not in short:
                raise ContractError(
                    f"contract {self.name!r} moves joint {joint!r}, which robot {robot.name!r} does"
                    f" not have (nearest: {nearest(joint, robot.joints)!r})"
                )
            found.append(short.index(joint.removesuffix("_joint")))
        missing = [robot.joints[i] for i in range(len(short)) if i not in found]
        if missing:
            raise ContractError(
                f"contract {self.name!r} does not say what joint {missing[0]!r} of robot"
                f" {robot.name!r} does: it has {len(self.joints)} of {len(short)} joints"
            )
        return np.array(found)


def _check(contract: Contract) -> None:
    if not contract.observation:
        raise ValueError("the observation has no term")
    joints = len(contract.joints)
    check_range("control_dt (s)", contract.control_dt, 0.001, 1.0)
    plain = [joint.removesuffix("_joint") for joint in contract.joints]
    if twice := [joint for joint in plain if plain.count(joint) > 1]:
        raise ValueError(f"joint {twice[0]!r} stands twice among the joints")
    _check_numbers("default_pose", contract.default_pose, joints, "joints")
    for joint, angle in zip(contract.joints, contract.default_pose, strict=True):
        if not abs(angle) <= 2 * math.pi:
            raise ValueError(f"default_pose of {joint} is {angle:g} rad, limit 2 pi (degrees?)")
    for field in ("history_layout", "history_order"):
        allowed = {"history_layout": ("term", "frame"), "history_order": ("oldest", "newest")}
        check_choice(field, getattr(contract, field), allowed[field])
    check_choice("action.kind", contract.action.kind, ("offset", "absolute"))
    _check_numbers("action.scale", contract.action.scale, joints, "joints")
    if 0.0 in np.atleast_1d(contract.action.scale):
        raise ValueError("action.scale is 0 for a joint: its output would do nothing")
    _check_limits("action.clip", contract.action.clip)
    _check_numbers("commands", contract.commands, len(contract.commands), "commands")
    _check_numbers("gait_offsets", contract.gait_offsets, len(contract.gait_offsets), "clocks")
    check_range("gait_period (s)", contract.gait_period, 0.0, 100.0)
    _check_information(contract, joints)
    names = [name for pair in contract.memory for name in pair]
    if any(len(pair) != 2 for pair in contract.memory) or len(set(names)) != len(names):
        raise ValueError(f"memory is {contract.memory}: need pairs of different names (in, out)")
    for index, term in enumerate(contract.observation):
        _check_term(contract, term, f"observation[{index}] {term.name!r}")
    _check_frames(contract)
    _check_motion(contract, joints)


def _check_motion(contract: Contract, joints: int) -> None:
    shown = [term.name for term in contract.observation if term.name.startswith(OF_MOTION)]
    if (motion := contract.motion) is None:
        if shown:
            raise ValueError(f"observation term {shown[0]!r} needs a motion, and there is none")
        return
    check_range("motion.frame_dt (s)", motion.frame_dt, 1e-4, 1.0)
    if len(motion.frames) < 2:
        raise ValueError(f"motion.frames has {len(motion.frames)} frames, need at least 2")
    for index, frame in enumerate(motion.frames):
        _check_numbers(f"motion.frames[{index}]", frame, 7 + joints, "position to joints")
    cycle = (len(motion.frames) - 1) * motion.frame_dt
    check_range("motion.start (s)", motion.start, 0.0, cycle)


def _check_information(contract: Contract, joints: int) -> None:
    if contract.gains is not None:
        _check_numbers("gains.kp", contract.gains.kp, joints, "joints")
        _check_numbers("gains.kd", contract.gains.kd, joints, "joints")
    if contract.torque_limit is not None:
        _check_numbers("torque_limit", contract.torque_limit, joints, "joints")
    if contract.joint_limits and len(contract.joint_limits) != joints:
        raise ValueError(f"joint_limits has {len(contract.joint_limits)} pairs for {joints} joints")
    for joint, limits in zip(contract.joints, contract.joint_limits, strict=False):
        _check_limits(f"joint_limits of {joint}", limits)
    if (lowpass := contract.lowpass) is not None:
        check_range("lowpass.cutoff_hz", lowpass.cutoff_hz, 0.001, 0.5 / contract.control_dt)
        _check_numbers("lowpass.b", lowpass.b, 3, "steps")
        _check_numbers("lowpass.a", lowpass.a, 3, "steps")
        if lowpass.a[0] != 1.0 or not abs(sum(lowpass.b) - sum(lowpass.a)) < 1e-4:
            raise ValueError(
                f"lowpass: a is {lowpass.a} and b {lowpass.b}, which would not keep a constant"
                " target (need a[0] = 1 and equal sums)"
            )


def _check_term(contract: Contract, term: Term, where: str) -> None:
    check_choice("observation term", term.name, tuple(VOCABULARY))
    sizes = {
        "joints": len(contract.joints),
        "commands": len(contract.commands),
        "gait": len(contract.gait_offsets),
    }
    size = VOCABULARY[term.name].size
    need = sizes.get(size, term.size) if isinstance(size, str) else size
    if term.size != need or term.size < 1:
        raise ValueError(f"{where} has size {term.size} (nearest: {max(need, 1)})")
    if size == "gait" and not contract.gait_period > 0.0:
        raise ValueError(f"{where} needs a gait_period in s above 0")
    check_range(f"{where}: history", term.history, 1, 1000)
    check_range(f"{where}: ahead", term.ahead, 0, 1000 * term.name.startswith(OF_MOTION))
    _check_numbers(f"{where}: scale", term.scale, term.size, "numbers")
    _check_numbers(f"{where}: offset", term.offset, term.size, "numbers")
    _check_limits(f"{where}: clip", term.clip)


def _check_frames(contract: Contract) -> None:
    if contract.history_layout == "frame":
        for run in frame_runs(contract):
            if len(lengths := {contract.observation[i].history for i in run}) > 1:
                raise ValueError(
                    f"neighbouring terms have histories of {sorted(lengths)} steps: history_layout"
                    " 'frame' needs equal ones (nearest: 'term')"
                )


def _check_numbers(what: str, value: Numbers, size: int, of: str) -> None:
    array = np.asarray(value, np.float64)
    if array.ndim and array.shape != (size,):
        raise ValueError(f"{what} has {array.size} numbers for {size} {of}")
    if not np.isfinite(array).all():
        raise ValueError(f"{what} is not finite")


def _check_limits(what: str, limits: tuple[float, float] | None) -> None:
    if limits is not None and not limits[0] < limits[1]:
        raise ValueError(f"{what} is {limits}, need a low and a higher number")


def frame_runs(contract: Contract) -> list[list[int]]:
    """Return the runs of neighbouring terms with a history, as indices."""
    runs: list[list[int]] = []
    for index, term in enumerate(contract.observation):
        if term.history > 1:
            joins = runs and runs[-1][-1] == index - 1
            runs[-1].append(index) if joins else runs.append([index])
    return runs


PARTS = {"action": Action, "gains": Gains, "lowpass": Lowpass, "motion": Motion}
"""Fields that are JSON objects themselves."""


def from_record(record: Any, origin: str) -> Contract:
    """Return the contract of plain values as :meth:`Contract.to_record` gives them.

    Raises:
        ContractError: It is none, or of another version; the message begins with ``origin``.
    """
    if not isinstance(record, dict) or record.get("format") != FORMAT:
        raise ContractError(f"{origin}: not marked as {FORMAT!r} (key 'format')")
    if record.get("format_version") != FORMAT_VERSION:
        raise ContractError(
            f"{origin}: contract version {record.get('format_version')!r}, this program reads"
            f" version {FORMAT_VERSION}"
        )
    values = {key: v for key, v in record.items() if key not in ("format", "format_version")}
    required = {
        f.name for f in dataclasses.fields(Contract) if f.default is dataclasses.MISSING
    } - values.keys()
    if required:
        raise ContractError(f"{origin}: the contract lacks {', '.join(sorted(required))}")
    try:
        terms = values["observation"]
        if not isinstance(terms, list):
            raise ValueError(f"observation is {terms!r}, expected a list of terms")
        values["observation"] = tuple(
            records.from_dict(Term, term, f"observation[{i}]") for i, term in enumerate(terms)
        )
        values["memory"] = tuple(tuple(pair) for pair in values.get("memory", ()))
        if isinstance(limits := values.get("joint_limits", ()), list):
            values["joint_limits"] = tuple(map(tuple, limits))
        motion = values.get("motion")
        if isinstance(motion, dict) and isinstance(motion.get("frames"), list):
            values["motion"] = motion | {"frames": tuple(map(tuple, motion["frames"]))}
        for key, kind in PARTS.items():
            if values.get(key) is not None:
                values[key] = records.from_dict(kind, values[key], key)
        return records.from_dict(Contract, values, "contract")
    except (TypeError, ValueError) as error:
        raise ContractError(f"{origin}: {error}") from error


def from_json(text: str, origin: str) -> Contract:
    """Return the contract in a text.

    Raises:
        ContractError: As :func:`from_record`, or no JSON.
    """
    try:
        record = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ContractError(f"{origin}: not JSON: {error}") from error
    return from_record(record, origin)


def read(path: str | Path) -> Contract:
    """Return the contract in a file.

    Raises:
        FileNotFoundError: There is none.
        ContractError: As :func:`from_json`.
    """
    return from_json(files.read_text(path, WHAT, TEXT_LIMIT), str(path))


def write(path: str | Path, contract: Contract) -> None:
    """Write a contract as indented JSON, whole or not at all."""
    files.write_json(path, contract.to_record())
