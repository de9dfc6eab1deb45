"""How often a surface winds about a point."""

import numpy as np

from realsim.arrays import Array, Int32, Int64
from realsim.compiled import njit


@njit
def solid_angle_share(points: Array, faces: Int64 | Int32) -> float:
    """Return the share of the sphere about the origin that the faces fill: 1 inside, 0 outside.

    The sum of signed solid angles (van Oosterom and Strackee, IEEE Trans. Biomed. Eng. 1983), which
    for a closed mesh is its winding number.
    """
    total = 0.0
    for f in range(len(faces)):
        a, b, c = points[faces[f, 0]], points[faces[f, 1]], points[faces[f, 2]]
        la, lb, lc = np.sqrt(np.sum(a * a)), np.sqrt(np.sum(b * b)), np.sqrt(np.sum(c * c))
        volume = (
            a[0] * (b[1] * c[2] - b[2] * c[1])
            + a[1] * (b[2] * c[0] - b[0] * c[2])
            + a[2] * (b[0] * c[1] - b[1] * c[0])
        )
        ab, bc, ca = np.sum(a * b), np.sum(b * c), np.sum(c * a)
        total += np.arctan2(volume, la * lb * lc + ab * lc + bc * la + ca * lb)
    return total / (2.0 * np.pi)
