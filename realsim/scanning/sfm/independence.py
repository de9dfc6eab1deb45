"""How much the pictures really know: correlated observations, and two halves of the scene compared.

The residuals of a bundle adjustment are smaller than the errors, because cameras and points were
fitted to them, and neighbours on one texture err alike: a thousand matches on wood are not a
thousand measurements. Both are inflated from the residuals themselves. What they cannot show (a
lens that is wrong everywhere, features that slide with the direction of view) shows up where two
halves of the scene, each by itself, move the cameras differently.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from realsim.scanning.sfm.result import Geometry

Array = NDArray[np.float64]
CELLS_ACROSS = 8
"""Cells along the longer side of an image within which errors count as one texture's."""
LEAST_FREEDOM = 0.1
"""Observations less unknowns, over observations, at least: below it the residuals say nothing."""
BLOCKS = 3
"""The scene is halved so often into blocks of equal numbers of points: 8 blocks, 4 to each half."""


def variance_inflation(geometry: Geometry, residuals_px: Array, weights: Array) -> float:
    """Return by what factor the variance of independent, unfitted errors is to be raised, >= 1.

    The first part is n / (n - u) of n numbers and u unknowns; the second is the design effect of
    clusters (Kish 1965), sum_g |sum_k w r|^2 / sum_k |w r|^2 over the cells g of every image.

    Args:
        geometry: what was adjusted.
        residuals_px: (K, 2) of the adjusted geometry [px].
        weights: (K,) robust weights.
    """
    use = np.isfinite(residuals_px[:, 0]) & np.isfinite(residuals_px[:, 1])
    numbers = 2 * int(use.sum())
    unknowns = 3 * len(np.unique(geometry.points_of[use])) + 6 * len(geometry.names)
    freedom = max(1 - unknowns / max(numbers, 1), LEAST_FREEDOM)
    size = max(geometry.intrinsics.width, geometry.intrinsics.height) / CELLS_ACROSS
    cell = np.floor(np.clip(geometry.uv_px / size, 0, CELLS_ACROSS - 1)).astype(np.int64)
    group = (geometry.cameras_of * CELLS_ACROSS + cell[:, 0]) * CELLS_ACROSS + cell[:, 1]
    pulls = np.where(use, weights, 0.0)[:, None] * np.where(use[:, None], residuals_px, 0.0)
    sums = np.stack([np.bincount(group, pulls[:, a]) for a in (0, 1)])
    single = float(np.square(pulls).sum())
    effect = float(np.square(sums).sum()) / single if single > 0 else 1.0
    return max(1.0, effect) / freedom


def halves(geometry: Geometry) -> tuple[Geometry, Geometry]:
    """Return the geometry with one half of its points and with the other, block by block in space.

    Neighbouring points share their errors, so a random half would agree with the other one.
    """
    count = len(geometry.points)
    block, parity = np.zeros(count, dtype=np.int64), np.zeros(count, dtype=np.int64)
    for _ in range(BLOCKS):
        block = _split(geometry.points, block)
        # Blocks that touch across any of the cuts go to different halves.
        parity = (parity + block) % 2
    odd: NDArray[np.bool_] = parity.astype(np.bool_)
    return _with_points(geometry, np.logical_not(odd)), _with_points(geometry, odd)


def reliability(first: Array, second: Array) -> float:
    """Return the share of signal in the mean of two estimates (V, n) of one thing, 0 to 1.

    With d = s + e of either half: <d1 d2> = <s s>, <|d1 - d2|^2> / 2 = <e e>, and the mean of both
    has half of that (the split-half reliability of Spearman and Brown).
    """
    signal = float((first * second).sum())
    noise = float(np.square(first - second).sum()) / 4
    return max(signal, 0.0) / max(max(signal, 0.0) + noise, 1e-300)


def _split(points: Array, block: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return block numbers after halving each block along its longest side."""
    finer = 2 * block
    for b in np.unique(block):
        own = np.flatnonzero(block == b)
        axis = int(np.argmax(np.ptp(points[own], axis=0)))
        order = np.argsort(points[own, axis], kind="stable")
        finer[own[order[len(own) // 2 :]]] += 1
    return finer


def _with_points(geometry: Geometry, keep: NDArray[np.bool_]) -> Geometry:
    """Return the geometry with some of its points; all cameras stay."""
    place = np.cumsum(keep) - 1
    use = keep[geometry.points_of]
    return replace(
        geometry, points=geometry.points[keep], colors=geometry.colors[keep],
        point_ids=geometry.point_ids[keep], cameras_of=geometry.cameras_of[use],
        points_of=place[geometry.points_of[use]], uv_px=geometry.uv_px[use],
    )  # fmt: skip
