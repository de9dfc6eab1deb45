"""Rigid transforms: the few functions the project uses, vectorised over leading axes.

A transform `T_a_b` is (..., 4, 4) float64 and maps b-coordinates to a: `p_a = T_a_b @ p_b`.
Tangent vectors are rotation first, `xi = [wx wy wz vx vy vz]` [rad, m] (the order of GTSAM's
Pose3), and perturb on the right: `T <- T @ exp(xi)`.
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array, Mask
from realsim.errors import NotRigidError

RIGID_TOLERANCE = 1e-5
"""How far R^T R may be from the identity: float32 files pass, a scaled or sheared matrix fails."""
IDENTITY_3 = np.eye(3)
LAST_ROW = np.array([0.0, 0.0, 0.0, 1.0])
LAST_ROW_TOLERANCE = np.array([1e-9, 1e-9, 1e-9, 1e-5])
"""Greatest error of the last row: single precision may have written the one."""
EXACT_TOLERANCE = 1e-14
"""A rotation this near to orthonormal is left as it is, so that checking twice changes nothing."""


def hat(w: ArrayLike) -> Array:
    """Return the skew matrix (..., 3, 3) with `hat(w) @ p = cross(w, p)`."""
    w = np.asarray(w, dtype=np.float64)
    m = np.zeros((*w.shape[:-1], 3, 3))
    m[..., 0, 1], m[..., 0, 2], m[..., 1, 2] = -w[..., 2], w[..., 1], -w[..., 0]
    m[..., 1, 0], m[..., 2, 0], m[..., 2, 1] = w[..., 2], -w[..., 1], w[..., 0]
    return m


def from_rt(rotation: ArrayLike, translation: ArrayLike) -> Array:
    """Return T (..., 4, 4) from a rotation (..., 3, 3) and a translation (..., 3) [m]."""
    rotation = np.asarray(rotation, dtype=np.float64)
    translation = np.asarray(translation, dtype=np.float64)
    batch = np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1])
    T = np.zeros((*batch, 4, 4))
    T[..., :3, :3] = rotation
    T[..., :3, 3] = translation
    T[..., 3, 3] = 1.0
    return T


def from_translation(translation: ArrayLike) -> Array:
    """Return T (..., 4, 4) that only translates by (..., 3) [m]."""
    return from_rt(np.eye(3), translation)


def invert(T: ArrayLike) -> Array:
    """Return the inverse (..., 4, 4) of a rigid transform, exactly rigid again."""
    T = np.asarray(T, dtype=np.float64)
    Rt = np.swapaxes(T[..., :3, :3], -1, -2)
    return from_rt(Rt, -(Rt @ T[..., :3, 3:4])[..., 0])


def transform(T: ArrayLike, points: ArrayLike) -> Array:
    """Return points (..., N, 3) [m] mapped by T (..., 4, 4)."""
    T = np.asarray(T, dtype=np.float64)
    points = np.asarray(points, dtype=np.float64)
    return points @ np.swapaxes(T[..., :3, :3], -1, -2) + T[..., None, :3, 3]


def _turned(w: ArrayLike) -> tuple[Array, Array, Array, Array, Mask]:
    """Return hat(w), its square, the angle's square, and the angle, 1 where it is small."""
    W = hat(w)
    theta2 = W[..., 2, 1] ** 2 + W[..., 0, 2] ** 2 + W[..., 1, 0] ** 2
    theta2 = np.asarray(theta2)[..., None, None]
    small = theta2 < 1e-10
    return W, W @ W, theta2, np.where(small, 1.0, np.sqrt(theta2)), small


def exp_so3(w: ArrayLike) -> Array:
    """Return the rotation (..., 3, 3) of a rotation vector (..., 3) [rad] (Rodrigues)."""
    W, WW, theta2, safe, small = _turned(w)
    a = np.where(small, 1.0 - theta2 / 6.0, np.sin(safe) / safe)
    b = np.where(small, 0.5 - theta2 / 24.0, (1.0 - np.cos(safe)) / (safe * safe))
    return IDENTITY_3 + a * W + b * WW


def log_so3(R: ArrayLike) -> Array:
    """Return the rotation vector (..., 3) [rad], |w| <= pi, of a rotation (..., 3, 3).

    Goes through the quaternion (Shepperd's choice of the largest component), so that angles near
    0 and near pi are both exact.
    """
    R = np.asarray(R, dtype=np.float64)
    q = quaternion_wxyz(R)
    v = q[..., 1:]
    n = np.linalg.norm(v, axis=-1, keepdims=True)
    small = n < 1e-12
    angle = 2.0 * np.arctan2(n, q[..., :1])
    return np.where(small, 2.0 * v, angle * v / np.where(small, 1.0, n))


def quaternion_wxyz(R: ArrayLike) -> Array:
    """Return the unit quaternion (..., 4), order w x y z, w >= 0, of rotations (..., 3, 3)."""
    R = np.asarray(R, dtype=np.float64)
    m00, m11, m22 = R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]
    # 4 times the squares of w, x, y, z; the row of the largest is the well-conditioned one.
    squares = np.stack(
        [1 + m00 + m11 + m22, 1 + m00 - m11 - m22, 1 - m00 + m11 - m22, 1 - m00 - m11 + m22], -1
    )
    wx, wy, wz = (
        R[..., 2, 1] - R[..., 1, 2],
        R[..., 0, 2] - R[..., 2, 0],
        R[..., 1, 0] - R[..., 0, 1],
    )
    xy, xz, yz = (
        R[..., 0, 1] + R[..., 1, 0],
        R[..., 0, 2] + R[..., 2, 0],
        R[..., 1, 2] + R[..., 2, 1],
    )
    rows = np.stack(
        [
            np.stack([squares[..., 0], wx, wy, wz], -1),
            np.stack([wx, squares[..., 1], xy, xz], -1),
            np.stack([wy, xy, squares[..., 2], yz], -1),
            np.stack([wz, xz, yz, squares[..., 3]], -1),
        ],
        -2,
    )
    best = np.argmax(squares, axis=-1)
    q = np.take_along_axis(rows, best[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(q[..., :1] < 0, -q, q)


def from_quaternion_wxyz(q: ArrayLike) -> Array:
    """Return the rotation (..., 3, 3) of a quaternion (..., 4), order w x y z, any length > 0."""
    given = np.asarray(q, dtype=np.float64)
    unit: Array = given / np.linalg.norm(given, axis=-1, keepdims=True)
    w, V = unit[..., 0, None, None], hat(unit[..., 1:])
    return np.eye(3) + 2.0 * w * V + 2.0 * (V @ V)


def left_jacobian_so3(w: ArrayLike) -> Array:
    """Return the left Jacobian (..., 3, 3) of SO(3): `exp([w, v])` translates by `J(w) @ v`."""
    W, WW, theta2, safe, small = _turned(w)
    b = np.where(small, 0.5 - theta2 / 24.0, (1.0 - np.cos(safe)) / (safe * safe))
    c = np.where(small, 1.0 / 6.0 - theta2 / 120.0, (safe - np.sin(safe)) / (safe**3))
    return IDENTITY_3 + b * W + c * WW


def exp(xi: ArrayLike) -> Array:
    """Return the transform (..., 4, 4) of a twist (..., 6), rotation first [rad, m]."""
    xi = np.asarray(xi, dtype=np.float64)
    w, v = xi[..., :3], xi[..., 3:]
    return from_rt(exp_so3(w), (left_jacobian_so3(w) @ v[..., None])[..., 0])


def log(T: ArrayLike) -> Array:
    """Return the twist (..., 6), rotation first [rad, m], with `exp(log(T)) = T`."""
    T = np.asarray(T, dtype=np.float64)
    w = log_so3(T[..., :3, :3])
    v = np.linalg.solve(left_jacobian_so3(w), T[..., :3, 3:4])[..., 0]
    return np.asarray(np.concatenate([w, v], axis=-1), dtype=np.float64)


def adjoint(T: ArrayLike) -> Array:
    """Return Ad (..., 6, 6), rotation first, with `T @ exp(xi) = exp(Ad @ xi) @ T`."""
    T = np.asarray(T, dtype=np.float64)
    R = T[..., :3, :3]
    Ad = np.zeros((*T.shape[:-2], 6, 6))
    Ad[..., :3, :3] = R
    Ad[..., 3:, 3:] = R
    Ad[..., 3:, :3] = hat(T[..., :3, 3]) @ R
    return Ad


def angle(R: ArrayLike) -> Any:
    """Return the rotation angle [rad] of rotations (..., 3, 3) or transforms (..., 4, 4)."""
    R = np.asarray(R, dtype=np.float64)
    x = R[..., 2, 1] - R[..., 1, 2]
    y = R[..., 0, 2] - R[..., 2, 0]
    z = R[..., 1, 0] - R[..., 0, 1]
    twice_cos = R[..., 0, 0] + R[..., 1, 1] + R[..., 2, 2] - 1.0
    return np.arctan2(np.sqrt(x * x + y * y + z * z), twice_cos)


def check_rigid(T: ArrayLike, name: str) -> Array:
    """Return T as float64 (..., 4, 4) with its rotation made exactly orthonormal.

    Args:
        T: (..., 4, 4) transform(s) as they were read.
        name: what the transform is called in the error.

    Raises:
        NotRigidError: wrong shape, not finite, last row not 0 0 0 1, mirrored, scaled or sheared.
    """
    T = np.array(T, dtype=np.float64)
    if T.shape[-2:] != (4, 4):
        raise NotRigidError(
            f"{name} has shape {T.shape}; a rigid transform is (4, 4) (a stack is (N, 4, 4))."
        )
    if not np.isfinite(T).all():
        raise NotRigidError(f"{name} holds NaN or infinite numbers; the pose was not measured.")
    # Plain comparisons: a data set has a hundred thousand poses, and np.allclose is half the cost.
    if not (np.abs(T[..., 3, :] - LAST_ROW) <= LAST_ROW_TOLERANCE).all():
        raise NotRigidError(
            f"{name} has the last row {T[..., 3, :].tolist()}; it must be 0 0 0 1. "
            "Is the matrix stored transposed (column-major)?"
        )
    R = T[..., :3, :3]
    det = np.linalg.det(R)
    error = float(np.abs(np.swapaxes(R, -1, -2) @ R - IDENTITY_3).max())
    if (det < 0).any():
        raise NotRigidError(
            f"{name} is mirrored (determinant {np.min(det):.3f}); a rotation has +1. "
            "Check the handedness of the axes it was exported with."
        )
    if error > RIGID_TOLERANCE:
        scale = float(np.mean(np.cbrt(det)))
        raise NotRigidError(
            f"{name} is not rigid: R^T R is off the identity by {error:.2g} (at most "
            f"{RIGID_TOLERANCE:g} is accepted; mean scale {scale:.4g}). If it carries a scale, "
            "divide the rotation by it and apply the scale to the mesh."
        )
    if error > EXACT_TOLERANCE:
        U, _, Vt = np.linalg.svd(R)
        T[..., :3, :3] = U @ Vt
    return T


def look_at(eye: ArrayLike, target: ArrayLike, roll: float = 0.0) -> Array:
    """Return T_world_cam (4, 4) of an OpenCV camera at `eye` whose z axis meets `target`.

    At roll 0 the camera's x axis is horizontal and its y axis points down; `roll` [rad] then
    turns the camera about its own optical axis. Looking straight down, x is the world's x.

    Raises:
        NotRigidError: eye and target coincide.
    """
    eye = np.asarray(eye, dtype=np.float64)
    z = np.asarray(target, dtype=np.float64) - eye
    distance = np.linalg.norm(z)
    if distance < 1e-12:
        raise NotRigidError("look_at: the camera stands in its own target; no direction is given.")
    z = z / distance
    x = np.cross(z, [0.0, 0.0, 1.0])
    n = np.linalg.norm(x)
    x = np.array([1.0, 0.0, 0.0]) if n < 1e-9 else x / n
    y = np.cross(z, x)
    R = np.stack([x, y, z], axis=-1) @ exp_so3([0.0, 0.0, roll])
    return from_rt(R, eye)


def random_rotation(rng: np.random.Generator, n: int | None = None) -> Array:
    """Return one (3, 3) or n (n, 3, 3) rotations, uniform over SO(3)."""
    q = rng.normal(size=(4,) if n is None else (n, 4))
    return from_quaternion_wxyz(q)


def random_transform(rng: np.random.Generator, n: int | None = None, spread: float = 1.0) -> Array:
    """Return (4, 4) or (n, 4, 4) random transforms with translations of sd `spread` [m]."""
    t = rng.normal(scale=spread, size=(3,) if n is None else (n, 3))
    return from_rt(random_rotation(rng, n), t)


def mean_rotation(Rs: ArrayLike) -> Array:
    """Return the chordal mean (3, 3) of rotations (N, 3, 3): the nearest rotation to their sum."""
    total: Array = np.sum(np.asarray(Rs, dtype=np.float64), axis=0)
    U, _, Vt = np.linalg.svd(total)
    D = np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    return np.asarray(U @ D @ Vt, dtype=np.float64)
