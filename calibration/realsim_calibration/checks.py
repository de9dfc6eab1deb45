"""What a person should know of a hand-eye calibration: verdicts, each with a sentence of advice."""

from collections.abc import Iterator
from typing import Literal

import numpy as np

from realsim.arrays import Array
from realsim.records import ArmErrorMap, CameraIntrinsics, Check
from realsim_calibration.faults.hypotheses import option_of, size_name
from realsim_calibration.results import HandEyeReport

Verdict = Literal["good", "warn", "bad", "unknown"]
# From the first value on a figure is worth a warning, from the second on it is bad.
USED_VIEWS = (12, 5)
"""Used views: fewer let the covariance rest on too few of them."""
REJECTED_SHARE = (0.15, 0.4)
"""Share of views that were dropped."""
ROLL_DEG = (60.0, 20.0)
"""Range of camera roll: without roll the error was 2 to 6 times larger in simulation."""
SIGMA_MM = (1.0, 3.0)
"""1-sigma of the camera's place, for this arm as it moves here."""
SIGMA_DEG = (0.1, 0.4)
"""1-sigma of the camera's direction: 0.1 deg is 0.7 mm at 0.4 m."""
UNSEEN_MM = (2.0, 6.0)
"""Board's place predicted without the view: a UR5e's own errors leave 1 to 2 mm."""
OPTIMISM = (1.6, 3.0)
"""Unseen over seen error: beyond, the fit follows single views."""
BOARD_SCALE = (0.003, 0.02)
"""A board size that is off by this share is a misprint; by more, another board."""
SCALE_SIGMAS = 3.0
"""It must be off by this many sigma as well."""
UNSEEN_PX = (1.5, 6.0)
"""Unseen views; good real sets reach 0.3 to 1.1 px."""
FOCAL_SHARE = (0.01, 0.03)
"""Focal length against the given camera's: factory values are within 0.5 %."""
WARP_MM = (0.5, 3.0)
"""Lift of the board's border: glue the print to something flatter."""
ROBOT_DEG = (0.1, 0.5)
"""RMS rotation error of the robot's poses."""
ROBOT_MM = (1.0, 4.0)
"""RMS position error of the robot's poses."""
JOINT_OFFSET_DEG = (0.05, 0.3)
"""Zero error of a joint: beyond, the controller's kinematics are nominal, not calibrated."""


def _verdict(value: float, limits: tuple[float, float], *, high_is_bad: bool = True) -> Verdict:
    """Return the verdict of a figure."""
    if not np.isfinite(value):
        return "unknown"
    sign = 1.0 if high_is_bad else -1.0
    if sign * value > sign * limits[1]:
        return "bad"
    return "warn" if sign * value > sign * limits[0] else "good"


def _worst(*verdicts: Verdict) -> Verdict:
    """Return the worst of some verdicts."""
    return max(verdicts, key=["good", "unknown", "warn", "bad"].index)


def hand_eye_checks(report: HandEyeReport) -> tuple[Check, ...]:
    """Return every check of a hand-eye calibration."""
    return (
        _views(report),
        _roll(report),
        _sigma(report),
        *_absolute(report),
        _held_out(report),
        _optimism(report),
        _scale(report),
        _flatness(report),
        _robot(report),
        *_stretched(report),
        *_arm(report),
    )


def _advice(verdict: Verdict, text: str) -> str:
    return "" if verdict == "good" else text


def _views(r: HandEyeReport) -> Check:
    used, given = len(r.used), len(r.views)
    worst = _worst(
        _verdict(used, USED_VIEWS, high_is_bad=False), _verdict(1 - used / given, REJECTED_SHARE)
    )
    gone = [v for v in r.views if not v.used]
    empty = sum(not len(v.uv) for v in gone)
    names = "; dropped: " + ", ".join(v.label for v in gone[:6]) if gone else ""
    more = f" and {len(gone) - 6} more" if len(gone) > 6 else ""
    return Check(
        name="views",
        verdict=worst,
        sentence=f"{used} of {given} views were used{names}{more}.",
        advice=_advice(worst, "Take 24 views or more in which the whole target is sharp."
                       + " The table of views says why the others were dropped." * bool(gone)
                       + f" Images without it: {empty}; keep one board a folder." * (empty > 0)),
        value=used,
        views=tuple(v.index for v in gone),
    )  # fmt: skip


def _roll(r: HandEyeReport) -> Check:
    verdict = _verdict(r.roll_range_deg, ROLL_DEG, high_is_bad=False)
    axis = float(1e3 * np.sqrt(r.place_covariance[5, 5]))
    return Check(
        name="roll",
        verdict=verdict,
        sentence=f"the camera rolls through {r.roll_range_deg:.0f} deg about its optical axis; its "
        f"place along that axis is known to +-{axis:.2f} mm.",
        advice=_advice(verdict, f"Roll the hand by {ROLL_DEG[0]:g} deg or more between views: it "
                       "improves the result more than further views do."),
        value=r.roll_range_deg,
        unit="deg",
    )  # fmt: skip


def _sigma(r: HandEyeReport) -> Check:
    worst = _worst(_verdict(r.here_mm, SIGMA_MM), _verdict(r.here_deg, SIGMA_DEG))
    return Check(
        name="uncertainty",
        verdict=worst,
        sentence=f"for this arm as it moves here the camera's place is known to {r.here_mm:.2f} mm "
        f"and {r.here_deg:.3f} deg (1 sigma, worst axis).",
        advice=_advice(worst, "Add views: other tilts, other rolls, other distances."),
        value=r.here_mm,
        unit="mm",
    )  # fmt: skip


def _absolute(r: HandEyeReport) -> Iterator[Check]:
    """Return the check of X for another arm or a drawing: told, it never decides."""
    if r.X_here_covariance is None:
        return
    known = r.sigma_mm <= SIGMA_MM[0] and r.sigma_deg <= SIGMA_DEG[0]
    remedies = [
        ""
        if isinstance(r.robot_map, ArmErrorMap)
        else "joint angles with every pose, by which the arm's own errors are modelled",
        "the same board seen once more in a second orientation",
        "" if r.board.sd[0] == 0 else "a board whose squares were measured with a calliper",
    ]
    advice = "What would make it smaller: " + "; ".join(text for text in remedies if text) + "."
    yield Check(
        name="uncertainty elsewhere",
        verdict="good" if known else "unknown",
        sentence="these views cannot show an arm error that is the same in all poses: "
        "for another arm, a new mount or a drawing the camera's place is known to "
        f"{r.sigma_mm:.2f} mm and {r.sigma_deg:.3f} deg (1 sigma, worst axis).",
        advice="" if known else advice,
        value=r.sigma_mm,
        unit="mm",
    )


def _stretched(r: HandEyeReport) -> Iterator[Check]:
    """Return how the robot's map does beyond the poses that it was fitted on."""
    s = r.stretch
    if s is None or r.robot_map is None:
        return
    helps = s.map_px <= s.plain_px
    yield Check(
        name="map beyond its poses",
        verdict="good" if helps else "warn",
        sentence=f"the {len(s.views)} outermost views, held out together, are predicted to "
        f"{s.map_px:.2f} px with the robot's map and to {s.plain_px:.2f} px without.",
        advice=""
        if helps
        else "Keep to the poses of these views, or calibrate with views where the arm will work.",
        value=s.map_px,
        unit="px",
        views=s.views,
    )


def _held_out(r: HandEyeReport) -> Check:
    verdict = _worst(_verdict(r.held_out_mm, UNSEEN_MM), _verdict(r.held_out_px, UNSEEN_PX))
    worst = sorted(r.used, key=lambda v: -v.unseen_px)[:3]
    return Check(
        name="held-out error",
        verdict=verdict,
        sentence=f"views that the fit has not seen are predicted to {r.held_out_px:.2f} px, "
        f"{r.held_out_mm:.2f} mm and {r.held_out_deg:.3f} deg; worst "
        + ", ".join(f"{v.label} ({v.unseen_px:.2f} px)" for v in worst) + ".",
        advice=_advice(verdict, "Check that the board was fixed, the arm at rest in every picture "
                       "and the robot's own calibration in use. Begin with the views named."),
        value=r.held_out_px,
        unit="px",
        views=tuple(v.index for v in worst),
    )  # fmt: skip


def _optimism(r: HandEyeReport) -> Check:
    ratio = r.held_out_px / max(r.seen_px, 1e-9)
    verdict = _verdict(ratio, OPTIMISM)
    return Check(
        name="overfitting",
        verdict=verdict,
        sentence=f"seen views fit to {r.seen_px:.2f} px, unseen ones to {r.held_out_px:.2f} px "
        f"({ratio:.1f} times).",
        advice=_advice(verdict, "The fit follows single views: take more views."),
        value=ratio,
    )  # fmt: skip


def _scale(r: HandEyeReport) -> Check:
    b = r.board
    sd = float(b.sd[0])
    off = abs(b.scale - 1)
    if sd == 0:
        said = "these data cannot measure the board's size: the size given was used."
        return Check(name="board size", verdict="unknown", sentence=said)
    verdict = _verdict(off, BOARD_SCALE)
    if verdict == "bad" and off <= SCALE_SIGMAS * sd:
        verdict = "warn"
    return Check(
        name="board size",
        verdict=verdict,
        sentence=f"by the robot's metres the board is {b.scale:.4f} +-{sd:.4f} times the size "
        f"given; its ratio of height to width is {1 + b.aspect:.4f}.",
        advice=_advice(verdict, "Measure the print over several squares with a calliper: by the "
                       f"robot {size_name(r.target, b.scale)}. If the calliper agrees, give "
                       f"{option_of(r.target, b.scale)} in --board."),
        value=b.scale,
    )  # fmt: skip


def _flatness(r: HandEyeReport) -> Check:
    if not np.any(r.board.sd[2:]):
        return Check(name="board flatness", verdict="unknown", sentence="the board was held flat.")
    verdict = _verdict(r.board.warp_mm, WARP_MM)
    return Check(
        name="board flatness",
        verdict=verdict,
        sentence=f"with the poses the board bends by up to {r.board.warp_mm:.2f} mm; the fit "
        "allows for it.",
        advice=_advice(verdict, "Glue the print to glass or aluminium."),
        value=r.board.warp_mm,
        unit="mm",
    )


def given_camera_check(f_given: float, f_fitted: float) -> Check:
    """Return the check of a camera that was given against the one that the views show."""
    return _focal_check(
        f_given, f_fitted, "given camera",
        "the views show a focal length of {:.1f} px, the given camera has {:.1f} px ({:+.1f} %).",
        "Check that it is the camera, resolution and focus of these images, or leave the camera "
        "out to calibrate the lens from these views.",
    )  # fmt: skip


def own_lens_check(alone: CameraIntrinsics, fitted: CameraIntrinsics, covariance: Array) -> Check:
    """Return the check of a lens from the views alone against the one that the poses agree with.

    `covariance` (2, 2) is that of the difference of the principal points, as if they were apart.
    """
    f_alone, f_fitted = (float(np.sqrt(c.fx * c.fy)) for c in (alone, fitted))
    step = np.array([fitted.cx - alone.cx, fitted.cy - alone.cy])
    sigmas = float(np.sqrt(step @ np.linalg.pinv(covariance) @ step))
    px = float(np.linalg.norm(step))
    return _focal_check(
        f_alone, f_fitted, "focal length with poses",
        "with the robot's poses the views show a focal length of {:.1f} px, without them {:.1f} px "
        f"({{:+.1f}} %). The principal points lie {px:.1f} px apart, {sigmas:.1f} combined sigma, "
        "of which a tilt of the camera and the tangential distortion take up a part.",
        "Add views at other distances and tilts: these hardly tell focal length and principal "
        "point from the camera's place. Was the focus changed between them?",
        px / f_alone,
    )  # fmt: skip


def _focal_check(
    f_before: float, f_fitted: float, name: str, sentence: str, advice: str,
    moved: float = 0.0,
) -> Check:  # fmt: skip
    off = f_fitted / f_before - 1
    verdict = _verdict(max(abs(off), moved), FOCAL_SHARE)
    return Check(
        name=name,
        verdict=verdict,
        sentence=sentence.format(f_fitted, f_before, 100 * off),
        advice=_advice(verdict, advice),
        value=off,
    )


def _robot(r: HandEyeReport) -> Check:
    errors = np.array([v.robot_error for v in r.used])
    deg = float(np.degrees(np.sqrt(np.mean(np.sum(errors[:, :3] ** 2, -1)))))
    mm = float(1e3 * np.sqrt(np.mean(np.sum(errors[:, 3:] ** 2, -1))))
    worst = _worst(_verdict(deg, ROBOT_DEG), _verdict(mm, ROBOT_MM))
    if r.robot_map is None:
        kind = "no map of it predicts unseen views better"
    elif isinstance(r.robot_map, ArmErrorMap):
        kind = "part of it is the arm's joints and links, which are corrected"
    else:
        kind = "part of it is smooth and corrected by a map, valid among the poses of these views"
    return Check(
        name="robot poses",
        verdict=worst,
        sentence=f"the robot's poses are off by {mm:.2f} mm and {deg:.3f} deg (RMS); {kind}.",
        advice=_advice(worst, "Use the controller's factory-calibrated pose, not a nominal URDF; "
                       "keep to poses like those calibrated with."),
        value=mm,
        unit="mm",
    )  # fmt: skip


def _arm(r: HandEyeReport) -> Iterator[Check]:
    if r.joint_offsets is None:
        return
    inner = np.degrees(r.joint_offsets[1:5])
    value = float(np.abs(inner[:, 0]).max())
    verdict = _verdict(value, JOINT_OFFSET_DEG)
    text = ", ".join(f"{k + 2}: {o:+.3f}+-{s:.3f}" for k, (o, s) in enumerate(inner))
    yield Check(
        name="joint zeros",
        verdict=verdict,
        sentence=f"zero offsets of joints [deg] {text}.",
        advice=_advice(
            verdict,
            "These look like nominal kinematics: read calibration.conf from the controller.",
        ),
        value=value,
        unit="deg",
    )
