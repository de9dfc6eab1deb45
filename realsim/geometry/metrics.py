"""How far an estimate is from the truth: rotation, translation, MSSD and mask overlap.

Rotation is in degrees, translation in millimetres, MSSD in metres; they are never summed.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.errors import InputError
from realsim.geometry import se3
from realsim.geometry.mesh_shape import hull_vertices

Array = NDArray[np.float64]
CHUNK = 2_000_000
"""Symmetries times vertices that are held at once (48 MB)."""


def rotation_error_deg(T_true: ArrayLike, T_estimated: ArrayLike) -> Any:
    """Return the angle (...) [deg] between two rotations or transforms (..., 3, 3) or (..., 4, 4).

    Symmetries are not considered; `mssd` is the error that knows them.
    """
    R_true = np.asarray(T_true, dtype=np.float64)[..., :3, :3]
    R_estimated = np.asarray(T_estimated, dtype=np.float64)[..., :3, :3]
    return np.degrees(se3.angle(np.swapaxes(R_true, -1, -2) @ R_estimated))


def translation_error_mm(T_true: ArrayLike, T_estimated: ArrayLike) -> Any:
    """Return the distance (...) [mm] between the origins of transforms (..., 4, 4) [m]."""
    t_true = np.asarray(T_true, dtype=np.float64)[..., :3, 3]
    t_estimated = np.asarray(T_estimated, dtype=np.float64)[..., :3, 3]
    return 1e3 * np.linalg.norm(t_true - t_estimated, axis=-1)


def mssd(
    T_true: ArrayLike,
    T_estimated: ArrayLike,
    vertices: ArrayLike,
    symmetries: ArrayLike | None = None,
) -> float:
    """Return the Maximum Symmetry-Aware Surface Distance [m].

    e = min over S of max over v of |T_estimated v - T_true S v| (Hodan et al., BOP Challenge 2020,
    section 2.2). For one S the distance is the norm of an affine map of v, so it is convex and its
    maximum over the mesh is reached at a vertex of the convex hull: only these are looked at.

    Args:
        T_true: (4, 4) true pose of the object.
        T_estimated: (4, 4) estimated pose, in the same frame.
        vertices: (V, 3) of the mesh [m].
        symmetries: (S, 4, 4) T_obj_obj, the identity among them; None = no symmetry.
    """
    v = hull_vertices(vertices)
    S = np.eye(4)[None] if symmetries is None else np.asarray(symmetries, dtype=np.float64)
    if S.ndim != 3 or S.shape[1:] != (4, 4) or len(S) == 0:
        raise InputError(f"symmetries have shape {S.shape}; (S, 4, 4) with S >= 1 is expected.")
    # |T_e v - T_t S v| = |(T_t^-1 T_e - S) v|: the difference itself is an affine map.
    D = (se3.invert(T_true) @ np.asarray(T_estimated, dtype=np.float64))[None] - S
    step = max(1, CHUNK // len(v))
    best = math.inf
    for start in range(0, len(D), step):
        part = D[start : start + step]
        moved = v @ np.swapaxes(part[:, :3, :3], -1, -2) + part[:, None, :3, 3]
        worst_squared = np.einsum("svi,svi->sv", moved, moved).max(axis=1)
        best = min(best, float(np.sqrt(worst_squared.min())))
    return best


def mask_iou(a: ArrayLike, b: ArrayLike) -> float:
    """Return intersection over union of two masks (H, W); NaN if both are empty.

    Raises:
        InputError: the masks have different sizes.
    """
    mask_a, mask_b = np.asarray(a) != 0, np.asarray(b) != 0
    if mask_a.shape != mask_b.shape:
        raise InputError(f"masks of the sizes {mask_a.shape} and {mask_b.shape} have no overlap.")
    union = int(np.count_nonzero(mask_a | mask_b))
    return int(np.count_nonzero(mask_a & mask_b)) / union if union else math.nan
