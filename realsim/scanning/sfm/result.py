"""What structure from motion gives: metric cameras and points, and how far to trust them.

What a reconstruction leaves on disk: the COLMAP model, a point cloud, cameras and the report.

OUT/model/            cameras, images, points3D, rigs, frames (.bin): COLMAP's own, in metres
OUT/model_text/       the same as text, if asked for
OUT/sparse.ply        points with colours [m]
OUT/cameras.json      intrinsics and T_world_cam of every registered view
OUT/sfm.json          result, checks, config, versions, hash of the images
OUT/database.db       features and matches, kept
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from realsim.arrays import Array, Int64, UInt8
from realsim.geometry.clouds import cloud_ply
from realsim.records import CameraIntrinsics, Verdict
from realsim.scanning.sfm.config import SfmConfig
from realsim.store import provenance
from realsim.store.atomic import write_bytes, write_json
from realsim.untrusted.own_json import to_json

Poses = Literal["unknown", "known", "refined"]
"""How the robot's poses are used: only for the scale; held as they are; as a start with a prior."""
Progress = Callable[[str, int, int], None]
"""Called with (step, done, total)."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Geometry:
    """Cameras, points and what was seen of them, in one world."""

    intrinsics: CameraIntrinsics
    """Intrinsics of all images."""
    names: tuple[str, ...]
    """(V,) registered images."""
    Ts_world_cam: Array
    """(V, 4, 4)"""
    points: Array
    """(P, 3)"""
    colors: UInt8
    """(P, 3) RGB."""
    cameras_of: Int64
    """(K,) camera of each observation, as its place in `names`."""
    points_of: Int64
    """(K,) point of each observation."""
    uv_px: Array
    """(K, 2) where it was seen; integers are pixel centres."""
    point_ids: Int64
    """(P,) numbers of the points in the COLMAP model."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ViewResidual:
    """How one camera of the reconstruction stands to the robot's pose."""

    name: str
    offset_mm: float
    """Distance of the centres [mm], the constant hand-eye correction taken out."""
    turn_deg: float
    """Angle between the rotations [deg]."""
    weight: float
    """Share with which the view counts in the scale."""
    chi2: float
    """Square of the six errors in their covariance; 6 is the mean of a faultless view."""
    outlier: bool
    """Whether it speaks against the others."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Alignment:
    """The similarity p_robot = scale * R @ p_sfm + t, and how well it is known."""

    scale: float
    """Metres per unit of the reconstruction."""
    sigma: float
    """1-sigma of the scale, in its unit: the greater of the formal and the jackknife's, and the
    arm's own metre."""
    R: Array
    """(3, 3)"""
    t: Array
    """(3,) [m]"""
    hand_eye_twist: Array
    """(6,) constant correction right of the robot's camera poses [rad, m], within its prior."""
    covariance: Array
    """(7, 7) of [rotation rad, translation m, log scale] about the middle of the centres."""
    views: tuple[ViewResidual, ...]
    parts_percent: dict[str, float]
    """What the sigma is made of [% of the scale]: formal, jackknife, hand_eye, arm."""

    @property
    def sigma_percent(self) -> float:
        """1-sigma of the scale as a percentage of it."""
        return 100.0 * self.sigma / self.scale


@dataclass(frozen=True, kw_only=True, slots=True)
class DepthScale:
    """A second scale, from measured depth at the sparse points: measured / reconstructed."""

    ratio: float
    """1 = the depth camera and the robot agree on the metre."""
    sigma: float
    """1-sigma of the ratio: its spread over the views, and the sensor's systematic part."""
    pairs: int
    """Observations compared."""
    views: int
    """Views with enough of them."""
    spread_mm: float
    """Robust 1-sigma of the single differences [mm]."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Matching:
    """What was found in the images before any geometry."""

    names: tuple[str, ...]
    """All images."""
    features: tuple[int, ...]
    """Features of each."""
    pairs: tuple[tuple[int, int, int, int], ...]
    """(image, image, matches, verified matches) of every pair that was matched, by place."""
    peak_threshold: float
    """SIFT's contrast threshold that was used."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class SfmResult:
    """Metric cameras and sparse points of a set of photographs."""

    poses: Poses
    geometry: Geometry
    """In metres and in the robot's world if `is_metric`; else in COLMAP's own unit."""
    is_metric: bool
    unregistered: tuple[str, ...]
    """Images that found no place."""
    models: tuple[int, ...]
    """Views of every model that mapping made, the one used first: more than one is fragmented."""
    scale: float
    """Metres per unit of the free reconstruction; 1 where the poses were given. NaN: unknown."""
    sigma_percent: float
    """1-sigma of the metric scale [%]; NaN where there is none."""
    alignment: Alignment | None
    """To the robot's poses."""
    depth: DepthScale | None
    """From the depth images."""
    reliability: float
    """Share of signal in what two halves of the scene do to the robot's poses, 0 to 1; below
    `least_reliability` a refinement leaves the cameras where they were. NaN: nothing refined."""
    camera_covariance: Array | None
    """(V, 6, 6) of the right perturbation of each camera [rad, m]; of a free reconstruction about
    the best similarity. None at the robot's own poses."""
    point_sigma_mm: Array
    """(P,) 1-sigma of each point along its worst direction [mm], cameras taken as right."""
    track_lengths: Int64
    """(P,) views that see each point."""
    reprojection_px: float
    """Median reprojection error."""
    view_reprojection_px: Array
    """(V,) median reprojection error of each camera."""
    matching: Matching
    verdict: Verdict
    reasons: tuple[str, ...]
    """Why the verdict is not 'accepted'."""
    notes: tuple[str, ...]
    """What a user should know besides."""
    cpu_s: float

    @property
    def outliers(self) -> tuple[str, ...]:
        """Views whose robot pose disagrees with the pictures."""
        found = () if self.alignment is None else self.alignment.views
        return tuple(v.name for v in found if v.outlier)


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
