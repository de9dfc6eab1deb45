"""What happened during a registration, as plain JSON values."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from realsim.geometry import se3
from realsim.records import ObjectPose, SupportPlane
from realsim.registration.blind import Kept, Uncertainty
from realsim.registration.body import Body
from realsim.registration.judge import Poses
from realsim.registration.many_views import ManyViews
from realsim.registration.photo_fit import PhotoFit
from realsim.registration.refinement.equations import BIAS, HAND_EYE
from realsim.registration.refinement.uncertainty import common_and_own
from realsim.registration.search.records import Placed
from realsim.registration.verify import common_offset, common_sinking


def plane_report(plane: SupportPlane | None, reason: str) -> dict[str, Any]:
    """Return the plane's quality, or why there is none."""
    if plane is None:
        return {"found": False, "reason": reason}
    return {"found": True, "rms_mm": 1e3 * plane.rms_m, "inliers": plane.inliers}


def common_report(given: Poses, objects: Sequence[ObjectPose]) -> dict[str, Any]:
    """Return what holds for all objects together."""
    poses = [o.T_world_obj for o in objects]
    good = [o.verdict != "rejected" for o in objects]
    sinking = common_sinking(given.bodies, poses, good, given.plane)
    report: dict[str, Any] = {"common_sinking": sinking}
    if given.with_starts:
        report["common_offset_mm"] = common_offset(given.bodies, poses, good)
    return report


def search_report(placed: Placed) -> dict[str, Any]:
    """Return how an object was found."""
    return {
        "source": placed.source,
        "gain_px": placed.gain_px,
        "gain_per_pixel": placed.gain_per_pixel,
        "agree": placed.agree,
        "pixels": placed.pixels,
        "contrast": placed.contrast,
    }


def object_report(
    body: Body, pose: ObjectPose, kept: Kept, search: dict[str, Any], u: Uncertainty
) -> dict[str, Any]:
    """Return what happened to one object."""
    fit = kept.fit
    T, T0 = pose.T_world_obj, body.T_start
    return {
        "instance": pose.instance,
        "obj_id": pose.obj_id,
        "name": body.model.name,
        "verdict": pose.verdict,
        "moved_mm": float(1e3 * np.linalg.norm(body.center(T) - body.center(T0))),
        "turned_deg": float(np.degrees(se3.angle(T0[:3, :3].T @ T[:3, :3]))),
        "points_used": fit.points,
        "points_offered": fit.offered,
        "residual_rms_mm": list(fit.history_mm),
        "variance_of_unit_weight": fit.variance,
        "unobservable": list(u.unobservable),
        "blind": kept.report,
        "sensitivities": list(u.sensitivities),
        "search": search,
    }


def photo_report(photo: PhotoFit | None) -> dict[str, Any]:
    """Return what the photograph of a single view said; nothing where there is none."""
    if photo is None:
        return {}
    said = {
        "taken": photo.taken,
        "beside_depth_px": [float(p) for p in photo.beside_px],
        "edge_px_before": photo.edge_px[0],
        "edge_px_after": photo.edge_px[1],
    }
    if not photo.taken:
        return {"photograph": said}
    depth = {
        "depth_scale": 1.0,
        "depth_scale_sigma": 0.0,
        "depth_offset_per_m": photo.offset_per_m,
        "depth_offset_sigma_per_m": photo.offset_sigma_per_m,
    }
    return {"photograph": said, "refinement": depth}


def camera_report(
    many: ManyViews, bodies: Sequence[Body], numbers: Sequence[int]
) -> dict[str, Any]:
    """Return what the refinement found of cameras, depth and table."""
    refined = many.refined
    C = refined.covariance.shared
    mm, deg = refined.hand_eye_mm_deg
    sigma = np.sqrt(np.diag(C))
    own, still = np.split(refined.state.views, [len(numbers)])
    shared, each = common_and_own(refined, bodies)
    arm = np.repeat([0.0, many.arm_constant_m**2], 3)
    common = np.sqrt(np.diag(shared) + arm)
    return {
        "hand_eye_mm": mm,
        "hand_eye_deg": deg,
        "hand_eye_sigma_mm": 1e3 * float(np.linalg.norm(sigma[HAND_EYE][3:])),
        "hand_eye_sigma_deg": float(np.degrees(np.linalg.norm(sigma[HAND_EYE][:3]))),
        "common_sigma_mm": 1e3 * float(np.linalg.norm(common[3:])),
        "common_sigma_deg": float(np.degrees(np.linalg.norm(common[:3]))),
        "own_sigma_mm": {
            str(b.start.instance): 1e3 * float(np.sqrt(np.trace(own_C[3:, 3:])))
            for b, own_C in zip(bodies, each, strict=True)
        },
        "view_sigma_mm": refined.view_sigma[1],
        "view_sigma_deg": refined.view_sigma[0],
        "views": {
            str(i): {
                "shift_mm": 1e3 * float(np.linalg.norm(x[3:6])),
                "turn_deg": float(np.degrees(np.linalg.norm(x[:3]))),
                "depth_offset_per_m": float(x[6]),
            }
            for i, x in zip(numbers, own, strict=True)
        },
        "fixed_cameras": {
            view.fixed.name: {
                "shift_mm": 1e3 * float(np.linalg.norm(x[3:6])),
                "turn_deg": float(np.degrees(np.linalg.norm(x[:3]))),
                "sigma_mm": 1e3 * float(np.sqrt(np.trace(C_view[3:6, 3:6]))),
                "depth_scale": 1.0 + float(x[7]),
                "depth_offset_per_m": float(x[6]),
                "noise_per_m": view.fixed.noise.per_m,
            }
            for view, x, C_view in zip(
                many.views[len(numbers) :],
                still,
                refined.covariance.views[len(numbers) :],
                strict=True,
            )
            if view.fixed is not None
        },
        "depth_scale": float(refined.state.bias[0]),
        "depth_scale_sigma": float(sigma[BIAS][0]),
        "depth_offset_per_m": float(refined.state.bias[1]),
        "depth_offset_sigma_per_m": float(sigma[BIAS][1]),
        "misfit_mm": [1e3 * float(m) for m in refined.misfit_m],
        "points": [int(n) for n in refined.used],
        "history": list(refined.history),
    }
