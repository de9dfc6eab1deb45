"""The plane in a depth image, and what is left of the image without it.

Inverse depth is linear along rays: a plane n . X = 1 has the disparity d = f B n . ray. So the
plane is found, and its residual taken, in disparity, where a stereo sensor's noise is even.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array, Array32, Mask
from realsim.errors import InputError
from realsim.geometry.camera import ray_table
from realsim.records import CameraIntrinsics
from realsim.rendering.depth_sensors.loss import require_same_size
from realsim.rendering.depth_sensors.statistics import require_metres

BENT_SHARE = 0.35
"""Pixels between one and two tolerances from the best plane, as a share of those within one, from
which on the surface is bent: a sphere has half as many, noise one in 16 000."""
TRIALS = 300
"""Triples of pixels tried: with one measured pixel in four on the plane, 300 miss it with a
probability of 1 %."""
SAMPLES = 20_000
"""Pixels that judge a triple."""
TOLERANCE_PX = 1.0
"""Residual of a plane's pixel at first [px]; afterwards four times the measured spread."""
LEAST_SHARE = 0.05
"""Share of the picture that a plane must fill to say anything."""
RIM_PX = 4
"""Pixels near anything else that are left out: edges smear [px]."""
CLOSING_PX = 15
"""Holes up to twice this width belong to the plane [px]."""
SEED = 0
"""Seed of the triples."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class PlaneView:
    """One picture's plane."""

    normal: Array
    """(3,) n of n . X = 1 in camera axes [1/m]."""
    disparity: Array32
    """(H, W) of the plane [px]; NaN where the lens model has no ray."""
    residual: Array32
    """(H, W) measured - plane [px] on the plane, NaN elsewhere."""
    area: Mask
    """(H, W) the plane with the holes in it."""
    holes: Mask
    """(H, W) pixels of the area that were not measured, and not because of a thing before it."""
    angle_deg: Array32
    """(H, W) between ray and normal of the plane [deg]."""
    distance_m: float
    """Median depth of the plane's pixels [m]."""

    @property
    def mask(self) -> Mask:
        """Pixels (H, W) measured on the plane."""
        return np.isfinite(self.residual)


def find_plane(
    depth_m: ArrayLike,
    intrinsics: CameraIntrinsics,
    baseline_m: float,
    *,
    region: Mask | None = None,
    name: str = "the depth picture",
) -> PlaneView:
    """Return the plane that most pixels lie on.

    Args:
        depth_m: (H, W) measured depth [m], 0 = none.
        intrinsics: the camera.
        baseline_m: of the sensor [m].
        region: (H, W) where to look; None = everywhere.
        name: what to call the picture in messages.

    Raises:
        InputError: wrong unit or size, or no plane in the picture.
    """
    depth = require_metres(depth_m, name)
    require_same_size(depth, intrinsics, name)
    rays = ray_table(intrinsics)
    known = (depth > 0) & np.isfinite(rays[..., 0])
    looked = known if region is None else known & region
    fB = intrinsics.fx * baseline_m
    d = np.where(known, fB / np.where(known, depth, 1), 0).astype(np.float32)
    p, tolerance = _consensus(rays[looked].astype(np.float64), d[looked], name)
    plane = (rays @ p.astype(np.float32)).astype(np.float32)
    away = d - plane
    on = looked & (np.abs(away) <= tolerance)
    area, mask = _extent(on, known & (np.abs(away) > tolerance))
    least = LEAST_SHARE * depth.size
    if mask.sum() < least:
        raise InputError(
            f"{name} shows no plane that fills {100 * LEAST_SHARE:.0f} % of it: the largest "
            f"has {int(mask.sum())} of {depth.size} pixels. Frames of a wall or a bare table are "
            "taken; a mask of the plane's region helps where other things are in view."
        )
    residual = np.where(mask, away, np.nan).astype(np.float32)
    _require_flat(away, looked, tolerance, name)
    return PlaneView(
        normal=p / fB,
        disparity=np.where(plane > 0, plane, np.nan).astype(np.float32),
        residual=residual,
        area=area,
        holes=_holes(area, known, known & (np.abs(away) > tolerance), plane),
        angle_deg=_angle(rays, p),
        distance_m=float(np.median(depth[mask])),
    )


def _consensus(rays: Array, d: Array32, name: str) -> tuple[Array, float]:
    """Return p of d = p . ray that most samples (N, 3), (N,) agree with, and their tolerance."""
    rng = np.random.default_rng(SEED)
    if len(d) < 1000:
        raise InputError(
            f"{name} has {len(d)} measured pixels where the plane is looked for; 1000 or more say "
            "something."
        )
    chosen = rng.choice(len(d), min(len(d), SAMPLES), replace=False)
    A, y = rays[chosen], d[chosen].astype(np.float64)
    tolerance = min(TOLERANCE_PX, 0.05 * float(np.median(y)))
    best: Array = np.zeros(3)
    most = -1
    judge_A, judge_y = A[:4000], y[:4000]
    for triple in rng.integers(len(y), size=(TRIALS, 3)):
        if abs(np.linalg.det(A[triple])) < 1e-9:
            continue
        p = np.asarray(np.linalg.solve(A[triple], y[triple]), np.float64)
        agree = int(np.sum(np.abs(judge_A @ p - judge_y) < tolerance))
        if agree > most:
            best, most = p, agree
    if most < 10:
        raise InputError(f"{name} shows no plane: no three of its pixels agree with the others.")
    first = tolerance
    for _ in range(8):
        off = A @ best - y
        near = np.abs(off) < tolerance
        best = np.asarray(np.linalg.lstsq(A[near], y[near], rcond=None)[0], np.float64)
        off = (A @ best - y)[near]
        spread = 1.4826 * float(np.median(np.abs(off - np.median(off))))
        tolerance = float(np.clip(4 * spread, 0.02, first))
    return best, tolerance


def _extent(on: Mask, other: Mask) -> tuple[Mask, Mask]:
    """Return the area of the greatest connected plane with its holes, and its sure pixels."""
    import cv2

    core = cv2.morphologyEx(on.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    # Single noisy pixels are no other thing; a thing has a body.
    body = cv2.morphologyEx(other.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    near = _within(core > 0, CLOSING_PX)
    closed = ~_within(~near, CLOSING_PX) & ~_within(body > 0, RIM_PX)
    count, parts, stats, _ = cv2.connectedComponentsWithStats(closed.astype(np.uint8))
    if count < 2:
        return np.zeros_like(on), np.zeros_like(on)
    area = np.asarray(parts == 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA])))
    return area, on & area


def _within(mask: Mask, radius_px: int) -> Mask:
    """Return the pixels (H, W) at most a radius from the mask."""
    import cv2

    if not mask.any():
        return np.zeros_like(mask)
    return np.asarray(cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5)) <= radius_px


def _holes(area: Mask, known: Mask, other: Mask, plane: Array32) -> Mask:
    """Return the unmeasured pixels of the area that no thing before the plane explains.

    A hole that touches another thing may be its shadow; and the band at the left, as wide as the
    plane's disparity, is not in the second eye's picture.
    """
    import cv2

    count, found = cv2.connectedComponents((~known).astype(np.uint8))
    parts = np.asarray(found, np.int64)
    body = cv2.morphologyEx(other.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    explained = np.zeros(count, dtype=bool)
    explained[np.unique(parts[_within(np.asarray(body) > 0, RIM_PX + 2)])] = True
    covered = np.arange(area.shape[1]) >= plane
    return area & ~known & covered & ~explained[parts]


def _require_flat(away: Array32, looked: Mask, tolerance: float, name: str) -> None:
    """Refuse a bent surface: it leaves its best plane gradually, where a plane's pixels end."""
    off = np.abs(away[looked])
    on = int(np.sum(off <= tolerance))
    beyond = int(np.sum(off < 2 * tolerance)) - on
    if beyond > BENT_SHARE * on:
        raise InputError(
            f"{name} shows a bent surface, no plane: {on} pixels lie within {tolerance:.2f} px of "
            f"disparity of the best plane, and {beyond} more within twice that. Frames of a flat "
            "wall or table are taken; a mask of the plane's region helps where other things are in "
            "view. If it IS flat, check the camera's distortion and the baseline."
        )


def _angle(rays: Array32, p: Array) -> Array32:
    """Return the angle (H, W) between each ray and the plane's normal [deg]."""
    n = (p / np.linalg.norm(p)).astype(np.float32)
    length = np.sqrt(np.square(rays).sum(-1))
    return np.degrees(np.arccos(np.clip(np.abs(rays @ n) / length, 0, 1))).astype(np.float32)
