"""Where on an object the measured surface is not the model's, averaged over all views.

One pixel says no more than its noise, 0.6 mm at 30 cm; the mean of hundreds of views over a patch
of 4 mm says 0.05 mm. A gear that is turned by half a tooth agrees with 97 of 100 pixels within
3 mm and yet differs by 1 to 2 mm on patches that lie where its teeth are.

Of a patch: m = sum(w r) / sum(w), w = 1 / sigma^2, se^2 = k / sum(w) + floor^2. It is wrong if
|m| > bound and |m| > 3 se. The bound is 1 mm, or 2.5 times the level of error that all objects of
the session share (the median of their robust patch RMS): a camera at 1 m and hand-made meshes
are off by 2 mm everywhere, which speaks against none of the poses.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from realsim.arrays import Array, Int32, Mask
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.geometry.robust import mad_sigma
from realsim.records import CameraIntrinsics, SupportPlane
from realsim.registration.body import Body
from realsim.registration.evidence import DepthNoise
from realsim.registration.judging.ownership import Claims, make_claims, owners
from realsim.registration.judging.patches import (
    Patches,
    add_to_patches,
    look_at_patches,
    make_patches,
)
from realsim.registration.views import ViewPoints

SIZE_LEAST, SIZE_ERRORS, SIZE_EXPLAINED, SIZE_PATCHES = 0.02, 5.0, 0.35, 30
"""When a model is said to have the wrong size: least share, standard errors, share of the residuals
that it explains, and patches that are measured."""
LEVEL_HALVINGS = 40
"""Halvings of the interval in which the level is sought: it ends at 1e-12 of it."""


PATCH_M = 0.004
"""Edge of a patch [m]: the teeth of a fine gear are as wide."""
SAMPLES_PER_PATCH = 8.0
"""Surface samples per patch by which areas are measured."""
REACH_M = 0.008
"""Points further from every surface belong to none of the objects [m]."""
POINTS_PER_OBJECT = 30_000
"""About so many points are used of each object: 30 or more of a patch."""
LEAST_POINTS = 4
"""A patch with fewer is not measured."""
VARIANCE_FACTOR = 2.0
"""k: neighbouring pixels are not independent, and the noise model is good to a third."""
FLOOR_M = 0.0001
"""Part of se that does not average out: the field's grid and the cameras' poses [m]."""
WRONG_M = 0.001
"""Least mean residual of a wrong patch [m]."""
WRONG_SIGMAS = 3.0
"""Least mean residual of a wrong patch, in standard errors."""
LEVEL_FACTOR = 2.5
"""Least mean residual of a wrong patch, in units of the session's level of error."""
LEVEL_M = (0.0002, 0.002)
"""Least and greatest level [m]: beyond, poses are wrong, not meshes and cameras."""
LEVEL_PER_M = 0.003
"""The level where it cannot be measured: this times z^2 [1/m], 0.3 mm at 30 cm, 3 mm at 1 m."""
LEVEL_PRIOR = 2.0
"""That expectation counts as so many objects: with fewer, one wrong pose would excuse
itself."""
LEVEL_PATCHES = 10.0
"""An object with so many measured patches counts half."""
LOOKS = 48
"""Views, evenly picked, in which patches are looked at for free space."""
LOOK_COS = 0.35
"""Least cosine at which a patch is looked at: flatter, the next pixel is millimetres off."""
THROUGH_M = 0.0035
"""Distance behind a patch from which a measurement has gone through it [m]."""
THROUGH_SIGMAS = 2.0
"""Plus so many sigma_z, plus `LEVEL_PER_M` z^2: a camera at 1 m is 3 mm off."""
THROUGH_LOOKS = 2
"""Fewer looks through do not count where there are more views than two."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class SurfaceResiduals:
    """What all views say of every patch of one object."""

    patches: Patches
    mean_m: Array
    """(P,) mean residual, positive = the real surface is outside [m]; NaN = not measured."""
    sigma_m: Array
    """(P,) its standard error [m]."""
    counts: Array
    """(P,) points."""
    looks: Int32
    """(P, 3) views that saw the patch, looked through it, saw something in front of it."""
    depth_m: float
    """Median depth at which the object was seen [m]; NaN = never."""
    views: int
    """How many views there were."""

    @property
    def measured(self) -> Mask:
        """(P,) whether a patch has a mean."""
        return np.isfinite(self.mean_m)


def surface_residuals(
    bodies: Sequence[Body],
    poses: Sequence[Array],
    intrinsics: CameraIntrinsics,
    views: Sequence[ViewPoints],
    Ts_world_cam: Array,
    noise: DepthNoise,
    plane: SupportPlane | None,
) -> list[SurfaceResiduals]:
    """Return the mean residual of every patch of every object, all views together.

    Every point counts for the surface it is nearest to: an object's, or the table's.

    Args:
        bodies: the objects.
        poses: their T_world_obj (4, 4).
        intrinsics: the camera in the hand.
        views: what each view measured.
        Ts_world_cam: (V, 4, 4) the corrected cameras.
        noise: of the depth of the camera in the hand.
        plane: the table; its points belong to no object.

    Raises:
        InputError: there are not as many cameras as views.
    """
    Ts = np.asarray(Ts_world_cam, dtype=np.float64)
    if Ts.shape != (len(views), 4, 4):
        raise InputError(f"cameras of shape {Ts.shape} for {len(views)} views; give (V, 4, 4).")
    pieces = [make_patches(b, PATCH_M, SAMPLES_PER_PATCH) for b in bodies]
    sums = [np.zeros((len(p.centers), 4)) for p in pieces]
    looks = [np.zeros((len(p.centers), 3), dtype=np.int32) for p in pieces]
    depths = [
        np.sum((b.center(T) - Ts[:, :3, 3]) * Ts[:, :3, 2], axis=1)
        for b, T in zip(bodies, poses, strict=True)
    ]
    claims = make_claims(bodies, poses, plane, REACH_M)
    step = thinning(bodies, poses, (intrinsics, views, Ts), POINTS_PER_OBJECT)
    every = max(1, len(views) // LOOKS)
    for v, (view, T) in enumerate(zip(views, Ts, strict=True)):
        own = view.noise(noise)
        _add_view(claims, pieces, (view, T, v % step, step), own, sums)
        if v % every == 0 or view.fixed is not None:
            _look(poses, pieces, view.intrinsics(intrinsics), view, T, own, looks)
    return [
        _means_of(p, s, seen, depth, len(views))
        for p, s, seen, depth in zip(pieces, sums, looks, depths, strict=True)
    ]


def thinning(
    bodies: Sequence[Body],
    poses: Sequence[Array],
    seen: tuple[CameraIntrinsics, Sequence[ViewPoints], Array],
    wanted: int,
) -> int:
    """Return every how many points one is enough for the smallest object to have `wanted`.

    Args:
        bodies: the objects.
        poses: their T_world_obj (4, 4).
        seen: the camera, the views and their poses (V, 4, 4).
        wanted: points of an object over all views.
    """
    intrinsics, views, Ts_world_cam = seen
    fewest = np.inf
    area_px = np.array([v.area_px for v in views])
    for body, T in zip(bodies, poses, strict=True):
        z = np.linalg.norm(Ts_world_cam[:, :3, 3] - body.center(T), axis=1)
        # A disc of half the bounding radius stands for the silhouette.
        disc = np.pi * np.square(0.5 * body.radius_m * intrinsics.fx / z)
        fewest = min(fewest, float(np.sum(disc / area_px)))
    return max(1, int(fewest / wanted)) if np.isfinite(fewest) else 1


def _add_view(
    claims: Claims,
    pieces: Sequence[Patches],
    seen: tuple[ViewPoints, Array, int, int],
    noise: DepthNoise,
    sums: Sequence[Array],
) -> None:
    """Add one view's points to the sums of the patches they lie on.

    Args:
        claims: of the objects and the table.
        pieces: patches of each object.
        seen: the view, its camera, the first point used, and every how many.
        noise: of the depth.
        sums: (P, 4) per object; added to.
    """
    view, T_world_cam, first, step = seen
    points_cam = view.points[first::step].astype(np.float64)
    points, sigmas = se3.transform(T_world_cam, points_cam), noise.sigma(points_cam[:, 2])
    owner = owners(claims, points)
    for k, patches in enumerate(pieces):
        lattice, T_obj_world, _, _ = claims.objects[k]
        mine = np.flatnonzero(owner == k)
        eye = T_obj_world[:3, :3] @ T_world_cam[:3, 3] + T_obj_world[:3, 3]
        add_to_patches(
            (points[mine], sigmas[mine]),
            lattice,
            (T_obj_world, eye),
            (patches.index, patches.origin, patches.size_m),
            sums[k],
        )


def _look(
    poses: Sequence[Array],
    pieces: Sequence[Patches],
    intrinsics: CameraIntrinsics,
    view: ViewPoints,
    T_world_cam: Array,
    noise: DepthNoise,
    looks: Sequence[Int32],
) -> None:
    """Count which patches one view saw, looked through, or was hidden from."""
    stride = max(1, round(float(np.sqrt(view.area_px))))
    shape = (-(-intrinsics.height // stride), -(-intrinsics.width // stride))
    depth = np.zeros(shape, dtype=np.float32)
    depth[view.pixels[:, 1] // stride, view.pixels[:, 0] // stride] = view.points[:, 2]
    own = (intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy)
    camera = np.concatenate([own, intrinsics.distortion])
    limits = (LOOK_COS, THROUGH_M, THROUGH_SIGMAS, LEVEL_PER_M)
    for k, patches in enumerate(pieces):
        look_at_patches(
            (patches.centers, patches.normals),
            se3.invert(T_world_cam) @ poses[k],
            camera,
            (depth, stride),
            (*limits, noise.per_m, noise.floor_m),
            looks[k],
        )


def _means_of(
    patches: Patches, sums: Array, looks: Int32, depths: Array, views: int
) -> SurfaceResiduals:
    """Return the means of the sums."""
    count, weight, first, _ = sums.T
    enough = count >= LEAST_POINTS
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = np.where(enough, first / weight, np.nan)
        variance = VARIANCE_FACTOR / weight + FLOOR_M**2
        sigma = np.where(enough, np.sqrt(variance), np.nan)
    return SurfaceResiduals(
        patches=patches,
        mean_m=mean,
        sigma_m=sigma,
        counts=count,
        looks=looks,
        depth_m=float(np.median(depths)) if len(depths) else float("nan"),
        views=views,
    )


def error_level_m(residuals: Sequence[SurfaceResiduals]) -> float:
    """Return the level of error L that the objects of a session share [m].

    It lies between what depth of that distance must be expected to be off by, L0, and the objects'
    own levels l_i = 1.48 * median |m| of their patches, freed of their standard error:
        w_0 (L0^2 - L^2) / (L0^2 + L^2) + sum_i w_i (l_i^2 - L^2) / (l_i^2 + L^2) = 0,
    w_i = n_i / (n_i + `LEVEL_PATCHES`) with n_i patches. No object pulls by more than 1, so that
    one wrong pose does not excuse itself; and no pose, moved a little, makes the level jump, as a
    median of a few objects does.
    """
    least, most = LEVEL_M
    own: list[float] = []
    weights: list[float] = []
    for r in residuals:
        if np.any(r.measured):
            spread = mad_sigma(r.mean_m[r.measured])
            noise = float(np.median(r.sigma_m[r.measured]))
            own.append(max(least**2, spread**2 - noise**2))
            count = float(np.count_nonzero(r.measured))
            weights.append(count / (count + LEVEL_PATCHES))
    depths = [r.depth_m for r in residuals if np.isfinite(r.depth_m)]
    if not depths:
        return least
    squares = np.append(own, max(least, LEVEL_PER_M * float(np.median(depths)) ** 2) ** 2)
    pulls = np.append(weights, LEVEL_PRIOR)
    low, high = np.log(squares.min()), np.log(squares.max())
    for _ in range(LEVEL_HALVINGS):
        middle = 0.5 * (low + high)
        up = float(pulls @ ((squares - np.exp(middle)) / (squares + np.exp(middle)))) > 0
        low, high = (middle, high) if up else (low, middle)
    return float(np.clip(np.exp(0.25 * (low + high)), least, most))


def wrong_bound_m(level_m: float) -> float:
    """Return the mean residual beyond which a patch is wrong [m]."""
    return max(WRONG_M, LEVEL_FACTOR * level_m)


def residual_checks(residuals: SurfaceResiduals, level_m: float) -> dict[str, float]:
    """Return the robust figures of one object's patches.

    Returns:
        wrong_surface: share of the measured surface whose mean residual is beyond the bound and
            beyond three of its standard errors.
        patch_rms_mm: RMS of the patch means beyond their standard errors.
        patch_rms: the same as a share of the bound.
        wrong_patch_mm2: largest connected wrong piece of surface.
        looked_through: share of the surface that views looked at through which they saw.
        measured_surface: share of the surface that has a mean.
        residual_bound_mm: the bound.
        NaN where nothing was measured or looked at.
    """
    r, areas = residuals, residuals.patches.areas_mm2
    measured, bound = r.measured, wrong_bound_m(level_m)
    through = _looked_through(r)
    watched = r.looks[:, :2].sum(axis=1) > 0
    unknown = ("wrong_surface", "patch_rms_mm", "patch_rms", "wrong_patch_mm2")
    checks = {
        **dict.fromkeys(unknown, float("nan")),
        "looked_through": _share(areas, through & watched, watched),
        "measured_surface": _share(areas, measured, np.ones(len(areas), dtype=np.bool_)),
        "residual_bound_mm": 1e3 * bound,
    }
    if not np.any(measured):
        return checks
    size = np.abs(np.where(measured, r.mean_m, 0.0))
    wrong = measured & (size > bound)
    wrong[measured] &= size[measured] > WRONG_SIGMAS * r.sigma_m[measured]
    beyond = np.square(r.mean_m[measured]) - np.square(r.sigma_m[measured])
    rms = float(np.sqrt(max(0.0, np.average(beyond, weights=areas[measured]))))
    return checks | {
        "wrong_surface": _share(areas, wrong, measured),
        "patch_rms_mm": 1e3 * rms,
        "patch_rms": rms / bound,
        "wrong_patch_mm2": _largest_piece(r, wrong),
    }


def size_error(residuals: SurfaceResiduals, center_obj: Array, level_m: float) -> float | None:
    """Return by what share the real object is larger than its model; None = nothing says so.

    With q the place of a patch from the centre and n its normal, a model of another size that was
    fitted all the same leaves m = n.t + s n.q. It is believed if s is `SIZE_LEAST` at least, many
    times its standard error, and explains most of what is left.
    """
    r = residuals
    some = r.measured
    if np.count_nonzero(some) < SIZE_PATCHES:
        return None
    n, q, m = r.patches.normals[some], r.patches.centers[some] - center_obj, r.mean_m[some]
    A = np.column_stack([n, np.sum(n * q, axis=1)])
    w = 1.0 / (np.square(r.sigma_m[some]) + level_m**2)
    H = (A.T * w) @ A
    x = np.linalg.lstsq(H, A.T @ (w * m), rcond=1e-9)[0]
    left = w @ np.square(m - A @ x)
    explained = 1.0 - float(left / max(float(w @ np.square(m)), 1e-12))
    error = float(np.sqrt(np.linalg.pinv(H)[3, 3]))
    s = float(x[3])
    sure = abs(s) > max(SIZE_LEAST, SIZE_ERRORS * error) and explained > SIZE_EXPLAINED
    return s if sure else None


def _share(areas: Array, part: Mask, whole: Mask) -> float:
    """Return the area of `part` over that of `whole`; NaN if that is nothing."""
    total = float(areas[whole].sum())
    return float(areas[part & whole].sum()) / total if total > 0 else float("nan")


def _looked_through(r: SurfaceResiduals) -> Mask:
    """Return the patches (P,) through which more views saw than ended on them."""
    least = THROUGH_LOOKS if r.views > THROUGH_LOOKS else 1
    return (r.looks[:, 1] >= least) & (r.looks[:, 1] > r.looks[:, 0])


def _largest_piece(r: SurfaceResiduals, wrong: Mask) -> float:
    """Return the area [mm^2] of the largest connected set of wrong patches of one sign.

    Patches are connected if their cells touch, corners included.
    """
    from scipy.ndimage import label

    largest = 0.0
    for sign in (-1.0, 1.0):
        chosen = wrong & (np.where(wrong, r.mean_m, 0.0) * sign > 0)
        if not np.any(chosen):
            continue
        cells = tuple(r.patches.cells[chosen].T)
        full = np.zeros(r.patches.index.shape[:3], dtype=np.bool_)
        full[cells] = True
        labelled: Any = label(full, structure=np.ones((3, 3, 3)))
        pieces: Int32 = labelled[0]
        areas = np.bincount(pieces[cells], weights=r.patches.areas_mm2[chosen])
        largest = max(largest, float(areas.max()))
    return largest
