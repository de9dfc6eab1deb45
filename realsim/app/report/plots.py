"""The plots of a session's report, as PNG files in SESSION/reports."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from realsim.records import STAGES, GraspSet, HandEye, ObjectModel, Scene, View

INK, MUTED, GOOD, WARN, BAD = "#22303c", "#8a99a8", "#2a9d8f", "#e9a13b", "#c8553d"
VERDICT_COLORS = {"accepted": GOOD, "doubtful": WARN, "rejected": BAD, "unchecked": MUTED}


def _figure(width: float, height: float, columns: int) -> tuple[Any, list[Any]]:
    """Return a figure of plain axes without the frame that nobody reads."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=110, layout="constrained")
    axes = [figure.add_subplot(1, columns, k + 1) for k in range(columns)]
    for ax in axes:
        ax.spines[["top", "right"]].set_visible(False)
        ax.tick_params(colors=INK, labelsize=8)
    return figure, axes


def plot_calibration(hand_eye: HandEye, views: Sequence[View], path: Path) -> None:
    """Plot the residual of every board view and how the arm turned the camera."""
    figure, (left, right) = _figure(9.0, 3.0, 2)
    left.bar([str(i) for i in hand_eye.view_indices], hand_eye.view_rms_px, color=GOOD)
    left.axhline(hand_eye.held_out_px, color=BAD, lw=1)
    left.annotate(
        f"held-out {hand_eye.held_out_px:.2f} px", (0.99, hand_eye.held_out_px), color=BAD,
        xycoords=("axes fraction", "data"), ha="right", va="bottom", fontsize=8,
        bbox={"boxstyle": "round,pad=0.1", "fc": "white", "ec": "none", "alpha": 0.8},
    )  # fmt: skip
    left.set_title("Reprojection through the robot pose", fontsize=9, loc="left")
    left.set_xlabel("board view", fontsize=8)
    left.set_ylabel("RMS [px]", fontsize=8)
    left.tick_params(axis="x", labelsize=6)
    T = np.stack([v.T_base_ee for v in views if v.T_base_ee is not None]) @ hand_eye.T_ee_cam
    axis = T[:, :3, 2]
    # The tilt of the optical axis from straight down, and the roll about it.
    tilt = np.degrees(np.arccos(np.clip(-axis[:, 2], -1, 1)))
    roll = np.degrees(np.arctan2(T[:, 1, 0], T[:, 0, 0]))
    right.scatter(roll, tilt, s=18, color=INK)
    right.set_xlim(-185, 185)
    right.set_title("Diversity of the board views", fontsize=9, loc="left")
    right.set_xlabel("direction of the image's x axis [deg]", fontsize=8)
    right.set_ylabel("tilt from straight down [deg]", fontsize=8)
    figure.savefig(path)


def plot_registration(
    scene: Scene, models: Mapping[int, ObjectModel], errors_mm: Mapping[int, float], path: Path
) -> None:
    """Plot the agreement of every object with the depth, and its error where the truth is known."""
    figure, axes = _figure(9.0, 0.8 + 0.28 * max(4, len(scene.objects)), 2 if errors_mm else 1)
    names = [f"{o.instance} {models[o.obj_id].name}" for o in scene.objects]
    colors = [VERDICT_COLORS[o.verdict] for o in scene.objects]
    axes[0].barh(names, [o.checks.get("agree", 0.0) for o in scene.objects], color=colors)
    axes[0].set_xlim(0, 1)
    axes[0].set_title(
        "Share of visible pixels that agree with the measured depth", fontsize=9, loc="left"
    )
    if errors_mm:
        axes[1].barh(names, [errors_mm.get(o.instance, 0.0) for o in scene.objects], color=INK)
        axes[1].set_title("MSSD against the truth [mm]", fontsize=9, loc="left")
        axes[1].set_yticklabels([])
    for ax in axes:
        ax.invert_yaxis()
    figure.savefig(path)


def plot_school(sets: Sequence[GraspSet], models: Mapping[int, ObjectModel], path: Path) -> None:
    """Plot how many grasps passed each stage, and the scores of each object."""
    figure, (left, right) = _figure(9.0, 0.9 + 0.3 * max(5, len(sets)), 2)
    base = np.concatenate([s.base_scores for s in sets]) if sets else np.zeros(0)
    base = base[np.isfinite(base)]
    names = ["tried", *[f"passed {s}" for s in STAGES]]
    counts = [len(base), *[int(np.sum(base >= 0.25 * (k + 1))) for k in range(len(STAGES))]]
    left.barh(names, counts, color=[MUTED, *[GOOD] * len(STAGES)])
    left.invert_yaxis()
    left.bar_label(left.containers[0], fontsize=8)
    left.set_title("Grasps through the four stages", fontsize=9, loc="left")
    edges = np.linspace(0, 1, 13)
    for k, s in enumerate(sets):
        scores = s.scores[np.isfinite(s.scores)]
        share = np.histogram(scores, edges)[0] / max(1, len(scores))
        right.bar(edges[:-1], share * 0.9, width=1 / 13, align="edge", bottom=k, color=INK)
    right.set_yticks(range(len(sets)), [models[s.obj_id].name for s in sets], fontsize=8)
    right.set_xlim(0, 1)
    right.set_title("Scores (height = share of the object's grasps)", fontsize=9, loc="left")
    right.set_xlabel("score", fontsize=8)
    figure.savefig(path)
