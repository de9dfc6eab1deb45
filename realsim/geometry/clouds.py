"""Point clouds: averaging on a voxel grid and finding a plane."""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array, Int64, Mask
from realsim.errors import DegenerateError
from realsim.geometry import se3
from realsim.geometry.robust import tukey_weights

REFINE_STEPS = 8
"""Re-weighted least squares settles to 1e-9 m in 4 to 6 steps on every plane tried."""


class VoxelMeans(NamedTuple):
    """The points of a cloud averaged per voxel, in the order of the voxels."""

    points: Array
    """(M, 3) weighted means [m]."""
    weights: Array
    """(M,) sum of the weights."""
    counts: Int64
    """(M,) how many points fell into the voxel."""
    attributes: Array
    """(M, K) weighted means of the attributes."""


def voxel_mean(
    points: ArrayLike,
    size: float,
    weights: ArrayLike | None = None,
    attributes: ArrayLike | None = None,
    labels: Int64 | None = None,
) -> VoxelMeans:
    """Return the weighted mean of the points in each voxel.

    Args:
        points: (N, 3) [m].
        size: edge of a voxel [m].
        weights: (N,), for instance inverse variances; 1 if not given.
        attributes: (N, K) averaged alongside.
        labels: (N,) small integers >= 0; points of different labels are never averaged together.
    """
    p = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    w = np.ones(len(p)) if weights is None else np.asarray(weights, dtype=np.float64)
    a = np.zeros((len(p), 0)) if attributes is None else np.asarray(attributes, dtype=np.float64)
    if len(p) == 0:
        return VoxelMeans(p, w, np.zeros(0, dtype=np.int64), a)
    cells = np.floor(p / size).astype(np.int64)
    cells -= cells.min(0)
    shape = cells.max(0) + 1
    key = (cells[:, 0] * shape[1] + cells[:, 1]) * shape[2] + cells[:, 2]
    if labels is not None:
        key = key * (int(labels.max()) + 1) + labels
    order = np.argsort(key, kind="stable")
    key = key[order]
    first = np.flatnonzero(np.concatenate([[True], key[1:] != key[:-1]]))
    total = np.add.reduceat(w[order], first)
    rows = np.concatenate([p, a], axis=1)[order] * w[order, None]
    means = np.add.reduceat(rows, first, axis=0) / total[:, None]
    counts = np.diff(np.append(first, len(p)))
    return VoxelMeans(means[:, :3], total, counts, means[:, 3:])


def fit_plane_ransac(
    points: ArrayLike, rng: np.random.Generator, tolerance_m: float, iterations: int = 300
) -> tuple[Array, float, Mask]:
    """Return the plane n.p = offset with the most points within `tolerance_m`.

    Args:
        points: (N, 3) [m].
        rng: where the random triples come from.
        tolerance_m: distance up to which a point belongs to the plane [m].
        iterations: triples tried; 300 find a plane of 25 % of the points with p = 0.99.

    Returns:
        normal (3,), offset [m], inliers (N,).

    Raises:
        DegenerateError: fewer than three points, or all on one line.
    """
    p = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    if len(p) < 3:
        raise DegenerateError(f"{len(p)} points do not determine a plane; at least 3 are needed.")
    triples = rng.integers(0, len(p), size=(iterations, 3))
    a, b, c = p[triples[:, 0]], p[triples[:, 1]], p[triples[:, 2]]
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1)
    usable = length > 1e-12
    if not usable.any():
        raise DegenerateError("the points lie on one line or coincide; no plane is determined.")
    normals, a = normals[usable] / length[usable, None], a[usable]
    offsets = np.sum(normals * a, axis=1)
    counts = np.array(
        [
            np.count_nonzero(np.abs(p @ n - d) < tolerance_m)
            for n, d in zip(normals, offsets, strict=True)
        ]
    )
    best = int(np.argmax(counts))
    return refine_plane(p, normals[best], float(offsets[best]), tolerance_m)


def refine_plane(
    points: ArrayLike, normal: ArrayLike, offset: float, tolerance_m: float
) -> tuple[Array, float, Mask]:
    """Return the plane after re-weighted least squares with Tukey's weights.

    Each step is the eigenvector of least variance of the weighted points; Tukey's weight
    (1 - (r/c)^2)^2 with c = 2 tolerances lets points on objects fade out smoothly.

    Args:
        points: (N, 3) [m].
        normal: (3,) where to start from; its sign is kept.
        offset: likewise [m].
        tolerance_m: distance up to which a point belongs to the plane [m].

    Returns:
        normal (3,), offset [m], inliers (N,).
    """
    p = np.asarray(points, dtype=np.float64)
    n = np.asarray(normal, dtype=np.float64)
    cutoff = 2.0 * tolerance_m
    for _ in range(REFINE_STEPS):
        r = p @ n - offset
        w = tukey_weights(np.square(r / cutoff))
        if np.count_nonzero(w) < 3:
            break
        mean = (w @ p) / w.sum()
        centred = p - mean
        _, vectors = np.linalg.eigh((centred * w[:, None]).T @ centred)
        n_new = vectors[:, 0]
        n = n_new if n_new @ n > 0 else -n_new
        offset = float(n @ mean)
    return n, offset, np.abs(p @ n - offset) < tolerance_m


def plane_frame(normal: ArrayLike, offset: float, points: ArrayLike) -> Array:
    """Return T_world_table (4, 4): z along the normal, origin at the foot of the points' centroid.

    x is the world axis most nearly in the plane, projected into it.

    Args:
        normal: (3,) unit, upwards.
        offset: n.p of the plane [m].
        points: (N, 3) the points that carry the plane [m].
    """
    z = np.asarray(normal, dtype=np.float64)
    z = z / np.linalg.norm(z)
    centroid = np.asarray(points, dtype=np.float64).reshape(-1, 3).mean(0)
    axis = np.eye(3)[int(np.argmin(np.abs(z)))]
    return frame_about(z, axis, centroid - (z @ centroid - offset) * z)


def frame_about(z: Array, axis: Array, origin: Array) -> Array:
    """Return a pose (4, 4) whose x is the axis (3,), freed of its part along the unit z (3,)."""
    x = axis - (axis @ z) * z
    x = x / np.linalg.norm(x)
    return se3.from_rt(np.stack([x, np.cross(z, x), z], axis=-1), origin)


def cloud_ply(points: ArrayLike, colors: ArrayLike, comment: str = "") -> bytes:
    """Return points (N, 3) with colours (N, 3) uint8 as binary PLY; the comment is its third line.

    Args:
        points: in the unit that the file is to have.
        colors: sRGB.
        comment: words without a line break; '' = none.
    """
    rows = np.zeros(len(np.asarray(points)), dtype=[("xyz", "<f4", 3), ("rgb", "u1", 3)])
    rows["xyz"], rows["rgb"] = points, colors
    lines = ["ply", "format binary_little_endian 1.0", *([f"comment {comment}"] if comment else [])]
    lines += [f"element vertex {len(rows)}", *(f"property float {axis}" for axis in "xyz")]
    lines += [f"property uchar {name}" for name in ("red", "green", "blue")]
    return "\n".join([*lines, "end_header", ""]).encode("ascii") + rows.tobytes()
