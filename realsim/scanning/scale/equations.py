"""The normal equations of the joint fit at one state, from what the views measured.

`surface_of` and `outlines_of` choose what a round of the fit holds fixed: the points with their
noise along the model's normal, the model's outlines, and the patch each belongs to; `linearised`
adds them up with the table, the contact and the priors.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from realsim.geometry import se3
from realsim.scanning.scale.accumulate import BLOCK, add_outline, add_surface, add_table
from realsim.scanning.scale.config import ScaleConfig
from realsim.scanning.scale.evidence import ScanEvidence
from realsim.scanning.scale.shape import ScanShape, outline
from realsim.scanning.scale.state import (
    BIAS,
    HAND_EYE,
    RIM,
    TABLE,
    VIEWS,
    Priors,
    State,
    all_points,
    camera_numbers,
    metre_per_px,
    priors_of,
    symmetric,
    table_points,
)

Array = NDArray[np.float64]
TABLE_CUT = 8.0
"""Tukey's cut-off of the table's points [sigma]."""
TABLE_SIGMA_M = 0.0003
"""Flatness of a table within a hand's breadth [m]."""
NORMAL_FLOOR_M = 0.00012
"""Least 1-sigma of a point along the normal [m]: grid and mesh are no finer."""
OBLIQUE = 0.3
"""Depth noise moves a point along the ray; of it at least this share along the normal."""
WIDEST_GAP_PX = 5.0
"""An outline whose place is unknown over more than this says nothing."""
RIM_PX = 0.35
"""1-sigma of an outline point without gap [px]: it lies somewhere in a pixel."""
SIDE_CELLS = 0.7
"""Cells towards the camera at which the surface's direction is looked up."""
FREE_TURN_RAD = 0.3
"""1-sigma of the object's turn before the measurements, about where it stands [rad]."""
LEAST_HEIGHT_M = 0.005
"""Outline points nearer to the table than this are not used [m]: the foot is not measured."""
LEAST_JUMP_M = 0.010
"""Nor where the depth behind the outline jumps by less than this [m]."""


@dataclass(frozen=True, eq=False, slots=True)
class Surface:
    """The object's points with what a round holds fixed."""

    points: Array
    view_of: NDArray[np.int64]
    variance: Array
    """(N,) of one point along the normal [m^2]."""
    crowding: Array
    """(N,) points that share one piece of independent noise."""
    ids: NDArray[np.int64]
    """(N,) patch."""


@dataclass(frozen=True, eq=False, slots=True)
class Rims:
    """The model's outlines of a round, per view."""

    points: list[Array]
    ids: list[NDArray[np.int64]]
    factors: list[Array]


@dataclass(frozen=True, eq=False, slots=True)
class System:
    """Normal equations of everything (n) and of the patches' offsets (K)."""

    G: Array
    """(n, n)."""
    g: Array
    """(n,)."""
    Gd: Array
    """(n, K)."""
    D: Array
    """(K,) diagonal: a point lies in one patch."""
    e: Array
    """(K,)."""

    def of_offsets(self) -> tuple[Array, Array]:
        """Return information (K, K) and right side (K,) of the offsets, all else integrated out."""
        X = np.linalg.solve(self.G, np.column_stack([self.Gd, self.g]))
        information = np.diag(self.D) - self.Gd.T @ X[:, :-1]
        return 0.5 * (information + information.T), self.e - self.Gd.T @ X[:, -1]

    def rest(self, offsets: Array) -> Array:
        """Return the step (n,) of everything else, given the offsets (K,)."""
        return np.asarray(np.linalg.solve(self.G, self.g - self.Gd @ offsets), dtype=np.float64)

    def covariance(self, offset_covariance: Array) -> Array:
        """Return the covariance (n, n) of everything else, given that of the offsets (K, K)."""
        inverse = np.linalg.inv(self.G)
        A = inverse @ self.Gd
        return np.asarray(inverse + A @ offset_covariance @ A.T, dtype=np.float64)


def local_points(state: State, evidence: ScanEvidence) -> Array:
    """Return the object's points of all views in the inner mesh's axes (N, 3)."""
    points, view_of = all_points(evidence.views)
    T = state.cameras(evidence.views)[view_of]
    world = np.einsum("nij,nj->ni", T[:, :3, :3], state.corrected(points)) + T[:, :3, 3]
    return (world - state.t) @ state.R / state.s


def surface_of(
    shape: ScanShape, evidence: ScanEvidence, state: State, config: ScaleConfig
) -> Surface:
    """Return the points with their variance along the model's normal at this state."""
    views = evidence.views
    points, view_of = all_points(views)
    local = local_points(state, evidence)
    # A little towards the camera, so that a thin wall shows the side that was seen.
    cameras = state.cameras(views)[view_of]
    eye = (cameras[:, :3, 3] - state.t) @ state.R / state.s - local
    eye /= np.linalg.norm(eye, axis=1, keepdims=True)
    _, gradient = shape.field.distance_gradient(local + SIDE_CELLS * shape.field.cell * eye)
    length = np.maximum(np.linalg.norm(gradient, axis=1), 1e-9)
    normal_obj = gradient / length[:, None]
    normal = normal_obj @ state.R.T
    ray = np.einsum("nij,nj->ni", cameras[:, :3, :3], points / points[:, 2:])
    cosine = np.clip(np.abs(np.sum(normal * ray, axis=1)), OBLIQUE, None)
    sigma = np.maximum(evidence.noise.sigma(points[:, 2]) * cosine, NORMAL_FLOOR_M)
    area = config.samples.noise_area_px
    crowding = np.array([max(1.0, area / v.point_area_px) for v in views])[view_of]
    ids = shape.patches.of(local, normal_obj)
    return Surface(points, view_of, np.square(sigma), crowding, ids)


def coarser(surface: Surface, within_m: float, config: ScaleConfig) -> Surface:
    """Return the points with the variance of the shape inside a patch shared among its points."""
    count = np.bincount(surface.ids)[surface.ids]
    shared = within_m**2 * np.maximum(1.0, count / config.shape.pieces)
    return replace(surface, crowding=surface.crowding + shared / surface.variance)


def outlines_of(
    shape: ScanShape, evidence: ScanEvidence, state: State, config: ScaleConfig
) -> Rims:
    """Return the points of the model's outline in every view that its depth can show."""
    T_table_world = se3.invert(state.T_world_table)
    focal, wanted = evidence.intrinsics.fx, config.samples.rim_points
    points: list[Array] = []
    ids: list[NDArray[np.int64]] = []
    offered = np.zeros(len(shape.patches.areas))
    for T in state.cameras(evidence.views):
        found = outline(shape, state.pose, T, focal, wanted)
        world = state.s * found.points @ state.R.T + state.t
        height = se3.transform(T_table_world, world)[:, 2]
        # Behind the outline there must be table far enough away for the depth to jump.
        eye = float(se3.transform(T_table_world, T[:3, 3])[0, 2])
        distance = np.linalg.norm(world - T[:3, 3], axis=1)
        jump = distance * height / np.maximum(eye - height, 1e-6)
        keep = (height > LEAST_HEIGHT_M) & (jump > LEAST_JUMP_M)
        points.append(found.points[keep])
        ids.append(shape.patches.of(found.points[keep], found.normals[keep]))
        metre = metre_per_px(evidence, T)
        offered += np.bincount(ids[-1], minlength=len(offered)) / (RIM_PX * metre) ** 2
    # All outlines of a patch may be off by the same: together they say no more than that.
    factor = 1.0 / (1.0 + offered * config.shape.rim_sigma_m**2)
    return Rims(points, ids, [factor[k] for k in ids])


def linearised(
    shape: ScanShape,
    evidence: ScanEvidence,
    state: State,
    seen: tuple[Surface, Rims],
    limits: tuple[Array, float, float],
    config: ScaleConfig,
) -> tuple[System, tuple[Array, Array]]:
    """Return the normal equations at a state, and the surface's residuals and kernel weights."""
    (offsets, cut, width), (surface, rims) = limits, seen
    views = evidence.views
    cameras = state.cameras(views)
    k = len(offsets)
    H, b = np.zeros((len(views), BLOCK, BLOCK)), np.zeros((len(views), BLOCK))
    Hd, D, e = np.zeros((len(views), k, BLOCK)), np.zeros(k), np.zeros(k)
    out = (np.empty(len(surface.points)), np.empty(len(surface.points)))
    weight = 1.0 / (surface.variance * surface.crowding)
    reach = cut * cut * (surface.variance + width**2)
    add_surface(
        (shape.field.grid, shape.field.origin, shape.field.cell), state.pose, cameras,
        (state.corrected(surface.points), surface.view_of, weight, reach),
        (surface.ids, offsets), (H, b, Hd, D, e), out,
    )  # fmt: skip
    _add_table(evidence, state, cameras, config, (H, b))
    for n, view in enumerate(views):
        if len(rims.points[n]) == 0:
            continue
        add_outline(
            state.pose, cameras[n], camera_numbers(evidence.intrinsics),
            (view.rim.distance_px, view.rim.gap_px, float(view.rim.left), float(view.rim.top)),
            (rims.points[n], rims.factors[n], state.rim, RIM_PX**2),
            (WIDEST_GAP_PX, cut, width**2, False), (rims.ids[n], offsets),
            (H[n], b[n], Hd[n], D, e),
        )  # fmt: skip
    G, g, Gd = _assembled(H, b, Hd)
    _add_contact(shape, evidence, state, (width, config), (G, g, Gd, D, e))
    _add_priors(state, priors_of(config), config, (G, g))
    return System(symmetric(G), g, Gd, D, e), out


def pivot_of(evidence: ScanEvidence, state: State) -> Array:
    """Return the point (3,) of the table under the object, about which it tilts."""
    x, y, _ = evidence.footprint.box.mean(0)
    return se3.transform(state.T_world_table, np.array([x, y, 0.0]))[0]


def _add_table(
    evidence: ScanEvidence,
    state: State,
    cameras: Array,
    config: ScaleConfig,
    system: tuple[Array, Array],
) -> None:
    """Add the table's points of all views."""
    points, view_of = table_points(evidence.views)
    area = config.samples.noise_area_px
    crowding = np.array([max(1.0, area / v.table_area_px) for v in evidence.views])[view_of]
    variance = np.square(evidence.noise.sigma(points[:, 2])) + TABLE_SIGMA_M**2
    T = state.T_world_table
    frame = (T[:3, 2].copy(), T[:3, 0].copy(), T[:3, 1].copy(), pivot_of(evidence, state))
    add_table(
        frame, cameras, (state.corrected(points), view_of, variance * crowding), TABLE_CUT,
        system[0], system[1],
    )  # fmt: skip


def _assembled(H: Array, b: Array, Hd: Array) -> tuple[Array, Array, Array]:
    """Return the normal equations of all views' blocks: upper triangle, right side, offsets'."""
    n, k = len(H), Hd.shape[1]
    Gd = np.zeros((VIEWS + 6 * n, k))
    G, g = np.zeros((VIEWS + 6 * n, VIEWS + 6 * n)), np.zeros(VIEWS + 6 * n)
    total, right, coupled = symmetric(H.sum(0)), b.sum(0), Hd.sum(0).T
    # Local numbers of object, table, bias and outline, and where they stand in the whole.
    shared = np.array([*range(7), 13, 14, 15, 16, 17])
    place = np.array([*range(7), TABLE, TABLE + 1, TABLE + 2, BIAS, RIM])
    camera = np.arange(7, 13)
    hand = np.arange(HAND_EYE, VIEWS)
    G[np.ix_(place, place)] = total[np.ix_(shared, shared)]
    G[np.ix_(place, hand)] = total[np.ix_(shared, camera)]
    G[np.ix_(hand, hand)] = total[np.ix_(camera, camera)]
    g[place], g[hand] = right[shared], right[camera]
    Gd[place], Gd[hand] = coupled[shared], coupled[camera]
    for v in range(n):
        full = symmetric(H[v])
        own = np.arange(VIEWS + 6 * v, VIEWS + 6 * v + 6)
        G[np.ix_(place, own)] = full[np.ix_(shared, camera)]
        G[np.ix_(hand, own)] = full[np.ix_(camera, camera)]
        G[np.ix_(own, own)] = full[np.ix_(camera, camera)]
        g[own] = b[v, camera]
        Gd[own] = Hd[v].T[camera]
    return np.triu(G), g, Gd


def _add_contact(
    shape: ScanShape,
    evidence: ScanEvidence,
    state: State,
    rules: tuple[float, ScaleConfig],
    system: tuple[Array, Array, Array, Array, Array],
) -> None:
    """Add that the lowest point of the real surface touches the table.

    Of a wrong shape the lowest point is low because it is wrong there, so contact says little.
    """
    G, g, Gd, D, e = system
    shape_m, config = rules
    T = state.T_world_table
    n = T[:3, 2]
    world = state.s * shape.hull @ state.R.T + state.t
    k = int(np.argmin(world @ n))
    offset = world[k] - pivot_of(evidence, state)
    m = state.s * shape.hull[k]
    normal_obj = state.R.T @ n
    patch = int(shape.patches.of(shape.hull[k][None], -normal_obj[None])[0])
    J = np.zeros(VIEWS)
    J[:3], J[3:6], J[6] = np.cross(m, normal_obj), normal_obj, m @ normal_obj
    J[TABLE], J[TABLE + 1], J[TABLE + 2] = T[:3, 0] @ offset, T[:3, 1] @ offset, -1.0
    w, r = 1.0 / (config.prior.contact_m**2 + shape_m**2), float(n @ offset)
    # Where the real surface lies lower than the mesh, the mesh ends above the table.
    G[:VIEWS, :VIEWS] += w * np.triu(np.outer(J, J))
    g[:VIEWS] -= w * J * r
    Gd[:VIEWS, patch] -= w * J
    D[patch] += w
    e[patch] += w * r


def _add_priors(
    state: State, priors: Priors, config: ScaleConfig, system: tuple[Array, Array]
) -> None:
    """Add what is known of the cameras, of the depth's bias and of the outlines' offset."""
    # A body of revolution may turn as it likes: without this the equations were singular.
    system[0][np.arange(3), np.arange(3)] += 1.0 / FREE_TURN_RAD**2
    twists = np.concatenate([state.hand_eye, state.views.ravel()])
    sigmas = np.concatenate([priors.hand_eye, np.tile(priors.arm, len(state.views))])
    index = np.arange(HAND_EYE, HAND_EYE + len(twists))
    w = 1.0 / np.square(sigmas)
    system[0][index, index] += w
    system[1][index] -= w * twists
    for place, value, sigma in (
        (BIAS, state.bias, config.prior.bias_per_m),
        (RIM, state.rim, config.prior.rim_px),
    ):
        system[0][place, place] += 1.0 / sigma**2
        system[1][place] -= value / sigma**2
