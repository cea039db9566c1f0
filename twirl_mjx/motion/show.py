"""Figures of clips: what a motion does, and how it compares with others.

Pictures of the robot in the poses of a clip: ``deploy.render`` with ``clip.configurations``.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path

import matplotlib.figure
import matplotlib.text
import numpy as np

from twirl_mjx import files
from twirl_mjx.motion.clip import Clip, headings
from twirl_mjx.motion.formats import foot_paths

FOOT_COLORS = ("#D55E00", "#E69F00", "#0072B2", "#56B4E9")
"""FR FL RR RL: warm colours in front, cold ones behind (Okabe and Ito's palette)."""
NEAR_GROUND = 0.005
"""m, a foot lower than this counts as standing in the figures."""
_LINE = 66
"""Letters that a line of the figures has room for."""


def pitch_angles(clip: Clip) -> np.ndarray:
    """Return the pitch [F] in degrees, nose up positive."""
    w, x, y, z = clip.root_quat.T
    return -np.degrees(np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0)))


def forward_paths(clip: Clip) -> tuple[np.ndarray, np.ndarray]:
    """Return root and foot positions [F, 3], [F, 4, 3] m, moved and turned to start along x."""
    yaw = headings(clip.root_quat[:1])[0]
    c, s = np.cos(-yaw), np.sin(-yaw)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    origin = clip.root_pos[0] * np.array([1.0, 1.0, 0.0])
    return (clip.root_pos - origin) @ turn.T, (foot_paths(clip) - origin) @ turn.T


def show(clip: Clip, path: str | Path) -> None:
    """Draw root height, pitch, foot heights and contact phases over one cycle.

    Args:
        clip: The motion.
        path: Image file to write; the ending decides the format.
    """
    times = np.arange(clip.num_frames) * clip.frame_duration
    corners = list(clip.robot.corners)
    names = [clip.robot.legs[leg] for leg in corners]
    lowest = foot_paths(clip)[:, corners, 2] - clip.robot.foot_radius
    figure = matplotlib.figure.Figure(figsize=(7.0, 6.2), layout="constrained")
    height, pitch, feet, phases = figure.subplots(
        4, 1, sharex=True, gridspec_kw={"height_ratios": [2, 1.4, 2, 1.2]}
    )
    height.plot(times, clip.root_pos[:, 2], color="black")
    height.set_ylabel("root height (m)")
    pitch.plot(times, pitch_angles(clip), color="black")
    pitch.axhline(0.0, color="0.8", lw=0.8, zorder=0)
    pitch.set_ylabel("nose-up pitch (deg)")
    for leg, (name, color) in enumerate(zip(names, FOOT_COLORS, strict=True)):
        # Right legs are dashed and on top: in a bound they hide the left ones.
        style = {"ls": "-", "zorder": 2} if leg % 2 else {"ls": (0, (4, 4)), "zorder": 3}
        feet.plot(times, lowest[:, leg], color=color, label=name, **style)
        standing = lowest[:, leg] < NEAR_GROUND
        phases.fill_between(
            times, 3 - leg - 0.35, 3 - leg + 0.35, where=standing.tolist(), color=color, lw=0
        )
    feet.set_ylabel("foot height (m)")
    feet.legend(ncols=4, frameon=False, loc="upper right")
    flight = (lowest >= NEAR_GROUND).all(axis=1)
    for axes in (height, pitch, feet, phases):
        axes.fill_between(
            times,
            0,
            1,
            where=flight.tolist(),
            transform=axes.get_xaxis_transform(),
            color="0.93",
            lw=0,
            zorder=-1,
        )
        axes.spines[["top", "right"]].set_visible(False)
    phases.set_yticks(range(len(names)), names[::-1])
    phases.set_ylabel("contact")
    phases.set_xlabel("time (s), all feet airborne where shaded")
    distance = float(np.linalg.norm(clip.cycle_displacement[:2]))
    title = f"{clip.name}: {distance:.2f} m in {clip.cycle_duration:.2f} s, "
    title += f"{flight[:-1].sum() * clip.frame_duration:.2f} s of it airborne"
    height.set_title(textwrap.fill(title, _LINE), loc="left")
    _save(figure, Path(path))


def compare(clips: Sequence[Clip], path: str | Path, source: str = "") -> None:
    """Draw several clips over the distance travelled: trunk height, pitch, feet.

    Args:
        clips: The motions; the first one is drawn in black, as ours.
        path: Image file to write.
        source: Where the other motions come from, written into the figure.
    """
    figure = matplotlib.figure.Figure(figsize=(7.0, 6.6), layout="constrained")
    axes = figure.subplots(4, 1, gridspec_kw={"height_ratios": [1.6, 1.4, 1.4, 1.4]})
    colors = ["black", *(color for color in ("#0072B2", "#56B4E9", "#009E73", "#CC79A7"))]
    for index, clip in enumerate(clips):
        root, feet = forward_paths(clip)
        times = np.arange(clip.num_frames) * clip.frame_duration
        lowest = feet[..., 2] - clip.robot.foot_radius
        apex = np.argmax(lowest.min(axis=1))  # line the leaps up where they clear the most
        style = {"color": colors[index % len(colors)], "lw": 1.8 if index == 0 else 1.1}
        name = textwrap.fill(clip.name, _LINE)
        axes[0].plot(root[:, 0] - root[apex, 0], root[:, 2], label=name, **style)
        axes[1].plot(times - times[apex], pitch_angles(clip), **style)
        axes[2].plot(
            times - times[apex], lowest[:, list(clip.robot.front_legs)].min(axis=1), **style
        )
        axes[3].plot(
            times - times[apex], lowest[:, list(clip.robot.hind_legs)].min(axis=1), **style
        )
    axes[0].set_xlabel("distance from the top of the leap (m)")
    axes[0].set_ylabel("root height (m)")
    axes[0].legend(frameon=False, fontsize=8, loc="upper right")
    for axis, label in zip(
        axes[1:], ("nose-up pitch (deg)", "front feet (m)", "hind feet (m)"), strict=True
    ):
        axis.set_ylabel(label)
    label = "time from the top of the leap (s)" + (f"; other clips: {source}" if source else "")
    axes[3].set_xlabel(textwrap.fill(label, _LINE))
    for axis in axes:
        axis.spines[["top", "right"]].set_visible(False)
    _save(figure, Path(path))


def _save(figure: matplotlib.figure.Figure, path: Path) -> None:
    """Write a figure, whole or not at all; names of clips are shown as they are."""
    for text in figure.findobj(matplotlib.text.Text):
        text.set_parse_math(False)
        text.set_text(text.get_text().encode(errors="replace").decode())
    kind = path.suffix.removeprefix(".") or "png"
    about = {"png": {"Software": files.MARK}, "pdf": {"Creator": files.MARK}}
    about["svg"] = about["pdf"]
    with files.write_atomic(path) as file:
        figure.savefig(file, format=kind, dpi=150, metadata=about.get(kind))
