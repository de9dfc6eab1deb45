"""`realsim calibrate SESSION --check`: does the calibration still hold, without a board?"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from realsim.app.console import Console
from realsim.arrays import Array
from realsim.errors import InputError
from realsim.store import SessionStore, load_hand_eye
from realsim.store.results import HAND_EYE_FILE
from realsim_calibration.pairs.drift import Drift, estimate_drift

CHECK_FILE = "calibration/check.json"
"""What the last check found."""
OTHER_M = 1e-4
"""Cameras further from where a registration was told that they are stem from another
calibration [m]."""


def run_check(source: Path, console: Console, tolerance_mm: float = 1.0) -> bool:
    """Say whether the hand-eye of a registered session still holds; return whether it does.

    What is held against the registered cameras is the calibration as it lies in the session now,
    also where the scene was registered with another one.

    Raises:
        InputError: no session, no registration in it, or too few views that it refined.
    """
    if not tolerance_mm > 0 or not np.isfinite(tolerance_mm):
        raise InputError(f"--tolerance {tolerance_mm:g}: a length above 0 in mm is expected.")
    from realsim.app.register.results import load_registered
    from realsim.app.stages import open_session

    if not source.is_dir():
        raise InputError(f"'{source}' does not exist: --check needs a registered session.")
    store = open_session(source)
    if not store.has("registration/report.json"):
        raise InputError(
            f"session '{source}' is not registered yet: run `realsim register {source}` first; "
            "--check then compares where the objects say that the cameras were."
        )
    registered = load_registered(store)
    cameras = registered.cameras
    trusted = {o.instance for o in registered.scene.objects if o.verdict != "rejected"}
    if not trusted:
        raise InputError(
            f"session '{source}': no object is placed, so nothing tells where the cameras were. "
            "Register a scene with objects that are found."
        )
    views = sorted(set(cameras.claimed) & set(cameras.refined))
    away = [
        float(pose.T_cam_obj[2, 3])
        for k in views
        for instance, pose in registered.seen.get(k, {}).items()
        if instance in trusted
    ]
    if not views:
        raise InputError(
            f"session '{source}': registration/cameras.json holds no refined camera. Register it "
            "with more views, and not with --no-cameras."
        )
    claimed = _placed_now(store, cameras.claimed, console)
    drift = estimate_drift(
        np.array([claimed[k] for k in views]).reshape(-1, 4, 4),
        np.array([cameras.refined[k] for k in views]).reshape(-1, 4, 4),
        float(np.median(away)) if away else 0.5,
        tolerance_mm,
    )
    document = document_of(drift, tolerance_mm)
    store.write_json(CHECK_FILE, document)
    console.say(sentence(drift, tolerance_mm))
    console.result(document)
    return not drift.moved


def _placed_now(
    store: SessionStore, claimed: Mapping[int, Array], console: Console
) -> dict[int, Array]:
    """Return the cameras as the calibration on disk places them; as claimed where there is none."""
    if not store.has(HAND_EYE_FILE):
        return dict(claimed)
    hand_eye = load_hand_eye(store)
    now = dict(claimed) | {
        v.index: hand_eye.camera_poses(v.T_base_ee, v.joints)
        for v in store.session.views
        if v.T_base_ee is not None and v.index in claimed
    }
    off = max(float(np.linalg.norm(now[k][:3, 3] - T[:3, 3])) for k, T in claimed.items())
    if off > OTHER_M:
        console.warn(
            f"{HAND_EYE_FILE} places cameras up to {1e3 * off:.1f} mm from where the registration "
            "was told that they are: it is another calibration, and the one that is checked."
        )
    return now


def sentence(drift: Drift, tolerance_mm: float) -> str:
    """Return the verdict in words."""
    sigma_deg, sigma_mm = drift.sigmas
    size = (
        f"the camera in the hand seems moved by {drift.mm:.2f} +-{sigma_mm:.2f} mm and "
        f"{drift.deg:.3f} +-{sigma_deg:.3f} deg ({drift.views} views), which shifts the objects by "
        f"{drift.shift_mm:.2f} +-{drift.sigma_mm:.2f} mm"
    )
    if drift.moved:
        return (
            f"the calibration does NOT hold: {size}; {tolerance_mm:g} mm are allowed. Tighten the "
            "camera and calibrate anew with the board (`realsim calibrate`)."
        )
    unseen = 3 * drift.sigma_mm
    doubt = (
        f" A move of less than {unseen:.1f} mm would go unseen here: register a scene with more "
        "views that roll and tilt the camera."
        if unseen > tolerance_mm
        else ""
    )
    return f"the calibration holds: {size}; {tolerance_mm:g} mm are allowed.{doubt}"


def document_of(drift: Drift, tolerance_mm: float) -> dict[str, object]:
    """Return plain JSON values."""
    sigma_deg, sigma_mm = drift.sigmas
    return {
        "holds": not drift.moved,
        "tolerance_mm": tolerance_mm,
        "shift_mm": drift.shift_mm,
        "shift_sigma_mm": drift.sigma_mm,
        "moved_mm": drift.mm,
        "moved_sigma_mm": sigma_mm,
        "moved_deg": drift.deg,
        "moved_sigma_deg": sigma_deg,
        "chance": drift.chance,
        "twist": drift.twist.tolist(),
        "covariance": drift.covariance.tolist(),
        "views": drift.views,
    }
