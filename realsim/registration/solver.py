"""Robust Gauss-Newton of one object's pose on the signed distance field of its mesh.

Residual of a measured point p_w:   r = phi(T_world_obj^-1 p_w), phi the signed distance.
Perturbation T <- T exp(xi) about the centre c of the object's box, xi = [omega, v]:
    dr = -(g x' ) . xi  with  g = grad phi,  dr/d omega = -(q x g), dr/d v = -g,  q = p_obj - c.
Weights: 1 / sigma^2 times Tukey's (1 - (r / (k sigma))^2)^2, k annealed from wide to narrow.
Free space: a model sample that lies in front of the measured surface (where the camera looked
through) is drawn back along its normal; without it a model may grow out of what was seen.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from realsim.arrays import Array, Array32
from realsim.compiled import njit
from realsim.geometry import se3
from realsim.geometry.distance_field import sample
from realsim.geometry.normal_equations import add_row
from realsim.geometry.point_loops import move, move_back, pixel, turn, turn_back
from realsim.geometry.robust import tukey
from realsim.geometry.seen_surface import GATE_COS, follow_to_camera
from realsim.registration.body import Body
from realsim.registration.evidence import Cloud

LEAST_POINTS = 6
"""Fewer points than unknowns determine nothing: the pose is left where it is."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Stage:
    """One stage of the annealing."""

    kernel: float
    """Cut-off of Tukey's kernel in units of a point's sigma."""
    cap_m: float
    """Greatest cut-off [m]: noisy cameras must not see the neighbour."""
    steps: int
    """Greatest number of steps."""
    gated: bool
    """Whether a point counts only towards surfaces that face the camera that saw it (thin walls);
    costs a little and matters once the pose is right to about a wall."""


SIGMA_FLOOR_M = 0.0006
"""Least 1-sigma of a point: camera poses, mesh and grid are off by as much."""
COARSE = (
    Stage(kernel=25.0, cap_m=0.030, steps=8, gated=False),
    Stage(kernel=12.0, cap_m=0.015, steps=8, gated=True),
    Stage(kernel=6.0, cap_m=0.010, steps=8, gated=True),
)
"""From a rough start: 15, 7 and 3.6 mm for a quiet camera (facts of simulated benches)."""
FINE = (
    Stage(kernel=12.0, cap_m=0.012, steps=6, gated=True),
    Stage(kernel=6.0, cap_m=0.008, steps=12, gated=True),
)
"""From a pose that is right to some millimetres."""
DAMPING = 0.04
"""Levenberg: sensitivities (root mean square cosine) below this are not moved along."""
FREE_SPACE_WEIGHT = 0.3
"""Weight of one violating model sample relative to one measured point."""
FREE_SPACE_TOLERANCE_M = 0.003
"""A sample must lie this (and 1.5 sigma_z) in front of the measurement to violate it."""
CONVERGED_M = 2e-6
"""A step that moves no point of the object further ends a stage."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class FreeSpace:
    """The depth images against which model samples are checked."""

    depths: Array32
    """(F, H, W) [m]; 0 = none."""
    Ts_cam_world: Array
    """(F, 4, 4)."""
    camera: Array
    """(12,) fx fy cx cy and the eight distortion terms."""
    noise: tuple[float, float]
    """Noise per m [1/m] and least sigma_z [m]."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class PoseFit:
    """Where the solver ended and what it saw there."""

    T_world_obj: Array
    """(4, 4)."""
    information: Array
    """(6, 6) J^T W J of the last step, about the box centre, rotation first [1/rad^2, 1/m^2]."""
    weight: float
    """Sum of the points' weights (of 1 / sigma^2 [1/m^2])."""
    variance: float
    """Weighted mean of (r / sigma)^2: 1 = residuals as the noise model says."""
    points: int
    """Points with a weight above zero."""
    offered: int
    """Points offered."""
    steps: int
    """Steps taken."""
    history_mm: tuple[float, ...] = field(default=())
    """RMS residual at the end of every stage [mm]."""

    def at(self, T_world_obj: Array) -> "PoseFit":
        """Return the fit's figures with another pose (4, 4)."""
        return replace(self, T_world_obj=T_world_obj)


@njit
def accumulate_points(
    lattice: tuple[Array32, Array, float],
    T: Array,
    cloud: tuple[Array, Array, Array],
    limits: tuple[float, float, bool],
    center: Array,
    system: tuple[Array, Array],
) -> tuple[float, float, float, int]:
    """Add the points' equations to H, b; return sum w, sum w r^2, sum of kernel weights, count."""
    grid, origin, cell = lattice
    points, towards, sigmas = cloud
    kernel, cap, gated = limits
    H, b = system
    weight, square, kernels, used = 0.0, 0.0, 0.0, 0
    J = np.empty(6)
    for m in range(len(points)):
        x, y, z = move_back(T, points[m, 0], points[m, 1], points[m, 2])
        r, gx, gy, gz = sample(grid, origin, cell, x, y, z)
        s = sigmas[m]
        q = r / min(kernel * s, cap)
        if q * q >= 1.0:
            continue
        if gated:
            vx, vy, vz = turn_back(T, towards[m, 0], towards[m, 1], towards[m, 2])
            # Behind or within a thin wall: the distance to the side that the camera saw.
            r, gx, gy, gz, t, facing = follow_to_camera(
                lattice, (x, y, z), (vx, vy, vz), (r, gx, gy, gz)
            )
            if facing <= GATE_COS:
                continue
            r -= t * facing
            q = r / min(kernel * s, cap)
            if q * q >= 1.0:
                continue
        kernels += tukey(q * q)
        w = tukey(q * q) / (s * s)
        x, y, z = x - center[0], y - center[1], z - center[2]
        J[0], J[1], J[2] = -(y * gz - z * gy), -(z * gx - x * gz), -(x * gy - y * gx)
        J[3], J[4], J[5] = -gx, -gy, -gz
        add_row(H, b, J, w, r)
        weight += w
        square += w * r * r
        used += 1
    return weight, square, kernels, used


@njit
def _accumulate_free_space(
    surface: tuple[Array, Array],
    T: Array,
    images: tuple[Array32, Array, Array],
    limits: tuple[float, float, float, float, float],
    center: Array,
    system: tuple[Array, Array],
) -> int:
    """Add the equations of model samples in front of the measured depth; return how many."""
    samples, normals = surface
    depths, Ts, camera = images
    weight, tolerance, cap, k, floor = limits
    H, b = system
    height, width = depths.shape[1], depths.shape[2]
    J = np.empty(6)
    violating = 0
    for f in range(len(depths)):
        M = Ts[f] @ T
        for m in range(len(samples)):
            s0, s1, s2 = samples[m, 0], samples[m, 1], samples[m, 2]
            a0, a1, a2 = normals[m, 0], normals[m, 1], normals[m, 2]
            px, py, pz = move(M, s0, s1, s2)
            nx, ny, nz = turn(M, a0, a1, a2)
            if pz <= 0.0 or nx * px + ny * py + nz * pz >= 0.0:
                continue
            x, y = px / pz, py / pz
            u, v = pixel(camera, x, y)
            i, j = int(np.floor(v + 0.5)), int(np.floor(u + 0.5))
            if i < 0 or j < 0 or i >= height or j >= width or depths[f, i, j] <= 0.0:
                continue
            z = depths[f, i, j]
            sigma = max(floor, k * z * z)
            gap = z - pz - tolerance - 1.5 * sigma
            if gap <= 0.0 or gap >= cap:
                continue
            # Moving back along the ray by `gap` in depth moves by n.(ray gap) along the normal.
            r = -gap * (nx * x + ny * y + nz)
            w = weight * tukey((gap / cap) ** 2)
            q0, q1, q2 = s0 - center[0], s1 - center[1], s2 - center[2]
            J[0], J[1], J[2] = q1 * a2 - q2 * a1, q2 * a0 - q0 * a2, q0 * a1 - q1 * a0
            J[3], J[4], J[5] = a0, a1, a2
            add_row(H, b, J, w, r)
            violating += 1
    return violating


@njit
def _step(
    T: Array, system: tuple[Array, Array], free: Array, damping: float, radius: float, center: Array
) -> tuple[Array, float]:
    """Return the pose after a damped step about the box's centre, and how far it moved [m].

    H is given by its upper triangle. In units of the radius every unknown moves the surface by
    about its own size: the equations are solved in these.
    """
    H, b = system
    scale = np.array([radius, radius, radius, 1.0, 1.0, 1.0])
    full = H + np.triu(H, 1).T
    A = free @ (full / np.outer(scale, scale)) @ free + damping * np.eye(6)
    if not np.isfinite(A.sum()):
        return np.full((4, 4), np.nan), np.inf
    x = np.linalg.solve(A, free @ (b / scale))
    moved = np.sqrt(np.sum(x[:3] ** 2)) + np.sqrt(np.sum(x[3:] ** 2))
    w, v = x[:3] / radius, x[3:]
    theta2 = np.sum(w * w)
    theta = np.sqrt(theta2)
    p, q, s = 1.0 - theta2 / 6.0, 0.5 - theta2 / 24.0, 1.0 / 6.0 - theta2 / 120.0
    if theta2 >= 1e-10:
        p, q = np.sin(theta) / theta, (1.0 - np.cos(theta)) / theta2
        s = (1.0 - p) / theta2
    W = np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])
    square = W @ W
    R = np.eye(3) + p * W + q * square
    shift = center - R @ center + v + q * (W @ v) + s * (square @ v)
    turned = np.ascontiguousarray(T[:3, :3])
    new = T.copy()
    new[:3, :3] = turned @ R
    new[:3, 3] += turned @ shift
    return new, moved


def solve_pose(
    body: Body,
    cloud: Cloud,
    T_world_obj: Array,
    stages: tuple[Stage, ...],
    free_space: FreeSpace | None = None,
    held: Array | None = None,
) -> PoseFit:
    """Return the pose at which the measured points lie on the model's surface.

    Args:
        body: the object.
        cloud: measured points near it; others are tolerated up to the kernel's width.
        T_world_obj: (4, 4) where to start.
        stages: the annealing.
        free_space: images that the model may not stand in front of; None = not checked.
        held: (6, K) orthonormal motions that are left as they are, about the box's centre, rotation
            first, turns times the radius; None = none.
    """
    T = np.array(T_world_obj, dtype=np.float64)
    sigmas = np.sqrt(np.square(cloud.sigmas) + SIGMA_FLOOR_M**2)
    typical = float(np.median(1.0 / np.square(sigmas))) if len(sigmas) else 1.0
    data = (np.ascontiguousarray(cloud.points), np.ascontiguousarray(cloud.towards), sigmas)
    radius = body.radius_m
    free = np.eye(6) if held is None else np.eye(6) - held @ held.T
    upper, weight, square, kernels, used, taken = np.zeros((6, 6)), 0.0, 0.0, 0.0, 0, 0
    history: list[float] = []
    for stage in stages:
        for _ in range(stage.steps):
            taken += 1
            H, b = np.zeros((6, 6)), np.zeros(6)
            rules = (stage.kernel, stage.cap_m, stage.gated)
            weight, square, kernels, used = accumulate_points(
                body.field.lattice, T, data, rules, body.center_obj, (H, b)
            )
            upper = H.copy()
            if used < LEAST_POINTS:
                break
            if free_space is not None:
                limits = (FREE_SPACE_WEIGHT * typical, FREE_SPACE_TOLERANCE_M)
                _accumulate_free_space(
                    (body.samples, body.normals),
                    T,
                    (free_space.depths, free_space.Ts_cam_world, free_space.camera),
                    (*limits, stage.cap_m, *free_space.noise),
                    body.center_obj,
                    (H, b),
                )
            damping = DAMPING**2 * weight
            T, moved = _step(T, (H, b), free, damping, radius, body.center_obj)
            if moved < CONVERGED_M:
                break
        rms = np.sqrt(square / weight) if weight > 0 else np.nan
        history.append(float(1e3 * rms))
    return PoseFit(
        T_world_obj=se3.check_rigid(T, "the fitted pose"),
        information=upper + np.triu(upper, 1).T,
        weight=weight,
        variance=square / kernels if kernels > 0 else float("nan"),
        points=used,
        offered=len(cloud.points),
        steps=taken,
        history_mm=tuple(history),
    )
