"""What holds an object: the table, or a neighbour that it leans on."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from realsim.geometry import se3
from realsim.records import SupportPlane
from realsim.registration.body import Body
from realsim.registration.plane import lowest_height

Array = NDArray[np.float64]


def support_checks(
    bodies: Sequence[Body], poses: Sequence[Array], plane: SupportPlane | None
) -> list[dict[str, float]]:
    """Return of every object how deep it is sunk into the table and how far it floats.

    In a pile an object may stand on another: it floats by the least of its heights over the table
    and its distances to the other objects.

    Returns:
        sunk_mm and floating_mm, both 0 or more; nothing without a table.
    """
    if plane is None:
        return [{} for _ in bodies]
    results: list[dict[str, float]] = []
    for k, (body, T) in enumerate(zip(bodies, poses, strict=True)):
        gap = lowest_height(plane, body.model.mesh.vertices, T)
        floating = max(0.0, gap)
        for j, (other, T_other) in enumerate(zip(bodies, poses, strict=True)):
            apart = float(np.linalg.norm(body.center(T) - other.center(T_other)))
            if floating == 0.0 or j == k or apart > body.radius_m + other.radius_m + floating:
                continue
            near = other.field.distance(body.samples, se3.invert(T_other) @ T)
            back = body.field.distance(other.samples, se3.invert(T) @ T_other)
            floating = max(0.0, min(floating, float(near.min()), float(back.min())))
        results.append({"sunk_mm": 1e3 * max(0.0, -gap), "floating_mm": 1e3 * floating})
    return results
