"""Plots of the calibration, the plan and the capture."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from realsim.geometry import se3
from realsim.pages.plots import (
    BAD,
    GOOD,
    INK,
    MUTED,
    WARN,
    axes,
    legend,
    png,
    titled,
    whole_numbers,
)
from realsim.records import HandEye

Array = NDArray[np.float64]
OUTLIER = 2.5
"""Board views beyond so many medians are drawn in another colour."""


def board_residuals(hand_eye: HandEye) -> bytes:
    """Plot how well every board view is predicted through the robot pose."""
    figure, ax = axes()
    views, rms = list(hand_eye.view_indices), np.asarray(hand_eye.view_rms_px)
    far = rms > OUTLIER * np.median(rms)
    ax.bar(views, rms, 0.8, color=np.where(far, WARN, GOOD).tolist())
    unseen = float(np.nan_to_num(hand_eye.held_out_px))
    if unseen:
        told = f"views that the fit has not seen: {unseen:.2f} px"
        ax.axhline(unseen, color=BAD, lw=1.5, ls="--", label=told)
        legend(ax, loc="upper left")
    ax.set_ylim(0, 1.25 * max(float(rms.max()), unseen))
    whole_numbers(ax.xaxis)
    titled(ax, "Residuals of the board views", "board view", "RMS reprojection [px]")
    return png(figure)


def board_directions(hand_eye: HandEye, Ts_base_ee: Sequence[Array]) -> bytes:
    """Plot how the arm turned the camera: tilt from straight down, and roll."""
    figure, ax = axes()
    T = np.stack(Ts_base_ee) @ hand_eye.T_ee_cam
    tilt = np.degrees(np.arccos(np.clip(-T[:, 2, 2], -1, 1)))
    roll = np.degrees(np.arctan2(T[:, 1, 0], T[:, 0, 0]))
    ax.scatter(roll, tilt, s=22, color=INK)
    ax.set_xlim(-185, 185)
    ax.set_xticks([-180, -90, 0, 90, 180])
    ax.set_ylim(bottom=0)
    titled(
        ax, "Diversity of the board views: spread is good", "direction of the image's x axis [deg]",
        "tilt from straight down [deg]",
    )  # fmt: skip
    return png(figure)


def intrinsics_change(names: Sequence[str], values: Sequence[float], sd: Sequence[float]) -> bytes:
    """Plot the calibrated lens against the camera that was given, in pixels."""
    figure, ax = axes()
    ax.axhline(0, color=MUTED, lw=1)
    ax.errorbar(range(len(names)), values, yerr=2 * np.asarray(sd), fmt="o", color=INK, capsize=4)
    ax.set_xticks(range(len(names)), names)
    ax.margins(x=0.2)
    titled(ax, "Lens as calibrated less the given camera (bars: 2 sigma)", "", "difference [px]")
    return png(figure)


def coverage(Ts_base_cam: Array, center: Array, captured: Sequence[bool]) -> bytes:
    """Plot from which directions the planned views look at the scene's middle, as from above."""
    figure, ax = axes()
    away = Ts_base_cam[:, :3, 3] - center
    distance = np.linalg.norm(away, axis=1)
    azimuth = np.degrees(np.arctan2(away[:, 1], away[:, 0]))
    elevation = np.degrees(np.arcsin(np.clip(away[:, 2] / distance, -1, 1)))
    done = np.asarray(captured, dtype=bool)
    for mine, marker, color, label in (
        (done, "o", GOOD, "captured"), (~done, "x", BAD, "planned, not captured"),
    ):  # fmt: skip
        if mine.any():
            ax.scatter(
                azimuth[mine], elevation[mine], s=28, marker=marker, color=color, label=label
            )
    ax.set_xlim(-185, 185)
    ax.set_xticks([-180, -90, 0, 90, 180])
    ax.set_ylim(0, 95)
    if not done.all():
        legend(ax, loc="upper right")
    titled(
        ax, "Directions from which the views look at the scene", "azimuth [deg]", "elevation [deg]"
    )
    return png(figure)


def settling(settle_s: Mapping[int, float]) -> bytes:
    """Plot how long the arm took to stand still before every view."""
    figure, ax = axes()
    ax.bar(list(settle_s), [1e3 * v for v in settle_s.values()], 0.8, color=GOOD)
    whole_numbers(ax.xaxis)
    titled(ax, "Time until the arm stood still", "view", "settling [ms]")
    return png(figure)


def photographs(measured: Mapping[int, Mapping[str, float]]) -> bytes:
    """Plot the sharpness and the depth of every photograph."""
    figure, ax = axes()
    views = list(measured)
    for name, label, marker, color in (
        ("depth_fill", "pixels with depth", "o", GOOD),
        ("sharpness", "sharpness", "s", INK),
    ):
        values = [measured[v].get(name, np.nan) for v in views]
        if np.isfinite(values).any():
            ax.plot(views, values, marker=marker, ms=4, lw=1, color=color, label=label)
    ax.set_ylim(0, 1.25)
    legend(ax, loc="upper left", ncols=2)
    whole_numbers(ax.xaxis)
    titled(ax, "Checks of the photographs", "view", "share")
    return png(figure)


def camera_moves(before: Mapping[int, Array], after: Mapping[int, Array]) -> bytes:
    """Plot how far registration moved every camera."""
    figure, ax = axes()
    views = [k for k in sorted(after) if k in before]
    deltas = np.stack([se3.invert(before[k]) @ after[k] for k in views])
    mm = 1e3 * np.linalg.norm(deltas[:, :3, 3], axis=1)
    far = mm > OUTLIER * max(1e-12, float(np.median(mm)))
    ax.bar(views, mm, 0.8, color=np.where(far, WARN, GOOD).tolist())
    whole_numbers(ax.xaxis)
    titled(ax, "Cameras before and after registration", "view", "moved by [mm]")
    return png(figure)
