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
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array, Mask
from realsim.errors import DegenerateError, InputError
from realsim.geometry import se3

HALF_TURN = np.radians(175.0)
"""Pairs that turn further are left out: near 180 deg the sign of the axis is decided by noise."""
MIN_VIEWS = 3
"""Two motions about different axes need three poses; two frames and a ratio of lengths, 13
unknowns, too: a view gives 6 equations."""
MIN_TURN_DEG = 2.0
"""Least RMS rotation of the view pairs about the second-best axis [deg]: ten times the angle
error of a planar pose seen from half a metre."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Relative:
    """The motions between all pairs i < j of a stack of poses."""

    Ts: Array
    """(P, 4, 4) T_j^-1 T_i [m]."""
    turns: Array
    """(P, 3) their rotation vectors [rad]."""


@lru_cache(maxsize=6)
def _relative(poses: bytes) -> Relative:
    # The tests of conventions, motion and turns, the gates and the closed forms all ask for the
    # pairs of the same views: 33,000 of 256.
    T = np.frombuffer(poses).reshape(-1, 4, 4)
    i, j = np.triu_indices(len(T), 1)
    Ts = se3.invert(T)[j] @ T[i]
    found = Relative(Ts=Ts, turns=se3.log_so3(Ts[:, :3, :3]))
    for array in (found.Ts, found.turns):
        array.setflags(write=False)
    return found


def relative(Ts: ArrayLike) -> Relative:
    """Return the motions T_j^-1 T_i between all pairs i < j of poses (N, 4, 4), computed once.

    Of hand poses T_base_ee they are A_ij, of T_board_cam = C^-1 they are B_ij.
    """
    return _relative(np.ascontiguousarray(Ts, dtype=np.float64).tobytes())


def motions(Ts_base_ee: ArrayLike, Ts_cam_board: ArrayLike) -> tuple[Relative, Relative]:
    """Return the motions of hand and camera between all pairs of N views.

    Raises:
        InputError: the two stacks do not have the same number of poses.
    """
    A, C = pose_stacks(Ts_base_ee, Ts_cam_board, "hand-eye")
    return relative(A), relative(se3.invert(C))


def pose_stacks(
    Ts_base_ee: ArrayLike, Ts: ArrayLike, what: str, *, least: int = 0, others: str = "board poses"
) -> tuple[Array, Array]:
    """Return two stacks (n, 4, 4) of poses that belong together.

    Args:
        Ts_base_ee: hand poses.
        Ts: what was measured beside each.
        what: is done with them, for the message.
        least: how many are needed.
        others: what the second stack holds, for the message.

    Raises:
        InputError: stacks of different lengths, or fewer than `least`.
    """
    A = np.asarray(Ts_base_ee, dtype=np.float64).reshape(-1, 4, 4)
    C = np.asarray(Ts, dtype=np.float64).reshape(-1, 4, 4)
    if len(A) != len(C) or len(A) < least:
        needed = f"at least {least} views with one of each are needed"
        raise InputError(
            f"{what}: {len(A)} hand poses and {len(C)} {others} were given; "
            f"{needed if least else 'every view needs one of each'}."
        )
    return A, C


def principal_turns(turns: Array) -> tuple[Array, Array]:
    """Return the RMS (3,) of turns (P, 3) about their principal axes, descending, and the axes.

    The axes (3, 3) stand in columns.
    """
    values, axes = np.linalg.eigh(turns.T @ turns / len(turns))
    return np.sqrt(np.maximum(values[::-1], 0.0)), axes[:, ::-1]


def check_observable(Ts_base_ee: ArrayLike) -> Array:
    """Return the RMS rotation of the view pairs about the three principal axes [rad], descending.

    The hand-eye is determined when the hand turns about two different axes (Chen 1991). With one
    axis a only, the camera's place along a, and unless the hand also translates across it the
    camera's angle about a, cannot be seen.

    Args:
        Ts_base_ee: (N, 4, 4) hand poses [m].

    Raises:
        DegenerateError: too few views, no rotation, or rotation about one axis only.
    """
    A = np.asarray(Ts_base_ee, dtype=np.float64).reshape(-1, 4, 4)
    if len(A) < MIN_VIEWS:
        raise DegenerateError(
            f"hand-eye: {len(A)} usable views; at least {MIN_VIEWS} that turn the hand "
            "about two different axes are needed, and 12 or more are advised."
        )
    rms, axes = principal_turns(relative(A).turns)
    least = np.radians(MIN_TURN_DEG)
    if rms[0] < least:
        raise DegenerateError(
            f"hand-eye: the hand does not turn between the views (RMS {np.degrees(rms[0]):.2f} "
            f"deg, at least {MIN_TURN_DEG:g} are needed): nothing of the camera's place in "
            "the hand can be observed. Add views that tilt the hand by 20 deg or more about two "
            "different axes, and roll it about the optical axis."
        )
    if rms[1] < least:
        raise DegenerateError(
            "hand-eye: the hand turns about one axis only, "
            f"{_axis_text(axes[:, 0])} of the tool frame (RMS {np.degrees(rms[0]):.1f} deg; about "
            f"the next axis {np.degrees(rms[1]):.2f} deg, at least {MIN_TURN_DEG:g} are "
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
    A, B, clear = _clear_motions(Ts_base_ee, Ts_cam_board)
    R = nearest_rotation(A.turns[clear].T @ B.turns[clear])
    hand, cam = A.Ts[clear], B.Ts[clear]
    H, g = np.zeros((3, 3)), np.zeros(3)
    # Unlike the rotation, this equation of a pair differs from that of the pair reversed.
    for a, b in ((hand, cam), (se3.invert(hand), se3.invert(cam))):
        left = (a[:, :3, :3] - np.eye(3)).reshape(-1, 3)
        H += left.T @ left
        g += left.T @ (b[:, :3, 3] @ R.T - a[:, :3, 3]).ravel()
    X = se3.from_rt(R, np.linalg.solve(H, g))
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
    A, B, clear = _clear_motions(Ts_base_ee, Ts_cam_board)
    length = max(float(np.median(np.linalg.norm(A.Ts[clear, :3, 3], axis=-1))), 1e-9)
    a, a_dual = _dual_quaternion(A, clear, length)
    b, b_dual = _dual_quaternion(B, clear, length)
    S = np.zeros((len(a), 6, 8))
    S[:, :3, 0] = S[:, 3:, 4] = (a - b)[:, 1:]
    S[:, :3, 1:4] = S[:, 3:, 5:] = se3.hat((a + b)[:, 1:])
    S[:, 3:, 0] = (a_dual - b_dual)[:, 1:]
    S[:, 3:, 1:4] = se3.hat((a_dual + b_dual)[:, 1:])
    flat = S.reshape(-1, 8)
    v2, v1 = np.linalg.eigh(flat.T @ flat)[1].T[:2]
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
    K = np.einsum("nji,nlk->ikjl", RB, RA).reshape(9, 9)
    U, _, Vt = np.linalg.svd(K)
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


def _clear_motions(
    Ts_base_ee: ArrayLike, Ts_cam_board: ArrayLike
) -> tuple[Relative, Relative, Mask]:
    """Return the motions of hand and camera and which (P,) are clear of half turns.

    Near 180 deg the axis has no sure sign.
    """
    A, B = motions(Ts_base_ee, Ts_cam_board)
    clear = clear_of_half_turns(A, B)
    if not clear.any():
        raise DegenerateError(
            "hand-eye: every pair of views turns the hand by about 180 deg; add views in between."
        )
    return A, B, clear


def clear_of_half_turns(hand: Relative, cam: Relative) -> Mask:
    """Return which pairs (P,) turn neither hand nor camera by nearly 180 deg."""
    turn = np.maximum(*(np.linalg.norm(m.turns, axis=-1) for m in (hand, cam)))
    return turn < HALF_TURN


def _dual_quaternion(m: Relative, rows: Mask, length: float) -> tuple[Array, Array]:
    """Return real and dual part (N, 4) of some motions, lengths in units of `length`."""
    turns, t = m.turns[rows], m.Ts[rows, :3, 3] / length
    angle = np.linalg.norm(turns, axis=-1, keepdims=True)
    w, v = np.cos(angle / 2), turns * np.sinc(angle / (2 * np.pi)) / 2
    q = np.concatenate([w, v], -1)
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
