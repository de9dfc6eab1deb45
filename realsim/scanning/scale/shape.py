"""The mesh as the scale fit sees it: distance field, rays, patches of surface and outlines.

The error of the mesh's own shape: a random field on its surface, estimated with the scale.

The true surface is the mesh displaced by a random vector field d, independent in every axis and
correlated over a length l. Of it a depth camera sees the normal part, delta_k = n_k . d_k in patch
k of the surface, so
    cov(delta_i, delta_j) = s^2 rho(|x_i - x_j|) n_i . n_j,
    rho(r) = (1 + a) exp(-a), a = sqrt(3) r / l    (Matern 3/2):
the two sides of a thin wall move together. What of the field is a shift, a turn or a change of
size is no error of the shape but the pose and the scale themselves: the covariance is conditioned
on the area-weighted sums of d . u over the whole surface being zero for the seven such u. With this
the scale of a wrong shape is defined: that of the mesh that fits the real thing best everywhere,
its underside included.

s and l are those under which the measurements are most probable with everything else integrated
out (restricted maximum likelihood, Patterson & Thompson 1971), and their own uncertainty enters the
result: the estimates of all (s, l) are averaged by their probability.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from realsim.arrays import Array, Array32, Int64
from realsim.errors import DegenerateError
from realsim.geometry.distance_field import DistanceField, raycasting_scene
from realsim.geometry.mesh import decimated, face_normals, hull_vertices, sample_surface
from realsim.records import Mesh
from realsim.scanning.scale.config import ScaleConfig, ShapeConfig

JITTER = 1e-12
"""Share of the variance that keeps conditioned covariances positive."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class SurfacePatches:
    """Patches of the mesh's surface."""

    middles: Array
    """(K, 3) in the inner mesh's axes."""
    normals: Array
    """(K, 3) mean outward normals, at most of unit length: a patch over an edge has less."""
    areas: Array
    """(K,) shares of the surface."""
    normal_weight: float
    """Length that a unit normal counts as in the distance to a patch [inner unit]."""
    radius: float
    """Typical distance of a patch's points from its middle [inner unit]."""

    def of(self, points: Array, normals: Array) -> Int64:
        """Return the patch (N,) of points (N, 3) with the normals (N, 3) of their surface."""
        from scipy.spatial import KDTree

        if len(points) == 0:
            return np.zeros(0, dtype=np.int64)
        tree: Any = KDTree(
            np.concatenate([self.middles, self.normal_weight * self.normals], axis=1)
        )
        both = np.concatenate([points, self.normal_weight * normals], axis=1)
        return np.asarray(tree.query(both)[1], dtype=np.int64)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ShapeModel:
    """One assumption about the shape's error, and how probable it is."""

    sigma_m: float
    """1-sigma of the displacement along each axis [m]."""
    length_m: float
    """Correlation length l [m]."""
    covariance: Array
    """(K, K) of the patches' offsets [m^2]."""
    probability: float
    """Relative to the others' of one grid."""


def make_patches(samples: Array, normals: Array, k: int, normal_weight: float) -> SurfacePatches:
    """Return k patches of a surface from evenly spread samples (S, 3) and their normals.

    Middles are chosen each as far as possible from those before, in place and direction: the two
    sides of a wall are two patches.
    """
    both = np.concatenate([samples, normal_weight * normals], axis=1)
    chosen = [int(np.argmax(np.linalg.norm(samples - samples.mean(0), axis=1)))]
    nearest = np.linalg.norm(both - both[chosen[0]], axis=1)
    label = np.zeros(len(both), dtype=np.int64)
    while len(chosen) < min(k, len(both)):
        chosen.append(int(np.argmax(nearest)))
        distance = np.linalg.norm(both - both[chosen[-1]], axis=1)
        closer = distance < nearest
        label[closer], nearest[closer] = len(chosen) - 1, distance[closer]
    count = np.bincount(label, minlength=len(chosen)).astype(np.float64)

    def mean(values: Array) -> Array:
        sums = [np.bincount(label, values[:, c], len(chosen)) for c in range(3)]
        return np.stack(sums, -1) / count[:, None]

    middles = mean(samples)
    spread = samples - middles[label]
    return SurfacePatches(
        middles=middles, normals=mean(normals), areas=count / count.sum(),
        normal_weight=normal_weight,
        radius=float(np.sqrt(np.mean(np.sum(np.square(spread), axis=1)))),
    )  # fmt: skip


def covariance_of(patches: SurfacePatches, length: float) -> Array:
    """Return the covariance (K, K) of the patches' offsets for a field of unit variance.

    Args:
        patches: the surface.
        length: correlation length, in the patches' unit.
    """
    x, n, a = patches.middles, patches.normals, patches.areas
    squares = np.sum(np.square(x[:, None] - x[None]), axis=2)
    r = np.sqrt(3.0 * squares) / length
    rho = (1.0 + r) * np.exp(-r)
    S = rho * (n @ n.T)
    q = x - a @ x
    q = q / np.sqrt(a @ np.sum(np.square(q), axis=1))
    modes = [np.tile(e, (len(x), 1)) for e in np.eye(3)]
    modes += [np.cross(e, q) for e in np.eye(3)] + [q]
    U = np.stack(modes)  # (7, K, 3)
    weighted = np.einsum("kl,l,mlc->mkc", rho, a, U)
    C = np.einsum("kc,mkc->km", n, weighted)
    M = np.einsum("k,mkc,nkc->mn", a, U, weighted)
    S = S - C @ np.linalg.solve(M + JITTER * np.eye(7), C.T)
    return 0.5 * (S + S.T)


def shape_models(
    patches: SurfacePatches,
    information: Array,
    offered: Array,
    scale: tuple[float, float],
    config: ShapeConfig,
) -> list[ShapeModel]:
    """Return the assumptions about the shape's error with their probabilities, best first.

    log p = -1/2 log |I + S Lambda| + 1/2 eta^T (S^-1 + Lambda)^-1 eta.

    Args:
        patches: the surface, in the inner mesh's unit.
        information: (K, K) Lambda of the offsets, all else integrated out [1/m^2].
        offered: (K,) eta, likewise [1/m].
        scale: metres per unit of the inner mesh, and the object's size [m].
        config: settings.
    """
    s, size = scale
    k = len(offered)
    rows: list[tuple[float, float, float, Array]] = []
    for share in config.lengths:
        unit = covariance_of(patches, share * size / s)
        within = within_share(patches, share * size / s)
        unit += config.nugget * within**2 * np.eye(k)
        for amplitude in config.amplitudes:
            sigma = max(amplitude * size, config.floor_m)
            S = sigma**2 * unit
            A = np.eye(k) + S @ information
            _, log_det = np.linalg.slogdet(A)
            quadratic = float(offered @ np.linalg.solve(A, S @ offered))
            rows.append((-0.5 * float(log_det) + 0.5 * quadratic, sigma, share * size, S))
    best = max(r[0] for r in rows)
    weights = np.exp(np.array([r[0] for r in rows]) - best)
    weights /= weights.sum()
    models = [
        ShapeModel(sigma_m=sigma, length_m=length, covariance=S, probability=float(w))
        for w, (_, sigma, length, S) in zip(weights, rows, strict=True)
    ]
    return sorted(models, key=lambda m: -m.probability)


def within_share(patches: SurfacePatches, length: float) -> float:
    """Return how much the field varies inside a patch, as a share of its 1-sigma: r / l."""
    return min(1.0, patches.radius / length)


def posterior(information: Array, offered: Array, S: Array) -> tuple[Array, Array]:
    """Return the offsets (K,) and their covariance (K, K) under one assumption."""
    A = np.eye(len(S)) + S @ information
    C = np.linalg.solve(A, S)
    C = 0.5 * (C + C.T)
    return C @ offered, C


# --- the mesh ------------------------------------------------------------------------------------


INNER_EXTENT = 0.1
"""Greatest side of the mesh inside of the fit [m]: numbers near those of real objects, so that a
mesh in inches or in units of its own is solved alike."""
SURFACE_SAMPLES = 1500
"""Points of the surface that free space and patches are judged at."""
FLAT_SHARE = 1e-3
"""A mesh thinner than this share of its length has no inside."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ScanShape:
    """A mesh about the centre of its box, its greatest side `INNER_EXTENT`."""

    mesh: Mesh
    unit: float
    """Inner length of one unit of the given mesh: scale_given = scale_inner * unit."""
    center: Array
    """(3,) centre of the given mesh's box, in its own units."""
    field: DistanceField
    ray_scene: Any
    samples: Array
    """(S, 3) points spread evenly over the surface."""
    normals: Array
    """(S, 3) outward."""
    patches: SurfacePatches
    edges: Int64
    """(E, 2) vertices of every edge with two faces."""
    edge_normals: Array
    """(E, 2, 3) normals of its two faces."""
    hull: Array
    """(H, 3) corners of the convex hull: what can touch the table."""
    radius: float
    """Half of the box's diagonal."""

    @property
    def vertices(self) -> Array:
        """(V, 3)."""
        return self.mesh.vertices

    def cast(self, origins: Array, directions: Array32, s: float, R: Array, t: Array) -> Array32:
        """Return the parameter (N,) at which world rays first meet the mesh; inf = never.

        Args:
            origins: (3,) or (N, 3) in world [m].
            directions: (N, 3) in world.
            s: scale of the inner mesh.
            R: (3, 3) its rotation.
            t: (3,) its centre in world [m].
        """
        from realsim.interop import import_open3d

        o3d = import_open3d()
        rays = np.empty((len(directions), 6), dtype=np.float32)
        rays[:, :3] = (origins - t) @ R / s
        rays[:, 3:] = (directions @ R.astype(np.float32)) / np.float32(s)
        hits = self.ray_scene.cast_rays(o3d.core.Tensor(rays), 1)
        return np.asarray(hits["t_hit"].numpy())


def make_shape(mesh: Mesh, config: ScaleConfig) -> ScanShape:
    """Return the shape of a mesh of any size.

    Raises:
        DegenerateError: the mesh is flat or has no extent.
    """
    extent = mesh.extent
    largest = float(extent.max())
    if not largest > 0 or float(np.sort(extent)[1]) < FLAT_SHARE * largest:
        raise DegenerateError(
            f"the mesh is a line or a point (extent {extent.tolist()}); a solid object is needed."
        )
    unit = INNER_EXTENT / largest
    center = mesh.bounds.mean(0)
    inner = _welded(mesh, center, unit)
    inner = decimated(inner, config.fit_faces)
    samples, normals = sample_surface(inner, SURFACE_SAMPLES, np.random.default_rng(0))
    edges, edge_normals = _two_faced_edges(inner)
    return ScanShape(
        mesh=inner, unit=unit, center=center,
        field=DistanceField.from_mesh(inner, config.field_cells),
        ray_scene=raycasting_scene(inner), samples=samples, normals=normals,
        patches=make_patches(
            samples, normals, config.shape.patches, config.shape.normal_share * INNER_EXTENT
        ), edges=edges, edge_normals=edge_normals,
        hull=hull_vertices(inner.vertices),
        radius=float(0.5 * np.linalg.norm(inner.extent)),
    )  # fmt: skip


def _welded(mesh: Mesh, center: Array, unit: float) -> Mesh:
    from realsim.geometry.mesh_shape import welded_mesh

    bare = welded_mesh(mesh)
    # Faces that are there twice would leave their edges out of every outline.
    _, first = np.unique(np.sort(bare.faces, axis=1), axis=0, return_index=True)
    faces = bare.faces[np.sort(first)]
    return Mesh(vertices=(bare.vertices - center) * unit, faces=faces)


def mirrored(shape: ScanShape) -> ScanShape:
    """Return the shape of the mirror image (x negated), about the same centre."""
    flip = np.array([-1.0, 1.0, 1.0])
    mesh = Mesh(vertices=shape.vertices * flip, faces=shape.mesh.faces[:, ::-1])
    field = shape.field
    end = field.origin[0] + field.cell * (field.grid.shape[0] - 1)
    return replace(
        shape,
        mesh=mesh,
        field=DistanceField(
            grid=np.ascontiguousarray(field.grid[::-1]),
            origin=np.array([-end, field.origin[1], field.origin[2]]),
            cell=field.cell,
        ),
        ray_scene=raycasting_scene(mesh),
        samples=shape.samples * flip,
        normals=shape.normals * flip,
        edge_normals=shape.edge_normals * flip,
        hull=shape.hull * flip,
    )


def _two_faced_edges(mesh: Mesh) -> tuple[Int64, Array]:
    """Return the edges (E, 2) that two faces share, and those faces' normals (E, 2, 3)."""
    f = mesh.faces.astype(np.int64)
    edges = np.sort(np.concatenate([f[:, [0, 1]], f[:, [1, 2]], f[:, [2, 0]]]), axis=1)
    owner = np.tile(np.arange(len(f)), 3)
    key = edges[:, 0] * len(mesh.vertices) + edges[:, 1]
    order = np.argsort(key, kind="stable")
    key, owner = key[order], owner[order]
    first = np.flatnonzero(np.concatenate([[True], key[1:] != key[:-1]]))
    count = np.diff(np.append(first, len(key)))
    pairs = first[count == 2]
    normals = face_normals(mesh)
    two = np.stack([normals[owner[pairs]], normals[owner[pairs + 1]]], axis=1)
    return edges[order][pairs], two
