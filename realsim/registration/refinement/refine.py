"""Objects, cameras, table and depth bias fitted together.

Forward kinematics and hand-eye leave every camera off by half a millimetre and a tenth of a degree:
1 to 2 px everywhere. The objects and the table, seen from all sides, say where the cameras were. It
minimises
    sum over points of all bodies   tukey(r^2 / (sigma^2 + misfit^2))
  + hand-eye twist, every view's twist, and the depth's bias, each against its prior
by Gauss-Newton with points assigned anew in every round. The views' prior sigmas are found from
the views themselves (expectation maximisation), since arms differ by a factor of twenty.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from realsim.arrays import Array, Mask
from realsim.errors import DegenerateError
from realsim.geometry import se3
from realsim.geometry.normal_equations import (
    Covariances,
    System,
    covariances,
    inverse,
    solve,
    symmetric,
    without_views,
)
from realsim.geometry.robust import mad_sigma
from realsim.geometry.seen_surface import seen_distances
from realsim.records import CameraIntrinsics, SupportPlane
from realsim.registration.body import Body
from realsim.registration.evidence import DepthNoise
from realsim.registration.refinement import priors
from realsim.registration.refinement.config import RefineConfig
from realsim.registration.refinement.equations import (
    BLOCK,
    LEAST_ALONG,
    OBJECTS,
    TABLE_AT,
    TABLE_ROWS,
    Blocks,
    State,
    add_blocks,
    assemble,
    moves_of_all,
    object_at,
    step_state,
)
from realsim.registration.refinement.flat import is_flat, step_term
from realsim.registration.refinement.points import (
    AllPoints,
    Owned,
    assign_views,
    exact_residuals,
    join_views,
    thin_share,
)
from realsim.registration.views import ViewPoints

SIDE_COS = 0.5
"""Steeper surface of a flat object is its side: its few points are half the table's."""
SMOOTH_WHOLE = 0.7
"""Share of the variance of smooth errors that all views have in common: set in the second lab."""
GROUPS = 8
"""Groups of views that are left out in turn."""


AREA_PX = 50.0
"""Pixels of one independent measurement at 1280 columns: 4 pi s^2 of noise correlated over
s = 2 px, the D405's matching window."""
AREA_WIDTH_PX = 1280
"""The image width at which `AREA_PX` holds; it shrinks with the square of the width."""
OBLIQUE = 0.3
"""Least cosine by which a ray's noise is projected onto the surface's normal."""
FLOOR_M = 1e-4
"""Least 1-sigma of a point along the normal [m]: the steps of the depth images."""
TABLE_FLAT_M = 2e-4
"""1-sigma of the table's flatness [m]."""
CUT_SIGMAS = 4.0
"""Tukey's cut-off [sigma of noise and misfit]."""
WIDEST_M = 0.003
"""First misfit that is tolerated [m]; it shrinks to what the residuals show."""
LEAST_MISFIT_M = 1e-4
"""Least misfit [m]: no mesh is better."""


def area_at(width_px: int) -> float:
    """Return the pixels that share one window's noise in an image of this width [px^2]."""
    return AREA_PX * (width_px / AREA_WIDTH_PX) ** 2


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Refined:
    """What the refinement found."""

    poses: Array
    """(K, 4, 4) T_world_obj."""
    cameras: Array
    """(V, 4, 4) T_world_cam."""
    plane: SupportPlane | None
    state: State
    covariance: Covariances
    """Covariance of objects (about their centres), hand-eye, table, bias and views."""
    misfit_m: Array
    """(K + 1,) what residuals of each body show beyond the noise [m]; the table's is last."""
    used: Array
    """(K + 1,) number of points that took part."""
    view_sigma: tuple[float, float]
    """1-sigma of the views' own errors as found [deg, mm]."""
    history: tuple[dict[str, float], ...]

    @property
    def hand_eye_mm_deg(self) -> tuple[float, float]:
        """How far all cameras were moved together [mm, deg]."""
        h = self.state.hand_eye
        return 1e3 * float(np.linalg.norm(h[3:])), float(np.degrees(np.linalg.norm(h[:3])))


@dataclass(frozen=True, eq=False, slots=True)
class _Task:
    """What stays the same in all rounds."""

    bodies: list[Body]
    claimed: Array
    views: tuple[ViewPoints, ...]
    points: AllPoints
    area_px: Array
    """(V,) pixels of one independent measurement."""
    hand: Mask
    """(V,) whether a view is of the camera in the hand."""
    config: RefineConfig
    thin: list[bool]


def refine(
    intrinsics: CameraIntrinsics,
    views: Sequence[ViewPoints],
    bodies: Sequence[Body],
    poses: Sequence[Array],
    plane: SupportPlane | None,
    noise: DepthNoise,
    config: RefineConfig | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Refined:
    """Return everything refined together.

    Args:
        intrinsics: the camera in the hand.
        views: trusted points of all views, with the cameras' claimed poses; a camera that stands
            still is one of them.
        bodies: the objects.
        poses: their T_world_obj (4, 4), right to about 3 mm and a few degrees.
        plane: the table; None = there is none.
        noise: of the depth of the camera in the hand.
        config: settings.
        progress: called with (rounds done, rounds).

    Raises:
        DegenerateError: no point lies on any object or on the table.
    """
    config = config or RefineConfig()
    task = _Task(
        list(bodies), np.stack([v.T_world_cam for v in views]), tuple(views),
        join_views(views, noise),
        np.array([area_at(v.intrinsics(intrinsics).width) for v in views]),
        np.array([v.fixed is None for v in views]), config,
        [thin_share(b, config.thin_cells) > config.thin_share for b in bodies],
    )  # fmt: skip
    of_view = priors.OF_VIEW if np.all(task.hand) else priors.OF_FIXED
    state = State(
        poses=np.stack(poses) if len(poses) else np.zeros((0, 4, 4)),
        T_world_table=None if plane is None else plane.T_world_table.copy(),
        hand_eye=np.zeros(6), views=np.zeros((len(views), of_view)),
        bias=np.array([config.bias.scale, config.bias.offset_per_m]),
        common=None if np.all(task.hand) else task.hand.astype(np.float64),
    )  # fmt: skip
    misfits = np.full(len(bodies) + 1, WIDEST_M)
    sigmas = priors.said_sigmas(config)
    history: list[dict[str, float]] = []
    system, blocks, used = None, list[Blocks](), np.zeros(len(bodies) + 1)
    for round_ in range(config.rounds):
        last = round_ == config.rounds - 1
        flat = _flat(task, state)
        own, table, near = assign_views(
            task.points, bodies, state, state.cameras(task.claimed), config.points,
            1.0 if last else config.early_share, flat,
        )  # fmt: skip
        if sum(len(o.points) for o in own) + len(table.points) < config.points.least_points:
            raise DegenerateError(
                f"the {len(views)} views hold {sum(len(o.points) for o in own)} points within "
                f"{1e3 * config.points.reach_m:.0f} mm of the objects and {len(table.points)} of "
                "the table: nothing to refine cameras with. Are the poses those of this scene?"
            )
        exact = round_ >= config.rounds - config.exact_rounds
        for _ in range(config.steps):
            blocks, misfits, used = _linearise(task, state, (own, table), misfits, exact)
            system = assemble(blocks, OBJECTS + 6 * len(own), of_view)
            priors.add_priors(system, state, task.views, config, sigmas)
            blur = config.blur_m[min(round_, len(config.blur_m) - 1)]
            for k, points in zip(flat, near, strict=True):
                _add_step(system, task, state, k, points, blur)
            state = step_state(state, task.bodies, *solve(system))
            sigmas = priors.learn_sigmas(system, state, task.hand, config, sigmas)
        history.append(_row(state, misfits, sigmas))
        if progress is not None:
            progress(round_ + 1, config.rounds)
    assert system is not None, "there is at least one round"
    beyond = _apart(system, blocks, task, state, sigmas)
    table_pose = state.T_world_table
    return Refined(
        poses=state.poses, cameras=state.cameras(task.claimed),
        plane=None if plane is None or table_pose is None
        else replace(plane, T_world_table=_rigid(table_pose)),
        state=state, covariance=covariances(system, beyond), misfit_m=misfits, used=used,
        view_sigma=(float(np.degrees(sigmas[0])), 1e3 * float(sigmas[1])), history=tuple(history),
    )  # fmt: skip


def _rigid(T: Array) -> Array:
    """Return the pose with its rotation exactly orthonormal."""
    U, _, Vt = np.linalg.svd(T[:3, :3])
    return se3.from_rt(U @ Vt, T[:3, 3])


def _row(state: State, misfits: Array, sigmas: Array) -> dict[str, float]:
    """Return one line of the history."""
    return {
        "hand_eye_mm": 1e3 * float(np.linalg.norm(state.hand_eye[3:])),
        "hand_eye_deg": float(np.degrees(np.linalg.norm(state.hand_eye[:3]))),
        "view_mm": 1e3 * float(sigmas[1]),
        "view_deg": float(np.degrees(sigmas[0])),
        "scale": float(state.bias[0]),
        "offset_per_m": float(state.bias[1]),
        "misfit_mm": 1e3 * float(np.median(misfits)),
    }


def _linearise(
    task: _Task, state: State, points: tuple[list[Owned], Owned], misfits: Array, exact: bool
) -> tuple[list[Blocks], Array, Array]:
    """Return what the points say at a state, the bodies' misfits, and points used."""
    own, table = points
    cameras = state.cameras(task.claimed)
    flat = _flat(task, state)
    blocks: list[Blocks] = []
    seen, used = misfits.copy(), np.zeros(len(own) + 1)
    for k, (body, mine) in enumerate(zip(task.bodies, own, strict=True)):
        T_obj_world = se3.invert(state.poses[k])
        Ms = T_obj_world @ cameras
        eyes = np.ascontiguousarray(Ms[:, :3, 3])
        p = state.corrected(mine.points, mine.views)
        if exact and task.thin[k]:
            surface = exact_residuals(body, p, mine.views, Ms, eyes)
        else:
            surface = seen_distances(body.field.lattice, 1.0, p, mine.views, (Ms, eyes), False)
        if k in flat and state.T_world_table is not None:
            up = T_obj_world[:3, :3] @ state.T_world_table[:3, 2]
            surface[1][np.abs(surface[2] @ up) < SIDE_COS] = np.nan
        center = body.center_obj
        Ms_centred = se3.from_translation(-center) @ Ms
        few = len(p) < task.config.points.least_points
        (H, b), seen[k], used[k] = _block_sums(
            task, (surface, mine, p), (center, eyes), Ms_centred, (float(misfits[k]), 0.0), few
        )
        blocks.append(Blocks(H=H, b=b, Ms=Ms_centred, own=object_at(k), common=state.common))
    if state.T_world_table is not None and len(table.points):
        Ms = se3.invert(state.T_world_table) @ cameras
        eyes = np.ascontiguousarray(Ms[:, :3, 3])
        p = state.corrected(table.points, table.views)
        M = Ms[table.views]
        places = np.einsum("nij,nj->ni", M[:, :3, :3], p) + M[:, :3, 3]
        up = np.tile(np.array([0.0, 0.0, 1.0]), (len(p), 1))
        (H, b), seen[-1], used[-1] = _block_sums(
            task, ((places, places[:, 2].copy(), up), table, p), (np.zeros(3), eyes), Ms,
            (float(misfits[-1]), TABLE_FLAT_M), False,
        )  # fmt: skip
        blocks.append(Blocks(H=H, b=b, Ms=Ms, own=TABLE_AT, rows=TABLE_ROWS, common=state.common))
    return blocks, seen, used


def _flat(task: _Task, state: State) -> list[int]:
    """Return which bodies lie on the table and rise hardly over it."""
    if state.T_world_table is None:
        return []
    T, most = se3.invert(state.T_world_table), task.config.flat_m
    found = enumerate(zip(task.bodies, state.poses, strict=True))
    return [k for k, (body, pose) in found if is_flat(body, T @ pose, most)]


def _add_step(
    system: System, task: _Task, state: State, k: int, near: Owned, blur_m: float
) -> None:
    """Add what the step at a flat body's outline says of its place on the table."""
    if state.T_world_table is None or len(near.points) < task.config.points.least_points:
        return
    T = se3.invert(state.T_world_table)
    Ms = T @ state.cameras(task.claimed)
    p = state.corrected(near.points, near.views)
    M = Ms[near.views]
    crowding = np.maximum(1.0, task.area_px[near.views] / near.area_px)
    sigmas = np.maximum(task.points.sigma(p[:, 2], near.views), FLOOR_M) * np.sqrt(crowding)
    places = np.einsum("nij,nj->ni", M[:, :3, :3], p) + M[:, :3, 3]
    H, b = step_term(task.bodies[k], T @ state.poses[k], places, M[:, :3, 3], sigmas, blur_m)
    at = object_at(k)
    system.A[np.ix_(at, at)] += H
    system.a[at] += b


def _block_sums(
    task: _Task,
    data: tuple[tuple[Array, Array, Array], Owned, Array],
    frame: tuple[Array, Array],
    Ms: Array,
    misfit: tuple[float, float],
    few: bool,
) -> tuple[tuple[Array, Array], float, int]:
    """Return the views' blocks H, b of one body, its misfit as seen, and how many points it had."""
    (places, distances, normals), mine, p = data
    n = len(Ms)
    H, b = np.zeros((n, BLOCK, BLOCK)), np.zeros((n, BLOCK))
    if few:
        return (H, b), misfit[0], 0
    rays = places - frame[1][mine.views]
    along = np.sum(normals * rays, axis=1)
    cosine = np.abs(along) / np.linalg.norm(rays, axis=1)
    # Weighed by the depth of the surface: by their own, points too near would count for more.
    steep = cosine > LEAST_ALONG
    surface_z = p[:, 2] * (1.0 - np.where(steep, distances / np.where(steep, along, 1.0), 0.0))
    sigma = task.points.sigma(surface_z, mine.views) * np.clip(cosine, OBLIQUE, None)
    variance = np.square(np.maximum(sigma, FLOOR_M)) + misfit[1] ** 2
    crowding = np.maximum(1.0, task.area_px[mine.views] / mine.area_px)
    weight = 1.0 / (variance * crowding + misfit[0] ** 2)
    reach = CUT_SIGMAS**2 * (variance + misfit[0] ** 2)
    kernels = np.empty(len(p))
    axes = np.ascontiguousarray(Ms[:, :3, 2])
    add_blocks(
        (places, distances, normals), mine.views, (*frame, axes), (weight, reach), (H, b), kernels
    )
    seen = _misfit(distances, variance)
    return (symmetric(H), b), min(seen, WIDEST_M), int(np.count_nonzero(kernels))


def _misfit(distances: Array, variance: Array) -> float:
    """Return by how much residuals are wider than their noise [m], robustly."""
    known = np.isfinite(distances)
    if np.count_nonzero(known) < 2:
        return WIDEST_M
    spread = mad_sigma(distances[known])
    beyond = spread**2 - float(np.median(variance[known]))
    return max(LEAST_MISFIT_M, float(np.sqrt(max(beyond, 0.0))))


def _apart(
    system: System, blocks: Sequence[Blocks], task: _Task, state: State, sigmas: Array
) -> Array:
    """Return by how much groups of views disagree on the shared unknowns, as a covariance (S, S).

    Errors that neighbouring views share (a smooth error of the arm, a lens that does not fit) do
    not average out as the equations take for granted. A jackknife over groups of neighbours sees:
    J = (n - 1) / n sum_g d_g d_g^T with d_g the solution without group g less its mean (Efron,
    1982), each solved from the same equations.
    """
    A, a = without_views(system)
    W = priors.view_precisions(task.views, sigmas, task.config)
    largest = np.zeros_like(A)
    # Cameras that stand still are no neighbours of any, and each has its own prior.
    hand = np.flatnonzero(task.hand)
    # By how high they look down, and by when they were taken.
    for order in (hand[np.argsort(-task.claimed[hand, 2, 2])], hand):
        found = []
        for g in np.array_split(order, min(GROUPS, len(order))):
            part = assemble(
                [replace(b, H=b.H[g], b=b.b[g], Ms=b.Ms[g], common=None) for b in blocks],
                len(a), W.shape[1],
            )  # fmt: skip
            part.D[:] += W[g]
            part.d[:] -= np.einsum("vi,vij->vj", state.views[g], W[g])
            A_g, a_g = without_views(part)
            found.append(inverse(A - A_g) @ (a - a_g))
        off = np.array(found) - np.mean(found, axis=0)
        J = (len(off) - 1) / len(off) * off.T @ off
        if np.trace(J[OBJECTS:, OBJECTS:]) > np.trace(largest[OBJECTS:, OBJECTS:]):
            largest = J
    move = moves_of_all(task.bodies, state)
    smooth = SMOOTH_WHOLE * _smooth_share(task, state, sigmas)
    shared = smooth * np.repeat(np.square(sigmas[:2]), 3)
    return largest + move @ np.diag(shared) @ move.T


def _smooth_share(task: _Task, state: State, sigmas: Array) -> float:
    """Return how alike the errors of the nearest cameras are, 0 to 1.

    An arm's errors are mostly smooth. What all views have of them moves the scene as a whole, which
    no view contradicts; how much that may be shows in neighbours, which are alike.
    """
    at = task.claimed[task.hand, :3, 3]
    gaps = np.linalg.norm(at[:, None] - at[None], axis=-1)
    np.fill_diagonal(gaps, np.inf)
    x = state.views[task.hand, :6] / np.repeat(sigmas[:2], 3)
    return float(np.clip(np.sum(x * x[gaps.argmin(axis=1)]) / max(np.sum(x * x), 1e-12), 0.0, 1.0))
