"""Objects on a table, in poses in which they would rest, without a physics engine.

An object rests on a facet of its convex hull whose polygon holds the projected centre of mass.
How often a thrown object ends on a facet is taken proportional to the solid angle under which the
centre of mass sees it (Boothroyd's energy-free estimate).
"""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from realsim.arrays import Array, Mask, Rows
from realsim.errors import DegenerateError, InputError
from realsim.geometry import se3
from realsim.records import Mesh, ObjectModel

SURELY_M = 1e-5
"""What is told without the outline of a facet is told by more than this [m]; rounding is less."""
UNMOVED = np.zeros((1, 2))
"""Shifts of an outline that stays where it is [m]."""


class CrowdedError(InputError):
    """The objects do not fit into the disc."""


GAP_M = 0.008
"""Least distance of two footprints [m]: room for a fingertip's edge, and no contact."""
STABILITY_M = 0.0004
"""Least distance of the projected centre of mass from the rim of its facet [m]. Small, because
a cylinder lies on a facet 2 mm wide; what stands on a point is still refused."""
TRIES = 400
"""Random spots tried for an object before the layout is started anew."""
RESTARTS = 12
"""Layouts tried before giving up. The first third scatters the objects evenly over the disc,
the rest packs them from its middle outward, which fits about a third more."""


def _merged_facets(equations: Array) -> NDArray[np.intp]:
    """Return (F,) the number of the flat facet that each hull triangle belongs to."""
    # Qhull gives coplanar triangles the same equation up to rounding; 1e-7 is 0.1 um and 0.1 urad.
    keys = np.round(equations * 1e6).astype(np.int64)
    _, number = np.unique(keys, axis=0, return_inverse=True)
    return number.reshape(-1)


def _solid_angles(triangles: Array, eye: Array) -> Array:
    """Return the solid angle (F,) [sr] of triangles (F, 3, 3) seen from a point.

    Van Oosterom and Strackee 1983, eq. 8.
    """
    a, b, c = np.moveaxis(triangles - eye, 1, 0)
    la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    volume = np.abs(np.einsum("ij,ij->i", a, np.cross(b, c)))
    dots = np.einsum("ij,ij->i", a, b) * lc
    dots += np.einsum("ij,ij->i", b, c) * la + np.einsum("ij,ij->i", c, a) * lb
    return np.asarray(2 * np.arctan2(volume, la * lb * lc + dots))


@lru_cache(maxsize=256)
def stable_rests(mesh: Mesh) -> tuple[Array, Array]:
    """Return the ways in which an object can rest on a plane.

    Returns:
        down (K, 3), the outward normals of the facets it rests on, and probabilities (K,).

    Raises:
        DegenerateError: no facet carries it.
    """
    from scipy.spatial import ConvexHull

    from realsim.geometry.mesh import mass_properties

    center = mass_properties(mesh, 1.0).center_of_mass
    hull = ConvexHull(mesh.vertices)
    equations = np.asarray(hull.equations, dtype=np.float64)
    triangles = mesh.vertices[hull.simplices]
    angles = _solid_angles(triangles, center)
    down: list[Array] = []
    weights: list[float] = []
    facets = _merged_facets(equations)
    order = np.argsort(facets, kind="stable")
    starts = np.flatnonzero(np.r_[True, np.diff(facets[order]) > 0])
    normals = equations[order[starts], :3]
    feet = center - (normals @ center + equations[order[starts], 3])[:, None] * normals
    members = np.split(order, starts[1:])
    for k in np.flatnonzero(~_is_beside(triangles[order], starts, feet)):
        if _inside_by(triangles[members[k]].reshape(-1, 3), normals[k], feet[k]) >= STABILITY_M:
            down.append(normals[k])
            weights.append(float(angles[members[k]].sum()))
    if not down:
        raise DegenerateError(
            "no facet of the object's hull holds its centre of mass by "
            f"{STABILITY_M * 1e3:.2g} mm; it would roll."
        )
    total = np.array(weights)
    return np.array(down), total / total.sum()


def _is_beside(triangles: Array, starts: Rows, feet: Array) -> Mask:
    """Return which feet (G,) surely miss their facets; these start in triangles (F, 3, 3)."""
    count = np.diff(np.r_[starts, len(triangles)])
    away = feet - np.add.reduceat(triangles.mean(1), starts) / count[:, None]
    far = np.linalg.norm(away, axis=1)
    from_foot = triangles - feet.repeat(count, axis=0)[:, None]
    ahead = np.einsum("fij,fj->fi", from_foot, away.repeat(count, axis=0))
    reach = np.maximum.reduceat(ahead.max(1), starts)
    return (far > SURELY_M) & (reach < (STABILITY_M - SURELY_M) * far)


def _inside_by(points: Array, normal: Array, foot: Array) -> float:
    """Return how far [m] a point lies inside the hull of coplanar points (negative: outside)."""
    from scipy.spatial import ConvexHull, QhullError

    x = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    axes = np.stack([x / np.linalg.norm(x), np.cross(normal, x / np.linalg.norm(x))])
    flat = (points - foot) @ axes.T
    try:
        outline = ConvexHull(flat)
    except QhullError:  # a needle of no width carries nothing
        return -np.inf
    return float(-np.asarray(outline.equations)[:, 2].max())


def random_rest(model: ObjectModel, rng: np.random.Generator) -> Array:
    """Return T_table_obj (4, 4) of a resting pose over the origin, its lowest vertex at z = 0."""
    down, probability = stable_rests(model.mesh)
    normal = down[rng.choice(len(down), p=probability)]
    yaw = se3.exp_so3([0.0, 0.0, rng.uniform(-np.pi, np.pi)])
    R = yaw @ _turn_onto(normal, np.array([0.0, 0.0, -1.0]))
    turned = model.mesh.vertices @ R.T
    middle = (turned.min(0) + turned.max(0)) / 2
    return se3.from_rt(R, [-middle[0], -middle[1], -turned[:, 2].min()])


def _turn_onto(source: Array, target: Array) -> Array:
    """Return the shortest rotation (3, 3) that takes one unit vector to another."""
    axis, cosine = np.cross(source, target), float(source @ target)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-12:
        if cosine > 0:
            return np.eye(3)
        x = np.cross(source, np.eye(3)[np.argmin(np.abs(source))])
        return se3.exp_so3(np.pi * x / np.linalg.norm(x))
    return se3.exp_so3(axis / sine * np.arctan2(sine, cosine))


def footprint(mesh: Mesh, T_table_obj: Array) -> Array:
    """Return the convex outline (N, 2) [m] of the object seen from above, counter-clockwise."""
    from scipy.spatial import ConvexHull

    from realsim.geometry.mesh import hull_vertices

    flat = se3.transform(T_table_obj, hull_vertices(mesh.vertices))[:, :2]
    return flat[ConvexHull(flat).vertices]


def _outward(outline: Array) -> tuple[Array, Array]:
    """Return the unit normals (N, 2) of a convex outline's edges and how far out these lie (N,)."""
    edge = np.roll(outline, -1, axis=0) - outline
    outward = np.stack([edge[:, 1], -edge[:, 0]], -1)
    outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-15)
    return outward, np.einsum("ij,ij->i", outward, outline)


def footprint_gap(a: Array, b: Array, shifts: Array = UNMOVED) -> Array:
    """Return lower bounds (S,) of the distance [m] of two convex outlines; negative: they overlap.

    The widest separation along any edge normal of either (separating axis): exact where an edge
    faces a corner, too small by at most 30 % where corner faces corner.

    Args:
        a: outline (N, 2) [m].
        b: outline (M, 2) [m].
        shifts: (S, 2) by which `a` is moved, one after the other [m].
    """
    of_a, far_a = _outward(a)
    of_b, far_b = _outward(b)
    from_a = ((b @ of_a.T).min(0) - far_a) - shifts @ of_a.T
    from_b = ((a @ of_b.T).min(0) - far_b) + shifts @ of_b.T
    return np.maximum(from_a.max(1), from_b.max(1))


def place_objects(
    models: Sequence[ObjectModel], center_world: Array, rng: np.random.Generator, radius_m: float
) -> Array:
    """Return resting, non-overlapping poses Ts_world_obj (n, 4, 4) on a table.

    Args:
        models: the objects, one for each instance.
        center_world: (3,) middle of the disc on the table's surface [m].
        rng: the same generator state gives the same layout.
        radius_m: of the disc that holds every footprint [m].

    Raises:
        CrowdedError: they do not fit; the message says how many did.
    """
    reach = [float(np.linalg.norm(m.mesh.extent)) for m in models]
    order = sorted(range(len(models)), key=lambda k: -reach[k])  # the bulky ones first
    best = 0
    for attempt in range(RESTARTS):
        packed = 3 * attempt >= RESTARTS
        poses: dict[int, Array] = {}
        outlines: list[Array] = []
        for k in order:
            spot = _free_spot(models[k], outlines, rng, radius_m, packed=packed)
            if spot is None:
                break
            poses[k] = spot[0]
            outlines.append(spot[1])
        best = max(best, len(poses))
        if len(poses) == len(models):
            lift = se3.from_translation(center_world)
            return np.stack([lift @ poses[k] for k in range(len(models))])
    raise CrowdedError(
        f"only {best} of {len(models)} objects fit into a disc of radius {radius_m:.3g} m "
        f"with {GAP_M * 1e3:.3g} mm between them; give fewer objects or a larger radius."
    )


def _free_spot(
    model: ObjectModel,
    outlines: Sequence[Array],
    rng: np.random.Generator,
    radius_m: float,
    *,
    packed: bool,
) -> tuple[Array, Array] | None:
    """Return a pose (4, 4) and outline (N, 2) clear of the others, or None if none was found.

    With `packed` the spots nearest to the middle of the disc are tried first.
    """
    rests = 8  # resting poses and yaws drawn, each tried in its share of the spots
    for _ in range(rests):
        T = random_rest(model, rng)
        shape = footprint(model.mesh, T)
        room = radius_m - float(np.linalg.norm(shape, axis=1).max())
        if room < 0:
            continue
        n = -(-TRIES // rests)
        angles, r = rng.uniform(-np.pi, np.pi, n), room * np.sqrt(rng.uniform(size=n))
        spots = np.stack([r * np.cos(angles), r * np.sin(angles)], -1)
        free = np.ones(n, dtype=bool)
        for other in outlines:
            free &= footprint_gap(shape, other, spots) >= GAP_M
        if free.any():
            first = np.where(free, r, np.inf).argmin() if packed else free.argmax()
            return se3.from_translation([*spots[first], 0.0]) @ T, shape + spots[first]
    return None
