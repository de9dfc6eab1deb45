"""The shape of a triangle mesh: hull, diameter, normals, surface samples and mass."""

import hashlib
import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.arrays import Array, Int64
from realsim.errors import InputError
from realsim.interop import import_open3d
from realsim.records import Mesh

LEAST_FILL = 1e-6
"""A closed mesh that fills less of its hull than this is a folded sheet, not a solid."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class MassProperties:
    """Volume, mass and inertia of a solid of one density."""

    volume_m3: float
    """Volume [m^3]: of the mesh if it is watertight, else of its convex hull."""
    mass_kg: float
    center_of_mass: Array
    """(3,) in the mesh's frame [m]."""
    inertia: Array
    """(3, 3) about the centre of mass, axes of the mesh's frame [kg m^2]."""
    is_watertight: bool
    """Whether the mesh is closed; if not, all figures are those of its convex hull."""
    hull_volume_fraction: float
    """volume_m3 / volume of the convex hull: 1 = convex, or taken for convex."""


def welded(mesh: Mesh) -> tuple[Array, Int64]:
    """Return vertices and faces with equal positions merged and collapsed faces dropped."""
    vertices, index = np.unique(mesh.vertices, axis=0, return_inverse=True)
    faces = index.reshape(-1)[mesh.faces].astype(np.int64)
    a, b, c = faces.T
    return vertices, faces[(a != b) & (b != c) & (c != a)]


def welded_mesh(mesh: Mesh) -> Mesh:
    """Return the bare surface with equal positions merged; colours and textures are lost."""
    vertices, faces = welded(mesh)
    return Mesh(vertices=vertices, faces=faces.astype(np.int32))


def decimated(mesh: Mesh, faces: int) -> Mesh:
    """Return the bare surface with about so many faces, or as it is if it has no more.

    Edges collapse where the quadric error is least (Garland & Heckbert 1997, "Surface
    simplification using quadric error metrics"; Open3D's). Closed surfaces may tear;
    `models.simplify` keeps them closed.
    """
    if len(mesh.faces) <= faces:
        return mesh
    o3d = import_open3d()
    full: Any = o3d.geometry.TriangleMesh(  # it refuses read-only arrays
        o3d.utility.Vector3dVector(mesh.vertices.copy()),
        o3d.utility.Vector3iVector(mesh.faces.copy()),
    )
    small = full.simplify_quadric_decimation(faces)
    small.remove_unreferenced_vertices()
    vertices: Array = np.asarray(small.vertices, dtype=np.float64)
    return Mesh(vertices=vertices, faces=np.asarray(small.triangles, dtype=np.int32))


class _Content:
    """Points that are equal as keys where their bytes are, so that results can be kept."""

    __slots__ = ("digest", "points")

    def __init__(self, points: Array) -> None:
        self.points = points
        self.digest = hashlib.blake2b(points.tobytes(), digest_size=16).digest()

    def __hash__(self) -> int:
        return hash(self.digest)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Content) and self.digest == other.digest


@lru_cache(maxsize=64)
def _hull(content: _Content) -> tuple[Array, Array, float]:
    """Return hull vertices (H, 3), its outward triangles (F, 3, 3) and its volume."""
    from scipy.spatial import ConvexHull, QhullError

    points = content.points
    try:
        hull: Any = ConvexHull(points)
    except QhullError:  # flat or a line: every point may matter, and there is no volume
        return np.unique(points, axis=0), np.zeros((0, 3, 3)), 0.0
    triangles: Array = points[hull.simplices]
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    inward = np.einsum("ij,ij->i", normals, hull.equations[:, :3]) < 0
    triangles[inward] = triangles[inward][:, ::-1]
    return points[hull.vertices], triangles, float(hull.volume)


@lru_cache(maxsize=64)
def _diameter(content: _Content) -> float:
    from scipy.spatial.distance import pdist

    corners = _hull(content)[0]
    return float(pdist(corners).max()) if len(corners) > 1 else 0.0


def hull_vertices(points: ArrayLike) -> Array:
    """Return those of the points (N, 3) that are corners of their convex hull (H, 3)."""
    points = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)
    if len(points) == 0:
        raise InputError("no points were given; a hull needs at least one.")
    return _hull(_Content(points))[0]


def hull_triangles(vertices: Array) -> tuple[Array, Int64]:
    """Return the corners (H, 3) of the hull, in the order given, and its outward faces (F, 3).

    Raises:
        QhullError: the points are flat.
    """
    from scipy.spatial import ConvexHull

    hull: Any = ConvexHull(vertices)
    corners = np.sort(hull.vertices)
    number = np.full(len(vertices), -1)
    number[corners] = np.arange(len(corners))
    faces: Int64 = number[hull.simplices].astype(np.int64)
    at = vertices[corners]
    a, b, c = np.moveaxis(at[faces], 1, 0)
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), hull.equations[:, :3]) < 0
    faces[inward] = faces[inward][:, ::-1]
    return at, faces


def diameter(mesh: Mesh) -> float:
    """Return the greatest distance between two vertices [m] (BOP's diameter)."""
    return _diameter(_Content(mesh.vertices))


def face_normals(mesh: Mesh) -> Array:
    """Return unit outward normals (F, 3); zero for faces without area."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    return _unit(np.cross(b - a, c - a))


def vertex_normals(mesh: Mesh) -> Array:
    """Return unit normals (V, 3), area-weighted over all faces that meet in the same position."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    normals = np.cross(b - a, c - a)
    unique, index = np.unique(mesh.vertices, axis=0, return_inverse=True)
    index = index.reshape(-1)
    corners = index[mesh.faces]
    total = np.stack(
        [
            np.bincount(corners.ravel(), np.repeat(normals[:, k], 3), minlength=len(unique))
            for k in range(3)
        ],
        -1,
    )
    return _unit(total)[index]


def _unit(v: NDArray[Any]) -> Array:
    n = np.linalg.norm(v, axis=-1, keepdims=True)
    return v / np.where(n > 0, n, 1.0)


def sample_surface(mesh: Mesh, n: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return n points (n, 3) [m] spread evenly over the surface, and their normals (n, 3)."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    normals = np.cross(b - a, c - a)
    areas = np.linalg.norm(normals, axis=1)
    if not areas.sum() > 0:
        raise InputError("the mesh has no area; its surface cannot be sampled.")
    face = rng.choice(len(areas), size=n, p=areas / areas.sum())
    # sqrt makes it even over the triangle (Osada et al. 2002, "Shape distributions", eq. 1).
    r1, r2 = np.sqrt(rng.random((n, 1))), rng.random((n, 1))
    points = (1 - r1) * a[face] + r1 * (1 - r2) * b[face] + r1 * r2 * c[face]
    return points, _unit(normals[face])


def is_closed(vertices: Array, faces: Int64) -> bool:
    """Return whether every directed edge of a welded mesh has its opposite: it bounds a solid."""
    n = len(vertices)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    there = np.sort(edges[:, 0] * n + edges[:, 1])
    back = np.sort(edges[:, 1] * n + edges[:, 0])
    return len(faces) > 0 and bool(np.array_equal(there, back))


def mass_properties(mesh: Mesh, density: float) -> MassProperties:
    """Return volume, mass, centre of mass and inertia of the solid that the mesh bounds.

    Each triangle spans a signed tetrahedron with the origin; with its corners a, b, c and
    V = det[a b c] / 6, the first moment is V (a + b + c) / 4 and the second moment is
    V / 20 (a a' + b b' + c c' + s s') with s = a + b + c (Blow & Binstock 2004). A mesh that is
    not closed is replaced by its convex hull.

    Args:
        mesh: the mesh [m].
        density: [kg/m^3].

    Raises:
        InputError: the mesh is flat, or the density is not positive.
    """
    if not (math.isfinite(density) and density > 0):
        raise InputError(f"the density is {density} kg/m^3; a positive number is needed.")
    vertices, faces = welded(mesh)
    # About the centre of the box, so that far-off meshes lose no digits.
    origin = vertices.mean(axis=0)
    _, hull_triangles, hull_volume = _hull(_Content(mesh.vertices))
    if not hull_volume > 0:
        raise InputError(
            f"the mesh is flat (extent {mesh.extent.tolist()} m): it has no volume and no mass."
        )
    closed = is_closed(vertices, faces)
    volume, first, second = _moments(vertices[faces] - origin)
    if not closed or abs(volume) < LEAST_FILL * hull_volume:
        closed = False
        volume, first, second = _moments(hull_triangles - origin)
    # Faces that all point inwards give the same solid with the opposite sign.
    sign = math.copysign(1.0, volume)
    volume, first, second = volume * sign, first * sign, second * sign
    center = first / volume
    about_center = second - volume * np.outer(center, center)
    inertia = density * (np.trace(about_center) * np.eye(3) - about_center)
    return MassProperties(
        volume_m3=volume,
        mass_kg=volume * density,
        center_of_mass=center + origin,
        inertia=0.5 * (inertia + inertia.T),
        is_watertight=closed,
        hull_volume_fraction=volume / hull_volume,
    )


def _moments(triangles: Array) -> tuple[float, Array, Array]:
    """Return volume, first moment (3,) and second moment (3, 3) of what (F, 3, 3) bounds."""
    a, b, c = np.moveaxis(triangles, 1, 0)
    V = np.einsum("ij,ij->i", a, np.cross(b, c)) / 6.0
    s = a + b + c
    second = sum(np.einsum("i,ij,ik->jk", V, p, p) for p in (a, b, c, s)) / 20.0
    return float(V.sum()), (V[:, None] * s).sum(axis=0) / 4.0, np.asarray(second)
