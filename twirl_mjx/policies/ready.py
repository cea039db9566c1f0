"""Ready contracts of published layouts, of this project's tasks, and of mjlab's metadata.

Facts only, each with where it was published; see ``docs/sources.md``.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from twirl_mjx.checks import choose_one, nearest
from twirl_mjx.policies import contract as schema
from twirl_mjx.policies.contract import (
    Action,
    Contract,
    ContractError,
    Gains,
    Lowpass,
    Motion,
    Numbers,
    Term,
)
from twirl_mjx.sim.robot import Robot
from twirl_mjx.tasks.imitate import ImitateObserver
from twirl_mjx.tasks.observations import Entry, Observer
from twirl_mjx.tasks.registry import TASKS
from twirl_mjx.tasks.task import Task

KINDS = ("hip", "thigh", "calf")


def _joints(*legs: str) -> tuple[str, ...]:
    return tuple(f"{leg}_{kind}_joint" for leg in legs for kind in KINDS)


LIMIT = (-100.0, 100.0)

_LEGGED_GYM_TERMS = (
    Term("base_lin_vel", 3, 2.0, clip=LIMIT),
    Term("base_ang_vel", 3, 0.25, clip=LIMIT),
    Term("projected_gravity", 3, clip=LIMIT),
    Term("commands", 3, (2.0, 2.0, 0.25), clip=LIMIT),
    Term("joint_pos_rel", 12, clip=LIMIT),
    Term("joint_vel", 12, 0.05, clip=LIMIT),
    Term("previous_action", 12, clip=LIMIT),
)
_LEGGED_GYM_POSE = (
    *(0.1, 0.8, -1.5), *(-0.1, 0.8, -1.5), *(0.1, 1.0, -1.5), *(-0.1, 1.0, -1.5),
)  # fmt: skip

LEGGED_GYM_48 = Contract(
    name="legged_gym_48",
    control_dt=0.02,
    observation=_LEGGED_GYM_TERMS,
    joints=_joints("FL", "FR", "RL", "RR"),
    default_pose=_LEGGED_GYM_POSE,
    action=Action("offset", 0.25, LIMIT),
    gains=Gains(20.0, 0.5),
    robot="A1, Go1, Go2",
    facts_from="leggedrobotics/legged_gym: base/legged_robot.py, legged_robot_config.py,"
    " a1/a1_config.py; unitreerobotics/unitree_rl_gym: go2/go2_config.py",
)
"""Velocity policies of legged_gym and rsl_rl on flat ground."""

LEGGED_GYM_45 = Contract(
    name="legged_gym_45",
    control_dt=0.02,
    observation=_LEGGED_GYM_TERMS[1:],
    joints=LEGGED_GYM_48.joints,
    default_pose=_LEGGED_GYM_POSE,
    action=Action("offset", 0.25, LIMIT),
    gains=Gains(20.0, 0.5),
    robot="A1, Go1, Go2",
    facts_from="the terms of legged_gym_48 without the linear velocity, which no sensor measures",
)
"""The same, blind to the linear velocity."""

UNITREE_RL_LAB_GO2 = Contract(
    name="unitree_rl_lab_go2",
    control_dt=0.02,
    observation=(
        Term("base_ang_vel", 3, 0.2),
        Term("projected_gravity", 3),
        Term("commands", 3),
        Term("joint_pos_rel", 12),
        Term("joint_vel", 12, 0.05),
        Term("previous_action", 12),
    ),
    joints=tuple(f"{leg}_{kind}_joint" for kind in KINDS for leg in ("FL", "FR", "RL", "RR")),
    default_pose=(*(0.1, -0.1, 0.1, -0.1), *(0.8, 0.8, 1.0, 1.0), *(-1.5,) * 4),
    action=Action("offset", 0.25, LIMIT),
    gains=Gains(25.0, 0.5),
    robot="Go2",
    facts_from="unitreerobotics/unitree_rl_lab: locomotion/robots/go2/velocity_env_cfg.py,"
    " assets/robots/unitree.py; joints in the order of Isaac Lab",
)
"""Isaac Lab velocity policy of Unitree's own repository."""

GO1_JOYSTICK = Contract(
    name="go1_joystick",
    control_dt=0.02,
    observation=(
        Term("base_lin_vel", 3),
        Term("base_ang_vel", 3),
        Term("projected_gravity", 3),
        Term("joint_pos_rel", 12),
        Term("joint_vel", 12),
        Term("previous_action", 12),
        Term("commands", 3),
    ),
    joints=_joints("FR", "FL", "RR", "RL"),
    default_pose=(0.1, 0.9, -1.8, -0.1, 0.9, -1.8) * 2,
    action=Action("offset", 0.5),
    gains=Gains(35.0, 0.5),
    robot="Go1",
    facts_from="google-deepmind/mujoco_playground: locomotion/go1/joystick.py and"
    " xmls/scene_mjx_feetonly_flat_terrain.xml (keyframe home)",
)
"""MuJoCo Playground's Go1JoystickFlatTerrain and Go1JoystickRoughTerrain (48 inputs)."""

READY = {
    c.name: c for c in (LEGGED_GYM_48, LEGGED_GYM_45, UNITREE_RL_LAB_GO2, GO1_JOYSTICK)
}  # fmt: skip
"""Contracts by name."""


def own_contract(
    name: str, layout: tuple[Entry, ...], robot: Robot, motion: Motion | None = None
) -> Contract:
    """Return the contract of a policy trained in a task of this project.

    Args:
        name: Name of the task.
        layout: Its observation; history entries end in ``[-2]`` ... ``[0]``, those of the motion in
            ``[+1]`` and so on.
        robot: Whose legs.
        motion: What the task follows, if anything.

    Raises:
        ContractError: An entry of the observation that is no word of the vocabulary.
    """
    terms: list[Term] = []
    steps = {e.name.partition("[")[2] for e in layout if "[" in e.name}
    history = sum("+" not in step for step in steps)
    for entry in layout:
        plain, _, step = entry.name.partition("[")
        if plain not in schema.VOCABULARY:
            raise ContractError(
                f"task {name} shows {entry.name!r}, which is no word of a contract (nearest:"
                f" {nearest(plain, schema.VOCABULARY)!r})"
            )
        if step.startswith("+"):
            terms.append(Term(plain, entry.size, ahead=int(step.removesuffix("]"))))
        elif step in ("", "0]"):
            terms.append(Term(plain, entry.size, history=history if step else 1))
    b, a = robot.lowpass
    return Contract(
        name=name,
        control_dt=robot.control_dt,
        observation=tuple(terms),
        joints=robot.joints,
        default_pose=tuple(map(float, robot.default_pose)),
        action=Action("offset", tuple(map(float, robot.action_half_range)), (-1.0, 1.0)),
        history_layout="frame",
        gains=Gains(tuple(map(float, robot.kp)), tuple(map(float, robot.kd))),
        robot=robot.name,
        facts_from="twirl_mjx: tasks/observations.py, sim/robots",
        lowpass=Lowpass(robot.cutoff_hz, (b[0], b[1], b[2]), (a[0], a[1], a[2])),
        joint_limits=tuple((float(low), float(high)) for low, high in robot.joint_limits),
        torque_limit=tuple(map(float, robot.torque_limit)),
        motion=motion,
    )


def contract_of_task(task: Task) -> Contract:
    """Return the contract of a task that is bound to its robot and options.

    Raises:
        ContractError: As :func:`own_contract`.
    """
    return own_contract(task.name, task.observer.layout, task.robot, motion_of(task.observer))


def motion_of(observer: Observer) -> Motion | None:
    """Return what a task follows; None where it follows nothing."""
    if not isinstance(observer, ImitateObserver):
        return None
    clip = observer.motion
    return Motion(
        frame_dt=clip.frame_duration,
        frames=tuple(tuple(round(float(x), 6) for x in frame) for frame in clip.qpos),
        start=observer.standing_time,
        travels=clip.cycle_offset_position,
        turns=clip.cycle_offset_rotation,
    )


def find_contract(text: str, robot: Robot) -> Contract:
    """Return a contract by name (ready, or of a task) or from a JSON file.

    Raises:
        ContractError: Neither; the message has the nearest name.
        FileNotFoundError: A file that does not exist.
    """
    if text in READY:
        return READY[text]
    if text in TASKS.names():
        kind = TASKS.get(text)
        return contract_of_task(kind(kind.paper_options(), robot=robot))
    if Path(text).suffix == ".json" or Path(text).exists():
        return schema.read(text)
    names = [*READY, *TASKS.names()]
    raise ContractError(f"unknown contract {text!r}: a .json file, or {choose_one(text, names)}")


MJLAB_KEYS = ("joint_names", "default_joint_pos", "action_scale", "observation_names")
"""Metadata without which an ONNX file is not mjlab's (mujocolab/mjlab: rl/exporter_utils.py)."""
MJLAB_DT = 0.02
"""s; the metadata do not have it. mjlab's velocity tasks: 4 physics steps of 5 ms."""
MJLAB_TERMS = {
    "base_lin_vel": "base_lin_vel",
    "base_ang_vel": "base_ang_vel",
    "projected_gravity": "projected_gravity",
    "joint_pos": "joint_pos_rel",
    "joint_pos_rel": "joint_pos_rel",
    "joint_vel": "joint_vel",
    "joint_vel_rel": "joint_vel",
    "actions": "previous_action",
    "last_action": "previous_action",
    "command": "commands",
    "velocity_commands": "commands",
}
"""mjlab's names of terms -> ours."""


def from_mjlab(metadata: Mapping[str, str], origin: str) -> Contract | None:
    """Return the contract in the metadata of an ONNX file that mjlab wrote; None for others.

    Raises:
        ContractError: mjlab's keys with values that cannot be, or an observation of unknown terms.
    """
    if not set(MJLAB_KEYS) <= metadata.keys():
        return None
    columns = {key: [v.strip() for v in text.split(",")] for key, text in metadata.items()}
    joints = tuple(columns["joint_names"])
    names = columns["observation_names"]
    for name in names:
        if name not in MJLAB_TERMS:
            raise ContractError(
                f"{origin}: mjlab's observation {name!r} is none that this program can fill:"
                f" {choose_one(name, MJLAB_TERMS)}, or say it all in a --source-contract file"
            )
    try:
        scale = tuple(map(float, columns["action_scale"]))
        kp, kd = (
            tuple(map(float, columns[key])) if key in columns else None
            for key in ("joint_stiffness", "joint_damping")
        )
        scales = list(map(float, columns.get("observation_terms_scale", ["1"] * len(names))))
        lengths = list(
            map(float, columns.get("observation_terms_history_length", ["0"] * len(names)))
        )
        limits = [
            tuple(map(float, text.split(";")))
            for text in columns.get("observation_terms_clip", ["-inf;inf"] * len(names))
        ]
        ours = [MJLAB_TERMS[name] for name in names]
        sizes = {"joint_pos_rel": len(joints), "joint_vel": len(joints)}
        sizes["previous_action"] = len(joints)
        rows = zip(ours, scales, lengths, limits, strict=True)
        return Contract(
            name="mjlab",
            control_dt=MJLAB_DT,
            observation=tuple(
                Term(name, sizes.get(name, 3), factor, clip=_after(limit, factor),
                     history=max(1, int(length)))
                for name, factor, length, limit in rows
            ),
            joints=joints,
            default_pose=tuple(map(float, columns["default_joint_pos"])),
            action=Action("offset", scale[0] if len(scale) == 1 else scale),
            gains=None if kp is None or kd is None else Gains(kp, kd),
            facts_from=f"metadata of {origin}",
        )  # fmt: skip
    except ContractError as error:
        raise ContractError(f"{origin}: {error}") from error
    except (TypeError, ValueError) as error:
        raise ContractError(f"{origin}: mjlab's metadata cannot be read: {error}") from error


def _after(limit: tuple[float, ...], factor: Numbers) -> tuple[float, float] | None:
    """Return limits after scaling for limits before it (mjlab clips first), None for none."""
    low, high = sorted(float(factor) * float(end) for end in limit)  # type: ignore[arg-type]
    if low == float("-inf") and high == float("inf"):
        return None
    return max(low, -1e30), min(high, 1e30)
