"""What each view says about small patches of the object's surface and of the table.

A patch is a cell of the surface with one direction. The mean distance of a view's points in it to
the fused surface, along the normal, is one observation; averaging first makes a million points
some ten thousand numbers, and their noise known.
"""

from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array, Int64, Mask
from realsim.geometry import se3
from realsim.geometry.camera import ray_table
from realsim.geometry.distance_field import DistanceField
from realsim.records import CameraIntrinsics
from realsim.scanning.fusion.evidence import Crops
from realsim.scanning.fusion.result import FusionConfig
from realsim.scanning.fusion.volume import Volume, smoothed

STRIDE_PX = 2
"""Every how many pixels one is used; stereo noise is correlated over more."""
SOUND_PX = 2
"""Poses rest on pixels whose neighbours so far away are trusted too [px]."""
PATCH_M = 0.004
"""Edge of a patch of the object [m]: flat enough where the radius is above 10 mm, and some 50
pixels, as many as the noise is correlated over."""
PATCH_PX = 6.0
"""Pixels that a patch is wide at least."""
TABLE_PATCH_M = 0.010
"""Edge of a patch of the table [m]."""
CORRELATED_PX = 50.0
"""Pixels that are worth one: 4 pi r^2 for noise correlated over a Gaussian radius of r = 2 px."""
PATCH_FLOOR_M = 0.00015
"""Error of a patch besides noise [m]: curvature, voxels."""
TABLE_FLOOR_M = 0.0005
"""Tables are not flatter than this over the neighbourhood of an object [m]."""
TABLE_STEP = 3
"""The table has points enough: every third of them along rows and columns is used."""
NEAR_SHARE = 0.9
"""Beyond this share of the truncation the fused distance is cut off."""
FLATNESS = 0.92
"""Largest eigenvalue of the mean square of the normals in a cell below which there is an edge
(5 deg of noise: 0.985, a radius of one cell: 0.92, a right angle: 0.5).
There every view sees another part of a rounded corner; what they differ by is not their poses."""
LEAST_ALONG = 0.25
"""Least cosine between ray and normal at which the ray is followed to the surface."""
NEWTON_STEPS = 5
"""Steps along the ray to the zero level."""
ZERO_CELLS = 0.1
"""The zero level was reached if the distance left is below this [cells]."""
LEAST_SLOPE = 0.5
"""Gradient of the fused distance below which the place is cut off or between two surfaces."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Observations:
    """Mean distances of views to patches; rows of a linear system in the views' twists."""

    patch: Int64
    """(N,) number of the patch."""
    view: Int64
    """(N,) number of the view in the list of frames."""
    residual: Array
    """(N,) mean distance to the surface along its normal [m]."""
    jacobian: Array
    """(N, 6) its derivative by the view's right twist, rotation first [m/rad, 1]."""
    sigma: Array
    """(N,) 1-sigma [m]."""
    place: Array
    """(N, 2) mean x, y in the table's frame [m]."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ViewPoints:
    """The trusted points of one view in its camera's frame."""

    on_object: Array
    """(N, 3) inside the volume and above the cut [m]."""
    object_sigma: Array
    """(N,) sigma_z [m]."""
    on_table: Array
    """(M, 3) near the plane [m]."""
    table_sigma: Array
    """(M,) sigma_z [m]."""
    pitch: float
    """Width of a pixel where most points are [m]; 0 without points."""


def view_points(
    intrinsics: CameraIntrinsics,
    crops: Crops,
    Ts_table_cam: Array,
    box: tuple[Array, Array],
    heights: tuple[float, float],
) -> list[ViewPoints]:
    """Return per view the points of the object and of the table.

    Args:
        intrinsics: the camera.
        crops: the depth of a region that is wider than the object.
        Ts_table_cam: (F, 4, 4) cameras in the table's frame.
        box: least and greatest corner (3,) of the volume [m].
        heights: above the first, within the box, a point is the object's; outside the box and
            nearer to the plane than the second (and two sigmas) it is the table's [m].
    """
    import cv2

    rays = ray_table(intrinsics)
    low, high = box
    kernel = np.ones((2 * SOUND_PX + 1, 2 * SOUND_PX + 1), np.uint8)
    out: list[ViewPoints] = []
    for depth, corner, T in zip(crops.depths, crops.corners, Ts_table_cam, strict=True):
        # Beside holes and edges pixels are off by more than their noise, always towards the other
        # side: grazing views would see the surface deeper than frontal ones do.
        sound = cv2.erode((depth > 0).astype(np.uint8), kernel)
        v, u = np.nonzero(sound[::STRIDE_PX, ::STRIDE_PX])
        v, u = v * STRIDE_PX, u * STRIDE_PX
        z = depth[v, u].astype(np.float64)
        local = rays[v + corner[1], u + corner[0]] * z[:, None]
        sigma = np.maximum(crops.noise[1], crops.noise[0] * z * z)
        p = se3.transform(T, local)
        beside = np.any((p[:, :2] < low[:2]) | (p[:, :2] > high[:2]), axis=1)
        mine = ~beside & (p[:, 2] > heights[0]) & (p[:, 2] < high[2])
        table = beside & (np.abs(p[:, 2]) < heights[1] + 2 * sigma)
        table &= (v % (STRIDE_PX * TABLE_STEP) == 0) & (u % (STRIDE_PX * TABLE_STEP) == 0)
        out.append(
            ViewPoints(
                on_object=local[mine], object_sigma=sigma[mine],
                on_table=local[table], table_sigma=sigma[table],
                pitch=float(np.median(z)) / intrinsics.fx if len(z) else 0.0,
            )
        )  # fmt: skip
    return out


def observed_object(
    points: list[ViewPoints], Ts_table_cam: Array, volume: Volume, config: FusionConfig
) -> tuple[Observations, Array]:
    """Return the views' distances to patches of the fused surface, and each view's matches.

    Returns:
        The observations, and the share (F,) of every view's points on the object that lie near
        the fused surface (NaN without points).
    """
    field = DistanceField(grid=volume.distance, origin=volume.origin, cell=volume.cell)
    smooth = DistanceField(grid=smoothed(volume.distance), origin=volume.origin, cell=volume.cell)
    rows: list[tuple[Array, ...]] = []
    matched = np.full(len(points), np.nan)
    for number, (view, T) in enumerate(zip(points, Ts_table_cam, strict=True)):
        p = se3.transform(T, view.on_object)
        r, n = _to_surface((field, smooth), p, T[:3, 3], config.truncation_m)
        near = np.abs(r) < NEAR_SHARE * config.truncation_m
        if len(p):
            matched[number] = np.count_nonzero(near) / len(p)
        rows.append(
            (*_rows(number, T, view.on_object[near], n[near], r[near]), view.object_sigma[near])
        )
    pitch = float(np.median([v.pitch for v in points]))
    return _averaged(rows, max(PATCH_M, PATCH_PX * pitch), STRIDE_PX, PATCH_FLOOR_M), matched


def _to_surface(
    fields: tuple[DistanceField, DistanceField], p: Array, center: Array, truncation: float
) -> tuple[Array, Array]:
    """Return the distances (N,) [m] of points to the zero level their rays meet, and normals there.

    Neither is read off where the noisy point lies: away from its zero the fused distance is not a
    distance, and next to edges the normal hangs on the side to which the noise went. Both go
    with the residual and pull the cameras along their axes. So the viewing ray is followed to the
    zero level, in Newton's steps; a point so far behind that nothing is known starts nearer.

    Args:
        fields: the fused distances, and smoothed ones for the normals: those of a noisy surface
            are as noisy, and every cell looks like an edge; the zero level, though, would be
            moved where one side of it is not known.
        p: (N, 3) points.
        center: (3,) of the camera that measured them.
        truncation: of the distances [m].

    Returns:
        The distances along the normals, NaN where no surface was found, and the normals.
    """
    field, smooth = fields
    end = field.origin + field.cell * (np.array(field.grid.shape) - 1)
    ray = p - center
    ray /= np.maximum(np.linalg.norm(ray, axis=1), 1e-9)[:, None]
    behind = np.isnan(field.distance_gradient(p)[0])
    t = np.where(behind, -0.5 * truncation, 0.0)
    d, g = field.distance_gradient(p + t[:, None] * ray)
    for _ in range(NEWTON_STEPS):
        fall = np.minimum(np.sum(g * ray, axis=1), -LEAST_ALONG * LEAST_SLOPE)
        t = t - np.clip(d / fall, -truncation, truncation)
        d, g = field.distance_gradient(p + t[:, None] * ray)
    x = p + t[:, None] * ray
    _, g = smooth.distance_gradient(x)
    slope = np.linalg.norm(g, axis=1)
    found = np.all((x > field.origin) & (x < end), axis=1)
    found &= (slope > LEAST_SLOPE) & (np.abs(d) < ZERO_CELLS * field.cell)
    n = g / np.where(found, slope, 1.0)[:, None]
    cosine = -np.sum(n * ray, axis=1)
    return np.where(found & (cosine > LEAST_ALONG), t * cosine, np.nan), n


def observed_table(points: list[ViewPoints], Ts_table_cam: Array) -> Observations:
    """Return the views' heights of patches of the table over the plane z = 0."""
    rows: list[tuple[Array, ...]] = []
    for number, (view, T) in enumerate(zip(points, Ts_table_cam, strict=True)):
        p = se3.transform(T, view.on_table)
        up = np.tile([0.0, 0.0, 1.0], (len(p), 1))
        rows.append((*_rows(number, T, view.on_table, up, p[:, 2]), view.table_sigma))
    return _averaged(rows, TABLE_PATCH_M, STRIDE_PX * TABLE_STEP, TABLE_FLOOR_M)


def _rows(number: int, T: Array, local: Array, n: Array, r: Array) -> tuple[Array, ...]:
    """Return view, place on the surface, side, Jacobian, cosine, normal and residual of points.

    With T <- T exp(xi) a point moves by R (omega x p_cam + v), so that the distance along n
    changes by (p_cam x R'n) . omega + R'n . v. The noise of a point is in its residual and must not
    be in its derivative too, or what is weakly seen is pulled by their product: the derivative is
    taken where the viewing ray meets the surface.

    Args:
        number: of the view.
        T: (4, 4) camera in the table's frame.
        local: (N, 3) points in the camera's frame [m].
        n: (N, 3) unit normals of the surface in the table's frame.
        r: (N,) distances to the surface along them [m].
    """
    m = n @ T[:3, :3]
    along = np.sum(m * local, axis=1)
    ray = np.linalg.norm(local, axis=1)
    cosine = np.abs(along) / np.where(ray > 0, ray, 1.0)
    steep = cosine > LEAST_ALONG
    factor = 1.0 - np.where(steep, r / np.where(steep, along, 1.0), 0.0)
    met = factor[:, None] * local
    jacobian = np.concatenate([np.cross(met, m), m], axis=1)
    axis = np.argmax(np.abs(n), axis=1)
    side = 2 * axis + (n[np.arange(len(n)), axis] > 0)
    place = se3.transform(T, met)
    return np.full(len(met), float(number)), place, side.astype(np.float64), jacobian, cosine, n, r


def _averaged(
    rows: list[tuple[Array, ...]], size: float, stride: int, floor_m: float
) -> Observations:
    """Return the observations: means over every patch and view."""
    view, p, side, jacobian, cosine, normal, residual, sigma = (
        np.concatenate([r[k] for r in rows]) for k in range(8)
    )
    view = view.astype(np.int64)
    cells = np.floor(p / size).astype(np.int64)
    cells -= cells.min(0) if len(cells) else 0
    shape = (*(cells.max(0) + 1 if len(cells) else (1, 1, 1)), 6)
    flat = _flat((cells[:, 0] * shape[1] + cells[:, 1]) * shape[2] + cells[:, 2], normal)
    key = np.ravel_multi_index((*cells.T, side.astype(np.int64)), shape)
    key, view, p, jacobian = key[flat], view[flat], p[flat], jacobian[flat]
    cosine, residual, sigma = cosine[flat], residual[flat], sigma[flat]
    views = int(view.max()) + 1 if len(view) else 1
    pair, inverse = np.unique(key * views + view, return_inverse=True)
    count = np.bincount(inverse, minlength=len(pair)).astype(np.float64)

    def mean(values: Array) -> Array:
        return np.bincount(inverse, values, minlength=len(pair)) / count

    # Noise is correlated: so many pixels are worth one, and two if they are just as many.
    independent = 1.0 + count * stride**2 / CORRELATED_PX
    noise = mean(sigma * cosine) / np.sqrt(independent)
    enough = count * stride**2 >= CORRELATED_PX / 2
    _, patch = np.unique(pair[enough] // views, return_inverse=True)
    return Observations(
        patch=patch,
        view=(pair % views)[enough],
        residual=mean(residual)[enough],
        jacobian=np.stack([mean(jacobian[:, k]) for k in range(6)], -1)[enough],
        sigma=np.hypot(noise, floor_m)[enough],
        place=np.stack([mean(p[:, k]) for k in range(2)], -1)[enough],
    )


def _flat(cell: Int64, normal: Array) -> Mask:
    """Return which points (N,) lie in cells without an edge.

    Judged by the largest eigenvalue of the mean of n n': the two sides of a wall are no edge.
    """
    _, inverse, count = np.unique(cell, return_inverse=True, return_counts=True)
    squares = np.empty((len(count), 3, 3))
    for i in range(3):
        for j in range(3):
            products = normal[:, i] * normal[:, j]
            squares[:, i, j] = np.bincount(inverse, products, len(count)) / np.maximum(count, 1)
    return (np.linalg.eigvalsh(squares)[:, 2] > FLATNESS)[inverse]
