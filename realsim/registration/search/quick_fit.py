"""The solver's Gauss-Newton without its overhead: hundreds of hypotheses are fitted per scene.

The equations are `realsim.registration.solver`'s own; only the loop around them is compiled, and it
ends sooner. A step turns about the box centre and shifts it: T <- T C exp(omega) C^-1, then v.
"""

import numpy as np
from numpy.typing import NDArray

from realsim.compiled import njit
from realsim.registration.body import Body
from realsim.registration.evidence import Cloud
from realsim.registration.solver import (
    LEAST_POINTS,
    SolverConfig,
    Stage,
    accumulate_points,
)

Array = NDArray[np.float64]


def quick_fit(
    body: Body,
    cloud: Cloud,
    T_world_obj: Array,
    stages: tuple[Stage, ...],
    config: SolverConfig,
    converged_m: float,
) -> Array:
    """Return the pose (4, 4) at which the measured points lie on the model's surface.

    Args:
        body: the object.
        cloud: measured points near it.
        T_world_obj: (4, 4) where to start.
        stages: the annealing.
        config: of the solver.
        converged_m: a step that moves no point of the object further ends a stage [m].
    """
    rules = np.array([[s.kernel, s.cap_m, s.gated, s.steps] for s in stages], np.float64)
    sigmas = np.sqrt(np.square(cloud.sigmas) + config.sigma_floor_m**2)
    return _fit(
        body.field.lattice,
        np.array(T_world_obj, dtype=np.float64),
        (cloud.points, cloud.towards, sigmas),
        rules,
        (body.center_obj, body.radius_m),
        (config.damping, converged_m),
    )


@njit
def _fit(
    lattice: tuple[NDArray[np.float32], Array, float],
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
