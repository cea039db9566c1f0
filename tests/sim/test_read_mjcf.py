"""Robots that are refused: another family, implausible facts, a file that is another's."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from twirl_mjx.motion.leap import make_leap
from twirl_mjx.sim.robot import FOOT, Robot
from twirl_mjx.sim.robots import A1
from twirl_mjx.sim.scene import build_scene
from twirl_mjx.tasks.imitate import load_clip


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (('axis="1 0 0"', 'axis="0 0 1"'), r"joint FL_hip_joint turns about \[0.0, 0.0, 1.0\]; "),
        (('pos="0 0 -0.21"', 'pos="0.05 0 -0.21"'), r"calf joints at \[\[0.05, 0.0, -0.21\]"),
        (('<freejoint name="float"/>', '<joint type="slide"/>'), "'sit': invalid qpos size"),
        (('<body name="crate" pos="2 0 0">', '<body pos="2 0 0"><joint name="door"/>'),
         r"the model's joints are \['door', 'FL_hip_joint'.*expected a quadruped"),
        (('axis="1 0 0" range', 'axis="1 0 0" pos="0 0 0.1" range'),
         r"FL_hip_joint is placed at \[0.0, 0.0, 0.1\], not 0"),
        (("</actuator>", '</actuator><equality><weld body1="base"/></equality>'),
         "has 1 equalities and 0 tendons"),
        (("<mujoco model", "<muco model"), "its XML: "),
    ],
)  # fmt: skip
def test_other_families_are_refused(
    change: tuple[str, str],
    words: str,
    other: Robot,
    quadruped: Callable[..., str],
    facts: dict[str, Any],
) -> None:
    joints = [
        f"{leg}_{part}_joint"
        for leg in ("FL", "FR", "RR", "RL")
        for part in ("hip", "thigh", "calf")
    ]
    with pytest.raises(ValueError, match=words) as error:
        Robot.from_mjcf("other", quadruped(change=change), **facts, joints=joints)
    assert "\n" not in str(error.value)
    assert "robot 'other'" in str(error.value)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"feet": ("FL_toe",)}, r"feet are \['FL_toe'\]; need 4"),
        ({"feet": ("FL_tow", "FR_toe", "RR_toe", "RL_toe")}, r"FL_tow.*nearest: 'FL_toe'"),
        ({"feet": ("FL_thigh_collision", "FR_toe", "RR_toe", "RL_toe")}, "straight below"),
        ({"kp": 6e4}, r"kp = 60000.0 is outside \[0.1, 5000.0\]"),
        ({"default_pose": (0, 45.8, -85)}, r"default_pose = 45.8 is outside \[-6.28"),
        ({"default_pose": (0, 0.8, 0.5)}, r"default_pose of FL_calf_joint = 0.5 is outside"),
        ({"default_pose": (0, 0.8)}, r"shape \(2,\)"),
        ({"thigh_length": 213.0}, r"thigh_length = 213.0 is outside"),
        ({"stiffness": 1.0}, r"fact about robot 'other' 'stiffness': choose one of"),
        ({"cutoff_hz": 12.0}, r"cutoff_hz = 12.0 is outside"),
        ({"contact_geoms": A1.contact_geoms[4:]}, r"need the trunk's \(-1\) first"),
    ],
)
def test_implausible_facts_are_refused(
    given: dict[str, Any], words: str, quadruped: Callable[..., str], facts: dict[str, Any]
) -> None:
    with pytest.raises(ValueError, match=words):
        Robot.from_mjcf("other", quadruped(), **(facts | given))


def test_missing_things_are_named(
    tmp_path: Path, quadruped: Callable[..., str], facts: dict[str, Any]
) -> None:
    with pytest.raises(FileNotFoundError, match=r"robot 'other': no MJCF file .*absent.xml"):
        Robot.from_mjcf("other", tmp_path / "absent.xml", **facts)
    weak = quadruped(change=(' forcerange="-30 30"', ""))
    with pytest.raises(
        ValueError, match="no torque limit for joint FL_hip_joint: give torque_limit"
    ):
        Robot.from_mjcf("other", weak, **facts)


def test_record_and_file_must_agree(other: Robot) -> None:
    longer = dataclasses.replace(other, thigh_length=0.22)
    with pytest.raises(ValueError, match=r"thigh_length is 0.22 in the record, 0.21 in its MJCF"):
        build_scene(robot=longer)
    renamed = dataclasses.replace(other, joints=("FL_hop_joint", *other.joints[1:]))
    with pytest.raises(ValueError, match=r"'FL_hop_joint'.*nearest: 'FL_hip_joint'"):
        build_scene(robot=renamed)


def test_motions_of_the_a1_are_refused_to_others(other: Robot) -> None:
    with pytest.raises(ValueError, match="no leap can be planned for robot 'other': the planner"):
        make_leap(robot=other)
    with pytest.raises(ValueError, match="'leap' is a motion of robot 'a1', not of 'other'"):
        load_clip("leap", other)


def test_a_path_or_a_function_serve_as_well_as_a_string(
    tmp_path: Path, other: Robot, quadruped: Callable[..., str], facts: dict[str, Any]
) -> None:
    path = tmp_path / "other.xml"
    path.write_text(quadruped())
    for model in (path, str(path), lambda: path, quadruped):
        robot = Robot.from_mjcf("other", model, **facts)
        assert robot.contact_mask(FOOT).sum() == 4
        assert robot.mass == pytest.approx(other.mass)
