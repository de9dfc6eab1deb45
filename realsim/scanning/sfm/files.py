"""What a reconstruction leaves on disk: the COLMAP model, a point cloud, cameras and the report.

OUT/model/            cameras, images, points3D, rigs, frames (.bin): COLMAP's own, in metres
OUT/model_text/       the same as text, if asked for
OUT/sparse.ply        points with colours [m]
OUT/cameras.json      intrinsics and T_world_cam of every registered view
OUT/sfm.json          result, checks, config, versions, hash of the images
OUT/database.db       features and matches, kept
"""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from realsim.geometry.clouds import cloud_ply
from realsim.scanning.sfm.config import SfmConfig
from realsim.scanning.sfm.result import Alignment, SfmResult
from realsim.store import provenance
from realsim.store.atomic import write_bytes, write_json
from realsim.untrusted.own_json import to_json

RESULT, CAMERAS, CLOUD = "sfm.json", "cameras.json", "sparse.ply"
VERSION = 1
PACKAGES = ("realsim", "pycolmap", "numpy", "scipy", "opencv-python-headless")


def write_result(
    result: SfmResult, config: SfmConfig, folder: Path, inputs: dict[str, Any]
) -> None:
    """Write cameras, cloud and report; each file whole or not at all, the report last.

    Args:
        result: of the reconstruction.
        config: that it was made with.
        folder: to write into.
        inputs: plain JSON values that say what went in (source, hash of the images, ...).
    """
    g, unit = result.geometry, "m" if result.is_metric else "arbitrary"  # COLMAP's
    write_bytes(folder / CLOUD, cloud_ply(g.points, g.colors, f"unit {unit}"))
    write_json(folder / CAMERAS, cameras_json(result))
    write_json(folder / RESULT, result_json(result, config) | {"inputs": inputs})


def cameras_json(result: SfmResult) -> dict[str, Any]:
    """Return the camera and its pose in every registered view."""
    g = result.geometry
    sigmas = _camera_sigmas(result)
    return {
        "format": "realsim-sfm-cameras",
        "version": VERSION,
        "units": ("m" if result.is_metric else "arbitrary") + "; T_world_cam maps camera to world",
        "camera": to_json(g.intrinsics),
        "views": [
            {"name": name, "T_world_cam": to_json(T), "reprojection_px": to_json(error), **sigma}
            for name, T, error, sigma in zip(
                g.names, g.Ts_world_cam, result.view_reprojection_px.tolist(), sigmas, strict=True
            )
        ],
        "unregistered": list(result.unregistered),
    }


def result_json(result: SfmResult, config: SfmConfig) -> dict[str, Any]:
    """Return everything but the arrays as JSON values."""
    g, d = result.geometry, result.depth
    return {
        "format": "realsim-sfm",
        "version": VERSION,
        "verdict": result.verdict,
        "reasons": list(result.reasons),
        "notes": list(result.notes),
        "poses": result.poses,
        "is_metric": result.is_metric,
        "scale_m_per_unit": to_json(result.scale),
        "scale_sigma_percent": to_json(result.sigma_percent),
        "refinement_reliability": to_json(result.reliability),
        "alignment": None if result.alignment is None else _alignment_json(result.alignment),
        "depth": None if d is None else {
            "ratio": d.ratio, "sigma": d.sigma, "pairs": d.pairs, "views": d.views,
            "spread_mm": d.spread_mm,
        },
        "views": {
            "given": len(result.matching.names), "registered": len(g.names),
            "models": list(result.models), "unregistered": list(result.unregistered),
        },
        "points": {
            "count": len(g.points),
            "mean_track": to_json(float(result.track_lengths.mean())),
            "median_sigma_mm": to_json(float(np.median(result.point_sigma_mm))),
            "reprojection_px": to_json(result.reprojection_px),
        },
        "camera": to_json(g.intrinsics),
        "features": dict(zip(result.matching.names, result.matching.features, strict=True)),
        "peak_threshold": result.matching.peak_threshold,
        "pairs_verified": sum(1 for p in result.matching.pairs if p[3] > 0),
        "pairs_matched": len(result.matching.pairs),
        "config": asdict(config),
        "versions": provenance.versions(PACKAGES),
    }  # fmt: skip


def _alignment_json(a: Alignment) -> dict[str, Any]:
    return {
        "scale": a.scale,
        "sigma_percent": a.sigma_percent,
        "sigma_parts_percent": {k: to_json(v) for k, v in a.parts_percent.items()},
        "R": to_json(a.R),
        "t_m": to_json(a.t),
        "hand_eye_correction_deg": np.degrees(a.hand_eye_twist[:3]).tolist(),
        "hand_eye_correction_mm": (1e3 * a.hand_eye_twist[3:]).tolist(),
        "covariance": to_json(a.covariance),
        "views": [asdict(v) for v in a.views],
    }


def _camera_sigmas(result: SfmResult) -> list[dict[str, Any]]:
    """Return 1-sigma of each camera's rotation and centre along the worst axis."""
    if result.camera_covariance is None:
        return [{} for _ in result.geometry.names]
    rows: list[dict[str, Any]] = []
    for C in result.camera_covariance:
        turn, shift = np.linalg.eigvalsh(C[:3, :3])[-1], np.linalg.eigvalsh(C[3:, 3:])[-1]
        rows.append(
            {"sigma_deg": float(np.degrees(np.sqrt(turn))), "sigma_mm": float(1e3 * np.sqrt(shift))}
        )
    return rows
