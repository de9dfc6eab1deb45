"""The solver's Gauss-Newton without its overhead: hundreds of hypotheses are fitted per scene.

The equations are `realsim.registration.solver`'s own; only the loop around them is compiled, and it
ends sooner. A step turns about the box centre and shifts it: T <- T C exp(omega) C^-1, then v.

When two poses of a shape are the same: the distance between them, whatever its symmetries.

    d(A, B) = min over g of max over v of |A^-1 B v - g v|,  v the corners of the box.

g is a discrete symmetry S, or a turn about a continuous axis after it. The turn is not sampled: it
is the twist of the rotation of A^-1 B S^-1 about the axis. Two axes that cross make a ball, and
then only its middle counts.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from realsim.arrays import Array, Array32, Int64
from realsim.compiled import njit
from realsim.geometry import se3
from realsim.geometry.distance_field import sample
from realsim.geometry.mesh import box_corners
from realsim.geometry.point_loops import move_back
from realsim.records import ObjectModel, SupportPlane
from realsim.registration.body import Body
from realsim.registration.evidence import (
    Cloud,
    DepthNoise,
    average_cloud,
    join_clouds,
    without_table,
)
from realsim.registration.search.scoring import Canvas, Render, Score, render, score
from realsim.registration.solver import (
    DAMPING,
    LEAST_POINTS,
    SIGMA_FLOOR_M,
    Stage,
    accumulate_points,
)
from realsim.registration.views import ViewPoints, world_cloud

PARALLEL = 0.99
"""Cosine above which two continuous axes are one."""
CHUNK = 4096
"""Pairs of pose and symmetry that are held at once."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Sameness:
    """What of a shape matters for the comparison of two poses."""

    corners: Array
    """(8, 3) of the box [m]."""
    symmetries: Array
    """(S, 4, 4) discrete ones, the identity first."""
    axis: tuple[Array, Array] | None
    """Direction (3,) and point (3,) [m] of the continuous axis, if there is one."""
    ball_center: Array | None
    """(3,) the middle of a shape that every rotation leaves as it is, or None."""

    def distances(self, T: Array, others: Array) -> Array:
        """Return the distance (N,) [m] of a pose (4, 4) to others (N, 4, 4)."""
        D = se3.invert(T) @ others
        if self.ball_center is not None:
            return np.linalg.norm(se3.transform(D, self.ball_center[None])[:, 0] - self.ball_center,
                                  axis=-1)  # fmt: skip
        step = max(1, CHUNK // len(self.symmetries))
        parts = [self._distances(D[i : i + step]) for i in range(0, len(D), step)]
        return np.concatenate(parts) if parts else np.zeros(0)

    def distance(self, T_a: Array, T_b: Array) -> float:
        """Return the distance [m] of two poses (4, 4)."""
        return float(self.distances(T_a, T_b[None])[0])

    def angle_deg(self, R_a: Array, R_b: Array) -> float:
        """Return the smallest turn [deg] that makes one rotation (3, 3) the other."""
        if self.ball_center is not None:
            return 0.0
        D = np.eye(4)
        D[:3, :3] = R_a.T @ R_b
        G = self._nearest(D[None])[0]
        turns = np.swapaxes(G[:, :3, :3], -1, -2) @ D[:3, :3]
        return float(np.degrees(np.min(se3.angle(turns))))

    def _nearest(self, D: Array) -> Array:
        """Return the symmetries (N, S, 4, 4) that may be nearest to motions D (N, 4, 4)."""
        S = np.broadcast_to(self.symmetries, (len(D), *self.symmetries.shape))
        if self.axis is None:
            return S
        direction, point = self.axis
        R = D[:, None, :3, :3] @ np.swapaxes(self.symmetries[:, :3, :3], -1, -2)
        # tan(twist / 2) = (v . a) / w of the quaternion, both times 4 w or of the rotation's parts:
        # sin and cos of the twist come from a . (R - R^T) and from the trace without a's part.
        skew = np.stack([R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0],
                         R[..., 1, 0] - R[..., 0, 1]], axis=-1)  # fmt: skip
        along = np.einsum("i,...ij,j->...", direction, R, direction)
        twist = np.arctan2(skew @ direction, np.trace(R, axis1=-2, axis2=-1) - along)
        turn = se3.exp_so3(twist[..., None] * direction)
        return se3.from_rt(turn, point - turn @ point) @ S

    def _distances(self, D: Array) -> Array:
        """Return the distance (N,) of motions D (N, 4, 4) from the nearest symmetry."""
        off = D[:, None] - self._nearest(D)
        moved = self.corners @ np.swapaxes(off[..., :3, :3], -1, -2) + off[..., None, :3, 3]
        return np.sqrt(np.einsum("nsvi,nsvi->nsv", moved, moved).max(-1).min(-1))


def make_sameness(model: ObjectModel) -> Sameness:
    """Return what of a model matters for the comparison of two poses."""
    axes = [(np.asarray(a, np.float64) / np.linalg.norm(a), np.asarray(p, np.float64))
            for a, p in model.symmetry_axes]  # fmt: skip
    ball = len(axes) > 1 and any(abs(a @ axes[0][0]) < PARALLEL for a, _ in axes[1:])
    return Sameness(
        corners=box_corners(*model.mesh.bounds),
        symmetries=np.asarray(model.symmetries, dtype=np.float64),
        axis=axes[0] if axes and not ball else None,
        ball_center=axes[0][1] if ball else None,
    )


def distinct(sameness: Sameness, Ts: Sequence[Array], apart_m: float) -> list[int]:
    """Return the places of the poses that differ: of those within `apart_m`, the first."""
    kept: list[int] = []
    for n, T in enumerate(Ts):
        known = np.array([Ts[k] for k in kept]).reshape(-1, 4, 4)
        if not kept or sameness.distances(T, known).min() > apart_m:
            kept.append(n)
    return kept


def quick_fit(body: Body, cloud: Cloud, T_world_obj: Array, stages: tuple[Stage, ...]) -> Array:
    """Return the pose (4, 4) at which the measured points lie on the model's surface.

    Args:
        body: the object.
        cloud: measured points near it.
        T_world_obj: (4, 4) where to start.
        stages: the annealing.
    """
    rules = np.array([[s.kernel, s.cap_m, s.gated, s.steps] for s in stages], np.float64)
    sigmas = np.sqrt(np.square(cloud.sigmas) + SIGMA_FLOOR_M**2)
    T = _fit(
        body.field.lattice,
        np.array(T_world_obj, dtype=np.float64),
        (cloud.points, cloud.towards, sigmas),
        rules,
        (body.center_obj, body.radius_m),
        (DAMPING, CONVERGED_M),
    )
    return se3.check_rigid(T, "the fitted pose")


@njit
def _fit(
    lattice: tuple[Array32, Array, float],
    T: Array,
    cloud: tuple[Array, Array, Array],
    rules: Array,
    shape: tuple[Array, float],
    limits: tuple[float, float],
) -> Array:
    """Return T after all stages; rules (K, 4) are kernel, cap [m], whether gated, and steps."""
    center, radius = shape
    damping, converged = limits
    scale = np.array([radius, radius, radius, 1.0, 1.0, 1.0])
    for k in range(len(rules)):
        for _ in range(int(rules[k, 3])):
            H, b = np.zeros((6, 6)), np.zeros(6)
            weight, _square, _kernels, used = accumulate_points(
                lattice, T, cloud, (rules[k, 0], rules[k, 1], rules[k, 2] > 0.0), center, (H, b)
            )
            if used < LEAST_POINTS:
                break
            for i in range(6):
                b[i] /= scale[i]
                for j in range(i, 6):
                    H[i, j] /= scale[i] * scale[j]
                H[i, i] += damping * damping * weight
            x = _solved(H, b)
            for i in range(6):
                x[i] /= scale[i]
            _moved(T, center, x)
            turn = np.sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2])
            if turn * radius + np.sqrt(x[3] * x[3] + x[4] * x[4] + x[5] * x[5]) < converged:
                break
    return T


@njit
def _solved(H: Array, b: Array) -> Array:
    """Return H^-1 b by Cholesky's method; only the upper half of H (6, 6) is read."""
    n = len(b)
    U = np.zeros((n, n))
    for i in range(n):
        d = H[i, i]
        for k in range(i):
            d -= U[k, i] * U[k, i]
        U[i, i] = np.sqrt(max(d, 1e-300))
        for j in range(i + 1, n):
            s = H[i, j]
            for k in range(i):
                s -= U[k, i] * U[k, j]
            U[i, j] = s / U[i, i]
    x = b.copy()
    for i in range(n):
        for k in range(i):
            x[i] -= U[k, i] * x[k]
        x[i] /= U[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            x[i] -= U[i, k] * x[k]
        x[i] /= U[i, i]
    return x


@njit
def _moved(T: Array, center: Array, x: Array) -> None:
    """Turn T in place about the object's centre by x[:3] and shift it by x[3:], object's axes."""
    angle = np.sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2])
    E = np.eye(3)
    if angle > 1e-12:
        a, b, c = x[0] / angle, x[1] / angle, x[2] / angle
        s, v = np.sin(angle), 1.0 - np.cos(angle)
        E[0, 0], E[0, 1], E[0, 2] = 1 - v * (b * b + c * c), v * a * b - s * c, v * a * c + s * b
        E[1, 0], E[1, 1], E[1, 2] = v * a * b + s * c, 1 - v * (a * a + c * c), v * b * c - s * a
        E[2, 0], E[2, 1], E[2, 2] = v * a * c - s * b, v * b * c + s * a, 1 - v * (a * a + b * b)
    R = T[:3, :3].copy()
    middle = np.empty(3)
    for i in range(3):
        middle[i] = T[i, 3]
        for j in range(3):
            middle[i] += R[i, j] * (center[j] + x[3 + j])
    for i in range(3):
        for j in range(3):
            T[i, j] = R[i, 0] * E[0, j] + R[i, 1] * E[1, j] + R[i, 2] * E[2, j]
        T[i, 3] = middle[i] - (T[i, 0] * center[0] + T[i, 1] * center[1] + T[i, 2] * center[2])


COARSE_VOXEL_M = 0.003
"""Edge of the voxels on which all hypotheses are fitted [m]."""
FINE_VOXEL_M = 0.002
"""Edge of the voxels on which the best are refined [m]."""
ABOVE_TABLE_M = 0.002
"""Points lower than this over the table are the table's [m]."""
COARSE_MARGIN_M = 0.010
"""Points within this of the hypothesis are fitted [m]: matching is right to a cell or two."""
FINE_MARGIN_M = 0.006
"""The same for the refinement [m]."""
COARSE_POINTS = 700
"""At most so many points fit a hypothesis: the cost is 60 ns each and step, and
1500 find nothing more."""
FINE_POINTS = 6000
"""At most so many points refine one."""
SAME_M = 0.002
"""Poses nearer than this, modulo symmetry, are one hypothesis [m]."""
REFINED = 5
"""Number of an object's best hypotheses that are refined on the fine points."""
COARSE = (
    Stage(kernel=25.0, cap_m=0.015, steps=8, gated=False),
    Stage(kernel=12.0, cap_m=0.0072, steps=8, gated=True),
    Stage(kernel=6.0, cap_m=0.0036, steps=8, gated=True),
)
"""From a hypothesis."""
FINE = (
    Stage(kernel=6.0, cap_m=0.005, steps=8, gated=True),
    Stage(kernel=4.0, cap_m=0.003, steps=8, gated=True),
)
"""From a fitted pose."""
CONVERGED_M = 1e-5
"""A step that moves no point of the object further ends a stage of a fit [m]: the joint
refinement comes later."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Sought:
    """A model with everything that is derived from it."""

    body: Body
    sameness: Sameness

    @property
    def obj_id(self) -> int:
        """The model's id."""
        return self.body.model.obj_id

    @cached_property
    def reach_m(self) -> float:
        """Radius of the ball about the box centre that holds the body [m]."""
        vertices = self.body.model.mesh.vertices
        return float(np.sqrt(np.max(np.sum(np.square(vertices - self.body.center_obj), 1))))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Fused:
    """The points of all views above the table, averaged."""

    coarse: Cloud
    fine: Cloud


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Candidate:
    """A fitted pose, rendered once."""

    obj_id: int
    T_world_obj: Array
    """(4, 4)."""
    rendered: Render
    alone: Score
    """What it gains over the bare table, or over the objects that were sure when it was made."""
    source: str


def fuse(views: Sequence[ViewPoints], noise: DepthNoise, plane: SupportPlane) -> Fused:
    """Return the views' points above the table, averaged on voxels of the table's frame."""
    above = [without_table(world_cloud([v], noise), plane, ABOVE_TABLE_M) for v in views]
    T = plane.T_world_table
    fine = average_cloud(join_clouds(above), T, FINE_VOXEL_M)
    return Fused(coarse=average_cloud(fine, T, COARSE_VOXEL_M), fine=fine)


def nearby(cloud: Cloud, sought: Sought, T_world_obj: Array, margin_m: float, most: int) -> Cloud:
    """Return the points within `margin_m` of a body's surface, evenly thinned to about `most`."""
    body = sought.body
    limit = (sought.reach_m + margin_m, margin_m)
    lattice = body.field.lattice
    where = _near(cloud.points, T_world_obj, body.center(T_world_obj), limit, lattice)
    if len(where) > most:
        where = where[np.linspace(0, len(where) - 1, most).astype(np.int64)]
    return cloud.select(where)


@njit
def _near(
    points: Array,
    T: Array,
    center: Array,
    limit: tuple[float, float],
    lattice: tuple[Array32, Array, float],
) -> Int64:
    """Return the indices of points within the radius of the centre and near the surface."""
    grid, origin, cell = lattice
    radius, margin = limit
    out = np.empty(len(points), np.int64)
    n = 0
    for m in range(len(points)):
        a, b, c = points[m, 0] - center[0], points[m, 1] - center[1], points[m, 2] - center[2]
        if a * a + b * b + c * c > radius * radius:
            continue
        x, y, z = move_back(T, points[m, 0], points[m, 1], points[m, 2])
        if abs(sample(grid, origin, cell, x, y, z)[0]) < margin:
            out[n] = m
            n += 1
    return out[:n].copy()


def candidate(
    sought: Sought, canvas: Canvas, T_world_obj: Array, source: str, buffer: Array32 | None = None
) -> Candidate:
    """Return a pose rendered and scored against a buffer; None = the bare table."""
    rendered = render(canvas, sought.body, T_world_obj)
    return Candidate(
        obj_id=sought.obj_id,
        T_world_obj=T_world_obj,
        rendered=rendered,
        alone=score(canvas, rendered, canvas.table if buffer is None else buffer),
        source=source,
    )


def candidates(
    sought: Sought,
    fused: Fused,
    canvas: Canvas,
    starts: Sequence[tuple[Array, str]],
    buffer: Array32 | None = None,
) -> list[Candidate]:
    """Return the distinct poses that the starts lead to, the best first.

    Args:
        sought: the model.
        fused: the measured points.
        canvas: where poses are rendered.
        starts: poses (4, 4) and where they come from.
        buffer: what is there already; None = the bare table.
    """
    Ts: list[Array] = []
    for T, _ in starts:
        points = nearby(fused.coarse, sought, T, COARSE_MARGIN_M, COARSE_POINTS)
        Ts.append(quick_fit(sought.body, points, T, COARSE))
    made = [
        candidate(sought, canvas, Ts[n], starts[n][1], buffer)
        for n in distinct(sought.sameness, Ts, SAME_M)
    ]
    made.sort(key=lambda c: -c.alone.gain)
    best = [_refined(sought, fused, canvas, c, buffer) for c in made[:REFINED]]
    made = sorted([*best, *made[REFINED:]], key=lambda c: -c.alone.gain)
    kept = distinct(sought.sameness, [c.T_world_obj for c in made], SAME_M)
    return [made[n] for n in kept]


def _refined(
    sought: Sought, fused: Fused, canvas: Canvas, start: Candidate, buffer: Array32 | None
) -> Candidate:
    """Return a candidate refined on the fine points, or as it was if that explains less."""
    points = nearby(fused.fine, sought, start.T_world_obj, FINE_MARGIN_M, FINE_POINTS)
    T = quick_fit(sought.body, points, start.T_world_obj, FINE)
    finer = candidate(sought, canvas, T, start.source, buffer)
    return finer if finer.alone.gain >= start.alone.gain else start


def inside_share(a: Sought, T_a: Array, b: Sought, T_b: Array, depth_m: float) -> float:
    """Return the share of either object's surface that lies deeper than this in the other."""
    off = np.linalg.norm(a.body.center(T_a) - b.body.center(T_b))
    if off > a.reach_m + b.reach_m - depth_m:
        return 0.0
    shares = [
        np.mean(two.body.field.distance(one.body.samples, se3.invert(T_two) @ T_one) < -depth_m)
        for one, T_one, two, T_two in ((a, T_a, b, T_b), (b, T_b, a, T_a))
    ]
    return float(max(shares))
