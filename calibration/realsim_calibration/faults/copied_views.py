"""Views that repeat another: the same view twice, one pose for several images, one image twice."""

import numpy as np

from realsim.arrays import Array, Mask
from realsim_calibration.faults import diagnosis
from realsim_calibration.faults.frame_fit import UNIT_DEG, UNIT_PART, chord_angle

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
