"""The map from a flat board to its image: fit, apply, and which side of the board is seen."""

from collections.abc import Callable

import numpy as np

from realsim.arrays import Array, Mask

AGREEING_SHARE = 0.7
"""Least share of the markers that must agree: of a wrong layout a skewed map explains half."""


def fit_homography(board: Array, uv: Array) -> Array:
    """Return H (3, 3) with uv ~ H board: Hartley's normalised DLT, at least four points.

    Args:
        board: (n, 2) points on the board [m].
        uv: (n, 2) where they are seen [px].

    Source: Hartley & Zisserman, Multiple View Geometry (2003), alg. 4.2.
    """
    S, p = _normalised(board)
    T, q = _normalised(uv)
    x, y = p[:, 0], p[:, 1]
    one, zero = np.ones_like(x), np.zeros_like(x)
    rows_u = np.stack([x, y, one, zero, zero, zero, *(-q[:, 0] * (x, y, one))], -1)
    rows_v = np.stack([zero, zero, zero, x, y, one, *(-q[:, 1] * (x, y, one))], -1)
    A = np.concatenate([rows_u, rows_v])
    h = np.linalg.eigh(A.T @ A)[1][:, 0].reshape(3, 3)
    H = np.linalg.inv(T) @ h @ S
    # The sign that puts the board in front of the camera.
    middle = H[2] @ [*board.mean(0), 1.0]
    return H / (np.linalg.norm(H) * (np.sign(middle) or 1.0))


def _normalised(points: Array) -> tuple[Array, Array]:
    """Return the similarity that brings points to mean 0 and RMS length sqrt 2, and its result."""
    middle = points.mean(0)
    scale = 1.0 / max(float(np.sqrt(np.mean((points - middle) ** 2))), 1e-12)
    S = np.array([[scale, 0, -scale * middle[0]], [0, scale, -scale * middle[1]], [0, 0, 1.0]])
    return S, (points - middle) * scale


def apply_homography(H: Array, points: Array) -> Array:
    """Return H applied to points (..., 2)."""
    p = np.concatenate([points, np.ones_like(points[..., :1])], -1) @ H.T
    return p[..., :2] / p[..., 2:]


def seen_from_front(H: Array, board: Array) -> bool:
    """Return whether all points (n, 2) are seen from the printed side: x, y clockwise, z away.

    The derivative of the map has the determinant det H / w^3. A mirrored picture turns its sign.
    """
    w = board @ H[2, :2] + H[2, 2]
    return bool(np.all(np.linalg.det(H) * w > 0))


def fit_trimmed(board: Array, uv: Array, limit_px: float) -> tuple[Array, Mask]:
    """Return H and which points (n,) it brings to within `limit_px`; RANSAC, then least squares."""
    import cv2

    robust, _ = cv2.findHomography(board, uv, cv2.RANSAC, limit_px, maxIters=500, confidence=0.999)
    H = np.asarray(robust, dtype=np.float64)
    if H.shape != (3, 3):  # None where the points lie on a line
        return np.eye(3), np.zeros(len(board), dtype=bool)
    inside = np.linalg.norm(apply_homography(H, board) - uv, axis=-1) <= limit_px
    for _ in range(3):
        if inside.sum() < 4:
            return H, np.zeros(len(board), dtype=bool)
        H = fit_homography(board[inside], uv[inside])
        inside = np.linalg.norm(apply_homography(H, board) - uv, axis=-1) <= limit_px
    return H, inside


def agreeing(known: Array, quads: Array, limit_px: float) -> Mask:
    """Return which quads (n, 4, 2) one map of the plane explains, seen from the printed side.

    `known` (n, 4, 2) is where they are on the board.
    """
    H, inside = fit_trimmed(known.reshape(-1, 2), quads.reshape(-1, 2), limit_px)
    fits: Mask = np.all(inside.reshape(-1, 4), axis=1)
    if not fits.any() or seen_from_front(H, known[fits].reshape(-1, 2)):
        return fits
    return np.zeros(len(known), dtype=bool)


def fit_layout(
    known: Array, quads: Array, share: float, remedy: Callable[[float, int], str]
) -> tuple[Mask, int, str]:
    """Return which quads (n, 4, 2) lie as on the board, the codes' quarter turns, and a remedy.

    Args:
        known: (n, 4, 2) where they are on the board.
        quads: where they are seen [px].
        share: furthest that a corner may lie from where the others put it, in sides.
        remedy: of a limit [px] and a number of quads: the layout that explains so many, in words;
            empty where none does.
    """
    limit = share * float(np.median(np.linalg.norm(quads - np.roll(quads, -1, axis=1), axis=-1)))
    least = max(2, int(np.ceil(AGREEING_SHARE * len(quads))))
    # Some generators print the codes turned on the page; the grid says by how much.
    for roll in (0, 2, 1, 3):
        good = agreeing(known, np.roll(quads, roll, axis=1), limit)
        # A wrong pattern may explain most markers, moved by a square: a better one counts more.
        if good.sum() >= least and (good.all() or not remedy(limit, int(good.sum()) + 1)):
            return good, roll, ""
    return np.zeros(len(quads), dtype=bool), 0, remedy(limit, least)
