"""The equations of one view: its points through robot, board shape and lens, in compiled code.

    T_cam_board = X^-1 D^-1 A^-1 Z      camera in the hand      (A D: where the hand really was)
    T_cam_board = X^-1 A D Z            camera that stands still

The residuals of a view depend on the poses X, Z and D only through T_cam_board, that is through a
twist xi with T <- Exp(xi) T. The n points therefore give a (2n, 23) Jacobian (xi 6, camera 12,
board 5) whatever the graph looks like; a QR decomposition of it and of the residual leaves 24 rows
with the same sum of squares and the same normal equations, and the chain rule

    X: xi = -x        Z: xi = Ad(T) z        D: xi = -Ad(X^-1) d   or   Ad(X^-1 A D) d

gives the columns of the poses. A view costs the same with 20 corners or with 2,000.

The pose of the board in one view, and its mirror twin.

A plane seen from afar fits two poses almost equally well (it may tip towards or away from the
viewer). Both are kept, each refined in pixels through the full lens model, and told apart by their
reprojection; the hand-eye gates may choose the twin where the motion of the hand says so.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from realsim.arrays import Array
from realsim.compiled import njit
from realsim.geometry import point_loops, se3
from realsim.geometry.camera import undistort
from realsim.records import CameraIntrinsics

CAMERA_TERMS = 12
"""fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6."""
BOARD_TERMS = 5
"""scale, aspect, three warps."""
SHARED = 12 + CAMERA_TERMS + BOARD_TERMS
"""Parameters that all views share: X, Z, camera, board."""
COLUMNS = 6 + CAMERA_TERMS + BOARD_TERMS + 1
"""Columns before the chain rule: xi, camera, board, residual."""
BEHIND_PX = 1e4
"""Residual of a point behind the camera [px]: large, so that the step is refused."""


def camera_vector(intrinsics: CameraIntrinsics) -> Array:
    """Return (12,) fx fy cx cy and the eight distortion terms."""
    i = intrinsics
    return np.concatenate([[i.fx, i.fy, i.cx, i.cy], i.distortion])


def camera_record(camera: Array, image_size: tuple[int, int]) -> CameraIntrinsics:
    """Return the camera of a (12,) vector for images of (width, height) [px]."""
    fx, fy, cx, cy = (float(v) for v in camera[:4])
    width, height = image_size
    return CameraIntrinsics(
        width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy, distortion=camera[4:]
    )


@njit
def _product(A: Any, B: Any) -> Any:
    """Return the product of two rigid transforms."""
    T = np.eye(4)
    for i in range(3):
        for j in range(4):
            T[i, j] = A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j]
        T[i, 3] += A[i, 3]
    return T


@njit
def _inverse(A: Any) -> Any:
    """Return the inverse of a rigid transform."""
    T = np.eye(4)
    for i in range(3):
        for j in range(3):
            T[i, j] = A[j, i]
        T[i, 3] = -(A[0, i] * A[0, 3] + A[1, i] * A[1, 3] + A[2, i] * A[2, 3])
    return T


@njit
def _adjoint(T: Any) -> Any:
    """Return Ad(T) (6, 6), rotation first."""
    ad = np.zeros((6, 6))
    x, y, z = T[0, 3], T[1, 3], T[2, 3]
    for j in range(3):
        a, b, c = T[0, j], T[1, j], T[2, j]
        ad[0, j], ad[1, j], ad[2, j] = a, b, c
        ad[3, j + 3], ad[4, j + 3], ad[5, j + 3] = a, b, c
        ad[3, j], ad[4, j], ad[5, j] = y * c - z * b, z * a - x * c, x * b - y * a
    return ad


@njit
def camera_from_board(X: Any, Z: Any, A: Any, D: Any, to_hand: bool) -> Any:
    """Return T_cam_board (4, 4)."""
    AD = _product(A, D)
    if to_hand:
        return _product(_inverse(X), _product(AD, Z))
    return _product(_inverse(_product(AD, X)), Z)


@njit
def _point_rows(
    M: Any, row: int, p: Any, lens: Any, measured: Any, root: float, chain: Any
) -> None:
    """Fill two rows of [xi | camera | board | residual] for the point p in the camera frame."""
    z = p[2]
    if z <= 1e-6:
        M[row, COLUMNS - 1] = M[row + 1, COLUMNS - 1] = BEHIND_PX
        return
    x, y = p[0] / z, p[1] / z
    r2 = x * x + y * y
    u, v = point_loops.bent(lens, x, y)
    du_dx, du_dy, dv_dy, radial, den = point_loops.bent_slopes(lens, x, y)
    for axis in range(2):
        f = lens[axis] * root
        a = du_dx if axis == 0 else du_dy
        b = du_dy if axis == 0 else dv_dy
        g0, g1 = f * a / z, f * b / z
        g2 = -(x * g0 + y * g1)
        k = row + axis
        M[k, 0], M[k, 1], M[k, 2] = p[1] * g2 - z * g1, z * g0 - p[0] * g2, p[0] * g1 - p[1] * g0
        M[k, 3], M[k, 4], M[k, 5] = g0, g1, g2
        bent = u if axis == 0 else v
        ideal = f * (x if axis == 0 else y)
        M[k, 6 + axis] = bent * root
        M[k, 8 + axis] = root
        M[k, 10] = ideal * r2 / den
        M[k, 11] = ideal * r2 * r2 / den
        M[k, 12] = f * (2 * x * y if axis == 0 else r2 + 2 * y * y)
        M[k, 13] = f * (r2 + 2 * x * x if axis == 0 else 2 * x * y)
        M[k, 14] = ideal * r2 * r2 * r2 / den
        for q in range(3):
            M[k, 15 + q] = -ideal * radial / den * r2 ** (q + 1)
        for q in range(BOARD_TERMS):
            M[k, 18 + q] = g0 * chain[0, q] + g1 * chain[1, q] + g2 * chain[2, q]
        predicted = lens[axis] * bent + lens[2 + axis]
        M[k, COLUMNS - 1] = root * (predicted - measured[axis])


@njit
def _rows(
    T: Any, lens: Any, board: Any, half: float, middle: Any, xy: Any, uv: Any, root: Any
) -> Any:
    """Return [xi | camera | board | residual] (2n, 24) of all points of a view."""
    n = len(xy)
    M = np.zeros((2 * n, COLUMNS))
    p, chain, local = np.zeros(3), np.zeros((3, BOARD_TERMS)), np.zeros((3, BOARD_TERMS))
    s, a = board[0], board[1]
    for i in range(n):
        x, y = xy[i, 0], xy[i, 1]
        b0, b1, b2 = x * x / half, x * y / half, y * y / half
        lift = board[2] * b0 + board[3] * b1 + board[4] * b2
        P0, P1, P2 = middle[0] + s * x, middle[1] + s * (1 + a) * y, middle[2] + s * lift
        local[0, 0], local[1, 0], local[2, 0] = x, (1 + a) * y, lift
        local[1, 1] = s * y
        local[2, 2], local[2, 3], local[2, 4] = s * b0, s * b1, s * b2
        for r in range(3):
            p[r] = T[r, 0] * P0 + T[r, 1] * P1 + T[r, 2] * P2 + T[r, 3]
            for q in range(BOARD_TERMS):
                chain[r, q] = T[r, 0] * local[0, q] + T[r, 1] * local[1, q] + T[r, 2] * local[2, q]
        _point_rows(M, 2 * i, p, lens, uv[i], root[i], chain)
    return M


@njit
def _triangle(rows_by_columns: Any) -> Any:
    """Return the (24, 24) R of M = QR by Householder reflections; rank deficiency is no matter."""
    M = rows_by_columns.T.copy()  # a column lies in one piece
    columns, rows = M.shape
    for k in range(min(columns, rows - 1)):
        v = M[k, k:]
        norm = np.sqrt(np.dot(v, v))
        if norm == 0.0:
            continue
        alpha = -norm if v[0] > 0 else norm
        v[0] -= alpha
        length = np.dot(v, v)
        if length > 0.0:
            for j in range(k + 1, columns):
                w = M[j, k:]
                factor = 2.0 / length * np.dot(v, w)
                for i in range(len(w)):
                    w[i] -= factor * v[i]
        M[k, k] = alpha
    R = np.zeros((columns, columns))
    for i in range(min(rows, columns)):
        for j in range(i, columns):
            R[i, j] = M[j, i]
    return R


@njit
def pose_normal_equations(T: Any, lens: Any, points: Any, uv: Any) -> Any:
    """Return H (6, 6), g (6,) and the sum of squares of the residuals of a pose alone [px^2].

    T <- Exp(xi) T; H xi = -g is the Gauss-Newton step. Infinite where a point is behind the camera.
    """
    H, g, total = np.zeros((6, 6)), np.zeros(6), 0.0
    M, chain, p = np.zeros((2, COLUMNS)), np.zeros((3, BOARD_TERMS)), np.zeros(3)
    for i in range(len(points)):
        for r in range(3):
            p[r] = T[r, 0] * points[i, 0] + T[r, 1] * points[i, 1] + T[r, 2] * points[i, 2]
            p[r] += T[r, 3]
        if p[2] <= 1e-6:
            return H, g, np.inf
        _point_rows(M, 0, p, lens, uv[i], 1.0, chain)
        for row in range(2):
            e = M[row, COLUMNS - 1]
            total += e * e
            for j in range(6):
                g[j] += M[row, j] * e
                for k in range(j, 6):
                    H[j, k] += M[row, j] * M[row, k]
    for j in range(6):
        for k in range(j):
            H[j, k] = H[k, j]
    return H, g, total


@njit
def _exp(xi: Any) -> Any:
    """Return the rigid transform of a twist (6,), rotation first."""
    theta2 = xi[0] * xi[0] + xi[1] * xi[1] + xi[2] * xi[2]
    theta = np.sqrt(theta2)
    if theta < 1e-5:
        a, b, c = 1 - theta2 / 6, 0.5 - theta2 / 24, 1.0 / 6 - theta2 / 120
    else:
        a, b = np.sin(theta) / theta, (1 - np.cos(theta)) / theta2
        c = (1 - a) / theta2
    W = np.zeros((3, 3))
    W[0, 1], W[0, 2], W[1, 2] = -xi[2], xi[1], -xi[0]
    W[1, 0], W[2, 0], W[2, 1] = xi[2], -xi[1], xi[0]
    T = np.eye(4)
    for i in range(3):
        for j in range(3):
            square = W[i, 0] * W[0, j] + W[i, 1] * W[1, j] + W[i, 2] * W[2, j]
            unit = 1.0 if i == j else 0.0
            T[i, j] = unit + a * W[i, j] + b * square
            T[i, 3] += (unit + b * W[i, j] + c * square) * xi[3 + j]
    return T


@njit
def refined_pose(
    start: Any, lens: Any, points: Any, uv: Any, steps: int, damping: float, gain: float
) -> Any:
    """Return the pose of locally least reprojection and its sum of squares [px^2]."""
    T = start.copy()
    H, g, cost = pose_normal_equations(T, lens, points, uv)
    for _ in range(steps):
        if not np.isfinite(cost) or cost == 0.0:
            break
        damped = H.copy()
        for j in range(6):
            damped[j, j] += damping * H[j, j] + 1e-12
        moved = _product(_exp(-np.linalg.solve(damped, g)), T)
        new_H, new_g, new = pose_normal_equations(moved, lens, points, uv)
        if new < cost:
            done = cost - new < gain * cost
            T, H, g, cost, damping = moved, new_H, new_g, new, damping * 0.1
            if done:
                break
        else:
            damping *= 10
    return T, cost


@njit
def view_rows(  # noqa: PLR0913, PLR0917 - compiled code takes no records
    X: Any, Z: Any, A: Any, D: Any, to_hand: bool, lens: Any, board: Any,
    half: float, middle: Any, xy: Any, uv: Any, root: Any,
) -> Any:  # fmt: skip
    """Return [xi | camera | board | residual] (2n, 24): every point's own rows [px]."""
    T = camera_from_board(X, Z, A, D, to_hand)
    return _rows(T, lens, board, half, middle, xy, uv, root)


@njit
def view_equations(  # noqa: PLR0913, PLR0917 - compiled code takes no records
    X: Any, Z: Any, A: Any, D: Any, to_hand: bool, lens: Any, board: Any,
    half: float, middle: Any, xy: Any, uv: Any, root: Any,
) -> Any:  # fmt: skip
    """Return the compressed equations of a view (24, 36) [px].

    Columns: X (6), Z (6), camera (12), board (5), D (6), residual (1). The sum of squares of the
    last column is that of the weighted residuals; the other columns are its derivatives.
    """
    T = camera_from_board(X, Z, A, D, to_hand)
    R = _triangle(_rows(T, lens, board, half, middle, xy, uv, root))
    if to_hand:
        to_xi = _adjoint(_product(_inverse(X), _product(A, D)))
    else:
        to_xi = -_adjoint(_inverse(X))
    ad = _adjoint(T)
    J = np.zeros((COLUMNS, SHARED + 7))
    for i in range(COLUMNS):
        for j in range(6):
            J[i, j] = -R[i, j]
            z, d = 0.0, 0.0
            for k in range(6):
                z += R[i, k] * ad[k, j]
                d += R[i, k] * to_xi[k, j]
            J[i, 6 + j] = z
            J[i, SHARED + j] = d
        for j in range(CAMERA_TERMS + BOARD_TERMS):
            J[i, 12 + j] = R[i, 6 + j]
        J[i, SHARED + 6] = R[i, COLUMNS - 1]
    return J


@njit
def all_rows(  # noqa: PLR0913, PLR0917 - compiled code takes no records
    X: Any, Z: Any, A: Any, D: Any, to_hand: bool, lens: Any, board: Any,
    half: float, middle: Any, xy: Any, uv: Any, starts: Any,
) -> Any:  # fmt: skip
    """Return the rows (2 points, 24) of views (A and D: views, 4, 4) whose points are stacked."""
    M, root = np.empty((2 * len(uv), COLUMNS)), np.ones(len(uv))
    for n in range(len(A)):
        a, b = starts[n], starts[n + 1]
        M[2 * a : 2 * b] = view_rows(
            X, Z, A[n], D[n], to_hand, lens, board, half, middle, xy[a:b], uv[a:b], root[a:b]
        )
    return M


@njit
def all_equations(  # noqa: PLR0913, PLR0917 - compiled code takes no records
    X: Any, Z: Any, A: Any, D: Any, to_hand: bool, lens: Any, board: Any,
    half: float, middle: Any, xy: Any, uv: Any, starts: Any, root: Any,
) -> Any:  # fmt: skip
    """Return the compressed equations (views, 24, 36) of views whose points are stacked [px]."""
    J = np.empty((len(A), COLUMNS, SHARED + 7))
    for n in range(len(A)):
        a, b = starts[n], starts[n + 1]
        J[n] = view_equations(
            X, Z, A[n], D[n], to_hand, lens, board, half, middle, xy[a:b], uv[a:b], root[a:b]
        )
    return J


REFINE_STEPS = 15
"""Gauss-Newton from IPPE's solution converges in four; the twin may take longer."""
FIRST_DAMPING = 1e-4
"""Levenberg-Marquardt's first damping, relative: nearly a Gauss-Newton step."""
RELATIVE_GAIN = 1e-9
"""A step that gains less of the cost is the last: the pose moves by 3e-5 of its own noise."""
SAME_POSE_RAD = 1e-3
"""Solutions nearer than this are one: a planar pose's own noise is ten times as large."""
MIN_POINTS = 4
"""A planar pose needs four points."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class BoardPose:
    """Where the board is in the camera frame."""

    T_cam_board: Array
    """(4, 4) the pose of least reprojection [m]."""
    rms_px: float
    """Its reprojection RMS [px]."""
    twin: Array | None
    """(4, 4) the other planar solution [m]; None where there is none."""
    twin_rms_px: float
    """Its reprojection RMS [px]; infinite where there is none."""


def estimate_board_pose(points: Array, uv: Array, intrinsics: CameraIntrinsics) -> BoardPose | None:
    """Return the board's pose in the camera, None where no pose in front of the camera fits.

    Args:
        points: (n, 3) points in the board frame [m].
        uv: (n, 2) where they are in the image [px].
        intrinsics: the camera.
    """
    found = planar_poses(points, uv, intrinsics)
    if not found:
        return None
    best, twin = found[0], found[1] if len(found) > 1 else (np.inf, None)
    return BoardPose(T_cam_board=best[1], rms_px=best[0], twin=twin[1], twin_rms_px=twin[0])


def planar_poses(
    points: Array, uv: Array, intrinsics: CameraIntrinsics, drawn: Array | None = None
) -> list[tuple[float, Array]]:
    """Return (RMS [px], T_cam_board) of all planar solutions, refined, the best first.

    IPPE (Collins & Bartoli, IJCV 2014) gives both planar solutions and SQPnP one more start; all
    are refined in pixels. `drawn` (n, 3) is a flat board to start from where the points are warped.
    """
    import cv2

    xy, valid = undistort(intrinsics, uv)
    if valid.sum() < MIN_POINTS:
        return []
    flat, lens = points if drawn is None else drawn, camera_vector(intrinsics)
    found: list[tuple[float, Array]] = []
    for flag in (cv2.SOLVEPNP_IPPE, cv2.SOLVEPNP_SQPNP):
        _, rotations, translations, _ = cv2.solvePnPGeneric(
            flat[valid], xy[valid], np.eye(3), None, flags=flag
        )
        for r, t in zip(rotations, translations, strict=True):
            start = se3.from_rt(se3.exp_so3(np.ravel(r)), np.ravel(t))
            refined, rms = refine_board_pose(start, points, uv, lens)
            turns = [se3.angle(se3.invert(refined) @ other) for _, other in found]
            if np.isfinite(rms) and all(turn > SAME_POSE_RAD for turn in turns):
                found.append((rms, refined))
    return sorted(found, key=lambda pair: pair[0])


def refine_board_pose(
    T_cam_board: Array, points: Array, uv: Array, lens: Array
) -> tuple[Array, float]:
    """Return the pose of locally least reprojection and its RMS [px] (Levenberg-Marquardt).

    `lens` is (12,) fx fy cx cy and the distortion.
    """
    T, cost = refined_pose(
        np.ascontiguousarray(T_cam_board), lens, np.ascontiguousarray(points),
        np.ascontiguousarray(uv), REFINE_STEPS, FIRST_DAMPING, RELATIVE_GAIN,
    )  # fmt: skip
    return T, float(np.sqrt(cost / len(points)))
