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

from realsim.arrays import Array
from realsim.errors import DegenerateError
from realsim.geometry import se3
from realsim.geometry.normal_equations import (
    Covariances,
    System,
    add_prior,
    covariances,
    solve,
    symmetric,
)
from realsim.geometry.robust import mad_sigma
from realsim.geometry.seen_surface import seen_distances
from realsim.records import CameraIntrinsics, SupportPlane
from realsim.registration.body import Body
from realsim.registration.evidence import DepthNoise
from realsim.registration.refinement.config import NoiseConfig, RefineConfig
from realsim.registration.refinement.equations import (
    BIAS,
    BLOCK,
    HAND_EYE,
    LEAST_ALONG,
    OBJECTS,
    TABLE_AT,
    TABLE_ROWS,
    Blocks,
    State,
    add_blocks,
    assemble,
    object_at,
    step_state,
)
from realsim.registration.refinement.points import (
    Owned,
    assign_views,
    exact_residuals,
    join_views,
    thin_share,
)
from realsim.registration.views import ViewPoints

LEAST_SIGMA = (np.radians(1e-3), 1e-5)
"""Least prior 1-sigma of a turn [rad] and a shift [m]: nothing is perfect."""
FIXED = 1e-9
"""1-sigma of an unknown that is held [its unit]."""


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
    noise: DepthNoise
    area_px: float
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
        intrinsics: the camera.
        views: trusted points of all views, with the cameras' claimed poses.
        bodies: the objects.
        poses: their T_world_obj (4, 4), right to about 3 mm and a few degrees.
        plane: the table; None = there is none.
        noise: of the depth.
        config: see there.
        progress: called with (rounds done, rounds).

    Raises:
        DegenerateError: no point lies on any object or on the table.
    """
    config = config or RefineConfig()
    width = config.noise.area_width_px
    task = _Task(
        list(bodies), np.stack([v.T_world_cam for v in views]), tuple(views), noise,
        config.noise.area_px * (intrinsics.width / width) ** 2, config,
        [thin_share(b, config.thin_cells) > config.thin_share for b in bodies],
    )  # fmt: skip
    state = State(
        poses=np.stack(poses) if len(poses) else np.zeros((0, 4, 4)),
        T_world_table=None if plane is None else plane.T_world_table.copy(),
        hand_eye=np.zeros(6), views=np.zeros((len(views), 6)),
        bias=np.array([config.bias.scale, config.bias.offset_per_m]),
    )  # fmt: skip
    everything = join_views(views)
    misfits = np.full(len(bodies) + 1, config.noise.widest_m)
    sigmas = np.array([np.radians(config.prior.view_deg), config.prior.view_mm / 1e3])
    history: list[dict[str, float]] = []
    system, used = None, np.zeros(len(bodies) + 1)
    for round_ in range(config.rounds):
        last = round_ == config.rounds - 1
        own, table = assign_views(
            everything, noise, bodies, state, state.cameras(task.claimed), config.points,
            1.0 if last else config.early_share,
        )  # fmt: skip
        if sum(len(o.points) for o in own) + len(table.points) < config.points.least_points:
            raise DegenerateError(
                f"the {len(views)} views hold {sum(len(o.points) for o in own)} points within "
                f"{1e3 * config.points.reach_m:.0f} mm of the objects and {len(table.points)} of "
                "the table: nothing to refine cameras with. Are the poses those of this scene?"
            )
        exact = round_ >= config.rounds - config.exact_rounds
        for _ in range(config.steps):
            system, misfits, used = _linearise(task, state, (own, table), misfits, exact)
            _add_priors(system, task, state, sigmas)
            state = step_state(state, task.bodies, *solve(system))
            sigmas = _learn_sigmas(system, state, config, sigmas)
        history.append(_row(state, misfits, sigmas))
        if progress is not None:
            progress(round_ + 1, config.rounds)
    assert system is not None, "there is at least one round"
    table_pose = state.T_world_table
    return Refined(
        poses=state.poses, cameras=state.cameras(task.claimed),
        plane=None if plane is None or table_pose is None
        else replace(plane, T_world_table=_rigid(table_pose)),
        state=state, covariance=covariances(system), misfit_m=misfits, used=used,
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
) -> tuple[System, Array, Array]:
    """Return the equations at a state without priors, the bodies' misfits, and points used."""
    own, table = points
    cameras = state.cameras(task.claimed)
    blocks: list[Blocks] = []
    seen, used = misfits.copy(), np.zeros(len(own) + 1)
    for k, (body, mine) in enumerate(zip(task.bodies, own, strict=True)):
        T_obj_world = se3.invert(state.poses[k])
        Ms = T_obj_world @ cameras
        eyes = np.ascontiguousarray(Ms[:, :3, 3])
        p = state.corrected(mine.points)
        if exact and task.thin[k]:
            surface = exact_residuals(body, p, mine.views, Ms, eyes)
        else:
            surface = seen_distances(body.field.lattice, 1.0, p, mine.views, (Ms, eyes), False)
        center = body.center_obj
        Ms_centred = se3.from_translation(-center) @ Ms
        few = len(p) < task.config.points.least_points
        (H, b), seen[k], used[k] = _block_sums(
            task, (surface, mine, p), (center, eyes), Ms_centred, (float(misfits[k]), 0.0), few
        )
        blocks.append(Blocks(H=H, b=b, Ms=Ms_centred, own=object_at(k)))
    if state.T_world_table is not None and len(table.points):
        Ms = se3.invert(state.T_world_table) @ cameras
        eyes = np.ascontiguousarray(Ms[:, :3, 3])
        p = state.corrected(table.points)
        M = Ms[table.views]
        places = np.einsum("nij,nj->ni", M[:, :3, :3], p) + M[:, :3, 3]
        up = np.tile(np.array([0.0, 0.0, 1.0]), (len(p), 1))
        (H, b), seen[-1], used[-1] = _block_sums(
            task, ((places, places[:, 2].copy(), up), table, p), (np.zeros(3), eyes), Ms,
            (float(misfits[-1]), task.config.noise.table_flat_m), False,
        )  # fmt: skip
        blocks.append(Blocks(H=H, b=b, Ms=Ms, own=TABLE_AT, rows=TABLE_ROWS))
    return assemble(blocks, OBJECTS + 6 * len(own)), seen, used


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
    noise = task.config.noise
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
    sigma = task.noise.sigma(surface_z) * np.clip(cosine, noise.oblique, None)
    variance = np.square(np.maximum(sigma, noise.floor_m)) + misfit[1] ** 2
    crowding = np.maximum(1.0, task.area_px / mine.area_px)
    weight = 1.0 / (variance * crowding + misfit[0] ** 2)
    reach = noise.cut_sigmas**2 * (variance + misfit[0] ** 2)
    kernels = np.empty(len(p))
    axes = np.ascontiguousarray(Ms[:, :3, 2])
    add_blocks(
        (places, distances, normals), mine.views, (*frame, axes), (weight, reach), (H, b), kernels
    )
    seen = _misfit(distances, variance, noise)
    return (symmetric(H), b), min(seen, noise.widest_m), int(np.count_nonzero(kernels))


def _misfit(distances: Array, variance: Array, noise: NoiseConfig) -> float:
    """Return by how much residuals are wider than their noise [m], robustly."""
    known = np.isfinite(distances)
    if np.count_nonzero(known) < 2:
        return noise.widest_m
    spread = mad_sigma(distances[known])
    beyond = spread**2 - float(np.median(variance[known]))
    return max(noise.least_misfit_m, float(np.sqrt(max(beyond, 0.0))))


def _add_priors(system: System, task: _Task, state: State, view_sigmas: Array) -> None:
    """Add what is known of hand-eye, views, bias and table, and hold what nothing says."""
    config = task.config
    p = config.prior
    hand = np.repeat([np.radians(p.hand_eye_deg), p.hand_eye_mm / 1e3], 3)
    add_prior(system, HAND_EYE, state.hand_eye, np.diag(1.0 / np.square(hand)))
    own = np.diag(1.0 / np.square(np.repeat(np.maximum(view_sigmas, LEAST_SIGMA), 3)))
    system.D[:] += own
    system.d[:] -= state.views @ own
    C = config.bias.covariance
    if not np.any(C):
        C = np.diag([config.unmeasured_scale**2, config.unmeasured_offset_per_m**2])
    W: Array = np.asarray(np.linalg.inv(C), np.float64) if config.fit_bias else np.eye(2) / FIXED**2
    said = np.array([config.bias.scale, config.bias.offset_per_m])
    add_prior(system, BIAS, state.bias - said, W)
    free = 1.0 / np.radians(config.free_turn_deg) ** 2
    for k in range(len(task.bodies)):
        turn, shift = np.split(object_at(k), 2)
        system.A[turn, turn] += free
        # An object without points stays where it is.
        system.A[shift, shift] += 1.0
    system.A[TABLE_AT, TABLE_AT] += 1.0


def _learn_sigmas(system: System, state: State, config: RefineConfig, sigmas: Array) -> Array:
    """Return the 1-sigma of the views' turns and shifts [rad, m]: one step of EM."""
    p = config.prior
    if not p.learn_views or len(state.views) < p.learn_from:
        return sigmas
    C = covariances(system).views
    spread = np.square(state.views) + np.diagonal(C, axis1=1, axis2=2)
    found = np.sqrt([spread[:, :3].mean(), spread[:, 3:].mean()])
    said = np.array([np.radians(p.view_deg), p.view_mm / 1e3])
    return np.clip(found, p.learn_factor[0] * said, p.learn_factor[1] * said)
