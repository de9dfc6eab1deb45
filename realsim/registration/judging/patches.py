"""The surface of a model cut into small patches: cells of a grid, apart by the way they face."""

from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array, Array32, Int32, Int64
from realsim.compiled import njit
from realsim.geometry.distance_field import sample
from realsim.geometry.mesh import sample_surface
from realsim.geometry.point_loops import move, pixel, turn
from realsim.geometry.seen_surface import GATE_COS, follow_to_camera
from realsim.registration.body import Body

SIDES = 6
"""Ways a patch may face: along +x -x +y -y +z -z. The two sides of a thin wall stay apart."""
PATCH_SEED = 0
"""The patches are part of the model: always the same."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Patches:
    """The patches of one model."""

    size_m: float
    """Edge of a cell [m]."""
    origin: Array
    """(3,) corner of the grid in the object's frame [m]."""
    index: Int32
    """(X, Y, Z, 6) number of the patch of a cell and side; -1 = no surface there."""
    centers: Array
    """(P, 3) mean of the surface in the patch [m]."""
    normals: Array
    """(P, 3) mean outward normal."""
    areas_mm2: Array
    """(P,) surface in the patch."""
    cells: Int64
    """(P, 3) cell of each patch."""


def make_patches(body: Body, size_m: float, samples_per_patch: float) -> Patches:
    """Return the patches of a body's surface.

    Args:
        body: the object.
        size_m: edge of a cell [m].
        samples_per_patch: mean number of surface samples by which a patch is measured.
    """
    mesh = body.model.mesh
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    area = 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())
    n = max(200, int(samples_per_patch * area / size_m**2))
    points, normals = sample_surface(mesh, n, np.random.default_rng(PATCH_SEED))
    origin = mesh.bounds[0] - 0.5 * size_m
    shape = (*np.ceil((mesh.bounds[1] - origin) / size_m + 0.5).astype(int), SIDES)
    cells = np.floor((points - origin) / size_m).astype(np.int64)
    axis = np.argmax(np.abs(normals), axis=1)
    side = 2 * axis + (normals[np.arange(n), axis] < 0)
    flat = np.ravel_multi_index((*cells.T, side), shape)
    used, number, counts = np.unique(flat, return_inverse=True, return_counts=True)
    index = np.full(shape, -1, dtype=np.int32)
    index.ravel()[used] = np.arange(len(used))

    def means(v: Array) -> Array:
        sums = np.stack([np.bincount(number, v[:, k], len(used)) for k in range(3)], axis=1)
        return sums / counts[:, None]

    directions = means(normals)
    length = np.linalg.norm(directions, axis=1, keepdims=True)
    return Patches(
        size_m=size_m,
        origin=origin,
        index=index,
        centers=means(points),
        normals=directions / np.where(length > 0, length, 1.0),
        areas_mm2=1e6 * counts * area / n,
        cells=np.stack(np.unravel_index(used, shape)[:3], axis=1).astype(np.int64),
    )


@njit
def add_to_patches(
    points: tuple[Array, Array],
    lattice: tuple[Array32, Array, float],
    pose: tuple[Array, Array],
    patches: tuple[Int32, Array, float],
    sums: Array,
) -> None:
    """Add the residuals of an object's points to the patches they lie on.

    Args:
        points: (N, 3) in world [m] and (N,) their 1-sigma [m]; all of them the object's.
        lattice: grid, origin and cell of its distance field.
        pose: T_obj_world (4, 4) and the camera's position in the object's frame (3,).
        patches: index, origin and size of the patches.
        sums: (P, 4) count, sum w, sum w r, sum w r^2 with w = 1 / sigma^2; is added to.
    """
    xyz, sigmas = points
    grid, origin, cell = lattice
    T, eye = pose
    index, corner, size = patches
    for m in range(len(xyz)):
        x, y, z = move(T, xyz[m, 0], xyz[m, 1], xyz[m, 2])
        vx, vy, vz = eye[0] - x, eye[1] - y, eye[2] - z
        length = np.sqrt(vx * vx + vy * vy + vz * vz)
        vx, vy, vz = vx / length, vy / length, vz / length
        r, gx, gy, gz, t, facing = follow_to_camera(
            lattice, (x, y, z), (vx, vy, vz), sample(grid, origin, cell, x, y, z)
        )
        if facing <= GATE_COS:
            continue
        # The foot on the surface, and the distance of the point itself to the plane there.
        fx, fy, fz = x + t * vx - r * gx, y + t * vy - r * gy, z + t * vz - r * gz
        r -= t * facing
        i = int(np.floor((fx - corner[0]) / size))
        j = int(np.floor((fy - corner[1]) / size))
        k = int(np.floor((fz - corner[2]) / size))
        if i < 0 or j < 0 or k < 0 or i >= index.shape[0] or j >= index.shape[1]:
            continue
        if k >= index.shape[2]:
            continue
        ax, ay, az = abs(gx), abs(gy), abs(gz)
        if ax >= ay and ax >= az:
            side = 0 if gx > 0 else 1
        elif ay >= az:
            side = 2 if gy > 0 else 3
        else:
            side = 4 if gz > 0 else 5
        p = index[i, j, k, side]
        if p < 0:
            continue
        w = 1.0 / (sigmas[m] * sigmas[m])
        sums[p, 0] += 1.0
        sums[p, 1] += w
        sums[p, 2] += w * r
        sums[p, 3] += w * r * r


@njit
def look_at_patches(
    surface: tuple[Array, Array],
    T_cam_obj: Array,
    camera: Array,
    image: tuple[Array32, int],
    limits: tuple[float, float, float, float, float, float],
    looks: Int32,
) -> None:
    """Count for every patch whether one view saw it, looked through it, or was hidden from it.

    Args:
        surface: (P, 3) centres and normals.
        T_cam_obj: (4, 4).
        camera: (12,) fx fy cx cy and the eight distortion terms.
        image: depth (H, W) of the sampled pixels [m], 0 = none; and their stride.
        limits: least facing cosine, tolerance [m], its sigmas, its bias per m, noise per m and
            floor.
        looks: (P, 3) seen, through, hidden; is added to.
    """
    centers, normals = surface
    depth, stride = image
    gate, tolerance, sigmas, bias, per_m, floor = limits
    M = T_cam_obj
    for m in range(len(centers)):
        px, py, pz = move(M, centers[m, 0], centers[m, 1], centers[m, 2])
        nx, ny, nz = turn(M, normals[m, 0], normals[m, 1], normals[m, 2])
        away = np.sqrt(px * px + py * py + pz * pz)
        if pz <= 0.0 or -(nx * px + ny * py + nz * pz) < gate * away:
            continue
        x, y = px / pz, py / pz
        u, v = pixel(camera, x, y)
        i, j = int(np.floor(v / stride + 0.5)), int(np.floor(u / stride + 0.5))
        if i < 0 or j < 0 or i >= depth.shape[0] or j >= depth.shape[1] or depth[i, j] <= 0.0:
            continue
        z = depth[i, j]
        tau = tolerance + sigmas * max(floor, per_m * z * z) + bias * z * z
        if z > pz + tau:
            looks[m, 1] += 1
        elif z < pz - tau:
            looks[m, 2] += 1
        else:
            looks[m, 0] += 1
