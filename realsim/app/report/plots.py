"""The plots of one report: capture, calibration, registration, Robot School and labels."""

from collections.abc import Mapping, Sequence

import numpy as np

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.pages import plots
from realsim.records import STAGES, GraspSet, HandEye

OUTLIER = 2.5
"""Board views beyond so many medians are drawn in another colour."""


def board_residuals(hand_eye: HandEye) -> bytes:
    """Plot how well every board view is predicted through the robot pose."""
    figure, ax = plots.axes("Residuals of the board views", "board view", "RMS reprojection [px]")
    views, rms = list(hand_eye.view_indices), np.asarray(hand_eye.view_rms_px)
    far = rms > OUTLIER * np.median(rms)
    ax.bar(views, rms, 0.8, color=np.where(far, plots.WARN, plots.GOOD).tolist())
    unseen = float(np.nan_to_num(hand_eye.held_out_px))
    if unseen:
        told = f"views that the fit has not seen: {unseen:.2f} px"
        ax.axhline(unseen, color=plots.BAD, lw=1.5, ls="--", label=told)
        plots.legend(ax, loc="upper left")
    ax.set_ylim(0, 1.25 * max(float(rms.max()), unseen))
    plots.whole_numbers(ax.xaxis)
    return plots.png(figure)


def board_directions(hand_eye: HandEye, Ts_base_ee: Sequence[Array]) -> bytes:
    """Plot how the arm turned the camera: tilt from straight down, and roll."""
    figure, ax = plots.axes(
        "Diversity of the board views: spread is good",
        "direction of the image's x axis [deg]",
        "tilt from straight down [deg]",
    )
    T = np.stack(Ts_base_ee) @ hand_eye.T_ee_cam
    tilt = np.degrees(np.arccos(np.clip(-T[:, 2, 2], -1, 1)))
    roll = np.degrees(np.arctan2(T[:, 1, 0], T[:, 0, 0]))
    ax.scatter(roll, tilt, s=22, color=plots.INK)
    ax.set_xlim(-185, 185)
    ax.set_xticks([-180, -90, 0, 90, 180])
    ax.set_ylim(bottom=0)
    return plots.png(figure)


def intrinsics_change(names: Sequence[str], values: Sequence[float], sd: Sequence[float]) -> bytes:
    """Plot the calibrated lens against the camera that was given, in pixels."""
    figure, ax = plots.axes(
        "Lens as calibrated less the given camera (bars: 2 sigma)", "", "difference [px]"
    )
    ax.axhline(0, color=plots.MUTED, lw=1)
    ax.errorbar(
        range(len(names)), values, yerr=2 * np.asarray(sd), fmt="o", color=plots.INK, capsize=4
    )
    ax.set_xticks(range(len(names)), names)
    ax.margins(x=0.2)
    return plots.png(figure)


def coverage(Ts_base_cam: Array, center: Array, captured: Sequence[bool]) -> bytes:
    """Plot from which directions the planned views look at the scene's middle, as from above."""
    figure, ax = plots.axes(
        "Directions from which the views look at the scene", "azimuth [deg]", "elevation [deg]"
    )
    away = Ts_base_cam[:, :3, 3] - center
    distance = np.linalg.norm(away, axis=1)
    azimuth = np.degrees(np.arctan2(away[:, 1], away[:, 0]))
    elevation = np.degrees(np.arcsin(np.clip(away[:, 2] / distance, -1, 1)))
    done = np.asarray(captured, dtype=bool)
    for mine, marker, color, label in (
        (done, "o", plots.GOOD, "captured"), (~done, "x", plots.BAD, "planned, not captured"),
    ):  # fmt: skip
        if mine.any():
            ax.scatter(
                azimuth[mine], elevation[mine], s=28, marker=marker, color=color, label=label
            )
    ax.set_xlim(-185, 185)
    ax.set_xticks([-180, -90, 0, 90, 180])
    ax.set_ylim(0, 95)
    if not done.all():
        plots.legend(ax, loc="upper right")
    return plots.png(figure)


def settling(settle_s: Mapping[int, float]) -> bytes:
    """Plot how long the arm took to stand still before every view."""
    figure, ax = plots.axes("Time until the arm stood still", "view", "settling [ms]")
    ax.bar(list(settle_s), [1e3 * v for v in settle_s.values()], 0.8, color=plots.GOOD)
    plots.whole_numbers(ax.xaxis)
    return plots.png(figure)


def photographs(measured: Mapping[int, Mapping[str, float]]) -> bytes:
    """Plot the sharpness and the depth of every photograph."""
    figure, ax = plots.axes("Checks of the photographs", "view", "share")
    views = list(measured)
    for name, label, marker, color in (
        ("depth_fill", "pixels with depth", "o", plots.GOOD),
        ("sharpness", "sharpness", "s", plots.INK),
    ):
        values = [measured[v].get(name, np.nan) for v in views]
        if np.isfinite(values).any():
            ax.plot(views, values, marker=marker, ms=4, lw=1, color=color, label=label)
    ax.set_ylim(0, 1.25)
    plots.legend(ax, loc="upper left", ncols=2)
    plots.whole_numbers(ax.xaxis)
    return plots.png(figure)


def camera_moves(before: Mapping[int, Array], after: Mapping[int, Array]) -> bytes:
    """Plot how far registration moved every camera."""
    figure, ax = plots.axes("Cameras before and after registration", "view", "moved by [mm]")
    views = [k for k in sorted(after) if k in before]
    deltas = np.stack([se3.invert(before[k]) @ after[k] for k in views])
    mm = 1e3 * np.linalg.norm(deltas[:, :3, 3], axis=1)
    far = mm > OUTLIER * max(1e-12, float(np.median(mm)))
    ax.bar(views, mm, 0.8, color=np.where(far, plots.WARN, plots.GOOD).tolist())
    plots.whole_numbers(ax.xaxis)
    return plots.png(figure)


MOST_BARS = 12
"""Reasons in one plot; further ones are summed up."""
LONGEST_LABEL = 44


def probabilities(
    names: Sequence[str], values: Sequence[float], verdicts: Sequence[str], accept: float
) -> bytes:
    """Plot the probability that every object is right, in the colour of its verdict."""
    figure, ax = plots.bars(
        names, values, [plots.VERDICT_COLORS[v] for v in verdicts],
        f"Probability that an object is right (dashed: {accept:g})",
        "probability of less than 3 mm",
    )  # fmt: skip
    for k, (value, verdict) in enumerate(zip(values, verdicts, strict=True)):
        inside = value > 0.3
        ax.text(
            value - 0.01 if inside else value + 0.01, k, verdict, va="center", fontsize=8,
            ha="right" if inside else "left", color="white" if inside else plots.INK,
        )  # fmt: skip
    ax.axvline(accept, color=plots.INK, lw=1, ls="--")
    ax.set_xlim(0, 1)
    return plots.png(figure)


def view_uncertainty(sigma_px: Mapping[int, Sequence[float]], left_out: Sequence[int]) -> bytes:
    """Plot how certain the objects are in every view: median, least and greatest."""
    figure, ax = plots.axes("Where the labels lie in every view, 1 sigma", "view", "1 sigma [px]")
    views = sorted(sigma_px)
    rows = [np.asarray(sigma_px[k], dtype=np.float64) for k in views]
    middle = np.array([np.median(r) for r in rows])
    low, high = (np.array([f(r) for r in rows]) for f in (np.min, np.max))
    ax.vlines(views, low, high, color=plots.MUTED, lw=2, label="least to greatest object")
    ax.plot(views, middle, "o", ms=4, color=plots.INK, label="median object")
    if left_out:
        ax.plot(list(left_out), [0] * len(left_out), "x", ms=7, color=plots.BAD,
                label="took no part", clip_on=False)  # fmt: skip
    ax.set_ylim(0, 1.35 * float(high.max()))
    plots.whole_numbers(ax.xaxis)
    plots.legend(ax, loc="upper left", ncols=3)
    return plots.png(figure)


def sigmas(names: Sequence[str], mm: Sequence[float], verdicts: Sequence[str]) -> bytes:
    """Plot 1 sigma of the objects' positions."""
    figure, _ = plots.bars(
        names, np.nan_to_num(mm).tolist(), [plots.VERDICT_COLORS[v] for v in verdicts],
        "How certain the objects' places are", "1 sigma along the worst axis [mm]",
    )  # fmt: skip
    return plots.png(figure)


def stages(tried: int, reachable: int, base_scores: Array) -> bytes:
    """Plot how many grasps passed each stage."""
    names = ["tried", "reached by the arm", *[f"passed: {s}" for s in STAGES]]
    passed = [int(np.sum(base_scores >= 0.25 * (k + 1))) for k in range(len(STAGES))]
    counts = [tried, reachable, *passed]
    figure, ax = plots.axes(
        "Grasps through the four stages", "grasps", "", height_px=90 + plots.BAR_PX * len(names)
    )
    drawn = ax.barh(
        names, counts, 0.7, color=[plots.MUTED, plots.MUTED, *[plots.GOOD] * len(STAGES)]
    )
    labels = [f"{n} ({100 * n / max(1, tried):.0f} %)" for n in counts]
    ax.bar_label(drawn, labels, fontsize=8, padding=3, color=plots.INK)
    ax.set_xlim(0, 1.2 * max(1, *counts))
    ax.invert_yaxis()
    plots.whole_numbers(ax.xaxis)
    return plots.png(figure)


def labels(sets: Sequence[GraspSet]) -> bytes:
    """Plot how the p_hold of grasps is distributed, of sets without one the score."""
    from realsim_sim_bridge.school.measure_statistics import label_chart

    figure, ax = plots.axes()
    counts, title, name = label_chart(sets)
    plots.share_bars(ax, counts, title, name, "grasps")
    return plots.png(figure)


def slips(slip_mm: Array, slip_deg: Array) -> bytes:
    """Plot how far objects slipped in grasps that kept them, and how far they turned."""
    figure, ax = plots.axes(
        f"Largest slip of {len(slip_mm)} grasps that kept their object",
        "slip in the hand [mm]",
        "turn in the hand [deg]",
    )
    ax.scatter(slip_mm, slip_deg, s=14, color=plots.INK, alpha=0.6, linewidths=0)
    ax.set_xscale("symlog", linthresh=0.1)
    ax.set_yscale("symlog", linthresh=0.1)
    ax.set_xlim(left=0)
    ax.set_ylim(bottom=0)
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_formatter("{x:g}")
    return plots.png(figure)


def failures(counts: Mapping[str, int]) -> bytes:
    """Plot why grasps failed, the most frequent reasons first."""
    ordered = sorted(counts.items(), key=lambda item: (-item[1], item[0]))
    shown, rest = ordered[:MOST_BARS], ordered[MOST_BARS:]
    if rest:
        shown.append((f"{len(rest)} other reasons", sum(n for _, n in rest)))
    names = [_shortened(name) for name, _ in shown]
    figure, ax = plots.axes(
        "Where grasps failed", "grasps", "", height_px=90 + plots.BAR_PX * len(shown)
    )
    drawn = ax.barh(range(len(shown)), [n for _, n in shown], 0.7, color=plots.WARN)
    ax.set_yticks(range(len(shown)), names, fontsize=8)
    ax.bar_label(drawn, fontsize=8, padding=3, color=plots.INK)
    ax.margins(x=0.15)
    ax.invert_yaxis()
    plots.whole_numbers(ax.xaxis)
    return plots.png(figure)


def _shortened(name: str) -> str:
    name = f"lost while: {name}" if name in STAGES else name
    return name if len(name) <= LONGEST_LABEL else name[: LONGEST_LABEL - 1] + "…"


def visibility(shares: Array) -> bytes:
    """Plot how visible the objects are in the frames."""
    figure, ax = plots.axes(
        f"Visible share of {len(shares)} objects in frames", "visible share", "number"
    )
    ax.hist(shares, np.linspace(0, 1, 21).tolist(), color=plots.GOOD, rwidth=0.9)
    plots.whole_numbers(ax.yaxis)
    return plots.png(figure)
