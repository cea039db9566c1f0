"""Clips of other robots: the feet are followed, and what comes out is checked like ours."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from twirl_mjx.assets import asset_path
from twirl_mjx.commands import clip as command
from twirl_mjx.motion.clip import Clip, rotation_of
from twirl_mjx.motion.formats import foot_paths, read_clip, write_clip
from twirl_mjx.motion.plausible import check_plausible
from twirl_mjx.motion.retarget import lowest_feet, read_motion, retarget, thigh_joints
from twirl_mjx.sim.robot import Robot
from twirl_mjx.sim.robots import A1
from twirl_mjx.tasks.imitate import ImitateOptions, clip_of, load_clip

BIG = dataclasses.replace(
    A1, name="big", thigh_length=0.25, calf_length=0.25, thigh_offset=1.25 * A1.thigh_offset,
    hip_offsets=1.25 * A1.hip_offsets, foot_radius=1.25 * A1.foot_radius,
)  # fmt: skip
"""An A1 a quarter larger."""
GO1_LIKE = dataclasses.replace(
    A1, name="go1-like", thigh_length=0.213, calf_length=0.213, thigh_offset=0.08,
    hip_offsets=A1.hip_offsets * [1.0287, 0.9947, 1.0],
)  # fmt: skip
"""Lengths of Unitree's Go1, legs in the A1's order."""
LEFT_FIRST = dataclasses.replace(
    GO1_LIKE, name="left-first", legs=tuple(GO1_LIKE.legs[i] for i in (1, 0, 3, 2)),
    joints=tuple(GO1_LIKE.joints[i] for i in (3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8)),
    hip_offsets=GO1_LIKE.hip_offsets[[1, 0, 3, 2]],
    links=tuple(GO1_LIKE.links[i] for i in (1, 0, 3, 2)),
    contact_geoms=(
        *GO1_LIKE.contact_geoms[:4],
        *(dataclasses.replace(g, leg=leg)
          for leg in range(4) for g in GO1_LIKE.contact_geoms if g.leg == (1, 0, 3, 2)[leg]),
    ),
)  # fmt: skip


@pytest.fixture(scope="module")
def leap() -> Clip:
    return read_clip(asset_path("a1", "leap.json"))


def test_a_similar_robot_moves_in_the_same_way(leap: Clip) -> None:
    large = retarget(leap, BIG)
    np.testing.assert_allclose(large.joint_pos, leap.joint_pos, atol=1e-6)
    np.testing.assert_allclose(large.root_pos, 1.25 * leap.root_pos, atol=1e-6)
    back = retarget(large, A1)
    np.testing.assert_allclose(back.qpos, leap.qpos, atol=1e-6)


@pytest.mark.parametrize("robot", [GO1_LIKE, LEFT_FIRST])
def test_feet_follow_and_stay_on_the_ground(leap: Clip, robot: Robot) -> None:
    moved = retarget(leap, robot)
    check_plausible(moved)
    scale = 0.426 / 0.4
    np.testing.assert_allclose(
        lowest_feet(moved) - robot.foot_radius, scale * (lowest_feet(leap) - 0.02), atol=1e-9
    )
    np.testing.assert_allclose(moved.root_quat, leap.root_quat, atol=1e-12)
    rotation = rotation_of(leap.root_quat).as_matrix()
    for name, legs in (("FR", 0), ("RL", 3)):
        ours, theirs = robot.legs.index(name), legs
        arms = [
            np.einsum("fji,fj->fi", rotation, foot_paths(clip)[:, leg] - clip.root_pos)
            - thigh_joints(clip.robot)[leg]
            for clip, leg in ((moved, ours), (leap, theirs))
        ]
        np.testing.assert_allclose(arms[0], scale * arms[1], atol=1e-9)


def test_what_is_out_of_reach_is_named(leap: Clip) -> None:
    stiff = dataclasses.replace(
        A1, joint_limits=np.tile([[-0.8, 0.8], [-1.0, 4.0], [-1.9, -0.9]], (4, 1))
    )
    with pytest.raises(ValueError, match=r"^leap: as a motion of 'a1'.*leg .* at index \(\d+,\)"):
        retarget(leap, stiff)


def test_files_of_other_robots_are_checked_twice(leap: Clip, tmp_path: Path) -> None:
    path = tmp_path / "big.json"
    write_clip(retarget(leap, BIG), path)
    found = read_motion(path, A1, recorded_on=BIG)
    np.testing.assert_allclose(found.joint_pos, leap.joint_pos, atol=1e-5)
    sunk = dataclasses.replace(
        retarget(leap, BIG), root_pos=retarget(leap, BIG).root_pos - [0.0, 0.0, 0.5]
    )
    write_clip(sunk, path)
    with pytest.raises(ValueError, match="the lowest foot of the clip is"):
        read_motion(path, A1, recorded_on=BIG)


def test_the_task_follows_the_feet_of_another_robot(leap: Clip) -> None:
    with pytest.raises(ValueError, match=r"nearest: --imitate\.clip-robot a1"):
        load_clip("leap", BIG)
    assert clip_of(ImitateOptions(clip_robot="a1"), BIG).robot is BIG
    with pytest.raises(ValueError, match="nearest: 'a1'"):
        clip_of(ImitateOptions(clip_robot="a2"), A1)


def test_the_commands_call_the_gates(
    leap: Clip, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def quiet(draws: bool) -> None:
        del draws

    assert command.main(["check"], quiet) == 0
    assert "a motion of a1: 101 frames in 1.25 s, 1.68 m/s" in capsys.readouterr().out
    degrees = tmp_path / "degrees.json"
    write_clip(dataclasses.replace(leap, joint_pos=np.degrees(leap.joint_pos)), degrees)
    for words in (["check"], ["show", "--out", str(tmp_path / "o")]):
        with pytest.raises(ValueError, match=r"limit 6\.28 \(degrees\? --clip-degrees\)"):
            command.main([*words, str(degrees)], quiet)
    assert command.main(["check", str(degrees), "--clip-degrees"], quiet) == 0
    picture = tmp_path / "o-film.mp4"
    picture.write_bytes(b"holiday")
    with pytest.raises(ValueError, match="not written by this command"):
        command.main(["show", "--out", str(tmp_path / "o")], quiet)
    mine = tmp_path / "mine.json"
    mine.write_text('{"LoopMode": "Wrap"}')
    with pytest.raises(ValueError, match="not written by this command"):
        command.main(["make", "--out", str(mine)], quiet)
