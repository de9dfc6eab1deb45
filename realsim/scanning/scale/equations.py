"""The equations of the joint fit: registration's, with a size, outlines and offsets of the surface.

Surface points say r - delta_k (data to model, at the side the camera saw), outline points r +
delta_k (model to data: keeps the model from growing), the table's points r. The lowest point
touches the table; hand-eye, arm, depth bias and the outlines' offset have priors.
"""

from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array, Int32, Int64
from realsim.geometry import se3
from realsim.geometry.normal_equations import System, add_prior, inverse, symmetric, without_views
from realsim.geometry.seen_surface import seen_distances
from realsim.registration.refinement.equations import (
    BIAS,
    BLOCK,
    HAND_EYE,
    TABLE_AT,
    TABLE_ROWS,
    Blocks,
    Offsets,
    add_blocks,
    add_offsets,
    assemble,
)
from realsim.scanning.scale.config import ScaleConfig
from realsim.scanning.scale.evidence import ScanEvidence
from realsim.scanning.scale.outlines import Rims, outline_blocks, outlines_of
from realsim.scanning.scale.shape import ScanShape
from realsim.scanning.scale.state import (
    OBJECT,
    PATCHES,
    RIM,
    SIZE,
    ScaleState,
    claimed_cameras,
    priors_of,
    stacked,
)

Seen = tuple[Array, Array, Array]
"""Places (N, 3) in the body's frame, distances (N,) and normals (N, 3); NaN = unseen."""
TABLE_CUT = 8.0
"""Tukey's cut-off of the table's points [sigma]."""
TABLE_SIGMA_M = 0.0003
"""Flatness of a table within a hand's breadth [m]."""
NORMAL_FLOOR_M = 0.00012
"""Least 1-sigma of a point along the normal [m]: grid and mesh are no finer."""
OBLIQUE = 0.3
"""Depth noise moves a point along the ray; of it at least this share along the normal."""
FREE_TURN_RAD = 0.3
"""1-sigma of the object's turn before the measurements, about where it stands [rad]."""
FIXED = 1e-6
"""1-sigma of what is held: the depth has no error of its own unit."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Round:
    """What a round of the fit holds fixed: points with their noise, outlines, patches."""

    points: Array
    """(N, 3) of the object, all views, camera axes."""
    views: Int32
    """(N,)."""
    variance: Array
    """(N,) of one point along the normal [m^2]."""
    crowding: Array
    """(N,) points that share one piece of independent noise."""
    ids: Int64
    """(N,) patch."""
    rims: Rims


@dataclass(frozen=True, eq=False, slots=True)
class Reduced:
    """Normal equations of the shared unknowns: the patches' offsets (K), and the rest (n)."""

    A: Array
    """(n + K, n + K)."""
    a: Array
    """(n + K,)."""

    def of_offsets(self) -> tuple[Array, Array]:
        """Return information (K, K) and right side (K,) of the offsets, all else integrated out."""
        coupled = inverse(self.A[:PATCHES, :PATCHES]) @ self.A[:PATCHES, PATCHES:]
        information = self.A[PATCHES:, PATCHES:] - coupled.T @ self.A[:PATCHES, PATCHES:]
        return 0.5 * (information + information.T), self.a[PATCHES:] - coupled.T @ self.a[:PATCHES]

    def rest(self, offsets: Array) -> Array:
        """Return the step (n,) of everything else, given the offsets (K,)."""
        left = self.a[:PATCHES] - self.A[:PATCHES, PATCHES:] @ offsets
        return inverse(self.A[:PATCHES, :PATCHES]) @ left

    def covariance(self, offset_covariance: Array) -> Array:
        """Return the covariance (n, n) of everything else, given that of the offsets (K, K)."""
        own = inverse(self.A[:PATCHES, :PATCHES])
        coupled = own @ self.A[:PATCHES, PATCHES:]
        return own + coupled @ offset_covariance @ coupled.T


def object_distances(shape: ScanShape, state: ScaleState, cameras: Array, points: Array,
                     views: Int32) -> tuple[Seen, Array]:  # fmt: skip
    """Return how far points in camera axes lie from the object, and T_body_cam (V, 4, 4)."""
    Ms = se3.invert(state.poses[0]) @ cameras
    eyes = np.ascontiguousarray(Ms[:, :3, 3])
    p = state.corrected(points, views)
    return seen_distances(shape.field.lattice, state.s, p, views, (Ms, eyes), True), Ms


def new_round(
    shape: ScanShape, evidence: ScanEvidence, state: ScaleState, within_m: float,
    config: ScaleConfig,
) -> Round:  # fmt: skip
    """Return what a round holds fixed at this state.

    Args:
        shape: the mesh.
        evidence: what was measured.
        state: where everything stands.
        within_m: 1-sigma of the shape inside a patch, shared among the patch's points [m].
        config: settings.
    """
    points, views = stacked([v.points for v in evidence.views])
    cameras = state.cameras(claimed_cameras(evidence.views))
    (places, _, normals), Ms = object_distances(shape, state, cameras, points, views)
    # Of the depth's noise, what a ray of z = 1 has along the normal.
    along = np.abs(np.sum(normals * (places - Ms[views, :3, 3]), axis=1)) / points[:, 2]
    sigma = evidence.noise.sigma(points[:, 2]) * np.clip(along, OBLIQUE, None)
    variance = np.square(np.maximum(sigma, NORMAL_FLOOR_M))
    ids = shape.patches.of(places / state.s, normals)
    shared = within_m**2 * np.maximum(1.0, np.bincount(ids)[ids] / config.shape.pieces)
    crowding = _crowding([v.point_area_px for v in evidence.views], config)[views]
    return Round(
        points=points, views=views, variance=variance, crowding=crowding + shared / variance,
        ids=ids, rims=outlines_of(shape, evidence, state, cameras, config),
    )  # fmt: skip


def linearised(
    shape: ScanShape, evidence: ScanEvidence, state: ScaleState, held: Round,
    limits: tuple[Array, float, float], config: ScaleConfig,
) -> tuple[System, Array, Array]:  # fmt: skip
    """Return the equations at a state, the surface's residuals (N,) and kernel weights (N,).

    Args:
        shape: the mesh.
        evidence: what was measured.
        state: where everything stands.
        held: what the round holds fixed.
        limits: where the real surface is believed to lie outside of the mesh (K,) [m], Tukey's
            cut-off [sigma], and the shape's 1-sigma [m].
        config: settings.
    """
    offsets, cut, width = limits
    cameras = state.cameras(claimed_cameras(evidence.views))
    seen, Ms = object_distances(shape, state, cameras, held.points, held.views)
    surface, kernels = surface_blocks(seen, Ms, held, limits)
    bodies = [
        surface,
        table_blocks(evidence, state, cameras, config),
        outline_blocks(evidence, state, cameras, held.rims, offsets, (cut, width)),
    ]
    system = assemble(bodies, PATCHES + len(offsets))
    add_contact(shape, state, offsets, (width, config), system)
    _add_priors(state, config, system)
    # Residuals hold what is believed of the offsets; the unknowns are to be the whole of them.
    system.a[:] += system.A[:, PATCHES:] @ offsets
    system.d[:] += np.einsum("vsi,s->vi", system.B[:, PATCHES:], offsets)
    return system, seen[1], kernels


def reduced(system: System) -> Reduced:
    """Return the equations with the views' errors integrated out."""
    return Reduced(*without_views(system))


def _crowding(areas_px: list[float], config: ScaleConfig) -> Array:
    """Return how many points (V,) share one piece of independent noise."""
    return np.maximum(1.0, config.samples.noise_area_px / np.array(areas_px))


def surface_blocks(
    seen: Seen, Ms: Array, held: Round, limits: tuple[Array, float, float]
) -> tuple[Blocks, Array]:
    """Return what the object's points say in every view, and their kernel weights (N,)."""
    (offsets, cut, width), (places, distances, normals) = limits, seen
    n, k = len(Ms), len(offsets)
    surface = (places, distances - offsets[held.ids], normals)
    frame = frame_of(Ms)
    weight = 1.0 / (held.variance * held.crowding)
    reach = cut * cut * (held.variance + width**2)
    H, b = np.zeros((n, BLOCK + 1, BLOCK + 1)), np.zeros((n, BLOCK + 1))
    kernels = np.empty(len(distances))
    add_blocks(surface, held.views, frame, (weight, reach), (H, b), kernels)
    coupling, information, right = np.zeros((n, BLOCK + 1, k)), np.zeros(k), np.zeros(k)
    add_offsets(
        surface, held.views, frame, kernels * weight, held.ids, (coupling, information, right)
    )
    further = np.array([BIAS.start, BIAS.start + 1, SIZE])
    return Blocks(
        H=symmetric(H), b=b, Ms=Ms, own=OBJECT, further=further,
        offsets=Offsets(
            coupling=coupling, information=information, right=right, at=PATCHES + np.arange(k)
        ),
    ), kernels  # fmt: skip


def frame_of(Ms: Array) -> tuple[Array, Array, Array]:
    """Return the centre of a body, and the cameras' places and directions in its frame."""
    return np.zeros(3), np.ascontiguousarray(Ms[:, :3, 3]), np.ascontiguousarray(Ms[:, :3, 2])


def table_blocks(
    evidence: ScanEvidence, state: ScaleState, cameras: Array, config: ScaleConfig
) -> Blocks:
    """Return what the table's points say in every view."""
    points, views = stacked([v.table for v in evidence.views])
    variance = np.square(evidence.noise.sigma(points[:, 2])) + TABLE_SIGMA_M**2
    variance *= _crowding([v.table_area_px for v in evidence.views], config)[views]
    Ms = se3.invert(state.table) @ cameras
    p = state.corrected(points, views)
    places = np.einsum("nij,nj->ni", Ms[views, :3, :3], p) + Ms[views, :3, 3]
    up = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    H, b = np.zeros((len(Ms), BLOCK, BLOCK)), np.zeros((len(Ms), BLOCK))
    add_blocks(
        (places, places[:, 2].copy(), up), views, frame_of(Ms),
        (1.0 / variance, TABLE_CUT**2 * variance), (H, b), np.empty(len(points)),
    )  # fmt: skip
    return Blocks(H=symmetric(H), b=b, Ms=Ms, own=TABLE_AT, rows=TABLE_ROWS)


def add_contact(
    shape: ScanShape, state: ScaleState, offsets: Array, rules: tuple[float, ScaleConfig],
    system: System,
) -> None:  # fmt: skip
    """Add that the lowest point of the real surface touches the table.

    Of a wrong shape the lowest point is low because it is wrong there, so contact says little.
    """
    shape_m, config = rules
    T_table_obj = se3.invert(state.table) @ state.poses[0]
    place = se3.transform(T_table_obj, state.s * shape.hull)
    k = int(np.argmin(place[:, 2]))
    (x, y, z), m, up = place[k], state.s * shape.hull[k], T_table_obj[2, :3]
    patch = int(shape.patches.of(shape.hull[k][None], -up[None])[0])
    J = np.zeros(len(system.a))
    J[OBJECT], J[SIZE], J[TABLE_AT] = [*np.cross(m, up), *up], m @ up, [-y, x, -1.0]
    # Where the real surface lies lower than the mesh, the mesh ends above the table.
    J[PATCHES + patch] = -1.0
    w = 1.0 / (config.prior.contact_m**2 + shape_m**2)
    system.A[:] += w * np.outer(J, J)
    system.a[:] -= w * J * (z - offsets[patch])


def _add_priors(state: ScaleState, config: ScaleConfig, system: System) -> None:
    """Add what is known of the cameras, of the depth's bias and of the outlines' offset."""
    priors, p = priors_of(config), config.prior
    # A body of revolution may turn as it likes: without this the equations were singular.
    add_prior(system, OBJECT[:3], np.zeros(3), np.eye(3) / FREE_TURN_RAD**2)
    add_prior(system, HAND_EYE, state.hand_eye, np.diag(1.0 / np.square(priors.hand_eye)))
    own = 1.0 / np.square(priors.arm)
    system.D[:] += np.diag(own)
    system.d[:] -= state.views * own
    said = state.bias - [1.0, 0.0]
    add_prior(system, BIAS, said, np.diag(1.0 / np.square([FIXED, p.bias_per_m])))
    add_prior(system, slice(RIM, RIM + 1), np.array([state.rim]), np.eye(1) / p.rim_px**2)
