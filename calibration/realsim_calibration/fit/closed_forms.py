"""Closed-form hand-eye solutions: Park, Daniilidis and Shah, in plain numpy.

The problem: the camera stands at X = T_ee_cam in the hand, the board at Z = T_base_board, and every
view i gives A_i = T_base_ee and C_i = T_cam_board with

    A_i X C_i = Z              (AX = ZB with B_i = C_i^-1; Shah)
    A_ij X = X B_ij            A_ij = A_j^-1 A_i,  B_ij = C_j C_i^-1       (Park, Daniilidis)

All pairs i < j are used and each enters symmetrically, so that the order of the views, the choice
of the base frame and the choice of the board frame do not matter.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.errors import DegenerateError, InputError
from realsim.geometry import se3

Array = NDArray[np.float64]
HALF_TURN = np.radians(175.0)
"""Pairs that turn further are left out: near 180 deg the sign of the axis is decided by noise."""


@dataclass(frozen=True, kw_only=True, slots=True)
class MotionConfig:
    """How much motion is asked for before a hand-eye is computed."""

    min_views: int = 3
    """Two motions about different axes need three poses."""
    min_turn_deg: float = 2.0
    """Least RMS rotation of the view pairs about the second-best axis [deg]: ten times the angle
    error of a planar pose seen from half a metre."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Motions:
    """The relative motions of all pairs of views."""

    Ts_hand: Array
    """(P, 4, 4) A_ij = T_eej_eei [m]."""
    Ts_cam: Array
    """(P, 4, 4) B_ij = T_camj_cami [m]."""
    pairs: NDArray[np.int64]
    """(P, 2) i < j."""


def motions(Ts_base_ee: ArrayLike, Ts_cam_board: ArrayLike) -> Motions:
    """Return the motions between all pairs of N views.

    Raises:
        InputError: the two stacks do not have the same number of poses.
    """
    A = np.asarray(Ts_base_ee, dtype=np.float64).reshape(-1, 4, 4)
    C = np.asarray(Ts_cam_board, dtype=np.float64).reshape(-1, 4, 4)
    if len(A) != len(C):
        raise InputError(
            f"hand-eye: {len(A)} hand poses and {len(C)} board poses were given; every view needs "
            "one of each."
        )
    i, j = np.triu_indices(len(A), 1)
    return Motions(
        Ts_hand=se3.invert(A[j]) @ A[i], Ts_cam=C[j] @ se3.invert(C[i]), pairs=np.stack([i, j], -1)
    )


def check_observable(Ts_base_ee: ArrayLike, config: MotionConfig | None = None) -> Array:
    """Return the RMS rotation of the view pairs about the three principal axes [rad], descending.

    The hand-eye is determined when the hand turns about two different axes (Chen 1991). With one
    axis a only, the camera's place along a, and unless the hand also translates across it the
    camera's angle about a, cannot be seen.

    Args:
        Ts_base_ee: (N, 4, 4) hand poses [m].
        config: how much motion is enough.

    Raises:
        DegenerateError: too few views, no rotation, or rotation about one axis only.
    """
    config = config or MotionConfig()
    A = np.asarray(Ts_base_ee, dtype=np.float64).reshape(-1, 4, 4)
    if len(A) < config.min_views:
        raise DegenerateError(
            f"hand-eye: {len(A)} usable views; at least {config.min_views} that turn the hand "
            "about two different axes are needed, and 12 or more are advised."
        )
    turns = se3.log_so3(motions(A, A).Ts_hand[:, :3, :3])
    values, axes = np.linalg.eigh(turns.T @ turns / len(turns))
    rms, axes = np.sqrt(np.maximum(values[::-1], 0.0)), axes[:, ::-1]
    least = np.radians(config.min_turn_deg)
    if rms[0] < least:
        raise DegenerateError(
            f"hand-eye: the hand does not turn between the views (RMS {np.degrees(rms[0]):.2f} "
            f"deg, at least {config.min_turn_deg:g} are needed): nothing of the camera's place in "
            "the hand can be observed. Add views that tilt the hand by 20 deg or more about two "
            "different axes, and roll it about the optical axis."
        )
    if rms[1] < least:
        raise DegenerateError(
            "hand-eye: the hand turns about one axis only, "
            f"{_axis_text(axes[:, 0])} of the tool frame (RMS {np.degrees(rms[0]):.1f} deg; about "
            f"the next axis {np.degrees(rms[1]):.2f} deg, at least {config.min_turn_deg:g} are "
            "needed): the camera's position along this axis is unobservable, its angle about it "
            f"poorly so. Add views that tilt the hand by 20 deg or more about "
            f"{_axis_text(axes[:, 1])} or {_axis_text(axes[:, 2])}."
        )
    return np.asarray(rms, dtype=np.float64)


def _axis_text(axis: Array) -> str:
    """Return an axis as [x, y, z] with its largest component positive."""
    axis = axis * np.sign(axis[np.argmax(np.abs(axis))])
    return f"[{axis[0]:.2f}, {axis[1]:.2f}, {axis[2]:.2f}]"


def park(Ts_base_ee: ArrayLike, Ts_cam_board: ArrayLike) -> tuple[Array, Array]:
    """Return (T_ee_cam, T_base_board) after Park & Martin (IEEE TRA 10(5), 1994).

    R = (M^T M)^-1/2 M^T with M = sum_k b_k a_k^T over the rotation vectors of the pairs; then
    (R_A - I) t = R t_B - t_A by least squares over the pairs, both ways round.

    Raises:
        DegenerateError: the motion does not determine the hand-eye.
    """
    check_observable(Ts_base_ee)
    m = _without_half_turns(motions(Ts_base_ee, Ts_cam_board))
    a, b = se3.log_so3(m.Ts_hand[:, :3, :3]), se3.log_so3(m.Ts_cam[:, :3, :3])
    R = nearest_rotation(a.T @ b)
    # Unlike the rotation, this equation of a pair differs from that of the pair reversed.
    hand = np.concatenate([m.Ts_hand, se3.invert(m.Ts_hand)])
    cam = np.concatenate([m.Ts_cam, se3.invert(m.Ts_cam)])
    left = hand[:, :3, :3] - np.eye(3)
    right = cam[:, :3, 3] @ R.T - hand[:, :3, 3]
    t = np.linalg.lstsq(left.reshape(-1, 3), right.ravel(), rcond=None)[0]
    X = se3.from_rt(R, t)
    return X, mean_board(Ts_base_ee, X, Ts_cam_board)


def daniilidis(Ts_base_ee: ArrayLike, Ts_cam_board: ArrayLike) -> tuple[Array, Array]:
    """Return (T_ee_cam, T_base_board) after Daniilidis (IJRR 18(3), 1999): dual quaternions.

    Every pair gives S (q, q') = 0 with S = [[a - b, [a + b]x, 0, 0], [a' - b', [a' + b']x, a - b,
    [a + b]x]]; the solution lies in the plane of the two least singular vectors, where |q| = 1 and
    q . q' = 0 pick it out. Lengths are divided by the median hand translation, so that the balance
    of rotation and translation does not depend on the unit.

    Raises:
        DegenerateError: the motion does not determine the hand-eye.
    """
    check_observable(Ts_base_ee)
    m = _without_half_turns(motions(Ts_base_ee, Ts_cam_board))
    length = max(float(np.median(np.linalg.norm(m.Ts_hand[:, :3, 3], axis=-1))), 1e-9)
    a, a_dual = _dual_quaternion(m.Ts_hand, length)
    b, b_dual = _dual_quaternion(m.Ts_cam, length)
    S = np.zeros((len(a), 6, 8))
    S[:, :3, 0] = S[:, 3:, 4] = (a - b)[:, 1:]
    S[:, :3, 1:4] = S[:, 3:, 5:] = se3.hat((a + b)[:, 1:])
    S[:, 3:, 0] = (a_dual - b_dual)[:, 1:]
    S[:, 3:, 1:4] = se3.hat((a_dual + b_dual)[:, 1:])
    v1, v2 = np.linalg.svd(S.reshape(-1, 8), full_matrices=False)[2][-2:]
    q, q_dual = _unit_dual_in_plane(v1, v2)
    R = se3.from_quaternion_wxyz(q)
    # t = 2 q' q^-1, its vector part
    t = 2 * (q[0] * q_dual[1:] - q_dual[0] * q[1:] - np.cross(q_dual[1:], q[1:]))
    X = se3.from_rt(R, t * length)
    return X, mean_board(Ts_base_ee, X, Ts_cam_board)


def shah(Ts_base_ee: ArrayLike, Ts_cam_board: ArrayLike) -> tuple[Array, Array]:
    """Return (T_ee_cam, T_base_board) after Shah (ASME J. Mech. Robot. 5(3), 2013).

    With B_i = C_i^-1, R_Ai R_X = R_Z R_Bi is vec(R_X) = (R_Bi^T kron R_Ai^T) vec(R_Z); the leading
    singular vectors of the sum of the Kronecker products are vec(R_X) and vec(R_Z). Then
    R_Ai t_X - t_Z = R_Z t_Bi - t_Ai by least squares.

    Raises:
        DegenerateError: the motion does not determine the hand-eye.
    """
    check_observable(Ts_base_ee)
    A = np.asarray(Ts_base_ee, dtype=np.float64)
    B = se3.invert(Ts_cam_board)
    RA, RB = A[:, :3, :3], B[:, :3, :3]
    K = sum(np.kron(rb.T, ra.T) for ra, rb in zip(RA, RB, strict=True))
    U, _, Vt = np.linalg.svd(np.asarray(K))
    # vec stacks columns, numpy stacks rows
    Rx, Rz = U[:, 0].reshape(3, 3).T, Vt[0].reshape(3, 3).T
    Rx = nearest_rotation(Rx * np.sign(np.linalg.det(Rx)))
    Rz = nearest_rotation(Rz * np.sign(np.linalg.det(Rz)))
    left = np.concatenate([RA, np.broadcast_to(-np.eye(3), RA.shape)], -1)
    right = B[:, :3, 3] @ Rz.T - A[:, :3, 3]
    t = np.linalg.lstsq(left.reshape(-1, 6), right.ravel(), rcond=None)[0]
    return se3.from_rt(Rx, t[:3]), se3.from_rt(Rz, t[3:])


CLOSED_FORMS: dict[str, Callable[[ArrayLike, ArrayLike], tuple[Array, Array]]] = {
    "park": park,
    "daniilidis": daniilidis,
    "shah": shah,
}
"""Every closed form by name: (Ts_base_ee, Ts_cam_board) -> (T_ee_cam, T_base_board)."""


def mean_board(Ts_base_ee: ArrayLike, T_ee_cam: ArrayLike, Ts_cam_board: ArrayLike) -> Array:
    """Return T_base_board (4, 4): the mean of A_i X C_i (chordal mean of the rotations)."""
    Z = np.asarray(Ts_base_ee) @ np.asarray(T_ee_cam) @ np.asarray(Ts_cam_board)
    return se3.from_rt(se3.mean_rotation(Z[:, :3, :3]), Z[:, :3, 3].mean(0))


def nearest_rotation(M: Array) -> Array:
    """Return the rotation nearest to M (3, 3) in the Frobenius norm."""
    U, _, Vt = np.linalg.svd(M)
    return np.asarray(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt, dtype=np.float64)


def _without_half_turns(m: Motions) -> Motions:
    """Return the motions without those near 180 deg, where the axis has no sure sign."""
    turn = np.maximum(se3.angle(m.Ts_hand), se3.angle(m.Ts_cam))
    keep = turn < HALF_TURN
    if not keep.any():
        raise DegenerateError(
            "hand-eye: every pair of views turns the hand by about 180 deg; add views in between."
        )
    return Motions(Ts_hand=m.Ts_hand[keep], Ts_cam=m.Ts_cam[keep], pairs=m.pairs[keep])


def _dual_quaternion(T: Array, length: float) -> tuple[Array, Array]:
    """Return real and dual part (N, 4) of rigid transforms, lengths in units of `length`."""
    q = se3.quaternion_wxyz(T[:, :3, :3])
    t = T[:, :3, 3] / length
    w, v = q[:, :1], q[:, 1:]
    dual = 0.5 * np.concatenate([-(t * v).sum(-1, keepdims=True), w * t + np.cross(t, v)], -1)
    return q, dual


def _unit_dual_in_plane(v1: Array, v2: Array) -> tuple[Array, Array]:
    """Return the unit dual quaternion l1 v1 + l2 v2: q . q' = 0 and |q| = 1."""
    (u1, w1), (u2, w2) = (v1[:4], v1[4:]), (v2[:4], v2[4:])
    # l1^2 u1.w1 + l1 l2 (u1.w2 + u2.w1) + l2^2 u2.w2 = 0: of both roots the one with the larger |q|
    a, b, c = u1 @ w1, u1 @ w2 + u2 @ w1, u2 @ w2
    if abs(a) < 1e-14 and abs(c) < 1e-14:
        candidates = [(1.0, 0.0), (0.0, 1.0)]
    else:
        swap = abs(c) > abs(a)
        roots = np.roots([c, b, a] if swap else [a, b, c]).real
        candidates = [(1.0, float(s)) if swap else (float(s), 1.0) for s in roots]
    lengths = [float(np.linalg.norm(l1 * u1 + l2 * u2) / np.hypot(l1, l2)) for l1, l2 in candidates]
    l1, l2 = candidates[int(np.argmax(lengths))]
    q, dual = l1 * u1 + l2 * u2, l1 * w1 + l2 * w2
    n = np.linalg.norm(q)
    return q / n, dual / n
