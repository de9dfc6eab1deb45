"""The section on the calibration: lens, hand-eye, depth, and how robot poses were read."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from realsim.app.report import plots as drawing
from realsim.app.report.figures import MEDIAN_SCATTER, Figure, count, mean_error, shown
from realsim.app.report.section import Section, attempted, drawn
from realsim.app.stages import BOARD_VIEWS
from realsim.arrays import Array
from realsim.pages import Cell, counted
from realsim.records import Check, HandEye
from realsim.records.calibration import worst_first
from realsim.store import SessionStore
from realsim.untrusted.own_json import from_json

HAND_EYE, DEPTH, EXPORT = (
    "calibration/hand_eye.json",
    "calibration/depth_bias.json",
    "calibration/exports/calibration.json",
)
LENS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
KIND: dict[str, str] = {"good": "good", "warn": "warn", "bad": "bad", "unknown": "off"}
CONVENTIONS = "conventions"
"""Name of the check that says whether the robot's poses were read right."""
CHECK_HEADER = ("check", "verdict", "what was found")
BIAS = "depth bias"
"""Check of the depth camera; a bias that it finds is taken out by registration."""
READING = (
    "Each photograph is joined to its robot pose by the view's number, in one line of robot.jsonl "
    "that was written when both were there; none is matched by order or by time. Poses are "
    "T_base_ee: they take points of the tool to the base, in metres."
)


def calibration_section(section: Section, store: SessionStore) -> None:
    """Fill the section on the calibration."""
    from realsim.store import load_hand_eye

    if not store.has(HAND_EYE):
        posed = len(store.session.Ts_world_cam)
        if posed:
            section.command = ""
            section.missing(
                f"No hand-eye calibration; {counted(posed, 'camera')} came with a pose."
            )
            return
        section.missing("No hand-eye calibration, and no camera has a pose.")
        return
    hand_eye = load_hand_eye(store)
    section.headline = (
        f"camera in the hand to {hand_eye.sigma_mm:.2f} mm / {hand_eye.sigma_deg:.3f} deg "
        f"(1 sigma), unseen views to {hand_eye.held_out_px:.2f} px"
    )
    section.add(*_figures(hand_eye))
    section.series["calibration.view_rms_px"] = {
        "view": list(hand_eye.view_indices),
        "value": [round(float(v), 5) for v in hand_eye.view_rms_px],
    }
    section.page.text(f"Method: {hand_eye.method}.")
    section.page.table(["figure", "value"], hand_eye_rows(hand_eye))
    drawn(section, "the plots", lambda: _plots(section, store, hand_eye))
    attempted(section, "how poses were read", lambda: _reading(section, store, hand_eye))
    _checks(section, hand_eye.checks)
    attempted(section, "the depth camera's bias", lambda: _depth(section, store))
    if hand_eye.rejected:
        section.page.heading("Board views left out")
        section.page.table(["board view", "why"], hand_eye.rejected)


def hand_eye_rows(hand_eye: HandEye) -> list[list[object]]:
    """Return the table of a hand-eye calibration."""
    i, sd = hand_eye.intrinsics, hand_eye.intrinsics_sd
    place = ", ".join(shown(v, s) for v, s in zip(*_place_mm(hand_eye), strict=True))
    values = (i.fx, i.fy, i.cx, i.cy, *i.distortion)
    lens: list[list[object]] = [
        [name, f"{shown(v, s)} px" if k < 4 else shown(v, s)]
        for k, (name, v, s) in enumerate(zip(LENS, values, sd, strict=True))
        if k < 4 or s > 0 or v != 0
    ]
    return [
        ["camera in the tool, x, y, z [mm]", place],
        ["1 sigma, worst axis", f"{hand_eye.sigma_mm:.3f} mm, {hand_eye.sigma_deg:.4f} deg"],
        ["reprojection of views the fit has not seen", f"{hand_eye.held_out_px:.3f} px"],
        ["board views used, left out", f"{len(hand_eye.view_indices)}, {len(hand_eye.rejected)}"],
        *lens,
        *[[f"closed-form start: {name}", f"{px:.2f} px"] for name, px in hand_eye.starts],
    ]


def _place_mm(hand_eye: HandEye) -> tuple[Array, Array]:
    """Return where the camera is in the tool, and its 1 sigma along the tool's axes [mm]."""
    R = hand_eye.T_ee_cam[:3, :3]
    covariance = R @ np.asarray(hand_eye.covariance)[3:, 3:] @ R.T
    each = np.sqrt(np.clip(np.diagonal(covariance), 0, None))
    return 1e3 * hand_eye.T_ee_cam[:3, 3], 1e3 * each


def _figures(hand_eye: HandEye) -> list[Figure]:
    rms = np.asarray(hand_eye.view_rms_px, dtype=np.float64)
    t, each = _place_mm(hand_eye)
    conventions = _conventions(hand_eye)
    verdicts = [c.verdict for c in hand_eye.checks]
    found = [
        ("sigma_mm", hand_eye.sigma_mm, None),
        ("sigma_deg", hand_eye.sigma_deg, None),
        ("held_out_px", hand_eye.held_out_px, mean_error(rms)),
        (
            "view_rms_px",
            float(np.median(rms)) if len(rms) else np.nan,
            MEDIAN_SCATTER * mean_error(rms),
        ),
        ("mismatch_deg", conventions.value if conventions else np.nan, None),
        ("camera_x_mm", t[0], each[0]),
        ("camera_y_mm", t[1], each[1]),
        ("camera_z_mm", t[2], each[2]),
        ("fx_px", hand_eye.intrinsics.fx, hand_eye.intrinsics_sd[0]),
        ("fy_px", hand_eye.intrinsics.fy, hand_eye.intrinsics_sd[1]),
    ]
    return [
        *[Figure(f"calibration.{n}", float(v), s) for n, v, s in found if np.isfinite(v)],
        count("calibration.views_used", len(hand_eye.view_indices)),
        count("calibration.views_rejected", len(hand_eye.rejected)),
        count("calibration.checks_bad", verdicts.count("bad")),
        count("calibration.checks_warn", verdicts.count("warn")),
    ]


def _conventions(hand_eye: HandEye) -> Check | None:
    return next((c for c in hand_eye.checks if c.name == CONVENTIONS), None)


def _plots(section: Section, store: SessionStore, hand_eye: HandEye) -> None:
    """Add residuals, diversity and what became of the lens."""
    if not hand_eye.view_indices:
        return
    plots = [(drawing.board_residuals(hand_eye), "Every board view, through the robot pose.")]
    if (store.folder / BOARD_VIEWS / "session.json").is_file():
        board = SessionStore.open(store.folder / BOARD_VIEWS)
        views = [v for v in board.session.views if v.index in hand_eye.view_indices]
        poses = [v.T_base_ee for v in views if v.T_base_ee is not None]
        if poses:
            plots.append((drawing.board_directions(hand_eye, poses), "How the arm turned."))
        given, i = board.session.intrinsics, hand_eye.intrinsics
        change = [i.fx - given.fx, i.fy - given.fy, i.cx - given.cx, i.cy - given.cy]
        sd = [float(s) for s in hand_eye.intrinsics_sd[:4]]
        if any(change) and any(sd):
            picture = drawing.intrinsics_change(LENS[:4], change, sd)
            plots.append((picture, "What the calibration changed of the camera's own figures."))
    section.page.plots(plots)


def _checks(section: Section, checks: Sequence[Check]) -> None:
    """Add checks, worst first; those that are not good are findings."""
    if not checks:
        return
    section.page.heading("Checks")
    ordered = worst_first(checks)
    # The check of the conventions stands with the reading of the poses.
    section.page.table(CHECK_HEADER, _rows([c for c in ordered if c.name != CONVENTIONS]))
    for c in ordered:
        if c.verdict in ("bad", "warn"):
            section.say(c.verdict, f"{section.title}, {c.name}: {c.words}")


def _rows(checks: Sequence[Check]) -> list[list[object]]:
    return [[c.name, _verdict(c), c.words] for c in checks]


def _verdict(check: Check) -> Cell:
    return Cell(text=check.verdict, kind=KIND[check.verdict])


def _reading(section: Section, store: SessionStore, hand_eye: HandEye) -> None:
    """Add how robot poses were read and joined to photographs, and what speaks for it."""
    section.page.heading("How the robot's poses were read and paired with photographs")
    section.page.text(READING)
    unknown = "no check of it is stored; calibrate again to have it"
    proof = _conventions(hand_eye) or Check(name=CONVENTIONS, verdict="unknown", sentence=unknown)
    rows: list[list[object]] = [["do hand and camera turn alike?", _verdict(proof), proof.sentence]]
    if store.has(EXPORT):
        told: Any = store.read_json(EXPORT)
        frames: Any = told.get("frames", {})
        named = f"base '{frames.get('robot_base')}', hand '{frames.get('hand')}', "
        rows.append(["frames", "", f"{named}camera '{frames.get('camera_optical')}'"])
        rows.append(["where the camera is", "", str(told.get("mode", "")).replace("_", " ")])
    folder = store.folder / BOARD_VIEWS
    if (folder / "session.json").is_file():
        views = SessionStore.open(folder).session.views
        rows.append(_pairing([(v.T_base_ee is not None, v.time_s) for v in views]))
    section.page.table(["", "", "what was found"], rows)


def _pairing(views: Sequence[tuple[bool, float]]) -> list[object]:
    """Return the row on photographs and poses."""
    posed = sum(has for has, _ in views)
    times = [t for _, t in views]
    back = sum(b < a for a, b in pairwise(times))
    text = f"{posed} of {len(views)} board photographs have the pose of the same number"
    text += f"; time stamps go back {back} times" if back else "; time stamps never go back"
    good = posed == len(views) and not back
    return ["pairs", Cell(text="good" if good else "warn", kind="good" if good else "warn"), text]


def _depth(section: Section, store: SessionStore) -> None:
    """Add what is known of the depth camera."""
    if not store.has(DEPTH):
        return
    told: Any = store.read_json(DEPTH)
    if not told.get("known"):
        section.page.text(f"The depth camera's bias is not known: {told.get('why', '')}")
        return
    sd = np.sqrt(np.clip(np.diagonal(np.asarray(told["covariance"], np.float64)), 0, None))
    scale = float(told["scale"])
    section.add(Figure(name="calibration.depth_scale", value=scale, sigma=float(sd[0])))
    section.page.heading("Depth camera")
    low, high = (float(v) for v in told["range_m"])
    section.page.table(
        ["figure", "value"],
        [
            ["scale of the inverse depth", f"{scale:.5f} ± {sd[0]:.5f}"],
            ["offset of the inverse depth", f"{told['offset_per_m']:+.5f} ± {sd[1]:.5f} 1/m"],
            ["noise of the inverse depth", f"{told['noise_per_m']:.5f} 1/m (1 sigma of a pixel)"],
            ["measured over", f"{low:.2f} to {high:.2f} m"],
        ],
    )
    ordered = worst_first([from_json(c, Check, "a check") for c in told.get("checks", ())])
    rows = _rows(ordered)
    for c, row in zip(ordered, rows, strict=True):
        if c.name == BIAS and c.verdict == "warn":
            row[1] = Cell(text="corrected", kind="off")  # no reason to look first
    section.page.table(CHECK_HEADER, rows)
    section.page.text("Registration takes a bias that is known out of the depth by itself.", "foot")
    for c in ordered:
        if c.verdict == "bad":
            section.say("bad", f"Depth camera, {c.name}: {c.words}")
