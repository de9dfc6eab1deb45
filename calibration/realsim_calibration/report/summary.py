"""A calibration in words and numbers: verdict, headline figures, checks; and where views stood."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from realsim.arrays import Array
from realsim.geometry import metrics, se3
from realsim.records import ArmErrorMap, Check, RobotErrorMap
from realsim.records.calibration import worst_first, worst_sigmas
from realsim_calibration.exports.frames import quaternion_xyzw, roll_pitch_yaw
from realsim_calibration.results import Clock, HandEyeReport, ViewReport
from realsim_calibration.views import target_middle

Verdict = Literal["good", "warn", "bad", "unknown"]
NOT_KNOWN = "not known"


@dataclass(frozen=True, kw_only=True, slots=True)
class Judgement:
    """A calibration in one sentence."""

    verdict: Verdict
    headline: str
    """What to do with it, in a few words."""
    sentence: str
    """Why."""


def amount(value: float, digits: int, unit: str = "") -> str:
    """Return a number with its unit, "not known" where it is none."""
    return f"{value:.{digits}f} {unit}".strip() if np.isfinite(value) else NOT_KNOWN


def verdict(report: HandEyeReport, lens: Sequence[Check] = ()) -> Judgement:
    """Return the judgement of a calibration from its checks and those of the lens alone."""
    checks = worst_first((*report.checks, *lens))
    bad = [c for c in checks if c.verdict == "bad"]
    warn = [c for c in checks if c.verdict == "warn"]
    unknown = [c for c in checks if c.verdict == "unknown"]
    figures = (
        f"Views that it had not seen are predicted within {amount(report.held_out_px, 2, 'px')}, "
        f"{amount(report.held_out_mm, 2, 'mm')} and {amount(report.held_out_deg, 3, 'deg')} (RMS)."
        if np.isfinite(report.held_out_px)
        else "How well it predicts views that it had not seen is not known."
    )
    if bad:
        return Judgement(
            verdict="bad",
            headline="Do not use this calibration yet",
            sentence=f"{len(bad)} of {len(checks)} checks failed. {_words(bad[0])}",
        )
    if warn:
        return Judgement(
            verdict="warn",
            headline="Usable, with care",
            sentence=f"{len(warn)} of {len(checks)} checks gave a warning. {_words(warn[0])} "
            f"{figures}",
        )
    if len(unknown) == len(checks):
        return Judgement(
            verdict="unknown", headline="Not judged", sentence=f"Nothing was checked. {figures}"
        )
    rest = f", {len(unknown)} could not be made" if unknown else ""
    return Judgement(
        verdict="good",
        headline="Good to use",
        sentence=f"{len(checks) - len(unknown)} checks passed{rest}. {figures}",
    )


def _words(check: Check) -> str:
    """Return a check's sentence, its name before it."""
    return f"{check.name[:1].upper()}{check.name[1:]}: {check.sentence}"


def check_rows(report: HandEyeReport, lens: Sequence[Check] = ()) -> list[list[str]]:
    """Return (verdict, check, value, what was found, what to do) of every check, worst first.

    Checks of the lens alone name views in their sentences.
    """
    names = {v.index: v.label for v in report.views}
    rows: list[list[str]] = []
    for c in worst_first((*report.checks, *lens)):
        found = c.sentence
        if c.views and c not in lens:
            found += f" Views: {', '.join(names.get(k, str(k)) for k in c.views)}."
        value = f"{c.value:.4g} {c.unit}".strip() if np.isfinite(c.value) else ""
        rows.append([c.verdict, c.name, value, found, c.advice])
    return rows


def carrier(report: HandEyeReport) -> str:
    """Return what carries the camera: "tool" or "base"."""
    return "tool" if report.mode == "eye_in_hand" else "base"


def pose_rows(report: HandEyeReport) -> list[list[str]]:
    """Return the rows that say where the camera is for this arm, 1 sigma along the carrier's axes.

    With a robot map the X that is used with it is elsewhere: the map's mean is in X for this arm.
    """
    X, what = report.X if report.X_here is None else report.X_here, carrier(report)
    # The covariance is that of a right perturbation: along the camera's axes.
    in_carrier = X[:3, :3] @ report.place_covariance[3:, 3:] @ X[:3, :3].T
    sd = 1e3 * np.sqrt(np.diag(in_carrier))
    place = [
        f"{a} {1e3 * v:.3f} ± {amount(s, 3)}" for a, v, s in zip("xyz", X[:3, 3], sd, strict=True)
    ]
    q = ", ".join(f"{v:.6f}" for v in quaternion_xyzw(X))
    rpy = ", ".join(f"{np.degrees(v):.3f}" for v in roll_pitch_yaw(X[:3, :3]))
    rows = [
        [f"camera in the {what} for this arm [mm], ± 1 sigma", ", ".join(place)],
        ["roll, pitch, yaw about fixed axes [deg]", f"{rpy} (± {report.here_deg:.4f})"],
        ["quaternion x, y, z, w", q],
        ["looks along", looks_along(report)],
    ]
    used = "none: the controller's poses are taken as they are"
    if report.robot_map is not None:
        moved = float(metrics.translation_error_mm(report.X, report.X_alone))
        turned = float(metrics.rotation_error_deg(report.X, report.X_alone))
        used = f"in use; X_alone, which needs none, is {moved:.2f} mm and {turned:.3f} deg from X"
    rows.append(["robot error map", used])
    if (s := report.stretch) is not None:
        held = f"{amount(s.map_px, 3, 'px')} with the map, {amount(s.plain_px, 3, 'px')} without"
        rows.append([f"the {len(s.views)} outermost views, held out together", held])
    if report.plain_scores:
        held = ", ".join(
            f"{name} {amount(px, 2)}{' (taken)' * (name == report.plain_name)}"
            for name, px in report.plain_scores
        )
        rows.append(["candidates for X_alone: unseen views without a map [px]", held])
    files = "X_alone, in exports/: ros2_static_transform.sh, camera.urdf"
    rows.append(["camera pose for ROS and URDF", files])
    return rows


PLACES_HEADER = (
    "the camera's place for", "in files", "x, y, z [mm]", "1 sigma for this arm as it moves here",
    "1 sigma absolute",
)  # fmt: skip


def places_rows(report: HandEyeReport) -> list[list[str]]:
    """Return what each X is for, its name in files, its place and its sigmas, worst axis."""

    def row(use: str, name: str, T: Array, here: Array | None, absolute: Array | None) -> list[str]:
        place = ", ".join(f"{1e3 * v:.2f}" for v in T[:3, 3])
        sigmas = ("-" if C is None else _sigmas(C) for C in (here, absolute))
        return [use, name, place, *sigmas]

    rows: list[list[str]] = []
    if report.X_here is not None:
        use = "this arm as it moves here"
        rows.append(row(use, "X_here", report.X_here, report.X_here_covariance, None))
    absolute = "another arm, a new mount, a drawing"
    if report.robot_map is not None:
        absolute += "; this arm through its error map"
    rows.append(row(absolute, "X", report.X, None, report.X_covariance))
    plain = "programs that know no error map: ROS, URDF, OpenCV"
    here = report.X_alone_here_covariance
    return [*rows, row(plain, "X_alone", report.X_alone, here, report.X_alone_covariance)]


def _sigmas(covariance: Array) -> str:
    """Return the sigmas along the worst axes in words."""
    mm, deg = worst_sigmas(covariance)
    return f"{mm:.3f} mm, {deg:.4f} deg"


def looks_along(report: HandEyeReport) -> str:
    """Return the optical axis in words: the nearest axis of the carrier and the angle to it."""
    z, what = report.X[:3, 2], carrier(report)
    k = int(np.argmax(np.abs(z)))
    off = np.degrees(np.arccos(np.clip(abs(z[k]), 0.0, 1.0)))
    sign = "+" if z[k] > 0 else "-"
    return f"{what} {sign}{'xyz'[k]}, {off:.1f} deg off it"


def accuracy_rows(report: HandEyeReport) -> list[list[str]]:
    """Return the rows that say how good the calibration is."""
    ratio = report.held_out_px / report.seen_px if report.seen_px > 0 else float("nan")
    compared = f"; unseen / seen = {ratio:.2f}" if np.isfinite(ratio) else ""
    unseen = f"{amount(report.held_out_px, 3, 'px')}, {amount(report.held_out_mm, 3, 'mm')}"
    unseen += f", {amount(report.held_out_deg, 4, 'deg')} RMS"
    rows = [
        ["unseen views (each predicted without it)", unseen],
        ["seen views (in-sample)", f"{amount(report.seen_px, 3, 'px')} RMS{compared}"],
        ["what a perfect calibration of this kind leaves", amount(report.floor_px, 3, "px")],
        ["corner noise", amount(report.sigma_px, 3, "px")],
        ["views used, dropped", f"{len(report.used)}, {len(report.rejected)}"],
        ["roll about the optical axis", amount(report.roll_range_deg, 0, "deg")],
    ]
    if report.clock is not None:
        rows.append(["clock offset arm to camera", clock_in_words(report.clock)])
    return rows


def clock_in_words(clock: Clock) -> str:
    """Return the offset of the clocks in words."""
    sigma = f"± {1e3 * clock.sigma_s:.2f} ms" if np.isfinite(clock.sigma_s) else "ms, as given"
    used = "applied" if clock.applied else "too small to matter, left out"
    if abs(clock.offset_s) > 1.0:
        return f"{clock.offset_s:+.6f} s {sigma.replace('ms, as', 'as')}, {used}"
    return f"{1e3 * clock.offset_s:+.2f} {sigma}, {used}"


def summary_rows(report: HandEyeReport) -> list[list[str]]:
    """Return (figure, value) rows for a table in the terminal."""
    b = report.board
    size = f"{b.scale:.5f} " + (f"± {amount(b.sd[0], 5)}" if b.sd[0] != 0 else "(held)")
    return [
        *pose_rows(report),
        *accuracy_rows(report),
        ["target's scale", f"{size}, warp {amount(b.warp_mm, 2, 'mm')}"],
    ]


# --- where the views stood ----------------------------------------------------------------------


def camera_in_board(report: HandEyeReport, view: ViewReport) -> Array:
    """Return T_board_cam (4, 4) [m] of a view, through the robot's pose and its map."""
    A = corrected(report, view)
    if report.mode == "eye_in_hand":
        return se3.invert(report.Z_points) @ A @ report.X
    return se3.invert(report.Z_points) @ se3.invert(A) @ report.X


def corrected(report: HandEyeReport, view: ViewReport) -> Array:
    """Return T_base_ee (4, 4) [m] of a view, the error that the map knows taken out.

    A map of the arm needs joints: of a view without any the controller's pose is returned,
    millimetres off, which is enough to draw it.
    """
    known = _mapped(report, view)
    return np.asarray(view.T_base_ee) if known is None else known


def _mapped(report: HandEyeReport, view: ViewReport) -> Array | None:
    """Return where the map says that the hand is (4, 4) [m]; None where it says nothing."""
    if isinstance(report.robot_map, RobotErrorMap):
        return report.robot_map.corrected(view.T_base_ee)
    if isinstance(report.robot_map, ArmErrorMap) and view.joints is not None:
        return report.robot_map.corrected(view.T_base_ee, view.joints)
    return None


def rest_of_map(report: HandEyeReport, view: ViewReport) -> Array | None:
    """Return the robot's error (6,) that the map leaves, rotation first [rad, m].

    None where there is no map, or one of the arm and the view's joints are not known.
    """
    mapped = _mapped(report, view)
    if mapped is None:
        return None
    return se3.log(se3.invert(mapped) @ view.T_base_ee @ se3.exp(view.robot_error))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Viewpoint:
    """From where a view sees the target."""

    tilt_deg: float
    """Between the target's normal and the line from its middle to the camera [deg]."""
    azimuth_deg: float
    """Direction of that line about the normal, from the target's x axis [deg]."""
    roll_deg: float
    """Turn of the camera about its optical axis [deg]."""
    distance_m: float


def viewpoint(report: HandEyeReport, view: ViewReport) -> Viewpoint:
    """Return from where a view sees the target."""
    T = camera_in_board(report, view)
    away = T[:3, 3] - target_middle(report.target)
    distance = float(np.linalg.norm(away))
    # The board's z points into the paper, away from the camera.
    tilt = np.degrees(np.arccos(np.clip(-away[2] / max(distance, 1e-12), -1.0, 1.0)))
    T_cam_board = se3.invert(T)
    return Viewpoint(
        tilt_deg=float(tilt),
        azimuth_deg=float(np.degrees(np.arctan2(away[1], away[0]))),
        roll_deg=float(np.degrees(np.arctan2(T_cam_board[1, 0], T_cam_board[0, 0]))),
        distance_m=distance,
    )
