"""The calibration's page: verdict, checks, figures and pictures in one self-contained HTML file."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from realsim.arrays import Array
from realsim.pages import Cell, Page
from realsim.records import ArmErrorMap, CameraIntrinsics, Check
from realsim.store import atomic
from realsim_calibration.depth.bias import DepthBiasReport
from realsim_calibration.lens.models import TERM_NAMES
from realsim_calibration.lens.report import IntrinsicsReport
from realsim_calibration.report import model_plots, scene_3d, style, view_plots
from realsim_calibration.report.summary import (
    NOT_KNOWN,
    PLACES_HEADER,
    accuracy_rows,
    amount,
    carrier,
    check_rows,
    places_rows,
    pose_rows,
    verdict,
    viewpoint,
    worst_first,
)
from realsim_calibration.report.view_plots import Images
from realsim_calibration.results import HandEyeReport

PAGE_NAME = "calibration_report.html"
VERDICT_KIND = {"good": "good", "warn": "warn", "bad": "bad", "unknown": "off"}


@dataclass(eq=False, kw_only=True, slots=True)
class _Page(Page):
    """The page while it is being written, and the pictures that lie beside it."""

    folder: Path
    written: list[Path] = field(default_factory=list[Path])

    def plot(self, name: str, draw: Callable[[], Any], caption: str) -> None:
        """Draw a picture, write it beside the page and put it into the page itself."""
        import cv2
        from matplotlib.backends.backend_agg import FigureCanvasAgg

        with style.paper_style():
            canvas = FigureCanvasAgg(draw())
            canvas.draw()
        bgr = cv2.cvtColor(np.asarray(canvas.buffer_rgba()), cv2.COLOR_RGBA2BGR)
        # As small as matplotlib's own, in half of the time.
        data = cv2.imencode(".png", bgr, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()
        atomic.write_bytes(self.folder / name, data)
        self.written.append(self.folder / name)
        self.picture(data, caption)

    def checks(self, header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
        """Add a table whose first column is a verdict."""
        self.table(header, [[Cell(r[0], kind=VERDICT_KIND[r[0]]), *r[1:]] for r in rows])


def write_calibration_report(
    report: HandEyeReport,
    folder: Path | str,
    *,
    images: Images | None = None,
    intrinsics_report: IntrinsicsReport | None = None,
    depth_report: DepthBiasReport | None = None,
    title: str = "Hand-eye calibration",
) -> list[Path]:
    """Write the page and its pictures and return the files, the page first.

    Args:
        report: the calibration.
        folder: where to write; made where needed.
        images: gives the photograph of a view by its index, for the worst views.
        intrinsics_report: a calibration of the lens alone, to be compared.
        depth_report: the depth camera's bias.
        title: heading of the page.
    """
    page = _Page(folder=Path(folder), title=title, about=_about(report))
    _verdict_section(page, report, () if intrinsics_report is None else intrinsics_report.checks)
    _place_section(page, report)
    _residual_section(page, report, images)
    _coverage_section(page, report)
    _model_section(page, report)
    if not report.nominal_lens:
        _lens_section(page, report, intrinsics_report)
    if depth_report is not None:
        _depth_section(page, depth_report)
    _appendix(page, report)
    atomic.write_bytes(page.folder / PAGE_NAME, page.encode())
    return [page.folder / PAGE_NAME, *page.written]


def _about(report: HandEyeReport) -> str:
    """Return one line on what was calibrated."""
    i, (x, y) = report.intrinsics, report.target.size_m
    where = "in the hand" if report.mode == "eye_in_hand" else "beside the robot"
    if report.T_points_board is not None:
        lens = "a lens that is not known" if report.nominal_lens else "the lens that was given"
        return (
            f"Camera {where}, pose pairs without images, {lens}, {len(report.used)} of "
            f"{len(report.views)} pairs used"
        )
    return (
        f"Camera {where}, {i.width} x {i.height} px, {len(report.used)} of {len(report.views)} "
        f"views used, {type(report.target).__name__} of {1e3 * x:.0f} x {1e3 * y:.0f} mm"
    )


def _verdict_section(page: _Page, report: HandEyeReport, lens: Sequence[Check]) -> None:
    """Say in one sentence what to do, then show figures and checks, those of the lens too."""
    judged = verdict(report, lens)
    page.verdict(VERDICT_KIND[judged.verdict], judged.headline, judged.sentence)
    page.cards([
        (amount(report.held_out_px, 2, "px"), "error of unseen views"),
        (amount(report.held_out_mm, 2, "mm"), "the same, as a distance"),
        (amount(report.held_out_deg, 3, "deg"), "the same, as an angle"),
        (f"± {amount(report.here_mm, 2, 'mm')}", "camera's place for this arm, 1 sigma"),
        (f"± {amount(report.here_deg, 3, 'deg')}", "its rotation for this arm, 1 sigma"),
        (f"± {amount(report.sigma_mm, 2, 'mm')}", "its place for another arm or a drawing"),
        (f"{len(report.used)} / {len(report.views)}", "views used / given"),
    ])  # fmt: skip
    rows = check_rows(report, lens)
    page.section("Checks", "" if rows else "Nothing was checked.")
    if rows:
        page.checks(["", "check", "value", "what was found", "what to do"], rows)


def _place_section(page: _Page, report: HandEyeReport) -> None:
    """Show where the camera is."""
    what = carrier(report)
    page.section("Where the camera is")
    hang = ", which hangs with its z axis down" if report.mode == "eye_in_hand" else ""
    page.plot(
        "camera_place.png", lambda: scene_3d.plot_camera_in_hand(report),
        f"Camera and {what} frame{hang}. Axes: x red, y green, z blue. Grey: a flange of 63 mm for "
        "scale. Yellow: the field of view. If this is not how the camera is mounted, a convention "
        "is wrong.",
    )  # fmt: skip
    page.table(PLACES_HEADER, places_rows(report))
    page.table(["figure", "value"], [*pose_rows(report), *accuracy_rows(report)])
    page.plot(
        "scene.png", lambda: scene_3d.plot_scene(report),
        "Robot base, target and cameras, coloured by the error of the unseen view; dotted red: "
        "dropped views. The dot is the target's first point.",
    )  # fmt: skip


def _residual_section(page: _Page, report: HandEyeReport, images: Images | None) -> None:
    """Show how well every view fits."""
    page.section(
        "How well the views fit",
        "All errors are measured through the robot's own pose. An unseen view was predicted by a "
        "calibration that did not know it.",
    )
    page.plot(
        "views.png", lambda: view_plots.plot_views(report),
        "If unseen errors are much larger than seen ones, there are too few views. One long bar is "
        "a view to look at; many alike are the robot's accuracy.",
    )  # fmt: skip
    page.plot(
        "residuals.png", lambda: view_plots.plot_residuals(report),
        "Predicted minus detected. Arrows of neighbours that agree on the right mean that the lens "
        "or the target's shape is not described well; the robot's errors average out there.",
    )  # fmt: skip
    worst = view_plots.worst_views(report)
    if worst:
        page.plot(
            "worst_views.png", lambda: view_plots.plot_worst_views(report, worst, images),
            "The views that the others predict worst. Arrows that all agree: the robot's pose. "
            "Arrows in disorder: blur, a wrong detection, or a bent target.",
        )  # fmt: skip


def _coverage_section(page: _Page, report: HandEyeReport) -> None:
    """Show what the calibration has seen."""
    page.section("What the calibration has seen")
    page.plot(
        "coverage.png", lambda: view_plots.plot_coverage(report),
        "Left: hatched parts of the image never held a point; the lens is a guess there. Middle: "
        "from where the target was seen, its normal in the centre. Right: how the camera was "
        "rolled about its optical axis; a full circle is best.",
    )  # fmt: skip


def _model_section(page: _Page, report: HandEyeReport) -> None:
    """Show the estimates beside X: covariance, target, robot, choices."""
    page.section("How sure it is")
    page.plot(
        "uncertainty.png", lambda: model_plots.plot_uncertainty(report),
        "Covariance of the camera's place along the camera's own axes. A long ellipse names the "
        "direction that further views should fix.",
    )  # fmt: skip
    page.section("The target's shape")
    page.plot(
        "board.png", lambda: model_plots.plot_board(report),
        "Left: how far the print lies out of its plane. Right: its size against the drawing. Both "
        "are measured against the robot's own metre.",
    )  # fmt: skip
    page.section("The robot's errors")
    if report.used:
        bare = sum(v.joints is None for v in report.used)
        unknown = f" The joints of {bare} views are not known." if bare else ""
        text = (
            "No error map predicts unseen views better than the controller's own poses."
            if report.robot_map is None
            else "The map knows the arm's lengths and angles; it needs the joints." + unknown
            if isinstance(report.robot_map, ArmErrorMap)
            else "The map is an interpolator: outside of the calibrated region it is a guess."
        )
        page.plot("robot.png", lambda: model_plots.plot_robot(report), text)
    if report.joint_offsets is not None:
        rows = [
            [f"joint {k + 1}", f"{v:+.3f} ± {amount(sd, 3)}" if np.isfinite(v) else NOT_KNOWN]
            for k, (v, sd) in enumerate(np.degrees(report.joint_offsets))
        ]
        page.table(["zero offset", "[deg]"], rows)
    if report.map_scores or report.starts:
        page.plot(
            "choices.png", lambda: model_plots.plot_choices(report),
            "Left: how well every error map predicts unseen views; dark: the chosen one, which "
            "must be better by more than its noise. "
            "Right: every closed form before the joint fit; dark: the smallest.",
        )  # fmt: skip


def _lens_section(
    page: _Page, report: HandEyeReport, intrinsics_report: IntrinsicsReport | None
) -> None:
    """Show the lens as calibrated with the hand-eye, and alone where that was done."""
    page.section(
        "The lens",
        "Files for other programs (camera_info.yaml, opencv.yml, calibration.npz) carry the lens "
        "of the table's last column, which belongs to X_alone. calibration.json has it as "
        "intrinsics_alone, and the one with the hand-eye, which belongs to X, as intrinsics.",
    )
    caption = (
        "Left: how far the lens moves the picture from an ideal camera's. Right: how well a "
        "pixel's direction is known, the turn that a pose would absorb taken out; dashed: the "
        "outline of all points, beyond it the lens is a guess; hatched: pixels that no ray reaches "
        "with these numbers. Cross: the principal point."
    )
    page.plot(
        "lens.png",
        lambda: model_plots.plot_lens(
            report.intrinsics, report.intrinsics_covariance, style.joined(v.uv for v in report.used)
        ),
        f"As calibrated together with the hand-eye. {caption}",
    )
    header = ["term", "with the hand-eye"]
    columns = [_lens_column(report.intrinsics, report.intrinsics_covariance)]
    if intrinsics_report is not None:
        r = intrinsics_report
        header.append("lens alone")
        columns.append(_lens_column(r.intrinsics, r.covariance))
        page.plot(
            "lens_alone.png",
            lambda: model_plots.plot_lens(
                r.intrinsics, r.open_covariance, style.joined(v.uv for v in r.used)
            ),
            f"The lens alone, {r.model}. {caption}",
        )
    header.append("exported, with X_alone")
    i = report.intrinsics_alone
    columns.append([f"{v:.6g}" for v in (i.fx, i.fy, i.cx, i.cy, *i.distortion)])
    page.table(header, [[name, *[c[k] for c in columns]] for k, name in enumerate(TERM_NAMES)])
    if intrinsics_report is not None:
        models = [
            [m.model, amount(m.held_out_px, 3), amount(m.seen_px, 3), "chosen" * m.chosen]
            for m in intrinsics_report.held_out
        ]
        page.table(["lens model", "unseen [px]", "seen [px]", ""], models)


def _lens_column(i: CameraIntrinsics, covariance: Array) -> list[str]:
    """Return the twelve terms of a lens with 1 sigma."""
    sd = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    values = [i.fx, i.fy, i.cx, i.cy, *i.distortion]
    return [
        f"{v:.6g} (held)" if s == 0 else f"{v:.6g} ± {s:.2g}" if s > 0 else f"{v:.6g} ± {NOT_KNOWN}"
        for v, s in zip(values, sd, strict=True)
    ]


def _depth_section(page: _Page, report: DepthBiasReport) -> None:
    """Show the depth camera's bias."""
    page.section("The depth camera's bias")
    page.plot(
        "depth_bias.png", lambda: model_plots.plot_depth_bias(report),
        "Left: measured minus true depth of every view and the fitted curve. Right: what is left "
        "where each view is corrected by the others.",
    )  # fmt: skip
    if report.checks:
        page.section("Checks of the depth camera")
        page.checks(
            ["", "check", "what was found", "what to do"],
            [[c.verdict, c.name, c.sentence, c.advice] for c in worst_first(report.checks)],
        )


def _appendix(page: _Page, report: HandEyeReport) -> None:
    """Add every view and the matrices."""
    rows: list[list[str]] = []
    for v in report.views:
        p = viewpoint(report, v)
        errors = [(v.seen_px, 3), (v.unseen_px, 3), (v.unseen_mm, 3), (v.unseen_deg, 4)]
        place = [(1e3 * p.distance_m, 0), (p.tilt_deg, 0), (p.roll_deg, 0)]
        rows.append([
            v.label, str(v.index), str(len(v.uv)),
            *(amount(*e) if v.used else "-" for e in errors),
            *(amount(*e) for e in place),
            "" if v.used else f"dropped: {v.reason}",
        ])  # fmt: skip
    header = [
        "view", "index", "points", "seen [px]", "unseen [px]", "unseen [mm]", "unseen [deg]",
        "distance [mm]", "tilt [deg]", "roll [deg]", "",
    ]  # fmt: skip
    page.section("Every view")
    page.table(header, rows)
    page.section("The numbers, to copy")
    what, other = ("ee", "base") if report.mode == "eye_in_hand" else ("base", "ee")
    suffix = ", only together with the robot's error map" if report.robot_map is not None else ""
    here = [] if report.X_here is None else [report.X_here]
    for name, T in (
        *((f"X_here: T_{what}_cam for this arm as it moves here [m]", T) for T in here),
        (f"X: T_{what}_cam, absolute{suffix} [m]", report.X),
        (f"X_alone: T_{what}_cam without a map, for other programs [m]", report.X_alone),
        (f"Z: T_{other}_board [m]", report.Z),
        (f"Z_alone: T_{other}_board that belongs to X_alone [m]", report.Z_alone),
    ):
        text = np.array2string(np.asarray(T), precision=9, suppress_small=True, separator=", ")
        page.code(f"{name}\n{text}")
