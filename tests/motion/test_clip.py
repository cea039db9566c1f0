"""Clips: sampling against scipy, cycle continuity, both file layouts, refusal of bad files."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from twirl_mjx.assets import asset_path
from twirl_mjx.motion.clip import Clip, configurations, frame_velocities, sample, slerp
from twirl_mjx.motion.conversion import Conversion
from twirl_mjx.motion.formats import foot_paths, read_clip, write_clip
from twirl_mjx.motion.plausible import check_plausible
from twirl_mjx.sim.robots import A1

SAMPLE = jax.jit(jax.vmap(sample, in_axes=(None, 0)))


def make_clip(num_frames: int = 9, yaw_per_cycle: float = 0.0, **changes: Any) -> Clip:
    """A smooth walk-like motion whose last frame is its first frame moved on."""
    phase = np.linspace(0.0, 2 * np.pi, num_frames)
    share = phase / (2 * np.pi)
    angles = np.stack(
        [yaw_per_cycle * share + 0.1 * np.sin(phase), 0.3 * np.sin(phase), 0.2 * np.sin(2 * phase)],
        axis=1,
    )
    quat = Rotation.from_euler("ZYX", angles).as_quat(scalar_first=True)
    pos = np.stack([1.0 + 0.8 * share, 0.2 + 0.1 * share, 0.3 + 0.03 * np.cos(phase)], axis=1)
    swing = np.sin(phase[:, None] + np.arange(12))
    clip = Clip(pos, quat, A1.default_pose + 0.2 * swing, frame_duration=0.05, name="walk")
    return dataclasses.replace(clip, **changes)


def test_sampling_agrees_with_scipy() -> None:
    clip = make_clip()
    times = np.linspace(0.0, clip.cycle_duration * 0.999, 57)
    qpos, _ = SAMPLE(clip.to_arrays(), jnp.asarray(times, jnp.float32))
    grid = np.arange(clip.num_frames) * clip.frame_duration
    rotations = Rotation.from_quat(clip.root_quat, scalar_first=True)
    expected = Slerp(grid, rotations)(times)
    got = Rotation.from_quat(np.asarray(qpos[:, 3:7]), scalar_first=True)
    assert (got * expected.inv()).magnitude().max() < 1e-5
    for column in range(3):
        want = np.interp(times, grid, clip.root_pos[:, column])
        np.testing.assert_allclose(qpos[:, column], want, atol=2e-6)
    for joint in range(12):
        want = np.interp(times, grid, clip.joint_pos[:, joint])
        np.testing.assert_allclose(qpos[:, 7 + joint], want, atol=2e-6)


@pytest.mark.parametrize("angle", [0.0, 1e-6, 1e-3, 0.5, 3.0])
def test_slerp_is_unit_and_even(angle: float) -> None:
    a = Rotation.from_euler("xyz", [0.3, -0.2, 0.9])
    b = a * Rotation.from_rotvec(angle * np.array([0.6, 0.0, 0.8]))
    quats = [jnp.asarray(r.as_quat(scalar_first=True), jnp.float32) for r in (a, b)]
    for sign in (1.0, -1.0):  # the other sign is the same rotation
        out = np.asarray(slerp(quats[0], sign * quats[1], jnp.float32(0.25)))
        turned = (a.inv() * Rotation.from_quat(out, scalar_first=True)).magnitude()
        assert np.linalg.norm(out) == pytest.approx(1.0, abs=1e-6)
        assert turned == pytest.approx(0.25 * angle, abs=2e-6)


@pytest.mark.parametrize("yaw", [0.0, 0.7])
def test_cycles_join_without_a_jump(yaw: float) -> None:
    clip = make_clip(yaw_per_cycle=yaw, cycle_offset_rotation=yaw != 0.0)
    duration, dt = clip.cycle_duration, 1e-4
    ends = duration * np.array([-1.0, 1.0, 2.0, 5.0])
    before, vel_before = SAMPLE(clip.to_arrays(), jnp.asarray(ends - dt, jnp.float32))
    after, vel_after = SAMPLE(clip.to_arrays(), jnp.asarray(ends + dt, jnp.float32))
    np.testing.assert_allclose(before[:, :3], after[:, :3], atol=2e-3)
    np.testing.assert_allclose(before[:, 7:], after[:, 7:], atol=2e-3)
    np.testing.assert_allclose(np.abs((before[:, 3:7] * after[:, 3:7]).sum(1)), 1.0, atol=1e-5)
    np.testing.assert_allclose(vel_before, vel_after, atol=0.05)


def test_cycle_displacement_is_a_repeated_rigid_motion() -> None:
    clip = make_clip(yaw_per_cycle=0.7, cycle_offset_rotation=True)
    x, y, yaw = clip.cycle_displacement
    assert (x, y, yaw) == pytest.approx((0.8, 0.1, 0.7))
    turn = Rotation.from_euler("z", yaw)
    pos, quat = clip.root_pos[2], Rotation.from_quat(clip.root_quat[2], scalar_first=True)
    start, end = clip.root_pos[0] * [1, 1, 0], clip.root_pos[-1] * [1, 1, 0]
    for cycle in range(1, 4):
        pos, quat = turn.apply(pos - start) + end, turn * quat
        time = cycle * clip.cycle_duration + 2 * clip.frame_duration
        qpos, qvel = (rows[0] for rows in SAMPLE(clip.to_arrays(), jnp.array([time], jnp.float32)))
        np.testing.assert_allclose(qpos[:3], pos, atol=1e-4)
        got = Rotation.from_quat(np.asarray(qpos[3:7]), scalar_first=True)
        assert (got * quat.inv()).magnitude() < 1e-4
        first = frame_velocities(clip)[0][2]
        turned = Rotation.from_euler("z", cycle * yaw).apply(first)
        np.testing.assert_allclose(qvel[:3], turned, atol=1e-3)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"cycle_offset_rotation": True},
        {"cycle_offset_position": False},
        {"cycle_offset_rotation": True, "cycle_offset_position": False},
        {"loop": "clamp"},
    ],
)
def test_numpy_and_jax_sampling_agree(changes: dict[str, Any]) -> None:
    clip = make_clip(yaw_per_cycle=0.7, **changes)
    times = np.linspace(-0.9, 1.7, 41)
    qpos, _ = SAMPLE(clip.to_arrays(), jnp.asarray(times, jnp.float32))
    want = configurations(clip, times)
    np.testing.assert_allclose(qpos[:, :3], want[:, :3], atol=2e-5)
    np.testing.assert_allclose(np.abs((qpos[:, 3:7] * want[:, 3:7]).sum(axis=1)), 1.0, atol=1e-5)
    np.testing.assert_allclose(qpos[:, 7:], want[:, 7:], atol=2e-5)


@pytest.mark.parametrize("frame", [1, 3, 8])  # the last begins the second cycle
def test_a_time_that_is_rounded_below_a_frame_is_that_frame_s(frame: int) -> None:
    """A compiler may round one time in two ways; both must find the same two frames."""
    clip = make_clip()
    at = frame * clip.frame_duration
    qpos, qvel = SAMPLE(clip.to_arrays(), jnp.array([at * (1.0 - 1e-5), at], jnp.float32))
    np.testing.assert_allclose(qpos[0, 3:], qpos[1, 3:], atol=3e-7)
    np.testing.assert_allclose(qvel[0], qvel[1], atol=3e-6)


def test_offset_flags_off_repeat_the_first_cycle() -> None:
    clip = make_clip(yaw_per_cycle=0.7, cycle_offset_position=False)
    np.testing.assert_array_equal(clip.cycle_displacement, 0.0)
    times = jnp.array([0.12, 0.12 + 3 * clip.cycle_duration], jnp.float32)
    qpos, _ = SAMPLE(clip.to_arrays(), times)
    np.testing.assert_allclose(qpos[0], qpos[1], atol=1e-4)


def test_velocities_are_derivatives_of_the_motion() -> None:
    clip = make_clip(num_frames=401)
    times = np.linspace(0.1, 19.0, 23)
    step = 0.05
    arrays = clip.to_arrays()
    now, vel = SAMPLE(arrays, jnp.asarray(times, jnp.float32))
    ahead, _ = SAMPLE(arrays, jnp.asarray(times + step, jnp.float32))
    behind, _ = SAMPLE(arrays, jnp.asarray(times - step, jnp.float32))
    slope = np.asarray(ahead - behind) / (2 * step)
    np.testing.assert_allclose(vel[:, :3], slope[:, :3], atol=2e-3)
    np.testing.assert_allclose(vel[:, 6:], slope[:, 7:], atol=2e-3)
    turns = [Rotation.from_quat(np.asarray(q[:, 3:7]), scalar_first=True) for q in (behind, ahead)]
    body = (turns[0].inv() * turns[1]).as_rotvec() / (2 * step)
    np.testing.assert_allclose(vel[:, 3:6], body, atol=2e-3)
    assert np.abs(body).max() > 0.05
    np.testing.assert_allclose(np.linalg.norm(now[:, 3:7], axis=1), 1.0, atol=1e-6)


def test_clamped_clip_holds_its_ends() -> None:
    clip = make_clip(loop="clamp")
    times = jnp.array([-1.0, clip.cycle_duration + 1.0], jnp.float32)
    qpos, qvel = SAMPLE(clip.to_arrays(), times)
    np.testing.assert_allclose(qpos, clip.qpos[[0, -1]], atol=1e-6)
    np.testing.assert_array_equal(qvel, 0.0)


@pytest.mark.parametrize("layout", ["peng", "amp"])
def test_both_layouts_round_trip(tmp_path: Path, layout: Any) -> None:
    clip = make_clip(yaw_per_cycle=0.3, cycle_offset_rotation=True)
    write_clip(clip, tmp_path / "walk.json", layout)
    back = read_clip(tmp_path / "walk.json")
    np.testing.assert_allclose(back.qpos, clip.qpos, atol=1e-6)
    for field in ("frame_duration", "loop", "cycle_offset_position", "cycle_offset_rotation"):
        assert getattr(back, field) == getattr(clip, field)
    assert back.name == "walk"
    rows = np.array(json.loads((tmp_path / "walk.json").read_text())["Frames"])
    np.testing.assert_allclose(rows[:, 3:7], clip.root_quat[:, [1, 2, 3, 0]], atol=1e-6)
    assert rows.shape[1] == {"peng": 19, "amp": 61}[layout]


def test_amp_velocities_and_toes_are_derivatives(tmp_path: Path) -> None:
    clip = make_clip(num_frames=401)
    write_clip(clip, tmp_path / "walk.json", "amp")
    rows = np.array(json.loads((tmp_path / "walk.json").read_text())["Frames"])
    toes = rows[:, 19:31]
    np.testing.assert_allclose(toes, foot_paths(clip).reshape(-1, 12), atol=1e-6)
    slope = np.gradient(toes, clip.frame_duration, axis=0)[1:-1]
    np.testing.assert_allclose(rows[1:-1, 49:61], slope, atol=2e-3)
    world = Rotation.from_quat(rows[:, 3:7])
    spin = (world[2:] * world[:-2].inv()).as_rotvec() / (2 * clip.frame_duration)
    np.testing.assert_allclose(rows[1:-1, 34:37], spin, atol=2e-3)


def test_legs_in_another_order_are_put_right(tmp_path: Path) -> None:
    clip = make_clip()
    write_clip(clip, tmp_path / "walk.json")
    data = json.loads((tmp_path / "walk.json").read_text())
    for frame in data["Frames"]:
        fr, fl, rr, rl = (frame[i : i + 3] for i in (7, 10, 13, 16))
        frame[7:] = fl + fr + rl + rr
    (tmp_path / "other.json").write_text(json.dumps(data))
    back = read_clip(tmp_path / "other.json", legs=("FL", "FR", "RL", "RR"))
    np.testing.assert_allclose(back.joint_pos, clip.joint_pos, atol=1e-6)
    with pytest.raises(ValueError, match="permutation of FR, FL, RR, RL"):
        read_clip(tmp_path / "other.json", legs=("FL", "FL", "RL", "RR"))


def _set(key: str, value: Any) -> Any:
    return lambda data: data.__setitem__(key, value)


def _number(frame: int, column: int, value: Any) -> Any:
    return lambda data: data["Frames"][frame].__setitem__(column, value)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda d: d["Frames"][3].pop(), "frame 3 has 18 numbers, need 19 as in frame 0"),
        (
            lambda d: [f.pop() for f in d["Frames"]],
            r"frame 0 has 18 numbers, need 19 \(peng\) or 61",
        ),
        (_number(4, 8, float("nan")), "frame 4, number 8 is nan"),
        (_number(2, 7, "0.1"), "frame 2, number 7 is '0.1'"),
        (_number(5, 6, 3.0), "frame 5: quaternion norm"),
        (_set("FrameDuration", 0.0), "key FrameDuration is 0.0"),
        (_set("FrameDuration", -0.1), "key FrameDuration is -0.1"),
        (_set("FrameDuration", "fast"), "key FrameDuration is 'fast'"),
        (_set("LoopMode", "Bounce"), "key LoopMode is 'Bounce', need 'Wrap' or 'Clamp'"),
        (_set("EnableCycleOffsetPosition", 1), "key EnableCycleOffsetPosition is 1"),
        (lambda d: d.pop("EnableCycleOffsetRotation"), "key EnableCycleOffsetRotation is missing"),
        (lambda d: d.pop("Frames"), "key Frames is missing"),
        (_set("Frames", [[0.0] * 19]), "at least 2 frames"),
        (_set("Frames", [1, 2, 3]), "frame 0 is no list"),
    ],
)
def test_bad_files_are_refused_with_the_place(tmp_path: Path, damage: Any, message: str) -> None:
    path = tmp_path / "bad.json"
    write_clip(make_clip(), path)
    data = json.loads(path.read_text())
    damage(data)
    path.write_text(json.dumps(data))
    with pytest.raises(ValueError, match=message) as error:
        read_clip(path)
    assert str(path) in str(error.value)


def test_text_that_is_not_json_names_the_line(tmp_path: Path) -> None:
    path = tmp_path / "bad.json"
    path.write_text('{\n"LoopMode": "Wrap",\n"FrameDuration": 0.02\n"Frames": []}')
    with pytest.raises(ValueError, match="line 4, column 1: not JSON"):
        read_clip(path)
    with pytest.raises(FileNotFoundError):
        read_clip(tmp_path / "absent.json")


def test_wrong_shapes_are_refused() -> None:
    clip = make_clip()
    with pytest.raises(ValueError, match=r"joint_pos has shape \(9, 11\), need \[F, 12\]"):
        dataclasses.replace(clip, joint_pos=clip.joint_pos[:, :11])
    with pytest.raises(ValueError, match="9, 9 and 8 frames"):
        dataclasses.replace(clip, joint_pos=clip.joint_pos[:-1])
    with pytest.raises(ValueError, match="frame_duration 0"):
        dataclasses.replace(clip, frame_duration=0)
    with pytest.raises(ValueError, match="loop 'once'"):
        dataclasses.replace(clip, loop="once")


def leap_file(path: Path, change: Any) -> Path:
    """Write the shipped leap with its numbers changed: ``change(data, frames [F, 19])``."""
    write_clip(read_clip(asset_path("a1", "leap.json")), path)
    data = json.loads(path.read_text())
    frames = np.array(data["Frames"])
    change(data, frames)
    path.write_text(json.dumps(data | {"Frames": frames.tolist()}))
    return path


def _degrees(data: dict, frames: np.ndarray) -> None:
    frames[:, 7:] = np.rad2deg(frames[:, 7:])


def _centimetres(data: dict, frames: np.ndarray) -> None:
    frames[:, :3] *= 100.0


def _wxyz(data: dict, frames: np.ndarray) -> None:
    frames[:, 3:7] = frames[:, [6, 3, 4, 5]]


def _laikago(data: dict, frames: np.ndarray) -> None:
    upright = Rotation.from_quat([0.5, 0.5, 0.5, 0.5])
    frames[:, 3:7] = (Rotation.from_quat(frames[:, 3:7]) * upright).as_quat()


def _rate(data: dict, frames: np.ndarray) -> None:
    data["FrameDuration"] = 1.0 / data["FrameDuration"]


def _jump(data: dict, frames: np.ndarray) -> None:
    frames[5:, 11] += 3.0


def _spin(data: dict, frames: np.ndarray) -> None:
    frames[:, 9] += 1.5


def _float(data: dict, frames: np.ndarray) -> None:
    frames[:, 2] += 0.5


def _instant(data: dict, frames: np.ndarray) -> None:
    data["FrameDuration"] = 1e-30


def _for_ever(data: dict, frames: np.ndarray) -> None:
    data["FrameDuration"] = 1e30


def _still_and_instant(data: dict, frames: np.ndarray) -> None:
    data["FrameDuration"] = 1e-30
    frames[:] = frames[0]  # at no speed, whatever the time between them


def _out_of_this_world(data: dict, frames: np.ndarray) -> None:
    frames[:, 0] += 1e30


def _joints(data: dict, frames: np.ndarray) -> None:
    frames[3, 7] = 1e6


RATE = 1.0 / read_clip(asset_path("a1", "leap.json")).frame_duration


@pytest.mark.parametrize(
    ("change", "message", "conversion"),
    [
        (_degrees, r"frame \d+: joint \w+_calf_joint is -\d+.* rad, limit 6\.28 \(degrees\?",
         Conversion(degrees=True)),
        (_centimetres, r"frame \d+: root height is .* m, limit 3 \(centimetres\? --imitate",
         Conversion(metres=0.01)),
        (_wxyz, r"frame \d+: the robot lies on its back.*--imitate\.clip-quaternion wxyz",
         Conversion(quaternion="wxyz")),
        (_laikago, r"frame \d+: the left flank points up by .*--imitate\.clip-root laikago",
         Conversion(root="laikago")),
        (_rate, r"FrameDuration is \d+ s, limits 0\.0005 to 0\.25 \(frames per second\?",
         Conversion(fps=RATE)),
        (_instant, r"FrameDuration is 1e-30 s, limits .*\(frames per second\? .*-fps 2000\)", None),
        (_for_ever, r"FrameDuration is 1e\+30 s, limits .* --imitate\.clip-fps 4\)", None),
        (_still_and_instant, r"FrameDuration is 1e-30 s, limits 0\.0005 to 0\.25", None),
        (_out_of_this_world, r"frame \d+: the root is at x = 1e\+30 m, limit 1000", None),
        (_joints, r"frame 3: joint FR_hip_joint is 1e\+06 rad, limit 6\.28", None),
        (_jump, r"frame 5: joint \w+ jumps at .* rad/s, limit 60", None),
        (_spin, r"frame \d+: joint FR_calf_joint is .* rad, limits -2\.7 to -0\.9", None),
        (_float, r"frame \d+: the lowest foot of the clip is 0\.\d+ m high, limits", None),
    ],
)  # fmt: skip
def test_implausible_clips_are_caught_and_converted(
    change: Any, message: str, conversion: Conversion | None, tmp_path: Path
) -> None:
    path = leap_file(tmp_path / "mine.json", change)
    with pytest.raises(ValueError, match=rf"mine: {message}"):
        check_plausible(read_clip(path))
    if conversion is not None:
        back = read_clip(path, conversion=conversion)
        check_plausible(back)
        leap = read_clip(asset_path("a1", "leap.json"))
        np.testing.assert_allclose(back.joint_pos, leap.joint_pos, atol=1e-5)
        np.testing.assert_allclose(back.root_pos, leap.root_pos, atol=1e-5)
        np.testing.assert_allclose(np.abs((back.root_quat * leap.root_quat).sum(1)), 1.0, atol=1e-5)
        assert back.frame_duration == pytest.approx(leap.frame_duration)


def test_three_keys_with_a_leg_order_a_mark_and_line_ends(tmp_path: Path) -> None:
    clip = make_clip()
    write_clip(clip, tmp_path / "walk.json")
    data = json.loads((tmp_path / "walk.json").read_text())
    for frame in data["Frames"]:
        fr, fl, rr, rl = (frame[i : i + 3] for i in (7, 10, 13, 16))
        frame[7:] = fl + fr + rl + rr
    keys = {"FrameDuration": 0.05, "LegOrder": "FL FR RL RR", "Frames": data["Frames"]}
    path = tmp_path / "three.json"
    path.write_bytes(b"\xef\xbb\xbf" + json.dumps(keys, indent=1).replace("\n", "\r\n").encode())
    back = read_clip(path)
    np.testing.assert_allclose(back.joint_pos, clip.joint_pos, atol=1e-6)
    assert (back.loop, back.cycle_offset_position) == ("wrap", True)
    path.write_text(json.dumps(keys | {"LegOrder": ["FL", "FR", "LF", "RR"]}))
    with pytest.raises(ValueError, match=r"key LegOrder is .*permutation of FR, FL, RR, RL"):
        read_clip(path)


@pytest.mark.parametrize("columns", [12, 19])
def test_tables_of_joint_trajectories(columns: int, tmp_path: Path) -> None:
    clip = make_clip()
    write_clip(clip, tmp_path / "walk.json")
    rows = np.array(json.loads((tmp_path / "walk.json").read_text())["Frames"])[:, 19 - columns :]
    np.save(tmp_path / "walk.npy", rows)
    text = ",".join(f"c{i}" for i in range(columns)) + "\r\n"
    text += "".join(",".join(map(str, row)) + "\r\n" for row in rows)
    (tmp_path / "walk.csv").write_text(text)
    for name in ("walk.npy", "walk.csv"):
        with pytest.raises(ValueError, match=r"does not say its rate .*--imitate\.clip-fps"):
            read_clip(tmp_path / name)
        back = read_clip(tmp_path / name, conversion=Conversion(fps=20.0))
        np.testing.assert_allclose(back.joint_pos, clip.joint_pos, atol=1e-6)
        assert back.frame_duration == pytest.approx(0.05)
        if columns == 12:
            lowest = foot_paths(back)[..., 2].min(axis=1)
            np.testing.assert_allclose(lowest, A1.foot_radius, atol=1e-9)
    (tmp_path / "walk.csv").write_text("1,2\n3,x\n")
    with pytest.raises(ValueError, match="row 1: could not convert"):
        read_clip(tmp_path / "walk.csv")
