"""Convex parts as points: hulls, fewer corners, and the OBJ that physics engines load."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry.mesh_shape import hull_triangles
from realsim.models.model_records import ConvexParts

GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))


def hull_volume(vertices: Array) -> float:
    """Return the volume of the hull [m^3]; 0 where the points are flat."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        return float(ConvexHull(vertices).volume)
    except QhullError:
        return 0.0


def outermost(vertices: Array, count: int) -> Array:
    """Return at most `count` of the vertices: the farthest out in evenly spread directions."""
    if len(vertices) <= count:
        return vertices
    i = np.arange(count) + 0.5
    polar, around = np.arccos(1.0 - 2.0 * i / count), GOLDEN_ANGLE * i
    directions = np.stack(
        [np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)]
    )
    kept = vertices[np.unique(np.argmax(vertices @ directions, axis=0))]
    return kept if hull_volume(kept) > 0 else vertices


def fewest(vertices: Array, count: int, most: int, loss: float) -> Array:
    """Return the outermost vertices: `count`, doubled until the hull keeps its volume.

    Args:
        vertices: (V, 3) corners of a hull.
        count: tried first.
        most: kept in any case at most.
        loss: share of the hull's volume that may be missing; 64 corners of a capsule of 2000 lose
            8 % of it.
    """
    full = hull_volume(vertices)
    while True:
        kept = outermost(vertices, min(count, most))
        if count >= most or hull_volume(kept) >= (1.0 - loss) * full:
            return kept
        count *= 2


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
