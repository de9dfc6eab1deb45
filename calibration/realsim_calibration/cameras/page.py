"""The page of several cameras: each camera, each pair, the views that disagree."""

import numpy as np

from realsim.pages import Cell, Page
from realsim.records import Check
from realsim.records.calibration import worst_first
from realsim_calibration.cameras.results import ROBOT_BASE, CamerasReport
from realsim_calibration.cameras.rig import MOUNTS

KIND = {"unknown": "off"}
PAGE = "cameras_report.html"


def camera_rows(report: CamerasReport) -> list[list[str]]:
    """Return a row of every camera, as `camera_header`: where, how sure, views, unseen error."""
    armless = report.reference != ROBOT_BASE
    rows: list[list[str]] = []
    for camera, r in zip(report.rig.cameras, report.cameras, strict=True):
        own = [v for v in report.views if v.camera == camera.name]
        place = " ".join(f"{v:.2f}" for v in np.round(1e3 * r.X[:3, 3], 2) + 0.0)
        rows.append([
            camera.name, MOUNTS[camera.mount], place,
            *([] if armless else [f"{r.here_mm:.2f} mm / {r.here_deg:.3f} deg"]),
            f"{r.sigma_mm:.2f} mm / {r.sigma_deg:.3f} deg",
            f"{sum(v.used for v in own)} / {len(own)}",
            f"{r.held_out_px:.2f} px / {r.held_out_mm:.2f} mm",
        ])  # fmt: skip
    return rows


def camera_header(report: CamerasReport) -> list[str]:
    """Return the names of the columns; without an arm there is one sigma only."""
    armless = report.reference != ROBOT_BASE
    sigmas = ["1 sigma for this arm as it moves here"] * (not armless) + ["1 sigma absolute"]
    return ["camera", "mount", "place [mm]", *sigmas, "views used / found", "unseen views"]


PAIR_HEADER = ["cameras", "sees the board together", "1 sigma absolute", "apart (RMS)", "worst"]
ODD_HEADER = ["camera", "view", "unseen", "why"]


def pair_rows(report: CamerasReport) -> list[list[str]]:
    """Return a row of every pair of cameras."""
    return [
        [
            " - ".join(p.names), f"{p.together} instants",
            f"{p.sigma_mm:.2f} mm / {p.sigma_deg:.3f} deg",
            f"{p.apart_mm:.2f} mm" if np.isfinite(p.apart_mm) else "never together", p.worst,
        ]
        for p in report.pairs
    ]  # fmt: skip


def odd_rows(report: CamerasReport) -> list[list[str]]:
    """Return a row of every view that was left out, then of those that disagree."""
    return [
        *([v.camera, v.name, "left out", v.reason] for v in report.rejected if len(v.detection)),
        *(
            [v.camera, v.name, f"{v.unseen_px:.2f} px", "three times its camera's median"]
            for v in report.disagreeing()
        ),
    ]


def cameras_page(report: CamerasReport) -> Page:
    """Return the page."""
    checks = worst_first(report.all_checks)
    worst = checks[0].verdict if checks else "good"
    page = Page(
        title="Cameras calibrated together",
        about=f"{len(report.cameras)} cameras, {len(report.rig.instants)} instants; places in "
        f"{report.reference}",
    )
    said = {"bad": "A check is bad.", "warn": "Usable; look at the warnings."}
    amiss = [c for c in checks if c.verdict in {"bad", "warn"}]
    page.verdict(KIND.get(worst, worst), said.get(worst, "No check found anything wrong."), "",
                 [[f"{c.name}: {c.words}"] for c in amiss])  # fmt: skip
    page.cards([
        (f"{r.held_out_mm:.2f} mm", f"unseen views of {c.name}")
        for c, r in zip(report.rig.cameras, report.cameras, strict=True)
    ])  # fmt: skip
    page.section("Cameras", f"Robot error map: {report.map_name}.", key="cameras")
    page.table(camera_header(report), camera_rows(report))
    if report.pairs:
        page.section("Pairs", "The board's middle, as either camera alone sees it.", key="pairs")
        page.table(PAIR_HEADER, pair_rows(report))
    odd = odd_rows(report)
    if odd or report.bad_arm:
        page.section("Views that disagree", key="views")
        if report.bad_arm:
            page.text(f"The arm's pose is not believed at {', '.join(report.bad_arm)}.", "note")
        if odd:
            page.table(ODD_HEADER, odd)
    page.section("Checks", key="checks")
    page.table(["check", "verdict", "what was found"], [_row(c) for c in checks])
    return page


def _row(check: Check) -> list[object]:
    return [
        check.name,
        Cell(check.verdict, kind=KIND.get(check.verdict, check.verdict)),
        check.words,
    ]
