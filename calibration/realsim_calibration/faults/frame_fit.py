"""Robust fit of the two constant frames in A_i X C_i = Z, with a free ratio of lengths.

C_i = T_cam_board. Camera in the hand: A_i = T_base_ee, X = T_ee_cam, Z = T_base_board. Fixed
camera: A_i = T_ee_base, X = T_base_cam, Z = T_ee_board. With m the board's middle, whose place in
the camera q_i = C_i m is far surer than the camera's place seen from a board of uncertain tilt:

    R_Ai R_X R_Ci = R_Z,        R_Ai (s R_X q_i + t_X) + t_Ai = z

s is how many times longer a metre of the camera is in the hand's unit: 1 for right data. Half of
the views may be wrong. The rotations start from triples of views (Park's mean of their turns, the
triple that most views agree with, MSAC after Torr & Zisserman, CVIU 78(1), 2000), the translations
from groups of views given the rotations (linear), and all 13 unknowns are refined together by
Gauss-Newton with Geman-McClure weights.
"""

from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array, Int64
from realsim.compiled import njit
from realsim.geometry import se3
from realsim_calibration.fit import closed_forms

RIDGE = 1e-9
"""Share of the mean curvature that decides what the views do not determine."""
SETTLED = 1e-9
"""A step shorter than this, in units of the distance and radians, ends the fit."""
COLLAPSED = 0.02
"""A ratio that makes the camera's motion this part of the hand's is a collapse, not a fit."""
UNIT_DEG = 0.5
"""A rotation error of this size counts 1 [deg]: twice that of a good robot and board."""
UNIT_PART = 0.01
"""A translation error of this part of the camera's distance counts 1: 4 mm at 0.4 m."""
AGREE = 3.0
"""Views with a larger error do not speak for a sample."""
CAP = 20.0
"""No view counts more than this in the score: one bad view must not outweigh a reading."""
SAMPLES = 120
"""Triples and groups that are tried: with half of the views wrong, one in eight triples is
good, and 120 miss all of them once in 10^7 times."""
GROUP = 5
"""Views that start the translations: 15 equations for 7 unknowns."""
WIDTH_SHARE = 0.5
"""The width of the refinement's weights follows the error of this share of the views: the
median, unless as many as half of the views may be wrong."""
STEPS = 12
"""Gauss-Newton steps: the start is near, six are usual."""
SEED = 0
"""Seed of the samples: the same data give the same answer."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class FrameFit:
    """The frames that fit most views, and how each view fits."""

    X: Array
    """(4, 4) the camera in the frame that A maps from [hand's unit]."""
    Z: Array
    """(4, 4) the board, its length in the hand's unit, in the frame that A maps to."""
    middle: Array
    """(3,) m [camera's unit]."""
    length_ratio: float
    """s: the hand's lengths over the camera's; 1 for right data."""
    ratio_sd: float
    """1-sigma of s / s from the scatter of the views that agree."""
    distance: float
    """Median |q| [camera's unit]."""
    angles: Array
    """(n,) rotation error per view [rad]."""
    slips: Array
    """(n,) translation error per view [camera's unit]."""
    errors: Array
    """(n,) both in UNIT_DEG and UNIT_PART."""
    score: float
    """RMS of the capped errors, corrected for the 13 unknowns: 0.2 to 1.5 for right data."""
    usual: float
    """Median error of the views."""

    @property
    def usual_deg(self) -> float:
        """Median rotation error [deg]."""
        return float(np.degrees(np.median(self.angles)))

    @property
    def usual_mm(self) -> float:
        """Median translation error [mm, where the camera's unit is the metre]."""
        return float(1e3 * np.median(self.slips))


def hand_side(Ts_base_ee: ArrayLike, eye_in_hand: bool) -> Array:
    """Return A (n, 4, 4): T_base_ee for a camera in the hand, T_ee_base for a fixed one."""
    T = np.asarray(Ts_base_ee, dtype=np.float64)
    return T if eye_in_hand else se3.invert(T)


def fit_frames(
    A: ArrayLike,
    C: ArrayLike,
    middle: ArrayLike = (0.0, 0.0, 0.0),
    *,
    width_share: float = WIDTH_SHARE,
) -> FrameFit:
    """Return the frames and the ratio of lengths that most views agree with.

    Args:
        A: (n, 4, 4) hand poses (`hand_side`), any unit of length.
        C: (n, 4, 4) board poses, any unit of length.
        middle: (3,) the board's middle in the board's frame, in the unit of C.
        width_share: see WIDTH_SHARE.

    Raises:
        InputError: fewer than three views, or stacks of different lengths.
    """
    A, C = closed_forms.pose_stacks(A, C, "hand-eye", least=closed_forms.MIN_VIEWS)
    m = np.asarray(middle, dtype=np.float64)
    q = C[:, :3, :3] @ m + C[:, :3, 3]
    rng = np.random.default_rng(SEED)
    Rx, Rz = _start_rotations(A, C, rng)
    distance = max(float(np.median(np.linalg.norm(q, axis=-1))), 1e-12)
    linear = _start_translations(A, q, Rx, distance, rng)
    return _refine(A, C[:, :3, :3], q, (Rx, Rz, linear), m, width_share)


def mean_transform(Ts: Array) -> Array:
    """Return the mean (4, 4) of transforms (n, 4, 4), its translation the median."""
    return se3.from_rt(se3.mean_rotation(Ts[:, :3, :3]), np.median(Ts[:, :3, 3], 0))


def mismatch(fit: FrameFit, A: ArrayLike, C: ArrayLike) -> Array:
    """Return the error (k, l) of k hand poses with l board poses through frames already known."""
    A, C = np.asarray(A, dtype=np.float64), np.asarray(C, dtype=np.float64)
    left = A @ fit.X
    Rs = fit.Z[:3, :3] @ np.swapaxes(C[:, :3, :3], -1, -2)
    angle = chord_angle(left[:, None, :3, :3], Rs[None])
    seen = fit.length_ratio * (C[:, :3, :3] @ fit.middle + C[:, :3, 3])
    where = np.einsum("kij,lj->kli", left[:, :3, :3], seen) + left[:, None, :3, 3]
    z = fit.Z[:3, :3] @ fit.middle * fit.length_ratio + fit.Z[:3, 3]
    slip = np.linalg.norm(where - z, axis=-1) / fit.length_ratio
    return np.hypot(angle / np.radians(UNIT_DEG), slip / (fit.distance * UNIT_PART))


def chord_angle(R: Array, S: Array) -> Array:
    """Return the angle between rotations from their chord, exact for small angles [rad]."""
    chord = np.linalg.norm(R - S, axis=(-2, -1))
    return 2 * np.arcsin(np.clip(chord / np.sqrt(8.0), 0.0, 1.0))


def _nearest_rotations(M: Array) -> Array:
    """Return the rotations nearest to matrices (..., 3, 3)."""
    U, _, Vt = np.linalg.svd(M)
    U[..., :, 2] *= np.sign(np.linalg.det(U @ Vt))[..., None]
    return U @ Vt


def _draw(n: int, size: int, samples: int, rng: np.random.Generator) -> Int64:
    """Return (samples, size) different views each; all groups where there are few."""
    if n <= size:
        return np.arange(n)[None]
    if n <= 3 * size:
        every = np.array(list(combinations(range(n), size)))
        return rng.permutation(every)[:samples]
    return np.argsort(rng.random((samples, n)), axis=1)[:, :size]


def _turns(A: Array, C: Array) -> tuple[Array, Array]:
    """Return the turns (n, n, 3) of hand and camera between views, 0 near half turns [rad]."""
    hand, cam = closed_forms.motions(A, C)
    clear = closed_forms.clear_of_half_turns(hand, cam)[:, None]
    i, j = np.triu_indices(len(A), 1)
    turns = np.zeros((2, len(A), len(A), 3))
    turns[0, i, j], turns[1, i, j] = hand.turns * clear, cam.turns * clear
    return turns[0], turns[1]


def _start_rotations(A: Array, C: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return R_X and R_Z that most views agree with."""
    Ra, Rd = A[:, :3, :3], np.swapaxes(C[:, :3, :3], -1, -2)
    a, b = _turns(A, C)
    triples = np.sort(_draw(len(Ra), 3, 3 * SAMPLES, rng), axis=1)
    i, j, k = triples.T
    M = sum(a[p, q][:, :, None] * b[p, q][:, None, :] for p, q in ((i, j), (i, k), (j, k)))
    M = np.asarray(M, dtype=np.float64)
    # Triples that turn about one axis only say little: the better third is kept.
    order = np.argsort(-np.linalg.svd(M, compute_uv=False)[:, 1])[:SAMPLES]
    everything = np.einsum("ijk,ijl->kl", a, b)
    Rx = _nearest_rotations(np.concatenate([M[order], everything[None]]))
    Zs = Ra @ Rx[:, None] @ np.swapaxes(Rd, -1, -2)
    members = np.concatenate([Zs[np.arange(len(order))[:, None], triples[order]].sum(1),
                              Zs[-1:].sum(1)])  # fmt: skip
    Rz = _nearest_rotations(members)
    limit = np.radians(UNIT_DEG) * AGREE
    loss = np.minimum(chord_angle(Zs, Rz[:, None]), limit)
    best = int(np.argmin(np.sum(loss**2, 1)))
    X, Z = Rx[best], Rz[best]
    for _ in range(2):
        good = chord_angle(Ra @ X @ np.swapaxes(Rd, -1, -2), Z) < limit
        if good.sum() < closed_forms.MIN_VIEWS:
            break
        w = good[:, None] & good[None, :]
        X = _nearest_rotations(np.einsum("ij,ijk,ijl->kl", w.astype(float), a, b))
        Z = _nearest_rotations((Ra[good] @ X @ np.swapaxes(Rd[good], -1, -2)).sum(0))
    return X, Z


def _start_translations(
    A: Array, q: Array, Rx: Array, distance: float, rng: np.random.Generator
) -> Array:
    """Return (7,) t_X, z, s that most views agree with, given R_X.

    R_A t_X - z + s R_A R_X q = -t_A.
    """
    n = len(A)
    rows = np.zeros((n, 3, 7))
    rows[:, :, :3], rows[:, :, 3:6] = A[:, :3, :3], -np.eye(3)
    rows[:, :, 6] = np.einsum("nij,jk,nk->ni", A[:, :3, :3], Rx, q)
    rhs = -A[:, :3, 3]
    groups = _draw(n, min(GROUP, n), SAMPLES, rng)
    size = max(float(np.median(np.linalg.norm(rhs - np.median(rhs, 0), axis=-1))), 1e-12)
    column = np.array([1, 1, 1, 1, 1, 1, distance])
    H = np.einsum("gvri,gvrj->gij", rows[groups] / column, rows[groups] / column)
    g = np.einsum("gvri,gvr->gi", rows[groups] / column, rhs[groups])
    # A trace of ridge decides what a group does not: no place along a common axis is made up.
    found = np.linalg.solve(H + 1e-9 * len(groups[0]) * np.eye(7), g[..., None])[..., 0] / column
    everything = np.linalg.lstsq((rows / column).reshape(-1, 7), rhs.ravel(), rcond=1e-9)[0]
    found = np.concatenate([found, (everything / column)[None]])
    slips = np.linalg.norm(np.einsum("nri,gi->gnr", rows, found) - rhs, axis=-1)
    # A ratio far below the spread of the hand is a collapse, not a fit.
    ratio = np.maximum(np.abs(found[:, 6:]), COLLAPSED * size / distance)
    loss = np.minimum(slips / ratio / (distance * UNIT_PART), AGREE)
    return found[int(np.argmin(np.sum(loss**2, 1) + 1e3 * (found[:, 6] <= 0)))]


def _refine(
    A: Array, Rc: Array, q: Array, start: tuple[Array, Array, Array], middle: Array,
    width_share: float,
) -> FrameFit:  # fmt: skip
    """Return the joint robust least-squares fit from a start R_X, R_Z, (t_X, z, s)."""
    Rx, Rz, (tx, z, s) = start[0], start[1], (start[2][:3], start[2][3:6], float(start[2][6]))
    n, distance = len(A), max(float(np.median(np.linalg.norm(q, axis=-1))), 1e-12)
    spread = float(np.median(np.linalg.norm(A[:, :3, 3] - np.median(A[:, :3, 3], 0), axis=-1)))
    least = max(COLLAPSED * spread / distance, 1e-9)
    s = max(s, least)
    data = (np.ascontiguousarray(A), np.ascontiguousarray(Rc), q)
    units = (np.radians(UNIT_DEG), distance, distance * UNIT_PART)
    weights = (AGREE, width_share)
    for _ in range(STEPS):
        J, r, errors, _ = _weighted(*data, Rx, Rz, tx, z, s, units, weights)
        H = J.T @ J
        move = -np.linalg.solve(H + RIDGE * np.trace(H) / 13 * np.eye(13), J.T @ r)
        if np.linalg.norm(move) < SETTLED:
            break
        turns = se3.exp_so3(move[:6].reshape(2, 3))
        Rx, Rz = Rx @ turns[0], Rz @ turns[1]
        tx, z = tx + s * distance * move[6:9], z + s * distance * move[9:12]
        # The unit of the residual follows s: a step may not carry it through zero.
        s = max(s * float(np.exp(np.clip(move[12], -1.0, 1.0))), least)
    J, rw, errors, r = _weighted(*data, Rx, Rz, tx, z, s, units, weights)
    freedom = max(6 * n - 13, 1)
    capped = np.minimum(errors, CAP)
    inverse = np.linalg.pinv(J.T @ J, hermitian=True)
    return FrameFit(
        X=se3.from_rt(Rx, tx), Z=se3.from_rt(Rz, z - s * Rz @ middle), middle=middle,
        length_ratio=s,
        ratio_sd=float(np.sqrt(max(inverse[12, 12], 0.0) * float(rw @ rw) / freedom)),
        distance=distance, angles=np.linalg.norm(r[:, :3], axis=-1),
        slips=np.linalg.norm(r[:, 3:], axis=-1) / s, errors=errors,
        score=float(np.sqrt(np.sum(capped**2) * 6 / freedom)), usual=float(np.median(errors)),
    )  # fmt: skip


@njit
def _weighted(  # noqa: PLR0913, PLR0917 - compiled code takes no records
    A: Any, Rc: Any, q: Any, Rx: Any, Rz: Any, tx: Any, z: Any, s: float, units: Any, weights: Any
) -> Any:
    """Return J (6 n, 13) and r (6 n) in units, weighted; the errors (n,), and r before that.

    Lengths among the unknowns are in units of the distance, s in units of itself.
    """
    turn, distance, part = units
    J, r = linearise(A, Rc, q, Rx, Rz, tx, z, s)
    unit = np.array([turn, turn, turn, s * part, s * part, s * part])
    errors = np.sqrt(np.sum((r / unit) ** 2, axis=1))
    width = weights[0] * max(np.quantile(errors, weights[1]), 1.0)
    root = (1.0 / (1.0 + (errors / width) ** 2)).reshape(-1, 1) / unit
    J[:, :, 6:12] *= s * distance
    J[:, :, 12] *= s
    return (J * root[:, :, None]).reshape(-1, 13), (r * root).ravel(), errors, r


@njit
def linearise(A: Any, Rc: Any, q: Any, Rx: Any, Rz: Any, tx: Any, z: Any, s: float) -> Any:
    """Return J (n, 6, 13) and residuals (n, 6): R_X, R_Z turned on the right, then t_X, z, s."""
    J, r = np.zeros((len(A), 6, 13)), np.empty((len(A), 6))
    for k in range(len(A)):
        R = np.ascontiguousarray(A[k, :3, :3]) @ Rx
        # The turn is measured on the right of R_X: R_C R_Z^T R_A R_X.
        r[k, :3] = _log(Rc[k] @ (Rz.T @ R))
        for i in range(3):
            J[k, i, i], J[k, i, 3:6], J[k, 3 + i, 9 + i] = 1.0, -Rc[k, i], -1.0
            J[k, 3 + i, :3] = -s * np.cross(R[i], q[k])
            J[k, 3 + i, 6:9], J[k, 3 + i, 12] = A[k, i, :3], R[i] @ q[k]
            r[k, 3 + i] = s * J[k, 3 + i, 12] + A[k, i, :3] @ tx + A[k, i, 3] - z[i]
    return J, r


@njit
def _log(R: Any) -> Any:
    """Return the rotation vector of a rotation (`se3.log_so3`)."""
    a, b, c = R[0, 0], R[1, 1], R[2, 2]
    x, y, z = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    u, v, w = R[0, 1] + R[1, 0], R[0, 2] + R[2, 0], R[1, 2] + R[2, 1]
    rows = np.array([
        [1 + a + b + c, x, y, z], [x, 1 + a - b - c, u, v],
        [y, u, 1 - a + b - c, w], [z, v, w, 1 - a - b + c],
    ])  # fmt: skip
    row = rows[np.argmax(np.diag(rows))]
    q = row / (np.sqrt(np.sum(row**2)) * (1.0 if row[0] >= 0 else -1.0))
    n = np.sqrt(np.sum(q[1:] ** 2))
    return q[1:] * (2.0 if n < 1e-12 else 2.0 * np.arctan2(n, q[0]) / n)
