"""Convex parts as one Wavefront OBJ: one object per part, as PyBullet and MuJoCo load them."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.errors import InputError
from realsim.models.convex_hulls import hull_triangles
from realsim.models.model_records import ConvexParts

Array = NDArray[np.float64]


def collision_obj(parts: ConvexParts | Sequence[ArrayLike]) -> bytes:
    """Return an OBJ [m] with one object `part_NNN` per convex part: its hull, faces outward.

    Coordinates are written so that they are read back bit for bit.

    Raises:
        InputError: there is no part, or one is flat.
    """
    from scipy.spatial import QhullError

    pieces = parts.parts if isinstance(parts, ConvexParts) else parts
    if len(pieces) == 0:
        raise InputError("there are no convex parts to write; a collision shape has one or more.")
    lines = ["# convex parts [m]"]
    first = 1
    for number, piece in enumerate(pieces):
        points = np.asarray(piece, dtype=np.float64).reshape(-1, 3)
        try:
            corners, faces = hull_triangles(points)
        except (QhullError, ValueError) as error:
            raise InputError(
                f"convex part {number} of {len(pieces)} ({len(points)} points) is flat: it has no "
                "volume that could be collided with. Leave it out."
            ) from error
        lines.append(f"o part_{number:03d}")
        lines += [f"v {x!r} {y!r} {z!r}" for x, y, z in corners.tolist()]
        lines += [f"f {a} {b} {c}" for a, b, c in (faces + first).tolist()]
        first += len(corners)
    return ("\n".join(lines) + "\n").encode("ascii")


def parts_from_collision_obj(data: bytes) -> tuple[Array, ...]:
    """Return the corners (V, 3) [m] of each part of an OBJ of `collision_obj`.

    Raises:
        InputError: it is not such an OBJ.
    """
    found: list[list[list[float]]] = []
    for number, line in enumerate(data.decode("utf-8", errors="replace").splitlines(), start=1):
        words = line.split()
        if words[:1] == ["o"]:
            found.append([])
        elif words[:1] == ["v"]:
            try:
                corner = [float(word) for word in words[1:4]]
            except ValueError:
                corner = []
            if len(corner) != 3 or not np.all(np.isfinite(corner)) or not found:
                raise InputError(
                    f"line {number} of the collision OBJ reads '{line[:80]}'; 'v x y z' after an "
                    "'o part_NNN' is expected. Write the file again from the mesh."
                )
            found[-1].append(corner)
    if not found or not all(found):
        raise InputError(
            f"the collision OBJ has {len(found)} objects, {sum(not f for f in found)} of them "
            "without corners; one or more with corners are expected. Is it another kind of OBJ?"
        )
    return tuple(np.array(part) for part in found)
