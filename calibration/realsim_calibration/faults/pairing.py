"""Which image belongs to which hand pose: shifted lists, swapped and foreign images, moved things.

Frames fitted on a stretch of views that is consistent in itself (shifted by a few, or not) tell for
every pose and every image how well they fit together. The best path through this table, which may
change its shift only for a price (Viterbi), is the pairing; what lies off the path is swapped,
belongs to another pose, or to none. If instead a stretch fits other frames of its own, the camera,
the tool or the board was moved.

Views that repeat another: the same view twice, one pose for several images, one image twice.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Literal

import numpy as np

from realsim.arrays import Array, Mask, Rows
from realsim.geometry import se3
from realsim_calibration.faults import diagnosis, frame_fit
from realsim_calibration.faults.frame_fit import UNIT_DEG, UNIT_PART, chord_angle
from realsim_calibration.fit.closed_forms import MIN_VIEWS

MovedFrame = Literal["X", "Z"]
MOVED_FRAMES: tuple[MovedFrame, ...] = ("X", "Z")
PREFER_TOOL = np.radians(3.0)
"""A tool is changed more often than a board is shifted without turning it [rad]."""
MOVE_ROUNDS = 3
"""The move and the frames are found in turn, from the frames of either stretch."""


MAX_SHIFT = 4
"""Largest shift of the images against the poses that is tried."""
RATIO = 4.0
"""Pose and image belong together when their error is below this many usual errors."""
FLOOR = 6.0
"""Pose and image belong together below this error, too, in the units of `fit_frames`: 3 deg or 6 %
of the distance. Planar poses of good real sets reach 5."""
SWAP_FLOOR = 3.0
"""Two views that fit far better exchanged are swapped from this error on."""
SWAP_GAIN = 4.0
"""Exchanged they must fit this many times better."""
SWITCH_PRICE = 2.0
"""Price of another shift, in views that do not fit: two views off the path are cheaper kept
apart, three are a new shift."""
MAX_DROPPED = 0.3
"""Largest share of views that a pairing may leave over."""
ALIKE = 1.1
"""Moves whose scores are within this factor cannot be told apart."""
MAX_DROPPED_RUN = 0.5
"""The same where they all stand at the beginning or at the end of the list."""
MIN_STRETCH = 4
"""Views of a stretch for which frames of its own are accepted."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Pairing:
    """Which hand pose every image belongs to."""

    rows: Rows
    """(k, 2) row of the pose and row of the image, by image."""
    shifts: Rows
    """(n,) pose row less image row along the path."""
    swapped: tuple[tuple[int, int], ...]
    """Rows of images that were exchanged."""
    strays: tuple[int, ...]
    """Rows of images that fit no pose, or that of another image; they are left out of `rows`."""
    elsewhere: tuple[tuple[int, int], ...]
    """(image row, pose row) of strays whose pose was found."""
    fit: frame_fit.FrameFit
    """Frames fitted to `rows`."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Moved:
    """From some view on a frame that must stand still stands elsewhere."""

    frame: MovedFrame
    """X: the camera against the frame that A maps from. Z: the board against that it maps to."""
    start: int
    """First row after the move."""
    step: Array
    """(4, 4) X_before X_after^-1 or Z_before Z_after^-1 [hand's unit]."""
    score: float
    """Score of all views with the move taken back."""
    either: bool = False
    """Whether a move of the other frame explains the views as well."""


def find_pairing(A: Array, C: Array, middle: Array) -> Pairing | None:
    """Return the pairing that fits best, None where no stretch of the lists is consistent."""
    fit = _best_stretch(A, C, middle)
    if fit is None:
        return None
    result: Pairing | None = None
    # Twice: the first frames come from a part of the views, the second from all that were paired.
    for _ in range(2):
        table = frame_fit.mismatch(fit, A, C)
        paired = table[table < FLOOR * frame_fit.AGREE]
        usual = float(np.median(np.min(table, 0))) if len(paired) else np.inf
        gate = max(RATIO * usual, FLOOR)
        shifts = _path(table, gate)
        result = _pairing(A, C, middle, table, shifts, gate)
        if result is None:
            return None
        fit = result.fit
    return result


def _best_stretch(A: Array, C: Array, middle: Array) -> frame_fit.FrameFit | None:
    """Return the frames of the most consistent stretch: all, the first or the second half."""
    n = len(A)
    fits: list[frame_fit.FrameFit] = []
    for shift in range(-MAX_SHIFT, MAX_SHIFT + 1):
        a, c = A[max(shift, 0) : n + min(shift, 0)], C[max(-shift, 0) : n - max(shift, 0)]
        half = len(a) // 2
        for part in (slice(None), slice(half), slice(half, None)):
            if len(a[part]) >= MIN_VIEWS + 1:
                fits.append(frame_fit.fit_frames(a[part], c[part], middle))
    if not fits:
        return None
    # A few views fit wrong frames by chance: the stretch that explains most of the table wins.
    fits.sort(key=lambda f: f.usual)
    return min(fits[:6], key=lambda f: _explained(frame_fit.mismatch(f, A, C)))


def _explained(table: Array) -> float:
    """Return the mean capped error of the images with their best pose of a permitted shift."""
    n = len(table)
    i, j = np.indices((n, n))
    near = np.where(np.abs(i - j) <= MAX_SHIFT, table, np.inf)
    return float(np.mean(np.minimum(near.min(0), frame_fit.CAP)))


def _path(table: Array, gate: float) -> Rows:
    """Return the shift (n,) of every image along the cheapest path."""
    n = len(table)
    shifts = np.arange(-MAX_SHIFT, MAX_SHIFT + 1)
    cost = np.full((n, len(shifts)), 1.0)
    for s, shift in enumerate(shifts):
        j = np.arange(max(-shift, 0), n - max(shift, 0))
        cost[j, s] = np.minimum(table[j + shift, j] / gate, 1.0)
    # Standing still is preferred where the data do not care.
    cost = cost + 1e-3 * np.abs(shifts)
    price = SWITCH_PRICE * (1 - np.eye(len(shifts)))
    total, back = cost[0], np.zeros((n, len(shifts)), dtype=np.int64)
    for j in range(1, n):
        step = total[:, None] + price
        back[j] = step.argmin(0)
        total = step.min(0) + cost[j]
    path = np.empty(n, dtype=np.int64)
    path[-1] = int(total.argmin())
    for j in range(n - 1, 0, -1):
        path[j - 1] = back[j, path[j]]
    # Images before a change whose pose is missing fit neither shift: they belong to the change.
    for j in range(n - 1, 0, -1):
        if path[j] != path[j - 1] and cost[j - 1, path[j - 1]] >= 1.0:
            path[j - 1] = path[j]
    return shifts[path]


def _pairing(
    A: Array, C: Array, middle: Array, table: Array, shifts: Rows, gate: float,
    ) -> Pairing | None:  # fmt: skip
    n = len(table)
    pose = np.arange(n) + shifts
    inside = (pose >= 0) & (pose < n)
    own = np.full(n, np.inf)
    own[inside] = table[pose[inside], np.flatnonzero(inside)]
    swapped = _swaps(table, pose, own, inside)
    exchanged = {row for pair in swapped for row in pair}
    rows: list[tuple[int, int]] = []
    strays: list[int] = []
    elsewhere: list[tuple[int, int]] = []
    partner = {a: b for a, b in swapped} | {b: a for a, b in swapped}
    for j in range(n):
        if j in exchanged:
            rows.append((int(pose[partner[j]]), j))
        elif own[j] <= gate:
            rows.append((int(pose[j]), j))
        elif inside[j]:
            strays.append(j)
            best = int(table[:, j].argmin())
            if table[best, j] <= gate:
                elsewhere.append((j, best))
    for a, b in _mutual(elsewhere, shifts):
        swapped = (*swapped, (a, b))
        rows += [(int(pose[b]), a), (int(pose[a]), b)]
        strays = [k for k in strays if k not in (a, b)]
        elsewhere = [e for e in elsewhere if e[0] not in (a, b)]
    rows.sort(key=lambda row: row[1])
    dropped = [j for j in range(n) if j not in {image for _, image in rows}]
    at_end = dropped == list(range(n - len(dropped), n)) or dropped == list(range(len(dropped)))
    most = MAX_DROPPED_RUN if at_end else MAX_DROPPED
    if len(rows) < MIN_VIEWS + 1 or len(rows) < (1 - most) * n:
        return None
    kept = np.array(rows, dtype=np.int64)
    return Pairing(
        rows=kept, shifts=shifts, swapped=swapped, strays=tuple(strays),
        elsewhere=tuple(elsewhere),
        fit=frame_fit.fit_frames(A[kept[:, 0]], C[kept[:, 1]], middle),
    )  # fmt: skip


def _mutual(elsewhere: list[tuple[int, int]], shifts: Rows) -> list[tuple[int, int]]:
    """Return pairs of images that fit each other's pose."""
    place = {j: int(i - shifts[j]) for j, i in elsewhere}
    return [(j, k) for j, k in place.items() if j < k and place.get(k) == j]


def _swaps(table: Array, pose: Rows, own: Array, inside: Mask) -> tuple[tuple[int, int], ...]:
    """Return pairs of images that fit far better exchanged, the clearest first."""
    suspects = [int(j) for j in np.flatnonzero(inside & (own > SWAP_FLOOR))]
    usual = float(np.median(own[inside]))
    found: list[tuple[float, int, int]] = []
    limit = max(RATIO * usual, SWAP_FLOOR)
    for a, b in combinations(suspects, 2):
        exchanged = float(np.hypot(table[pose[a], b], table[pose[b], a]))
        if exchanged * SWAP_GAIN < np.hypot(own[a], own[b]) and exchanged < limit:
            found.append((exchanged, a, b))
    taken: set[int] = set()
    pairs: list[tuple[int, int]] = []
    for _, a, b in sorted(found):
        if a not in taken and b not in taken:
            taken |= {a, b}
            pairs.append((a, b))
    return tuple(pairs)


def find_move(A: Array, C: Array, middle: Array) -> Moved | None:
    """Return the move of the camera, tool or board after which the views fit anew, else None."""
    n = len(A)
    half = n // 2
    found: list[Moved] = []
    for part in (slice(half), slice(half, None)):
        if half < MIN_STRETCH:
            return None
        seed = frame_fit.fit_frames(A[part], C[part], middle)
        errors = np.minimum(np.diag(frame_fit.mismatch(seed, A, C)), frame_fit.CAP)
        before, after = errors, frame_fit.CAP - errors
        if part.start is not None:
            before, after = after, before
        cost = np.cumsum(np.append(0, before)) + np.cumsum(np.append(0, after[::-1]))[::-1]
        start = int(np.argmin(cost))
        if min(start, n - start) < MIN_STRETCH:
            continue
        found += _moves_at(A, C, middle, start)
    return _likeliest(found)


def _likeliest(found: list[Moved]) -> Moved | None:
    """Return the move of least score; of two that fit alike the one without a turn.

    A tool offset is set as a pure shift. Where the hand hardly turns, a shifted board explains it
    too, which is said.
    """
    best = min(found, key=lambda m: m.score, default=None)
    if best is None:
        return None
    alike = [m for m in found if m.score <= ALIKE * best.score]
    chosen = min(alike, key=lambda m: float(se3.angle(m.step)) + (m.frame == "Z") * PREFER_TOOL)
    other = any(m.frame != chosen.frame for m in alike)
    return replace(chosen, either=other)


def _moves_at(A: Array, C: Array, middle: Array, start: int) -> Iterator[Moved]:
    """Yield both kinds of move at a row, each with the score of a model that shares the rest."""
    halves = [frame_fit.fit_frames(A[s], C[s], middle) for s in (slice(start), slice(start, None))]
    for frame in MOVED_FRAMES:
        for fit in halves:
            step, best = _carried(A, C, middle, start, frame, fit)
            yield Moved(frame=frame, start=start, step=step, score=best.score)


def _carried(
    A: Array, C: Array, middle: Array, start: int, frame: MovedFrame, fit: frame_fit.FrameFit,
    ) -> tuple[Array, frame_fit.FrameFit]:  # fmt: skip
    """Return the move of a frame at a row, and the fit of all views with the move taken back.

    Every view shows where the frame stands, given the other one: X_i = A_i^-1 Z C_i^-1 or
    Z_i = A_i X C_i. The move is from the mean before to the mean after.
    """
    step = np.eye(4)
    for _ in range(MOVE_ROUNDS):
        seen = C.copy()
        seen[:, :3, 3] *= fit.length_ratio
        hand = frame == "X"
        places = se3.invert(A) @ fit.Z @ se3.invert(seen) if hand else A @ fit.X @ seen
        step = frame_fit.mean_transform(places[:start]) @ se3.invert(
            frame_fit.mean_transform(places[start:])
        )
        later = A[start:] @ se3.invert(step) if hand else step @ A[start:]
        fit = frame_fit.fit_frames(np.concatenate([A[:start], later]), C, middle)
    return step, fit


Groups = tuple[tuple[int, ...], ...]


def find_copies(T: Array, C: Array, middle: Array) -> dict[diagnosis.Fault, Groups]:
    """Return the groups of (n, 4, 4) hand and board poses that repeat each other, worst first.

    A frozen pose has different images, a repeated image different poses; of a duplicate both are
    the same.
    """
    unit = _length_unit(T)
    same_hand = _near(T, 1e-3 * diagnosis.SAME_POSE_MM * unit, np.radians(diagnosis.SAME_POSE_DEG))
    q = C[:, :3, :3] @ middle + C[:, :3, 3]
    distance = max(float(np.median(np.linalg.norm(q, axis=-1))), 1e-12)
    turn = chord_angle(C[:, None, :3, :3], C[None, :, :3, :3])
    slip = np.linalg.norm(q[:, None] - q[None], axis=-1) / distance
    seen = np.hypot(turn / np.radians(UNIT_DEG), slip / UNIT_PART)
    # The same image gives the same numbers; a second photograph of the same view does not.
    same_image = seen < 1e-6 * diagnosis.SAME_VIEW
    return {
        "frozen_pose": _groups(same_hand & (seen > diagnosis.OTHER_VIEW)),
        "repeated_image": _groups(same_image & ~same_hand),
        "duplicated_views": _groups(same_hand & (seen < diagnosis.SAME_VIEW)),
    }


def _length_unit(T: Array) -> float:
    """Return 1000 where the poses are plainly in millimetres, else 1."""
    return 1000.0 if float(np.median(np.linalg.norm(T[:, :3, 3], axis=-1))) > 20.0 else 1.0


def _near(T: Array, length: float, angle: float) -> Mask:
    far = np.linalg.norm(T[:, None, :3, 3] - T[None, :, :3, 3], axis=-1)
    turn = chord_angle(T[:, None, :3, :3], T[None, :, :3, :3])
    return (far < length) & (turn < angle)


def _groups(linked: Mask) -> Groups:
    """Return the rows that are linked with each other, groups of two and more."""
    n = len(linked)
    free, groups = set(range(n)), list[tuple[int, ...]]()
    while free:
        group, todo = set[int](), {min(free)}
        while todo:
            row = todo.pop()
            group.add(row)
            todo |= {int(k) for k in np.flatnonzero(linked[row]) if k != row} - group
        free -= group
        if len(group) > 1:
            groups.append(tuple(sorted(group)))
    return tuple(groups)
