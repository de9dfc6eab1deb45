"""The signed distance to a mesh on a grid: value and gradient at any point for 60 ns.

Inside is negative. The distance is exact at the grid's nodes near the surface and trilinear
between them; the gradient is that of the interpolated value, so that value and derivative agree,
as a least-squares solver needs. Outside the grid the field goes on as the value at the nearest
point of the box plus the distance to it: an upper bound that points the right way.

How often a surface winds about a point.
"""

import contextlib
import hashlib
import os
from collections import OrderedDict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array, Array32, Int32, Int64, Mask
from realsim.compiled import njit
from realsim.errors import InputError
from realsim.geometry.mesh_shape import is_closed, welded
from realsim.geometry.point_loops import move
from realsim.interop import import_open3d
from realsim.records import Mesh
from realsim.untrusted.arrays import read_npz


@njit
def solid_angle_share(points: Array, faces: Int64 | Int32) -> float:
    """Return the share of the sphere about the origin that the faces fill: 1 inside, 0 outside.

    The sum of signed solid angles (van Oosterom and Strackee, IEEE Trans. Biomed. Eng. 1983), which
    for a closed mesh is its winding number.
    """
    total = 0.0
    for f in range(len(faces)):
        a, b, c = points[faces[f, 0]], points[faces[f, 1]], points[faces[f, 2]]
        la, lb, lc = np.sqrt(np.sum(a * a)), np.sqrt(np.sum(b * b)), np.sqrt(np.sum(c * c))
        volume = (
            a[0] * (b[1] * c[2] - b[2] * c[1])
            + a[1] * (b[2] * c[0] - b[0] * c[2])
            + a[2] * (b[0] * c[1] - b[1] * c[0])
        )
        ab, bc, ca = np.sum(a * b), np.sum(b * c), np.sum(c * a)
        total += np.arctan2(volume, la * lb * lc + ab * lc + bc * la + ca * lb)
    return total / (2.0 * np.pi)


MARGIN_CELLS = 6
"""Cells around the bounding box in which the field is interpolated, not extended."""
NEAR_CELLS = 7
"""Nodes within so many cells of the surface get the exact distance, the others a blend."""
FAR_STEP = 4
"""Far from the surface the exact distance is computed at every fourth node: the field is smooth
there (error (4 cells)^2 / 8R, 0.1 mm for a 10 cm object), and closest points far off are dear."""
OCCUPANCY_RAYS = 5
"""Rays that vote on inside or outside: a hole in the mesh misleads one of them, not three."""
SAME_SIDE = 0.501
"""Two neighbouring nodes that are both farther from the surface than this share of their distance
from each other lie on one side of it: the balls about them hold what is between them."""
INSIDE_TURNS = 0.5
"""Winding number beyond which a node lies inside."""
REMEMBERED_FIELDS = 64
"""Fields kept in memory; 96^3 float32 cells are 3.5 MB, mostly less."""

_memory: "OrderedDict[str, DistanceField]" = OrderedDict()


@njit(inline="always")
def sample(
    grid: Array32, origin: Array, cell: float, x: float, y: float, z: float
) -> tuple[float, float, float, float]:
    """Return distance and gradient (d, gx, gy, gz) at one point of the mesh's frame."""
    nx, ny, nz = grid.shape
    fx, fy, fz = (x - origin[0]) / cell, (y - origin[1]) / cell, (z - origin[2]) / cell
    cx = min(max(fx, 0.0), nx - 1.0)
    cy = min(max(fy, 0.0), ny - 1.0)
    cz = min(max(fz, 0.0), nz - 1.0)
    i, j, k = min(int(cx), nx - 2), min(int(cy), ny - 2), min(int(cz), nz - 2)
    u, v, w = cx - i, cy - j, cz - k
    d000, d001 = grid[i, j, k], grid[i, j, k + 1]
    d010, d011 = grid[i, j + 1, k], grid[i, j + 1, k + 1]
    d100, d101 = grid[i + 1, j, k], grid[i + 1, j, k + 1]
    d110, d111 = grid[i + 1, j + 1, k], grid[i + 1, j + 1, k + 1]
    d00, d01 = d000 + u * (d100 - d000), d001 + u * (d101 - d001)
    d10, d11 = d010 + u * (d110 - d010), d011 + u * (d111 - d011)
    d0, d1 = d00 + v * (d10 - d00), d01 + v * (d11 - d01)
    d = d0 + w * (d1 - d0)
    gz = (d1 - d0) / cell
    gy = ((d10 - d00) * (1.0 - w) + (d11 - d01) * w) / cell
    gx0 = (d100 - d000) * (1.0 - v) + (d110 - d010) * v
    gx1 = (d101 - d001) * (1.0 - v) + (d111 - d011) * v
    gx = (gx0 * (1.0 - w) + gx1 * w) / cell
    ox, oy, oz = (fx - cx) * cell, (fy - cy) * cell, (fz - cz) * cell
    outside = np.sqrt(ox * ox + oy * oy + oz * oz)
    if outside > 0.0:
        # Along an axis on which the point was clamped, the value at the box does not change.
        d += outside
        gx = ox / outside if ox != 0.0 else gx
        gy = oy / outside if oy != 0.0 else gy
        gz = oz / outside if oz != 0.0 else gz
    return d, gx, gy, gz


@njit
def _sample_all(
    grid: Array32, origin: Array, cell: float, points: Array, T: Array
) -> tuple[Array, Array]:
    """Return distances (N,) and gradients (N, 3), in the mesh's frame, of points mapped by T."""
    n = len(points)
    distances, gradients = np.empty(n), np.empty((n, 3))
    for m in range(n):
        x, y, z = move(T, points[m, 0], points[m, 1], points[m, 2])
        d, gx, gy, gz = sample(grid, origin, cell, x, y, z)
        distances[m] = d
        gradients[m, 0], gradients[m, 1], gradients[m, 2] = gx, gy, gz
    return distances, gradients


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class DistanceField:
    """The signed distance to one mesh."""

    grid: Array32
    """(X, Y, Z) signed distance at the nodes, inside negative [m]."""
    origin: Array
    """(3,) position of node (0, 0, 0) in the mesh's frame [m]."""
    cell: float
    """Edge of a cell [m]."""

    @classmethod
    def from_mesh(cls, mesh: Mesh, cells: int = 96, folder: Path | None = None) -> "DistanceField":
        """Return the field of a mesh, from memory (or `folder`) if it was computed before.

        The distance is exact (closest point on the triangles). The sign is the majority of five
        rays' inside/outside counts, so a mesh with holes still has an inside; of an open sheet,
        which has none, the field is the unsigned distance.

        Args:
            mesh: the mesh; need not be watertight.
            cells: cells along its longest side.
            folder: where to keep fields between runs; None = in memory only.

        Raises:
            InputError: fewer than 4 cells are asked for.
        """
        if cells < 4:
            raise InputError(f"{cells} cells do not describe a shape; ask for 4 or more (96).")
        key = _content_key(mesh, cells)
        known = _memory.get(key)
        if known is None:
            known = _load(folder, key)
            if known is None:
                known = _compute(mesh, cells)
                if folder is not None:
                    _save(folder, key, known)
        _memory[key] = known
        _memory.move_to_end(key)
        while len(_memory) > REMEMBERED_FIELDS:
            _memory.popitem(last=False)
        return known

    @property
    def lattice(self) -> tuple[Array32, Array, float]:
        """Grid, origin and cell: what compiled loops take (see `sample`)."""
        return self.grid, self.origin, self.cell

    def distance(self, points: ArrayLike, T_obj_points: ArrayLike | None = None) -> Array:
        """Return the signed distance (N,) of points (N, 3) [m], mapped by T first if given."""
        return self._sampled(points, T_obj_points)[0]

    def distance_gradient(self, points: ArrayLike) -> tuple[Array, Array]:
        """Return the signed distance (N,) [m] of points (N, 3) [m], and its gradient (N, 3)."""
        return self._sampled(points, None)

    def _sampled(self, points: ArrayLike, T: ArrayLike | None) -> tuple[Array, Array]:
        p = np.ascontiguousarray(np.asarray(points, dtype=np.float64).reshape(-1, 3))
        M = np.ascontiguousarray(np.eye(4) if T is None else np.asarray(T, dtype=np.float64))
        d, g = _sample_all(self.grid, self.origin, self.cell, p, M)
        return d, g


def _content_key(mesh: Mesh, cells: int) -> str:
    """Return a name for the field that depends on nothing but the shape and the resolution."""
    digest = hashlib.blake2b(digest_size=16)
    digest.update(mesh.vertices.tobytes())
    digest.update(mesh.faces.tobytes())
    digest.update(f"{cells} {MARGIN_CELLS} {OCCUPANCY_RAYS} {INSIDE_TURNS}".encode())
    return digest.hexdigest()


def raycasting_scene(mesh: Mesh) -> Any:
    """Return an Open3D RaycastingScene that holds the mesh in its own frame."""
    o3d = import_open3d()
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    # Open3D refuses dtypes such as '<f8' and read-only buffers: fresh native arrays.
    vertices = o3d.core.Tensor(np.array(mesh.vertices, dtype=np.float32))
    faces = o3d.core.Tensor(np.array(mesh.faces, dtype=np.uint32))
    scene.add_triangles(vertices, faces)
    return scene


def _compute(mesh: Mesh, cells: int) -> DistanceField:
    """Return the field of the triangles: exact near the surface, interpolated far off."""
    from scipy.ndimage import map_coordinates

    low, high = mesh.bounds
    cell = float(np.max(high - low)) / cells
    origin = low - MARGIN_CELLS * cell
    blocks = np.ceil(((high - low) / cell + 2 * MARGIN_CELLS) / FAR_STEP).astype(int)
    shape = blocks * FAR_STEP + 1
    scene = raycasting_scene(mesh)

    solid = _Solid(mesh, scene)

    far = np.moveaxis(np.indices(tuple(blocks + 1)), 0, -1).reshape(-1, 3)
    signed = solid.signed_distance(far, origin, FAR_STEP * cell).reshape(blocks + 1)
    index = np.indices(tuple(shape), dtype=np.float32) / FAR_STEP
    grid = np.array(map_coordinates(signed, index, order=1), dtype=np.float32)
    near = np.argwhere(np.abs(grid) < NEAR_CELLS * cell)
    grid[tuple(near.T)] = solid.signed_distance(near, origin, cell)
    grid.setflags(write=False)
    origin.setflags(write=False)
    return DistanceField(grid=grid, origin=origin, cell=cell)


class _Solid:
    """What a mesh bounds: how far nodes of a grid are from its surface, and on which side.

    Rays that graze an edge, or a wall that two bodies share, miscount; half of their votes can be
    wrong beside such a wall. Of a closed mesh the winding number is asked instead, once for all
    nodes that hang together.
    """

    def __init__(self, mesh: Mesh, scene: Any) -> None:
        self._scene = scene
        self._vertices, self._faces = welded(mesh)
        self._is_closed = is_closed(self._vertices, self._faces)

    def signed_distance(self, nodes: Int64, origin: Array, cell: float) -> Array32:
        """Return the exact distance of nodes (N, 3) of a grid [m], inside negative."""
        points = origin + cell * nodes
        query = import_open3d().core.Tensor(np.ascontiguousarray(points, dtype=np.float32))
        distance = np.array(self._scene.compute_distance(query, 1).numpy())
        inside = np.zeros(len(nodes), dtype=bool)
        by_rays = np.ones(len(nodes), dtype=bool)
        if self._is_closed:
            by_rays = distance <= SAME_SIDE * cell
            inside[~by_rays] = self._parts_inside(
                nodes[~by_rays], points[~by_rays], distance[~by_rays]
            )
        if by_rays.any():
            votes = self._scene.compute_occupancy(query[by_rays.nonzero()[0]], 1, OCCUPANCY_RAYS)
            inside[by_rays] = votes.numpy() > 0
        return np.where(inside, -distance, distance)

    def _parts_inside(self, nodes: Int64, points: Array, distance: Array32) -> Mask:
        """Return which nodes (N, 3) hang together with one that lies inside."""
        from scipy.ndimage import label

        off = np.zeros(nodes.max(axis=0, initial=0) + 1, dtype=bool)
        off[tuple(nodes.T)] = True
        labelled: Any = label(off)
        part = labelled[0][tuple(nodes.T)]
        # The farthest node of each part speaks for it.
        order = np.lexsort((-distance, part))
        parts, first = np.unique(part[order], return_index=True)
        turns = [solid_angle_share(self._vertices - p, self._faces) for p in points[order[first]]]
        return (np.abs(turns) > INSIDE_TURNS)[np.searchsorted(parts, part)]


def _save(folder: Path, key: str, field: DistanceField) -> None:
    """Write a field under its key; the name appears only when the file is complete."""
    folder.mkdir(parents=True, exist_ok=True)
    part = folder / f".{key}.{os.getpid()}.npz"  # two processes may want the same field
    np.savez_compressed(part, grid=field.grid, origin=field.origin, cell=field.cell)
    part.replace(folder / f"{key}.npz")


def _load(folder: Path | None, key: str) -> DistanceField | None:
    """Return the field kept under this key, or None."""
    if folder is None or not (folder / f"{key}.npz").is_file():
        return None
    with contextlib.suppress(InputError):  # a damaged one is computed again
        data = read_npz(folder / f"{key}.npz", ("grid", "origin", "cell"))
        grid = np.ascontiguousarray(data["grid"], dtype=np.float32)
        return DistanceField(grid=grid, origin=data["origin"], cell=float(data["cell"]))
    return None
