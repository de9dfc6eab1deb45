"""Draw docs/images/gripper_frames.png: where each format of grasps has the hand's frame.

One hand, one box, one grasp; every panel has the axes of another format, taken from the code that
reads and writes it. Run it again when one changes: `uv run python docs/draw_grippers.py`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, Polygon
from matplotlib.patheffects import withStroke

from realsim.formats.graspnet.gripper_frame import BASE_M, graspnet_poses
from realsim.formats.grasps.hand_frames import hand_poses
from realsim.robots.hand import find_hand

AXES = ("#c8553d", "#2a9d8f", "#3a6ea5")
INK, PALE, PAPER = "#22303c", "#8d9aa7", "#ffffff"
HAND, BOX = "#eaeff3", "#f8e2ae"
OPENING_M, WIDTH_M, DEPTH_M = 0.066, 0.046, 0.02
BOX_M = np.array([[-0.017, -WIDTH_M / 2, -DEPTH_M], [0.017, WIDTH_M / 2, 0.034]])
"""The box, least and greatest corner in `grasp` [m]: its upper face is DEPTH_M above the contacts.
"""
TIP_M = find_hand().tip_beyond_tcp_m
ARROW_M = 0.042
AZIMUTH, ELEVATION = np.deg2rad(24.0), np.deg2rad(11.0)
LIGHT = np.array([-0.55, 0.1, -0.83])
"""Towards the light, in `grasp`: from above, on the viewer's side."""


def view() -> np.ndarray:
    """Return the page's axes (3, 3) in `grasp`: right, up, towards the viewer; approach is down."""
    towards = np.array(
        [
            -np.cos(AZIMUTH) * np.cos(ELEVATION),
            np.sin(AZIMUTH) * np.cos(ELEVATION),
            -np.sin(ELEVATION),
        ]
    )
    right = np.cross([0.0, 0.0, -1.0], towards)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(towards, right), towards])


PAGE = view()


def on_page(points: Any) -> np.ndarray:
    """Return where points (N, 3) [m] are on the page (N, 2) [mm]."""
    return 1e3 * np.atleast_2d(np.asarray(points, dtype=float)) @ PAGE[:2].T


def draw_solids(ax: Any) -> None:
    """Draw hand and box, the nearer faces over the farther ones."""
    hand = find_hand().boxes(OPENING_M)[0]
    faces: list[tuple[float, np.ndarray, str]] = []
    for box, color in [*((b, HAND) for b in hand), (BOX_M, BOX)]:
        for k in range(3):
            for side in (0, 1):
                normal = np.zeros(3)
                normal[k] = 2 * side - 1
                if float(normal @ PAGE[2]) <= 0:
                    continue
                a, b = (k + 1) % 3, (k + 2) % 3
                corners = np.repeat(box[:1], 4, axis=0)
                corners[:, k] = box[side, k]
                corners[[1, 2], a], corners[[2, 3], b] = box[1, a], box[1, b]
                lit = shade(color, max(float(normal @ LIGHT), 0.0))
                faces.append((float(corners.mean(axis=0) @ PAGE[2]), corners, lit))
    for _, corners, color in sorted(faces, key=lambda face: face[0]):
        ax.add_patch(Polygon(on_page(corners), facecolor=color, edgecolor=INK, lw=0.9, zorder=2))


def shade(color: str, light: float) -> str:
    """Return a colour, darker where the face is turned away from the light."""
    rgb = np.array([int(color[k : k + 2], 16) for k in (1, 3, 5)])
    return "#" + "".join(f"{int(v):02x}" for v in rgb * min(0.84 + 0.19 * light, 1.0))


def line(ax: Any, points: Any, **style: Any) -> None:
    """Draw a line through points of `grasp`."""
    ax.plot(*on_page(points).T, **{"color": INK, "lw": 0.9, "zorder": 5, **style})


def text(ax: Any, point: Any, words: str, shift: tuple[float, float], **style: Any) -> None:
    """Write words beside a point of `grasp`, readable over whatever is there."""
    at = on_page(point)[0] + shift
    halo = [withStroke(linewidth=3.2, foreground=PAPER)]
    ax.text(*at, words, **{"fontsize": 9.5, "color": INK, "zorder": 9, "path_effects": halo,
                           **style})  # fmt: skip


def draw_axes(ax: Any, T: np.ndarray, names: dict[str, str], pale: bool = False) -> None:
    """Draw the axes of a frame T (4, 4) in `grasp`, and what two of them are."""
    halo = [withStroke(linewidth=5.0, foreground=PAPER)]
    for k, (axis, color) in enumerate(zip("xyz", AXES, strict=True)):
        tip = T[:3, 3] + ARROW_M * T[:3, k]
        arrow = FancyArrowPatch(
            tuple(on_page(T[:3, 3])[0]), tuple(on_page(tip)[0]), arrowstyle="-|>",
            mutation_scale=13, shrinkA=0, shrinkB=0, color=color, lw=2.4, zorder=7,
            alpha=0.35 if pale else 1.0, path_effects=None if pale else halo,
        )  # fmt: skip
        ax.add_patch(arrow)
        if pale:
            continue
        along = on_page(tip)[0] - on_page(T[:3, 3])[0]
        step = 5.0 * along / np.linalg.norm(along)
        side = "left" if along[0] > 4 else "right" if along[0] < -4 else "center"
        words = f"{axis} {names[axis]}" if axis in names else axis
        text(ax, tip, words, tuple(step), color=color, fontweight="bold", ha=side, va="center")
    if not pale:
        ax.plot(*on_page(T[:3, 3]).T, "o", ms=6, color=INK, mec=PAPER, mew=1.2, zorder=8)


def dimension(ax: Any, z: float, to: float, words: str, y: float) -> None:
    """Draw how far it is along the approach from z to another height, beside the hand."""
    line(ax, [[0, y, z], [0, y, to]], lw=1.1)
    for end in (z, to):
        line(ax, [[0, y - 0.003, end], [0, y + 0.003, end]], lw=1.1)
        line(ax, [[0, y, end], [0, 0, end]], color=PALE, lw=0.8, ls=(0, (4, 3)), zorder=1)
    left = y < 0
    text(ax, [0, y, 0.5 * (z + to)], words, (-4.0 if left else 4.0, 0.0),
         ha="right" if left else "left", va="center")  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Panel:
    """What a format's panel shows."""

    title: str
    field: str
    T_grasp_frame: np.ndarray
    names: dict[str, str]
    caption: str
    more: Callable[[Any], None] = lambda ax: None


def draw_graspnets_gripper(ax: Any) -> None:
    """Draw the outline of GraspNet's gripper, whose fingertips are where the contacts are."""
    half, palm = OPENING_M / 2, -DEPTH_M - BASE_M
    style: dict[str, Any] = {"color": "#8a3ffc", "lw": 1.6, "ls": (0, (4, 2)), "zorder": 6}
    line(ax, [[0, -half, 0], [0, -half, palm], [0, half, palm], [0, half, 0]], **style)
    line(ax, [[0, 0, palm], [0, 0, palm - 0.03]], **style)
    text(ax, [0, 0, palm - 0.03], "GraspNet's gripper", (4, -5), color="#8a3ffc", fontsize=9)


def panels() -> list[Panel]:
    """Return the panels in reading order."""
    mount = f"origin: the hand's mounting face,\n{-1e3 * find_hand().mount_z_m:.1f} mm behind grasp"
    acronym = {"z": "approach", "x": "closing"}
    ours = {"z": "approach", "y": "closing"}
    half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    return [
        Panel(title="realsim", field="Ts_obj_grasp", T_grasp_frame=np.eye(4), names=ours,
              caption="origin: tool centre point, between\nthe pads where the contacts are"),
        Panel(title="GraspIT authors' HDF5", field="(N, 2, 4, 4), in world",
              T_grasp_frame=np.eye(4), names=ours,
              caption="as realsim; each grasp beside its\nhalf turn about the approach (pale)",
              more=lambda ax: draw_axes(ax, half_turn, {}, pale=True)),
        Panel(title="GraspNet GraspGroup npy, labels", field="rotation, translation",
              T_grasp_frame=graspnet_poses(np.eye(4), DEPTH_M),
              names={"x": "approach", "y": "closing", "z": "height"},
              caption="origin: a point of the surface;\ncontacts at x = depth (here 20 mm)",
              more=draw_graspnets_gripper),
        Panel(title="ACRONYM HDF5", field="grasps/transforms",
              T_grasp_frame=hand_poses(np.eye(4), "acronym"), names=acronym, caption=mount),
        Panel(title="GraspGen JSON", field="grasps.transforms",
              T_grasp_frame=hand_poses(np.eye(4), "acronym"), names=acronym, caption=mount),
        Panel(title="isaac_grasp YAML", field="position, orientation",
              T_grasp_frame=hand_poses(np.eye(4), "panda_hand"), names=ours,
              caption=f"panda_hand; {mount}"),
    ]  # fmt: skip


def draw_panel(ax: Any, panel: Panel) -> None:
    """Draw one format's frame at the hand."""
    draw_solids(ax)
    z = float(panel.T_grasp_frame[2, 3])
    line(ax, [[0, -WIDTH_M / 2, 0], [0, WIDTH_M / 2, 0]], ls=(0, (1, 1.5)), zorder=4)
    for side in (-1, 1):
        ax.plot(*on_page([0, side * WIDTH_M / 2, 0]).T, "o", ms=4, color=INK, zorder=4)
    panel.more(ax)
    draw_axes(ax, panel.T_grasp_frame, panel.names)
    if z < 0:
        dimension(ax, z, 0.0, f"{-1e3 * z:.1f} mm\nto the\ncontacts", 0.132)
    dimension(ax, z, TIP_M, f"{1e3 * (TIP_M - z):.1f} mm\nto the\nfingertips", -0.126)
    ax.set_title(panel.title, fontsize=13, color=INK, fontweight="bold", pad=20)
    ax.text(0.5, 1.015, panel.field, transform=ax.transAxes, ha="center", fontsize=9.5,
            color=PALE, family="monospace")  # fmt: skip
    ax.text(0.5, 0.0, panel.caption, transform=ax.transAxes, ha="center", va="bottom",
            fontsize=9.5, color=INK)  # fmt: skip
    ax.set(xlim=(-162, 172), ylim=(-80, 128), aspect="equal")
    ax.set_axis_off()


def main() -> None:
    """Write the picture."""
    figure = Figure(figsize=(14.5, 8.5), dpi=105, layout="constrained", facecolor=PAPER)
    figure.get_layout_engine().set(w_pad=0.05, h_pad=0.12)  # type: ignore[union-attr, call-arg]
    for k, panel in enumerate(panels()):
        draw_panel(figure.add_subplot(2, 3, k + 1), panel)
    figure.suptitle("One grasp, one hand: the frame that each format writes",
                    fontsize=15, color=INK)  # fmt: skip
    path = Path(__file__).parent / "images/gripper_frames.png"
    path.parent.mkdir(exist_ok=True)
    figure.savefig(path)


if __name__ == "__main__":
    main()
