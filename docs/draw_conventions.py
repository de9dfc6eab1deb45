"""Draw docs/images/conventions.png: the frames of a capture and of the gripper.

Run it again when a convention changes: `uv run python docs/draw_conventions.py`.
"""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from realsim.geometry import se3

AXES = ("#c8553d", "#2a9d8f", "#3a6ea5")
INK, PALE = "#22303c", "#aab7c4"


def draw_frame(ax: Any, T: np.ndarray, name: str, length: float, offset: tuple[float, ...]) -> None:
    """Draw the axes of a frame (x red, y green, z blue) and its name."""
    origin = T[:3, 3]
    for k, color in enumerate(AXES):
        tip = origin + length * T[:3, k]
        ax.plot(*zip(origin, tip, strict=True), color=color, lw=2.2, zorder=5)
    ax.text(*(origin + np.array(offset)), name, fontsize=10, color=INK, fontweight="bold", zorder=6)


def draw_box(ax: Any, T: np.ndarray, size: tuple[float, float, float], color: str) -> None:
    """Draw the edges of a box centred on the frame T."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / 2
    p = se3.transform(T, corners * size)
    for a in range(8):
        for b in range(a + 1, 8):
            if np.sum(corners[a] != corners[b]) == 1:
                ax.plot(*zip(p[a], p[b], strict=True), color=color, lw=1.2)


def capture_panel(ax: Any) -> None:
    """Draw the arm, the camera in its hand, the board and an object on the table."""
    base = np.eye(4)
    ee = se3.look_at([0.34, -0.16, 0.44], [0.40, 0.02, 0.02])
    cam = ee @ se3.from_translation([0.0, -0.10, 0.03])
    obj = se3.from_rt(se3.exp_so3([0, 0, 0.5]), [0.50, -0.02, 0.03])
    board = se3.from_rt(np.diag([1.0, -1.0, -1.0]), [0.24, 0.28, 0.0])
    table = se3.from_translation([0.62, -0.20, 0.0])
    joints = np.array([[0, 0, 0], [0, 0, 0.16], [0.06, -0.16, 0.52], ee[:3, 3] - 0.08 * ee[:3, 2],
                       ee[:3, 3]])  # fmt: skip
    ax.plot(*joints.T, color=PALE, lw=9, solid_capstyle="round", zorder=1)
    x, y = np.array([0.12, 0.75, 0.75, 0.12, 0.12]), np.array([-0.3, -0.3, 0.36, 0.36, -0.3])
    ax.plot(x, y, 0 * x, color=PALE, lw=1.2)
    draw_box(ax, cam @ se3.from_translation([0, 0, -0.012]), (0.05, 0.04, 0.02), INK)
    draw_box(ax, obj, (0.10, 0.06, 0.06), INK)
    bx, by = np.array([0, 0.2, 0.2, 0, 0]), np.array([0, 0, 0.13, 0.13, 0])
    ax.plot(*se3.transform(board, np.stack([bx, by, 0 * bx], -1)).T, color=INK, lw=1.2)
    corners = np.array([[sx * 0.11, sy * 0.065, 0.2] for sx, sy in
                        ((-1, -1), (1, -1), (1, 1), (-1, 1))])  # fmt: skip
    far = se3.transform(cam, corners)
    for corner in far:
        ax.plot(*zip(cam[:3, 3], corner, strict=True), color=PALE, lw=0.8, ls=":")
    ax.plot(*np.vstack([far, far[:1]]).T, color=PALE, lw=0.8, ls=":")
    for T, name, offset in (
        (base, "world = base", (-0.2, -0.02, -0.06)),
        (ee, "ee", (-0.09, -0.02, -0.05)),
        (cam, "cam", (0.05, 0.02, 0.05)),
        (obj, "obj", (0.09, 0.02, 0.05)),
        (board, "board", (-0.09, 0.05, 0.02)),
        (table, "table", (0.04, -0.04, 0.03)),
    ):
        draw_frame(ax, T, name, 0.09, offset)
    ax.set_title("p_a = T_a_b p_b;  T_world_cam = T_base_ee T_ee_cam", fontsize=11, color=INK)
    ax.set(xlim=(-0.1, 0.8), ylim=(-0.35, 0.45), zlim=(-0.1, 0.6))
    ax.set_box_aspect((0.9, 0.8, 0.7), zoom=1.3)
    ax.view_init(elev=22, azim=-62)


def gripper_panel(ax: Any) -> None:
    """Draw the Franka Hand with its grasp frame: origin between the fingertips."""
    half, finger, palm = 0.04, 0.05, 0.1034
    for side in (-1, 1):
        T = se3.from_translation([0, side * (half + 0.005), -finger / 2 + 0.006])
        draw_box(ax, T, (0.018, 0.010, finger), INK)
    draw_box(ax, se3.from_translation([0, 0, -palm + 0.028]), (0.04, 0.19, 0.052), INK)
    draw_frame(ax, np.eye(4), "grasp", 0.045, (0.0, -0.028, -0.008))
    ax.text(0, 0.012, 0.05, "z approach", color=AXES[2], fontsize=9)
    ax.text(0, 0.058, -0.004, "y closing axis", color=AXES[1], fontsize=9)
    ax.plot([0, 0], [-half, half], [0.016, 0.016], color=INK, lw=0.8)
    ax.text(0, -0.075, 0.028, "80 mm opening", fontsize=9, color=INK)
    ax.plot([0, 0], [-0.075, -0.075], [-finger + 0.006, 0.006], color=INK, lw=0.8)
    ax.text(0, -0.118, -0.012, "50 mm\nfingers", fontsize=9, color=INK)
    ax.set_title("frame `grasp`: origin between the fingertips", fontsize=11, color=INK)
    ax.set(xlim=(-0.1, 0.1), ylim=(-0.1, 0.1), zlim=(-0.12, 0.08))
    ax.set_box_aspect((1, 1, 1), zoom=1.3)
    # Seen with the approach axis pointing down, as a gripper hangs over a table.
    ax.view_init(elev=-14, azim=-12)
    ax.invert_zaxis()


def main() -> None:
    """Write the picture."""
    figure = Figure(figsize=(12.5, 6.0), dpi=110, layout="constrained")
    for k, panel in enumerate((capture_panel, gripper_panel)):
        ax = figure.add_subplot(1, 2, k + 1, projection="3d")
        panel(ax)
        ax.set_axis_off()
    path = Path(__file__).parent / "images/conventions.png"
    path.parent.mkdir(exist_ok=True)
    figure.savefig(path)


if __name__ == "__main__":
    main()
