"""One self-contained HTML page a session: what was done, how good it is, and the pictures."""

import base64
import html
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from string import Template

import numpy as np
from numpy.typing import NDArray

from realsim import __version__
from realsim.app.console import StageTime
from realsim.app.report import plots as report_plots
from realsim.app.show import GRASP_HEADER, grasp_rows
from realsim.app.stages import BOARD_VIEWS, registered_views, session_models
from realsim.app.truth import LoopErrors
from realsim.records import HandEye, Scene
from realsim.store import SessionStore

OVERLAY_VIEWS = 4
"""Annotated photographs in a report: the first view and others spread over the session."""
GRASPS = 15
"""Grasps drawn in one of them: few, so that the outlines can be judged."""
THUMBNAIL_WIDTH_PX = 400
SHEET_VIEWS = 12
"""Thumbnails of the captured views."""


@dataclass(eq=False, kw_only=True, slots=True)
class Page:
    """The body of the report while it is being written."""

    parts: list[str] = field(default_factory=list[str])

    def section(self, title: str, text: str = "") -> None:
        """Begin a section."""
        self.parts.append(f"<h2>{html.escape(title)}</h2>")
        if text:
            self.parts.append(f"<p>{html.escape(text)}</p>")

    def table(self, header: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
        """Add a table."""
        head = "".join(f"<th>{html.escape(h)}</th>" for h in header)
        body = "".join(
            "<tr>" + "".join(f"<td>{html.escape(str(c))}</td>" for c in row) + "</tr>"
            for row in rows
        )
        self.parts.append(f'<div class="scroll"><table><tr>{head}</tr>{body}</table></div>')

    def picture(self, path: Path, caption: str) -> None:
        """Add a picture, inside the page itself."""
        data = base64.b64encode(path.read_bytes()).decode()
        self.parts.append(
            f'<figure><img src="data:image/png;base64,{data}" alt="{html.escape(caption)}">'
            f"<figcaption>{html.escape(caption)}</figcaption></figure>"
        )


def write_report(
    store: SessionStore,
    errors: LoopErrors | None,
    *,
    notes: Sequence[str] = (),
    times: Sequence[StageTime] = (),
) -> Path:
    """Write SESSION/reports/report.html and its pictures from what the session holds.

    Args:
        store: the session; stages that have not been run are left out.
        errors: the errors against the simulated lab's truth; None on real data.
        notes: what the reader must know first.
        times: cost of the stages of the run that made it.

    Returns:
        The path of the page.
    """
    folder = store.folder / "reports"
    folder.mkdir(exist_ok=True)
    page = Page()
    for note in notes:
        page.parts.append(f'<p class="note">{html.escape(note)}</p>')
    if errors is not None:
        page.section(
            "Errors against the truth",
            "The simulated lab knows the truth; none of the stages was told it.",
        )
        page.table(["figure", "measured", "goal"], errors.rows())
    _photograph_section(page, store, folder)
    if (store.folder / "calibration/hand_eye.json").is_file():
        _calibration_section(page, store, folder)
    if (store.folder / "registration/scene.json").is_file():
        _registration_section(page, store, folder, errors)
        _slider_section(page, store)
    if any((store.folder / "grasps").glob("*.npz")):
        _school_section(page, store, folder)
    if times:
        page.section("Cost of the run")
        rows = [[t.name, f"{t.cpu_s:.1f}", f"{t.wall_s:.1f}"] for t in times]
        page.table(["stage", "CPU [s]", "clock [s]"], rows)
    template = Template((files("realsim.app") / "report_page.html").read_text())
    text = template.substitute(
        title=html.escape(store.session.name),
        about=html.escape(_about(store)),
        body="\n".join(page.parts),
        version=__version__,
    )
    store.write_bytes("reports/report.html", text.encode())
    return folder / "report.html"


def _about(store: SessionStore) -> str:
    """Return one line on what the session is."""
    i = store.session.intrinsics
    lens = "distorted lens" if i.is_distorted else "no distortion"
    return (
        f"{len(store.session.views)} views, {i.width} x {i.height} px, fx {i.fx:.1f} px, {lens}, "
        f"depth unit {1e3 * store.session.depth_unit_m:g} mm"
    )


def _slider_section(page: Page, store: SessionStore) -> None:
    """Add sliders of the outlines before and after registration, where there is a before."""
    from realsim.app.picture_pages import pair_markup, slider_style
    from realsim.app.report.sliders import registration_pairs

    pairs, before = registration_pairs(store)
    if pairs:
        page.section("Before and after registration", before)
        page.parts.append(f"<style>{slider_style()}</style>")
        page.parts += [pair_markup(p) for p in pairs]


def _photograph_section(page: Page, store: SessionStore, folder: Path) -> None:
    """Add annotated photographs, or the bare ones when nothing is annotated yet."""
    from realsim.rendering.overlay import contact_sheet, save_png
    from realsim.store import load_grasps, load_scene
    from realsim_sim_bridge.annotation.pictures import overlay_picture

    indices = [v.index for v in store.session.views]
    if not indices:
        return
    if (store.folder / "registration/scene.json").is_file():
        page.section(
            "The annotated scene",
            "Outlines are the visible masks in the colour of the verdict; grippers are coloured by "
            "score, red 0 to green 1. Magenta: hidden by something that is not in the scene.",
        )
        scene, models = load_scene(store), session_models(store)
        grasps = load_grasps(store.folder / "grasps")
        known = registered_views(store)
        told = [k for k in indices if known is None or k in known] or indices
        pick = np.unique(np.linspace(0, len(told) - 1, OVERLAY_VIEWS).round().astype(int))
        for index in (told[k] for k in pick):
            path = folder / f"overlay_{index:06d}.png"
            save_png(path, overlay_picture(store, index, scene, models, grasps, GRASPS))
            page.picture(path, f"view {index}")
    if len(indices) > 1:
        pick = np.unique(np.linspace(0, len(indices) - 1, SHEET_VIEWS).round().astype(int))
        shown = [indices[k] for k in pick]
        small = [_thumbnail(store.rgb(k)) for k in shown]
        sheet = contact_sheet(small, columns=4, captions=[f"view {k}" for k in shown])
        save_png(folder / "views.png", sheet)
        page.section("Captured views", f"{len(shown)} of {len(indices)} are shown.")
        page.picture(folder / "views.png", "captured views")


def _thumbnail(rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a picture at the width of a thumbnail."""
    import cv2

    height = round(rgb.shape[0] * THUMBNAIL_WIDTH_PX / rgb.shape[1])
    small = cv2.resize(rgb, (THUMBNAIL_WIDTH_PX, height), interpolation=cv2.INTER_AREA)
    return np.asarray(small, dtype=np.uint8)


def _calibration_section(page: Page, store: SessionStore, folder: Path) -> None:
    """Add the hand-eye calibration."""
    from realsim.store import load_hand_eye

    hand_eye = load_hand_eye(store)
    page.section("Hand-eye calibration", hand_eye.method)
    page.table(["figure", "value"], hand_eye_rows(hand_eye))
    views = SessionStore.open(store.folder / BOARD_VIEWS).session.views
    used = [v for v in views if v.index in hand_eye.view_indices]
    report_plots.plot_calibration(hand_eye, used, folder / "calibration.png")
    page.picture(folder / "calibration.png", "residuals and diversity of the board views")
    if hand_eye.rejected:
        page.table(["board view not used", "why"], hand_eye.rejected)


def hand_eye_rows(hand_eye: HandEye) -> list[list[str]]:
    """Return the table of a hand-eye calibration."""
    i, sd = hand_eye.intrinsics, hand_eye.intrinsics_sd
    t = ", ".join(f"{1e3 * v:.3f}" for v in hand_eye.T_ee_cam[:3, 3])
    return [
        ["camera in tool [mm]", t],
        ["1 sigma, worst axis", f"{hand_eye.sigma_mm:.3f} mm, {hand_eye.sigma_deg:.4f} deg"],
        ["held-out reprojection", f"{hand_eye.held_out_px:.3f} px"],
        ["fx, fy", f"{i.fx:.2f} +- {sd[0]:.2f}, {i.fy:.2f} +- {sd[1]:.2f} px"],
        ["cx, cy", f"{i.cx:.2f} +- {sd[2]:.2f}, {i.cy:.2f} +- {sd[3]:.2f} px"],
        ["k1, k2", f"{i.distortion[0]:.4f} +- {sd[4]:.4f}, {i.distortion[1]:.4f} +- {sd[5]:.4f}"],
        ["views used, rejected", f"{len(hand_eye.view_indices)}, {len(hand_eye.rejected)}"],
        *[[f"start: {name}", f"{px:.2f} px"] for name, px in hand_eye.starts],
    ]


def _registration_section(
    page: Page, store: SessionStore, folder: Path, errors: LoopErrors | None
) -> None:
    """Add the registered objects with their checks."""
    from realsim.store import load_scene

    scene, models = load_scene(store), session_models(store)
    plane = scene.plane
    found = (
        "No supporting plane was found."
        if plane is None
        else f"Supporting plane: RMS {1e3 * plane.rms_m:.2f} mm over {plane.inliers} points."
    )
    page.section("Registered objects", found)
    mssd_mm = {} if errors is None else errors.object_mssd_mm
    report_plots.plot_registration(scene, models, mssd_mm, folder / "registration.png")
    page.picture(folder / "registration.png", "agreement with the measured depth")
    header, rows = object_table(scene, store)
    page.table([*header[:3], header[-1]], [[*row[:3], row[-1]] for row in rows])
    if checks := header[3:-1]:
        # A check a row: as columns they would be wider than any screen.
        names = [row[0] for row in rows]
        values = [[check, *(row[3 + k] for row in rows)] for k, check in enumerate(checks)]
        page.table(["check", *names], values)


def object_table(scene: Scene, store: SessionStore) -> tuple[list[str], list[list[str]]]:
    """Return header and rows: every object with its sigma, checks and verdict."""
    models = session_models(store)
    checks = sorted({name for o in scene.objects for name in o.checks})
    rows: list[list[str]] = []
    for o in scene.objects:
        sigma = "-"
        if o.covariance is not None:
            mm = 1e3 * np.sqrt(np.linalg.eigvalsh(o.covariance[3:, 3:])[-1])
            deg = np.degrees(np.sqrt(np.linalg.eigvalsh(o.covariance[:3, :3])[-1]))
            sigma = f"{mm:.2f} mm, {deg:.2f} deg"
        values = [f"{o.checks[c]:.3g}" if c in o.checks else "-" for c in checks]
        rows.append(
            [f"{o.instance} {models[o.obj_id].name}", o.verdict, sigma, *values,
             "; ".join(o.reasons)]
        )  # fmt: skip
    return ["object", "verdict", "1 sigma", *checks, "why"], rows


def _school_section(page: Page, store: SessionStore, folder: Path) -> None:
    """Add the Robot School."""
    from realsim.store import load_grasps

    sets, models = load_grasps(store.folder / "grasps"), session_models(store)
    page.section(
        "Robot School",
        "Every grasp is planned with a Franka Panda, closed with 70 N, lifted, shaken and swung.",
    )
    page.table(GRASP_HEADER, grasp_rows(sets, models))
    report_plots.plot_school(sets, models, folder / "school.png")
    page.picture(folder / "school.png", "stages and scores")
