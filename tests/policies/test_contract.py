"""Contracts as data: what they say, and refusal of what cannot be, before anything runs."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from twirl_mjx.policies import contract as schema
from twirl_mjx.policies import ready
from twirl_mjx.policies.contract import Contract, ContractError, Gains, Term
from twirl_mjx.policies.meeting import FILL, Command, parse_command
from twirl_mjx.sim.robots import A1
from twirl_mjx.tasks.observations import Entry
from twirl_mjx.tasks.registry import TASKS

GO1 = ready.GO1_JOYSTICK


def test_every_word_can_be_filled() -> None:
    assert set(FILL) == set(schema.VOCABULARY) - {"constant"}


@pytest.mark.parametrize(
    ("name", "size"),
    [
        ("legged_gym_48", 48),
        ("legged_gym_45", 45),
        ("unitree_rl_lab_go2", 45),
        ("go1_joystick", 48),
    ],
)
def test_ready_contracts_have_the_published_sizes(name: str, size: int) -> None:
    found = ready.find_contract(name, A1)
    assert found.observation_size == size
    assert sorted(found.joint_order(A1)) == list(range(12))


def test_legged_gym_layout() -> None:
    """Against leggedrobotics/legged_gym at 05481214, by hand."""
    terms = {t.name: t for t in ready.LEGGED_GYM_48.observation}
    assert list(terms)[:4] == ["base_lin_vel", "base_ang_vel", "projected_gravity", "commands"]
    assert (terms["base_lin_vel"].scale, terms["base_ang_vel"].scale) == (2.0, 0.25)
    assert terms["commands"].scale == (2.0, 2.0, 0.25)
    assert terms["joint_vel"].scale == 0.05
    pose = dict(zip(ready.LEGGED_GYM_48.joints, ready.LEGGED_GYM_48.default_pose, strict=True))
    assert pose["FL_hip_joint"] == 0.1
    assert pose["RR_hip_joint"] == -0.1
    assert (pose["FR_thigh_joint"], pose["RL_thigh_joint"]) == (0.8, 1.0)
    assert ready.LEGGED_GYM_48.joint_order(A1)[0] == A1.joints.index("FL_hip_joint")


def test_round_trip(tmp_path: Path) -> None:
    for found in [
        *ready.READY.values(),
        *(ready.find_contract(t, A1) for t in ("stand", "hurdles", "imitate")),
    ]:
        path = tmp_path / f"{found.name}.json"
        schema.write(path, found)
        assert schema.read(path) == found
        assert ready.find_contract(str(path), A1) == found
        assert schema.from_json(found.to_json(), "here") == found


def test_every_task_has_a_contract() -> None:
    sizes = {"stand": 101, "biped": 101, "hurdles": 95, "imitate": 160}
    assert set(sizes) == set(TASKS.builtin_names())
    for task, size in sizes.items():
        found = ready.find_contract(task, A1)
        assert found.observation_size == size
        assert (found.motion is not None) == (task == "imitate")
        assert found.lowpass is not None
        assert found.lowpass.cutoff_hz == 4.0
        assert found.joint_limits[2] == pytest.approx((-2.69653369433, -0.916297857297))
        assert found.torque_limit == (33.5,) * 12
    entry = Entry("terrain_height", 4, "m")
    with pytest.raises(ContractError, match=r"'terrain_height', which is no word of a contract"):
        ready.own_contract("mine", (entry,), A1)


FAULTS: list[tuple[dict[str, Any], str]] = [
    ({"format": "other"}, "not marked as 'twirl_mjx contract'"),
    ({"format_version": 2}, "contract version 2, this program reads version 1"),
    ({"joints": None}, "joints"),
    ({"observation": []}, "has no term"),
    ({"observation": 3}, "expected a list of terms"),
    ({"observation": [{"name": "base_ang_val", "size": 3}]}, "nearest: 'base_ang_vel'"),
    ({"observation": [{"name": "base_ang_vel", "size": 4}]}, r"size 4 \(nearest: 3\)"),
    ({"observation": [{"name": "joint_vel", "size": 10}]}, r"size 10 \(nearest: 12\)"),
    ({"observation": [{"name": "joint_vel", "size": 12, "scal": 1.0}]}, "nearest: 'scale'"),
    ({"observation": [{"name": "time", "size": 1, "history": 0}]}, "history = 0 is outside"),
    ({"observation": [{"name": "time", "size": 1, "scale": [1.0, 2.0]}]}, "scale has 2 numbers"),
    ({"observation": [{"name": "time", "size": 1, "clip": [1.0, -1.0]}]}, "a low and a higher"),
    ({"observation": [{"name": "gait_sin", "size": 1}]}, "needs a gait_period"),
    ({"joints": [*GO1.joints[:11], GO1.joints[0]]}, "joint 'FR_hip' stands twice"),
    ({"default_pose": [0.0] * 11}, "default_pose has 11 numbers for 12 joints"),
    ({"default_pose": [0.0, 51.6, -103.0] * 4}, r"is 51\.6 rad.*degrees\?"),
    ({"control_dt": 50.0}, r"control_dt \(s\) = 50.0 is outside"),
    ({"action": {"kind": "torque"}}, "unknown action.kind 'torque'"),
    ({"action": {"scale": 0.0}}, "its output would do nothing"),
    ({"action": {"scale": [0.25] * 3}}, "action.scale has 3 numbers for 12 joints"),
    ({"memory": [["h", "h"]]}, "pairs of different names"),
    ({"history_layout": "frames"}, "nearest: 'frame'"),
    ({"names": []}, "unknown key in contract 'names'"),
    ({"joint_limits": [[-1.0, 1.0]] * 3}, "joint_limits has 3 pairs for 12 joints"),
    ({"joint_limits": [[1.0, -1.0]] * 12}, "joint_limits of FR_hip_joint is"),
    ({"torque_limit": [20.0] * 3}, "torque_limit has 3 numbers for 12 joints"),
    ({"gains": {"kp": [20.0], "kd": 0.5}}, "gains.kp has 1 numbers for 12 joints"),
    ({"lowpass": {"cutoff_hz": 5.0, "b": [0.1, 0.2, 0.1], "a": [1.0, 0.2, 0.1]}}, "equal sums"),
    ({"lowpass": {"cutoff_hz": 5.0, "b": [1.0], "a": [1.0, 0.0, 0.0]}}, r"lowpass\.b = "),
    ({"lowpass": {"cutoff_hz": 30.0, "b": [1.0, 0, 0], "a": [1.0, 0, 0]}}, r"outside \[0\.001, 25"),
    ({"observation": [{"name": "target_joint_pos", "size": 12}]}, "needs a motion, and there is"),
    ({"observation": [{"name": "joint_pos", "size": 12, "ahead": 2}]}, "ahead = 2 is outside"),
    ({"motion": {"frame_dt": 0.02, "frames": [[0.0] * 19]}}, "has 1 frames, need at least 2"),
    (
        {"motion": {"frame_dt": 0.02, "frames": [[0.0] * 7] * 2}},
        r"frames\[0\] has 7 numbers for 19",
    ),
    ({"motion": {"frame_dt": 0.02, "frames": 3}}, "frames = 3 is int"),
]


@pytest.mark.parametrize(("change", "message"), FAULTS)
def test_malformed_contracts_are_refused(change: dict, message: str, tmp_path: Path) -> None:
    record = GO1.to_record() | change
    record = {key: value for key, value in record.items() if value is not None}
    path = tmp_path / "contract.json"
    path.write_text(json.dumps(record))
    with pytest.raises(ContractError, match=rf"contract\.json: .*{message}") as caught:
        schema.read(path)
    assert "\n" not in str(caught.value)


def test_files_that_are_none(tmp_path: Path) -> None:
    path = tmp_path / "contract.json"
    path.write_text("{")
    with pytest.raises(ContractError, match="not JSON"):
        schema.read(path)
    with pytest.raises(FileNotFoundError):
        ready.find_contract("nothing.json", A1)
    with pytest.raises(ContractError, match="nearest: 'go1_joystick'"):
        ready.find_contract("go1_joystik", A1)


def test_frames_need_equal_histories() -> None:
    terms = (Term("time", 1, history=2), Term("joint_vel", 12, history=3))
    with pytest.raises(ContractError, match=r"histories of \[2, 3\] steps.*nearest: 'term'"):
        dataclasses.replace(GO1, observation=terms, history_layout="frame")


def test_joints_of_another_robot_are_refused() -> None:
    anymal = tuple(j.replace("_hip_joint", "_HAA") for j in GO1.joints)
    with pytest.raises(
        ContractError, match=r"moves joint 'FR_HAA'.*'a1' does not have \(nearest: "
    ):
        dataclasses.replace(GO1, joints=anymal).joint_order(A1)
    fewer = Contract("legs", 0.02, (Term("time", 1),), GO1.joints[:9], (0.0,) * 9)
    with pytest.raises(ContractError, match="does not say what joint 'RL_hip_joint'"):
        fewer.joint_order(A1)


def test_commands() -> None:
    assert parse_command("", GO1).values == GO1.commands
    assert parse_command("1,0,-0.5", GO1) == Command((1.0, 0.0, -0.5))
    assert parse_command("towards-goal:0.7", GO1) == Command(GO1.commands, 0.7)
    for text, message in (
        ("1,0", "2 numbers, contract 'go1_joystick' has 3"),
        ("fast", r"nearest: 0\.5,0,0"),
        ("towards-goal:9", "outside"),
        ("nan,0,0", "3 numbers"),
    ):
        with pytest.raises(ContractError, match=message):
            parse_command(text, GO1)
    blind = dataclasses.replace(GO1, observation=GO1.observation[:-1])
    with pytest.raises(ContractError, match="shows no commands"):
        parse_command("1,0,0", blind)


def test_towards_the_goal() -> None:
    command = Command((9.0, 9.0, 9.0, 0.3), 0.5)
    qpos = np.zeros((4, 19), np.float32)
    qpos[:, 3] = 1.0
    qpos[3, 3:7] = [np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]  # faces +y
    goals = np.array([[3.0, 0.0], [0.2, 0.0], [-2.0, 0.1], [0.0, 2.0]], np.float32)
    expected = [[0.5, 0.0, 0.0, 0.3], [0.2, 0.0, 0.0, 0.3], [0.0, 0.0, 1.0, 0.3],
                [0.5, 0.0, 0.0, 0.3]]  # fmt: skip
    np.testing.assert_allclose(command.at(qpos, goals), expected, atol=1e-6)


MJLAB = {
    "joint_names": ",".join(GO1.joints),
    "default_joint_pos": ",".join(f"{v:.3f}" for v in GO1.default_pose),
    "joint_stiffness": ",".join(["35.000"] * 12),
    "joint_damping": ",".join(["0.500"] * 12),
    "action_scale": ",".join(["0.373"] * 12),
    "command_names": "twist",
    "observation_names": "base_lin_vel,base_ang_vel,projected_gravity,joint_pos,joint_vel,actions,"
    "command",
}


def test_metadata_of_mjlab() -> None:
    found = ready.from_mjlab(MJLAB, "policy.onnx")
    assert found is not None
    assert found.observation_size == 48
    assert [t.name for t in found.observation][3:] == [
        "joint_pos_rel", "joint_vel", "previous_action", "commands",
    ]  # fmt: skip
    assert found.action.scale == (0.373,) * 12
    assert found.gains == Gains((35.0,) * 12, (0.5,) * 12)
    assert ready.from_mjlab({"joint_names": "a"}, "policy.onnx") is None
    more = {
        "observation_terms_scale": ",".join(["1.0", "0.25", *["1.0"] * 5]),
        "observation_terms_clip": ",".join(["-inf;inf", "-4.0;4.0", *["-inf;inf"] * 5]),
        "observation_terms_history_length": ",".join(["0.000", "3.000", *["0.000"] * 5]),
    }
    found = ready.from_mjlab(MJLAB | more, "policy.onnx")
    assert found is not None
    assert found.observation[1] == Term("base_ang_vel", 3, 0.25, clip=(-1.0, 1.0), history=3)


def test_faulty_metadata_of_mjlab() -> None:
    for change, message in (
        ({"observation_names": "base_lin_vel,height_scan"}, "'height_scan' is none that this"),
        ({"action_scale": "big"}, "mjlab's metadata cannot be read"),
        ({"default_joint_pos": "0.1,0.9"}, "default_pose has 2 numbers"),
        ({"observation_terms_scale": "1.0"}, "cannot be read"),
    ):
        with pytest.raises(ContractError, match=f"policy.onnx: .*{message}"):
            ready.from_mjlab(MJLAB | change, "policy.onnx")
