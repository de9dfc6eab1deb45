"""What is looked at in a camera calibration, and what to do about it."""

import numpy as np

from realsim.geometry.camera import undistort
from realsim.records import CameraIntrinsics, Check
from realsim_calibration.fit.view_system import camera_vector
from realsim_calibration.lens.bundle import CAMERA_TERMS, Prior
from realsim_calibration.lens.covariance import border_pixels
from realsim_calibration.lens.models import TERM_NAMES
from realsim_calibration.lens.report import IntrinsicsReport

GOOD_VIEWS = 12
"""Views from which on the covariance can be trusted."""
GOOD_SHARE = 0.8
"""Share of the image's cells with corners."""
BAD_SHARE = 0.4
"""Share below which the lens is a guess in most of the image."""
GOOD_FOCAL = 0.005
"""1-sigma of the focal length, relative: 2 mm at 0.4 m."""
GOOD_RMS_PX = 1.0
"""RMS of the residuals [px]; good corners are below 0.3."""
GOOD_UNSEEN_RATIO = 1.3
"""Error on unseen views relative to the error in sample."""
GOOD_BORDER_PX = 1.0
"""1-sigma of the lens at the image's border [px]."""
GOOD_WARP_MM = 1.0
"""Bending of the board [mm] above which a flatter one is advised; it is modelled."""
GOOD_ASPECT = 0.003
"""Stretch of the print above which it is named; it is modelled."""
OUTLIER_SHARE = 0.02
"""Share of outlier corners that is no news."""
BELIEVED_SIGMAS = 3.0
"""Distance from a belief (a centred principal point, the given intrinsics) that is named."""


def intrinsics_checks(
    report: IntrinsicsReport, prior: Prior, start: CameraIntrinsics | None
) -> tuple[Check, ...]:
    """Return every check of a camera calibration, good ones too."""
    checks = [
        _views(report),
        _outliers(report),
        _coverage(report),
        _focal(report),
        _center(report, prior),
        _model(report),
        _refused(report),
        _residuals(report),
        _border(report),
        _board(report),
    ]
    if start is not None:
        checks.append(_start(report, start))
    return tuple(checks)


def _views(report: IntrinsicsReport) -> Check:
    left_out = [v for v in report.views if not v.used]
    n = len(report.used)
    sentence = f"{n} of {len(report.views)} views were used."
    if left_out:
        shown = "; ".join(f"{v.name}: {v.reason}" for v in left_out[:4])
        more = f"; and {len(left_out) - 4} more" if len(left_out) > 4 else ""
        sentence += f" Left out: {shown}{more}."
    few = n < GOOD_VIEWS
    advice = f"Take at least {GOOD_VIEWS} views." if few else ""
    if left_out:
        advice = (advice + " Look at the views that were left out.").strip()
    return Check(
        name="views of the lens", verdict="warn" if few or left_out else "good", sentence=sentence,
        advice=advice, value=float(n), views=tuple(v.index for v in left_out),
    )  # fmt: skip


def _outliers(report: IntrinsicsReport) -> Check:
    guilty = [v for v in report.used if v.outliers]
    count = sum(len(v.outliers) for v in guilty)
    share = count / max(count + sum(len(v.uv) for v in report.used), 1)
    sentence = f"{count} corners ({share:.1%}) were left out as outliers."
    if guilty:
        worst = max(guilty, key=lambda v: len(v.outliers))
        point, px = max(worst.outliers, key=lambda o: o[1])
        sentence += (
            f" Most of them in view {worst.name} ({len(worst.outliers)}; point {point} is "
            f"{px:.1f} px off)."
        )
    warn = share > OUTLIER_SHARE
    return Check(
        name="outlier corners", verdict="warn" if warn else "good", sentence=sentence,
        advice="Look at these views: reflections, fingers, motion blur." if warn else "",
        value=share, views=tuple(v.index for v in guilty),
    )  # fmt: skip


def _coverage(report: IntrinsicsReport) -> Check:
    c = report.coverage
    verdict = "good"
    if c.advice or c.share < GOOD_SHARE:
        verdict = "bad" if c.share < BAD_SHARE else "warn"
    return Check(
        name="coverage",
        verdict=verdict,
        sentence=f"Corners lie in {c.share:.0%} of the image's cells and reach {c.reach:.0%} of "
        f"the way to its corners; tilts reach {float(c.tilt_deg.max()):.0f} deg, distances "
        f"{float(c.distance_m.min()):.2f} to {float(c.distance_m.max()):.2f} m.",
        advice=c.advice,
        value=c.share,
    )


def _focal(report: IntrinsicsReport) -> Check:
    i, sd = report.intrinsics, report.sd
    relative = float(max(sd[0] / i.fx, sd[1] / i.fy))
    warn = relative > GOOD_FOCAL
    return Check(
        name="focal length",
        verdict="warn" if warn else "good",
        sentence=f"fx = {i.fx:.2f} +- {sd[0]:.2f} px, fy = {i.fy:.2f} +- {sd[1]:.2f} px "
        f"({relative:.2%}).",
        advice="Add views that tilt the board by 30 deg about two axes." if warn else "",
        value=relative,
    )


def _center(report: IntrinsicsReport, prior: Prior) -> Check:
    i, sd = report.intrinsics, report.sd[2:4]
    offset = (np.array([i.cx, i.cy]) - prior.mean[2:4]) / prior.sd[2:4]
    unmeasured = bool(np.any(sd > 0.7 * prior.sd[2:4]))
    odd = bool(np.any(np.abs(offset) > BELIEVED_SIGMAS))
    sentence = f"Principal point ({i.cx:.2f} +- {sd[0]:.2f}, {i.cy:.2f} +- {sd[1]:.2f}) px."
    advice = ""
    if unmeasured:
        sentence += " The views hardly determine it, so it keeps its expected value."
        advice = "Add views that tilt the board to all four sides, some with the board turned."
    elif odd:
        sentence += f" It is {float(np.abs(offset).max()):.1f} sigmas from the expected place."
        advice = "Were the images cropped, or resized in one direction?"
    return Check(
        name="principal point", verdict="warn" if unmeasured or odd else "good",
        sentence=sentence, advice=advice, value=float(np.abs(offset).max()), unit="sigma",
    )  # fmt: skip


def _model(report: IntrinsicsReport) -> Check:
    if not report.held_out:
        return Check(
            name="lens model",
            verdict="warn",
            sentence=f"The lens model '{report.model}' was not chosen by unseen views: there are "
            "too few.",
            advice=f"Take at least {GOOD_VIEWS} views.",
        )
    table = ", ".join(f"{s.model} {s.held_out_px:.3f}" for s in report.held_out)
    ratio = report.held_out_px / max(report.rms_px, 1e-12)
    warn = not ratio < GOOD_UNSEEN_RATIO
    return Check(
        name="lens model",
        verdict="warn" if warn else "good",
        sentence=f"'{report.model}' predicts unseen views to {report.held_out_px:.3f} px, "
        f"{ratio:.2f} times the error in sample (all models: {table} px).",
        advice="The lens describes its own views better than others: add views." if warn else "",
        value=report.held_out_px,
        unit="px",
    )


def _refused(report: IntrinsicsReport) -> Check:
    if not report.refused:
        return Check(
            name="refused terms", verdict="good",
            sentence=f"All distortion terms of '{report.model}' are determined.", value=0.0,
        )  # fmt: skip
    why = "; ".join(f"{term}: {reason}" for term, reason in report.refused)
    return Check(
        name="refused terms",
        verdict="warn",
        sentence=f"Not determined by these views: {why}.",
        advice="Add views with the board in the corners and along the borders of the image.",
        value=float(len(report.refused)),
    )


def _residuals(report: IntrinsicsReport) -> Check:
    worst = max(report.used, key=lambda v: v.rms_px)
    warn = report.rms_px > GOOD_RMS_PX
    return Check(
        name="residuals",
        verdict="warn" if warn else "good",
        sentence=f"Residuals are {report.rms_px:.3f} px (RMS, in sample); the worst view is "
        f"{worst.name} with {worst.rms_px:.3f} px.",
        advice="Is the target described as printed, is it flat, were the images sharp?"
        if warn
        else "",
        value=report.rms_px,
        unit="px",
        views=(worst.index,) if warn else (),
    )


def _border(report: IntrinsicsReport) -> Check:
    border = border_pixels(report.intrinsics)
    _, valid = undistort(report.intrinsics, border)
    if not valid.all():
        return Check(
            name="lens at the border",
            verdict="bad",
            sentence=f"The lens model folds back inside the image: {np.mean(~valid):.0%} of the "
            "border has no ray.",
            advice="Add views with the board in the image's corners, or use fewer terms.",
        )
    sd = float(report.projection_sd_px(border).max())
    warn = not sd < GOOD_BORDER_PX
    return Check(
        name="lens at the border",
        verdict="warn" if warn else "good",
        sentence=f"At the image's border the lens is known to {sd:.2f} px (1 sigma).",
        advice="Add views with the board in the image's corners." if warn else "",
        value=sd,
        unit="px",
    )


def _board(report: IntrinsicsReport) -> Check:
    b = report.board
    held = not np.any(b.sd > 0)
    if held:
        return Check(
            name="board shape", verdict="unknown",
            sentence="The print was taken to be flat and true to its drawing.",
        )  # fmt: skip
    warped, stretched = b.warp_mm > GOOD_WARP_MM, abs(b.aspect) > GOOD_ASPECT
    advice = "Glue the print to something flat (glass, aluminium)." if warped else ""
    if stretched:
        advice = (advice + " Measure the print along both edges.").strip()
    return Check(
        name="board shape",
        verdict="warn" if warped or stretched else "good",
        sentence=f"By the images alone the board bends by {b.warp_mm:.2f} mm and is "
        f"{abs(b.aspect):.2%} (+- {b.sd[1]:.2%}) too {'tall' if b.aspect > 0 else 'short'} for its "
        "width; both are part of the fit.",
        advice=advice,
        value=b.warp_mm,
        unit="mm",
    )


def _start(report: IntrinsicsReport, start: CameraIntrinsics) -> Check:
    difference = camera_vector(report.intrinsics)[:4] - camera_vector(start)[:4]
    sd = np.maximum(report.sd[:CAMERA_TERMS][:4], 1e-9)
    worst = int(np.argmax(np.abs(difference) / sd))
    sigmas = float(abs(difference[worst]) / sd[worst])
    warn = sigmas > BELIEVED_SIGMAS
    return Check(
        name="given intrinsics",
        verdict="warn" if warn else "good",
        sentence=f"{TERM_NAMES[worst]} differs from the given intrinsics by "
        f"{difference[worst]:+.2f} px ({sigmas:.1f} sigmas).",
        advice="Use the new ones, or find out for which image size and stream the given ones are."
        if warn
        else "",
        value=sigmas,
        unit="sigma",
    )
