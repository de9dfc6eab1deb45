"""What the search for starts needs of a mesh, computed once: templates, samples, distances."""

import hashlib
from collections import OrderedDict
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from realsim.errors import InputError
from realsim.geometry.mesh import hull_vertices, sample_surface
from realsim.models.resting import RestingConfig, resting_orientations, turned_down
from realsim.records import Mesh
from realsim.scanning.scale.height_maps import Template, templates

Array = NDArray[np.float64]
REMEMBERED_SHAPES = 8
"""Shapes kept in memory; one is about 6 MB."""
GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))
_memory: "OrderedDict[tuple[str, ShapeConfig], Shape]" = OrderedDict()


@dataclass(frozen=True, kw_only=True, slots=True)
class ShapeConfig:
    """How a mesh is prepared."""

    directions: int = 200
    """Directions down besides the resting ones: 16 deg apart, so that none is farther than about 9
    deg from a pose that no resting pose explains (a leaning object, a hull that is wrong)."""
    general_penalty: float = 0.06
    """What a direction that is no resting pose loses of its score, which is at most 1."""
    rare_penalty: float = 0.02
    """What a resting pose of probability 1 % loses; one of 10 % loses half of it."""
    rays: int = 1200
    """Of each template, over its box."""
    samples: int = 500
    """Points on the surface that are looked for in the cloud."""
    support: int = 150
    """Extreme points of the hull that tell how deep the mesh reaches."""
    cells: int = 48
    """Cells of the distance grid along the diameter of the mesh."""
    seed: int = 0
    """Of the samples; the preparation must not depend on who asks first."""
    resting: RestingConfig = field(default_factory=RestingConfig)
    """How the mesh may stand."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Grid:
    """Unsigned distances to a set of points, on a grid."""

    distances: NDArray[np.float32]
    """(X, Y, Z) at the middle of each cell."""
    origin: Array
    """(3,) corner of cell (0, 0, 0)."""
    cell: float
    """Edge of a cell."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Shape:
    """A mesh of radius 1 about the origin, prepared for the search: p_mesh = radius p + center."""

    center: Array
    """(3,) middle of the mesh's box [units of the mesh]."""
    radius: float
    """Greatest distance of a vertex from it [units of the mesh]."""
    templates: tuple[Template, ...]
    support: Array
    """(H, 3) extreme points of the hull."""
    samples: Array
    """(S, 3) spread evenly over the surface."""
    lit: NDArray[np.float32]
    """(S, D) 1 where the sample is seen from the direction."""
    directions: Array
    """(D, 3) unit, of `lit`: from the mesh to the eye."""
    surface: Grid
    """Distance to the surface."""


def shape_of(mesh: Mesh, config: ShapeConfig) -> Shape:
    """Return the prepared mesh, from memory if it was prepared before.

    Raises:
        InputError: the mesh is flat.
    """
    digest = hashlib.blake2b(mesh.vertices.tobytes(), digest_size=16)
    digest.update(mesh.faces.tobytes())
    key = (digest.hexdigest(), config)
    if key not in _memory:
        _memory[key] = _prepared(mesh, config)
        while len(_memory) > REMEMBERED_SHAPES:
            _memory.popitem(last=False)
    _memory.move_to_end(key)
    return _memory[key]


def spread_directions(n: int) -> Array:
    """Return n unit vectors (n, 3) spread evenly over the sphere (Fibonacci's lattice)."""
    k = np.arange(n) + 0.5
    z = 1 - 2 * k / n
    out = np.sqrt(1 - z * z)
    return np.stack([out * np.cos(GOLDEN_ANGLE * k), out * np.sin(GOLDEN_ANGLE * k), z], -1)


def point_grid(points: Array, cell: float, margin: int) -> Grid:
    """Return the distance to the nearest of the points (N, 3), to within about half a cell."""
    from scipy.ndimage import distance_transform_edt

    origin = points.min(0) - margin * cell
    index = np.floor((points - origin) / cell).astype(np.int64)
    free = np.ones(index.max(0) + 1 + margin, dtype=bool)
    free[tuple(index.T)] = False
    distances = np.asarray(distance_transform_edt(free), dtype=np.float32)
    return Grid(distances=distances * np.float32(cell), origin=origin, cell=cell)


def _prepared(mesh: Mesh, config: ShapeConfig) -> Shape:
    """Return the prepared mesh."""
    center = mesh.bounds.mean(0)
    radius = float(np.linalg.norm(mesh.vertices - center, axis=1).max())
    if not radius > 0:
        raise InputError("all vertices of the mesh coincide; it has no size to be found.")
    unit = Mesh(vertices=(mesh.vertices - center) / radius, faces=mesh.faces)
    rng = np.random.default_rng(config.seed)
    samples, _ = sample_surface(unit, config.samples, rng)
    dense, _ = sample_surface(unit, 60 * config.cells**2 // 4, rng)
    directions = spread_directions(config.directions)
    corners = hull_vertices(unit.vertices)
    extreme = np.unique(np.argmax(spread_directions(4 * config.support) @ corners.T, axis=1))
    found = _templates(unit, directions, config)
    return Shape(
        center=center,
        radius=radius,
        templates=tuple(found),
        support=corners[extreme],
        samples=samples,
        lit=_lit(unit, samples, directions),
        directions=directions,
        surface=point_grid(dense, 2.0 / config.cells, 6),
    )


def _templates(unit: Mesh, directions: Array, config: ShapeConfig) -> list[Template]:
    """Return the templates of the resting poses, most probable first, and of all directions."""
    resting = resting_orientations(unit, config.resting)
    general = [turned_down(d) for d in directions]
    rotations = np.stack([*(r.R for r in resting), *general])
    chance = np.array([r.probability for r in resting])
    basin = np.array([r.basin for r in resting])
    # A body that rolls is as likely to lie as all its representatives together.
    together = np.bincount(basin, chance)[basin]
    rare = 0.5 * config.rare_penalty * np.log10(np.clip(together, 1e-3, 1.0))
    priors = np.concatenate([rare, np.full(len(general), -config.general_penalty)])
    names = [f"resting pose {k + 1}" for k in range(len(resting))]
    names += [f"direction {k + 1}" for k in range(len(general))]
    return templates(unit, rotations, priors, names, config.rays, config.seed)


def _lit(unit: Mesh, samples: Array, directions: Array) -> NDArray[np.float32]:
    """Return (S, D) 1 where a sample of the unit mesh is seen from far along a direction."""
    from realsim.rendering.rays import PlacedMesh, RayScene

    scene = RayScene([PlacedMesh(0, unit, np.eye(4))])
    far = 3.0
    origins = samples[:, None] + far * directions[None]
    rays = np.broadcast_to(-directions[None], origins.shape)
    t, _ = scene.first_hits(origins.reshape(-1, 3), rays.reshape(-1, 3).astype(np.float32))
    return (t.reshape(len(samples), -1) > far - 0.02).astype(np.float32)
