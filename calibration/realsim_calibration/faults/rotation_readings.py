"""What if the rotations were decoded by another convention? Encode them back and read them anew.

A rotation that was decoded from three numbers by convention E gives these numbers back, up to the
few forms in which E can write it; read by convention F they give the rotation that was meant. Which
pair (E, F) is right is found without any hand-eye: positions and images alone fix the rotation R_Z
of the base,

    R_Z^T t_A - w - s t_D + R_D u = 0        (D = T_board_cam in the hand, T_cam_board fixed;
                                              u = R_X^T t_X with X on the hand's side)

after which every form of every view votes for its R_X = R_A^T R_Z R_D: the right pair's votes
coincide.
"""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import permutations

import numpy as np

from realsim.arrays import Array
from realsim.geometry import se3
from realsim_calibration.inputs.readings import ROTATIONS, PoseReading

AXES = "xyz"
JUDGES = 12
"""Views that judge the pairs of the first two Euler angles: chance passes one in 10^5."""
PAIRS_KEPT = 30
"""Pairs of the first two Euler angles, of 3000, for which the third is tried."""


AGREE_DEG = 5.0
"""Two votes for R_X within this angle agree [deg]: several times the error of R_Z that 2 mm of
robot error leave over 0.2 m, and a chance agreement of forms is one in 10^4."""
STARTS = 64
"""Rotations from which the base's is sought: the cost has few minima."""
STEPS = 30
"""Gauss-Newton steps from every start."""
MINIMA = 2
"""Different minima that may vote: positions near a plane have a mirror twin."""
FINALISTS = 4
"""Readings whose poses are fitted in full after the vote."""
NUMBER_TOLERANCE = 1.25
"""Degrees that are known modulo 2 pi = 6.28 agree within this: twice the error that R_Z has."""
SEED = 0
"""Seed of the starts."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Convention:
    """A way to write a rotation in three or four numbers."""

    name: str
    decode: Callable[[Array], Array]
    """(..., k) numbers -> (..., 3, 3)."""
    encode: Callable[[Array], Array]
    """(n, 3, 3) -> (n, forms, k): every form in which a rotation can have been written."""
    middle: int | None = None
    """Place of the middle Euler angle, which programs write within 90 deg; None = no angles."""


def _axis_rotation(axis: int, angle: Array) -> Array:
    w = np.zeros((*angle.shape, 3))
    w[..., axis] = angle
    return se3.exp_so3(w)


def euler_rotation(order: str, slots: tuple[int, int, int], numbers: Array) -> Array:
    """Return R = R_order[0](numbers[slots[0]]) R_order[1](...) R_order[2](...)."""
    a, b, c = (
        _axis_rotation(AXES.index(o), numbers[..., k]) for o, k in zip(order, slots, strict=True)
    )
    return a @ b @ c


def euler_numbers(order: str, slots: tuple[int, int, int], R: Array) -> Array:
    """Return both forms (..., 2, 3) [rad] in which rotations (..., 3, 3) are written.

    Tait-Bryan angles of the product R_i(a) R_j(b) R_k(c): with e the sign of the order i j k,
    sin b = e R_ik, tan a = -e R_jk / R_kk, tan c = -e R_ij / R_ii.
    """
    i, j, k = (AXES.index(o) for o in order)
    e = 1.0 if (j - i) % 3 == 1 else -1.0
    b = np.arctan2(e * R[..., i, k], np.hypot(R[..., i, i], R[..., i, j]))
    a = np.arctan2(-e * R[..., j, k], R[..., k, k])
    c = np.arctan2(-e * R[..., i, j], R[..., i, i])
    forms = np.empty((*R.shape[:-2], 2, 3))
    for form, values in enumerate(((a, b, c), (a + np.pi, np.pi - b, c + np.pi))):
        for slot, value in zip(slots, values, strict=True):
            forms[..., form, slot] = (value + np.pi) % (2 * np.pi) - np.pi
    return forms


def rotation_vectors(R: Array) -> Array:
    """Return both forms (n, 2, 3) [rad]: the short way round and the long one."""
    w = se3.log_so3(R)
    n = np.maximum(np.linalg.norm(w, axis=-1, keepdims=True), 1e-12)
    return np.stack([w, w * (1 - 2 * np.pi / n)], -2)


def reading_of(meant: str) -> PoseReading | None:
    """Return the reading of a pose file in metres that a convention's name means, None = none."""
    text = meant.removesuffix(" in degrees")
    euler = re.match(r"Euler (?:angles \(product )?([xyzXYZ]{3})", text)
    matrix = text == "matrices column by column"
    name = f"euler_{euler[1]}" if euler else "matrix_column_major" if matrix else text
    rotation = name.replace(" ", "_", 1).replace(" ", "")
    if rotation not in ROTATIONS:
        return None
    return PoseReading(rotation=rotation, angle_unit="rad" if text == meant else "deg")


def _euler(name: str, order: str, slots: tuple[int, int, int]) -> Convention:
    return Convention(
        name=name,
        decode=lambda v: euler_rotation(order, slots, v),
        encode=lambda R: euler_numbers(order, slots, R),
        middle=slots[1],
    )


def three_number_conventions() -> tuple[Convention, ...]:
    """Return the rotation vector and every Euler convention of three different axes in use.

    Angles given in the order in which they are applied (about moving axes "XYZ", about fixed axes
    "xyz"), and angles given by axis, rx ry rz, multiplied in any order.
    """
    found = [Convention(name="rotation vector", decode=se3.exp_so3, encode=rotation_vectors)]
    for p in permutations(AXES):
        order = "".join(p)
        found.append(_euler(f"Euler {order.upper()} (moving axes)", order, (0, 1, 2)))
        found.append(_euler(f"Euler {order} (fixed axes)", order[::-1], (2, 1, 0)))
    for p in permutations(AXES):
        order = "".join(p)
        i, j, k = (AXES.index(o) for o in order)
        # The product x y z (z y x) of rx ry rz is XYZ (xyz) above.
        if order not in ("xyz", "zyx"):
            product = " ".join(f"R{o}" for o in order)
            found.append(_euler(f"rx ry rz as the product {product}", order, (i, j, k)))
    return tuple(found)


def four_number_conventions() -> tuple[Convention, ...]:
    """Return the two orders of a quaternion's numbers."""

    def signs(q: Array) -> Array:
        return q[..., None, :]

    return (
        Convention(name="quaternion w x y z", decode=se3.from_quaternion_wxyz,
                   encode=lambda R: signs(se3.quaternion_wxyz(R))),
        Convention(name="quaternion x y z w",
                   decode=lambda q: se3.from_quaternion_wxyz(np.roll(q, 1, axis=-1)),
                   encode=lambda R: signs(np.roll(se3.quaternion_wxyz(R), -1, axis=-1))),
    )  # fmt: skip


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Reread:
    """Rotations read anew."""

    name: str
    meant: str
    """The convention that fits."""
    read_as: str
    """The convention by which they were decoded."""
    Rs: Array
    """(n, 3, 3)."""
    agreement: float
    """RMS of the votes' distances from the winner, each at most `agree_deg`, over `agree_deg`."""
    snap: Callable[[Array], Array] | None = None
    """For degrees known modulo 2 pi: the rotations they allow nearest to predicted ones."""


def base_rotations(t_A: Array, D: Array) -> list[Array]:
    """Return the rotations (3, 3) of the base that positions and images allow, the best first.

    The equation above is linear in w, s and u; projected on what they cannot explain it is B vec M
    with M = R_Z^T, and |B vec M|^2 is minimised over SO(3) from many starts.
    """
    n = len(t_A)
    spread = max(float(np.sqrt(np.mean(np.sum((t_A - t_A.mean(0)) ** 2, -1)))), 1e-12)
    length = max(float(np.median(np.linalg.norm(D[:, :3, 3], axis=-1))), 1e-12)
    linear = np.zeros((n, 3, 7))
    linear[:, :, :3], linear[:, :, 3:6] = np.eye(3), D[:, :3, :3]
    linear[:, :, 6] = D[:, :3, 3] / length
    known = np.einsum("ab,nc->nabc", np.eye(3), (t_A - t_A.mean(0)) / spread).reshape(3 * n, 9)
    U, S, _ = np.linalg.svd(linear.reshape(3 * n, 7), full_matrices=False)
    U = U[:, S > 1e-9 * S[0]]
    H = known - U @ (U.T @ known)
    H = H.T @ H / n
    M = se3.random_rotation(np.random.default_rng(SEED), STARTS)
    turn = np.stack([se3.hat(e) for e in np.eye(3)])
    damping = 1e-3 * np.trace(H) / 9
    for _ in range(STEPS):
        J = np.einsum("nij,cjk->nikc", M, turn).reshape(-1, 9, 3)
        gradient = np.einsum("npc,pq,nq->nc", J, H, M.reshape(-1, 9))
        curvature = np.einsum("npc,pq,nqd->ncd", J, H, J) + damping * np.eye(3)
        step = -np.linalg.solve(curvature, gradient[..., None])[..., 0]
        size = np.linalg.norm(step, axis=-1, keepdims=True)
        M = M @ se3.exp_so3(step * np.minimum(1.0, 0.5 / np.maximum(size, 1e-12)))
    costs = np.einsum("np,pq,nq->n", M.reshape(-1, 9), H, M.reshape(-1, 9))
    found: list[Array] = []
    for k in np.argsort(costs):
        if all(se3.angle(M[k] @ other) > np.radians(AGREE_DEG) for other in found):
            found.append(M[k].T)
        if len(found) == MINIMA:
            break
    return found


def vote(forms: Array, G: Array, voters: int | None = None) -> tuple[Array, float]:
    """Return the forms (n, 3, 3) whose R_X = R_A^T G agree best, and their disagreement (0 to 1).

    Args:
        forms: (n, f, 3, 3) every rotation that a view may have.
        G: (n, 3, 3) R_Z R_D, which R_A R_X must be.
        voters: how many views may propose an R_X; None = all.
    """
    Rx = np.swapaxes(forms, -1, -2) @ G[:, None]
    n, f = Rx.shape[:2]
    proposals = Rx[: voters or n].reshape(-1, 9)
    # |R - S|^2 = 6 - 2 tr(R^T S)
    chord = 6 - 2 * (proposals @ Rx.reshape(-1, 9).T).reshape(-1, n, f)
    nearest = np.maximum(chord.min(-1), 0.0)
    limit = 8 * np.sin(np.radians(AGREE_DEG) / 2) ** 2
    cost = np.minimum(nearest, limit).mean(1) / limit
    best = int(np.argmin(cost))
    return forms[np.arange(n), chord[best].argmin(-1)], float(np.sqrt(cost[best]))


def _mistaken(R: Array, scale: float) -> Iterator[tuple[Convention, Convention, Array]]:
    """Yield the convention E that rotations were decoded by, F that was meant, and E's numbers.

    With a scale it is the unit that was mistaken, of angles only: F is E.
    """
    families = (three_number_conventions(), four_number_conventions())
    for family in families if scale == 1.0 else families[:1]:
        for E in family:
            numbers = E.encode(R) * scale
            for F in family if scale == 1.0 else (E,):
                if F is not E or scale != 1.0:
                    yield E, F, numbers


def reread(R: Array, t_A: Array, D: Array, scale: float = 1.0) -> list[Reread]:
    """Return the pairs of conventions whose votes agree best, the best first.

    Args:
        R: (n, 3, 3) hand rotations as decoded.
        t_A: (n, 3) hand positions.
        D: (n, 4, 4) T_board_cam (camera in the hand) or T_cam_board (fixed).
        scale: factor of the numbers (180 / pi where radians were read as degrees).
    """
    bases = base_rotations(t_A, D)
    found: list[Reread] = []
    for E, F, numbers in _mistaken(R, scale):
        found.append(_best_vote(F.decode(numbers), bases, D, F.name, E.name))
    if scale == 1.0:
        transposed = np.swapaxes(R, -1, -2)[:, None]
        found.append(_best_vote(transposed, bases, D, "matrices column by column",
                                "matrices row by row"))  # fmt: skip
    found.sort(key=lambda r: r.agreement)
    return found[:FINALISTS]


def usual_form(convention: Convention, numbers: Array) -> Array:
    """Return of numbers (n, forms, k) the form that programs write (n, k)."""
    if convention.middle is None:
        size = np.linalg.norm(numbers, axis=-1)
    else:
        size = np.abs(numbers[..., convention.middle])
    return numbers[np.arange(len(numbers)), size.argmin(-1)]


def every_reading(R: Array, scale: float = 1.0) -> list[Reread]:
    """Return what every pair of conventions makes of rotations (n, 3, 3), in the usual form.

    For poses whose positions do not fix the base's rotation well enough for a vote.
    """
    found: list[Reread] = []
    for E, F, numbers in _mistaken(R, scale):
        Rs = F.decode(usual_form(F, numbers))
        if all(np.abs(Rs - other.Rs).max() > 1e-9 for other in found):
            found.append(Reread(name=f"{F.name}, not {E.name}", meant=F.name, read_as=E.name,
                                Rs=Rs, agreement=1.0))  # fmt: skip
    return found


def _best_vote(forms: Array, bases: list[Array], D: Array, meant: str, read_as: str) -> Reread:
    Rs, cost = min((vote(forms, Rz @ D[:, :3, :3]) for Rz in bases), key=lambda pair: pair[1])
    return Reread(name=f"{meant}, not {read_as}", meant=meant, read_as=read_as, Rs=Rs,
                  agreement=cost)  # fmt: skip


def reread_degrees(R: Array, t_A: Array, D: Array) -> list[Reread]:
    """Return what fits if numbers in degrees were taken for radians, best first; empty = nothing.

    A number d [deg] taken for radians is only known modulo 2 pi: 57 values each. For a rotation
    vector the direction is known, so a view has 58 forms, which vote. For Euler angles every form
    of the first view proposes an R_X, which must then predict all numbers of the other views.
    """
    bases = base_rotations(t_A, D)
    w = se3.log_so3(R)
    n = np.maximum(np.linalg.norm(w, axis=-1), 1e-12)
    turns = np.arange(-29, 29)
    lengths = n[:, None] + 2 * np.pi * turns
    forms = se3.exp_so3(np.radians(lengths[..., None] * (w / n[:, None])[:, None]))
    found: list[Reread] = []
    for Rz in bases:
        Rs, cost = vote(forms, Rz @ D[:, :3, :3], voters=3)
        found.append(_degrees("rotation vector", Rs, cost, partial(_nearest_form, forms)))
    for order in permutations(AXES):
        name = "".join(order)
        snap = partial(_nearest_degrees, name, euler_numbers(name, (0, 1, 2), R))
        for Rz in bases:
            Rs, cost = _euler_degrees(name, R, Rz @ D[:, :3, :3])
            found.append(_degrees(f"Euler angles (product {name.upper()})", Rs, cost, snap))
    return sorted(found, key=lambda r: r.agreement)


def _degrees(name: str, Rs: Array, cost: float, snap: Callable[[Array], Array]) -> Reread:
    return Reread(name=f"{name} in degrees, not radians", meant=f"{name} in degrees",
                  read_as="radians", Rs=Rs, agreement=cost, snap=snap)  # fmt: skip


def _nearest_form(forms: Array, predicted: Array) -> Array:
    """Return of forms (n, f, 3, 3) those nearest to predicted rotations (n, 3, 3)."""
    off = np.linalg.norm(forms - predicted[:, None], axis=(-2, -1))
    return forms[np.arange(len(forms)), off.argmin(-1)]


def _nearest_degrees(order: str, numbers: Array, predicted: Array) -> Array:
    """Return the rotations of the degrees nearest to predicted ones (n, 3, 3).

    Args:
        order: product of the rotations.
        numbers: (n, 2, 3) the degrees modulo 2 pi, both forms.
        predicted: (n, 3, 3).
    """
    degrees = np.degrees(euler_numbers(order, (0, 1, 2), predicted))[:, :, None]
    rest = _wrap(degrees - numbers[:, None])
    n = len(numbers)
    chosen = np.abs(rest).max(-1).reshape(n, -1).argmin(1)
    meant = (degrees - rest).reshape(n, -1, 3)[np.arange(n), chosen]
    return euler_rotation(order, (0, 1, 2), np.radians(meant))


def _euler_degrees(order: str, R: Array, G: Array) -> tuple[Array, float]:
    """Return the rotations meant and their disagreement (0 to 1).

    The last column of R_i(a) R_j(b) R_k(c) does not hold c: the values of (a, b) of one view are
    tried first, and those of c only for the best.
    """
    i, j, k = (AXES.index(o) for o in order)
    e = 1.0 if (j - i) % 3 == 1 else -1.0
    numbers = euler_numbers(order, (0, 1, 2), R)
    turns = 2 * np.pi * np.arange(-29, 30)
    a, b, c = (x[:, None] + turns for x in numbers[0].T)
    grids = [np.stack(np.meshgrid(a[f], b[f]), -1).reshape(-1, 2) for f in (0, 1)]
    pairs, form = np.concatenate(grids), np.repeat([0, 1], [len(g) for g in grids])
    legal = (np.abs(pairs[:, 0]) <= 180.0) & (np.abs(pairs[:, 1]) <= 90.0)
    pairs, form = pairs[legal], form[legal]
    start = euler_rotation(order, (0, 1, 2), np.radians(np.c_[pairs, 0 * pairs[:, 0]]))
    column = np.einsum("vab,pb->pva", G[:JUDGES], start[:, :, k] @ G[0])
    seen = np.stack([np.arctan2(-e * column[..., j], column[..., k]),
                     np.arcsin(np.clip(e * column[..., i], -1, 1))], -1)  # fmt: skip
    cost = _off(np.degrees(seen)[:, :, None], numbers[None, :JUDGES, :, :2]).mean(1)
    best = np.argsort(cost)[:PAIRS_KEPT]
    tried = np.concatenate(
        [np.c_[np.broadcast_to(pairs[p], (len(turns), 2)), c[form[p]]] for p in best]
    )
    tried = tried[np.abs(tried[:, 2]) <= 180.0]
    Rx = np.swapaxes(euler_rotation(order, (0, 1, 2), np.radians(tried)), -1, -2) @ G[0]
    predicted = np.degrees(euler_numbers(order, (0, 1, 2), G @ np.swapaxes(Rx, -1, -2)[:, None]))
    cost = _off(predicted[:, :, :1], numbers[None]).mean(1)
    winner = int(np.argmin(cost))
    meant = _nearest_degrees(order, numbers, G @ Rx[winner].T)
    return meant, float(np.sqrt(cost[winner]))


def _wrap(angle: Array) -> Array:
    return (angle + np.pi) % (2 * np.pi) - np.pi


def _off(degrees: Array, numbers: Array) -> Array:
    """Return how far degrees are from the nearest form of numbers known modulo 2 pi, at most 1."""
    rest = np.abs(_wrap(degrees - numbers)).max(-1).min(-1)
    return np.minimum(rest / NUMBER_TOLERANCE, 1.0) ** 2
