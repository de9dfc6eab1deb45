"""Plates and cards found on the table, by the mean height of what lies on it.

One image shows nothing of a plate of 2 mm: its table explains it as well. The heights that all
views measured, averaged in cells of 2 mm, are known to 0.2 mm once the cameras are right. In that
map h, with precision w, a pose whose height over the table is m explains of what is there
    1 - sum w (h - m)^2 / sum w h^2        over its footprint and a ring around it
and correlation by Fourier transforms tells it for all places at once.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, gaussian_filter, map_coordinates

from realsim.arrays import Array, Int64, Mask
from realsim.geometry import se3
from realsim.geometry.metrics import mssd_symmetric
from realsim.models.resting import resting_orientations
from realsim.records import SupportPlane
from realsim.registration.body import Body
from realsim.registration.evidence import DepthNoise
from realsim.registration.judging.verdict import CONTRAST_DECIDED
from realsim.registration.refinement.flat import height_map, step_term
from realsim.registration.views import ViewPoints

CAP = 25.0
"""A cell's square counts as this at most."""
DECIDED_T, DECIDED_RATIO = 4.0, 0.25
"""Standard errors, and share of the mean square, by which a rival is worse that is decided."""


FLAT_HEIGHT_M = 0.008
"""An object that rises less than this over the table is flat [m]."""
CELL_M = 0.002
"""Cells of the map [m]."""
LOW_M = 0.012
"""Cells with points higher than this belong to something else [m]."""
REACH_M = 0.3
"""How far from the middle of the objects it is looked [m]."""
RING_M = 0.006
"""Width of the ring around the footprint that must be empty table [m]."""
YAW_DEG = 4.0
"""Steps of the turn [deg]."""
LIKELY = 0.03
"""Least probability of a resting face."""
MEASURED = 0.6
"""Least share of the footprint and its ring that is measured."""
EXPLAINED = 0.5
"""Least share of the heights that a pose must explain."""
POLISHED = 6
"""Number of best poses that are fitted to the map."""
POLISH_STEPS = 8
"""Steps of that fit."""
FLOOR_M = 2e-4
"""Least 1-sigma of a cell's height [m]: tables are no flatter."""
SAME_PLACE_M = 0.006
"""Poses nearer than this are one [m]."""


class FlatPose(NamedTuple):
    """A place for a flat object."""

    T_world_obj: Array
    """(4, 4)."""
    explained: float
    """Share of the heights around it that the pose explains."""
    contrast: float | None
    """How clearly it is better than the best other pose; None = there is no other."""


@dataclass(frozen=True, eq=False, slots=True)
class TableMap:
    """Mean heights over the table."""

    T_world_table: Array
    """(4, 4)."""
    low: Array
    """(2,) centre of the first cell [m]."""
    heights: Array
    """(X, Y) [m]."""
    weights: Array
    """(X, Y) [1/m^2]; 0 = not measured, or something stands there."""


def table_map(
    views: Sequence[ViewPoints], plane: SupportPlane, noise: DepthNoise, middle: Array,
    area_px: float,
) -> TableMap:  # fmt: skip
    """Return the mean heights of the views' points.

    Args:
        views: with refined cameras.
        plane: the table.
        noise: of the depth.
        middle: (3,) in world, around which is looked [m].
        area_px: pixels of one independent measurement.
    """
    T = se3.invert(plane.T_world_table)
    low = se3.transform(T, middle[None])[0, :2] - REACH_M
    size = int(2 * REACH_M / CELL_M)
    total, precision, tall, count = (np.zeros(size * size) for _ in range(4))
    for view in views:
        p = se3.transform(T @ view.T_world_cam, view.points.astype(np.float64))
        cell = np.round((p[:, :2] - low) / CELL_M).astype(np.int64)
        here = np.all((cell >= 0) & (cell < size), axis=1) & (p[:, 2] > -LOW_M)
        at, z = cell[here, 0] * size + cell[here, 1], p[here, 2]
        w = 1.0 / np.square(np.maximum(noise.sigma(view.points[here, 2]), 1e-4))
        w /= max(1.0, area_px / view.area_px)
        high = z > LOW_M
        precision += np.bincount(at, np.where(high, 0.0, w), size * size)
        total += np.bincount(at, np.where(high, 0.0, w * z), size * size)
        tall += np.bincount(at, high, size * size)
        count += np.bincount(at, minlength=size * size)
    standing = (tall > 0.2 * np.maximum(count, 1)).reshape(size, size)
    weights = np.where(binary_dilation(standing, iterations=2), 0.0, precision.reshape(size, size))
    heights = (total / np.maximum(precision, 1e-12)).reshape(size, size)
    return TableMap(plane.T_world_table, low, np.where(weights > 0, heights, 0.0), weights)


def cover(map_: TableMap, body: Body, T_world_obj: Array) -> TableMap:
    """Return the map without the cells on which an object lies."""
    weights = map_.weights.copy()
    weights[_footprint(map_, body, T_world_obj)] = 0.0
    return TableMap(map_.T_world_table, map_.low, map_.heights, weights)


def explained_at(
    map_: TableMap, body: Body, T_world_obj: Array, table_off_m: float
) -> float | None:
    """Return what share of the heights on and around a flat object its pose explains, noise aside.

    With N cells of variance s^2: 1 - (sum (h - m)^2 / s^2 - N) / (sum h^2 / s^2), at most 1.
    s is that of the mean of a cell and of what the table is off by, `table_off_m` [m]. None = too
    little of the footprint and the ring around it is measured.
    """
    T = se3.invert(map_.T_world_table) @ T_world_obj
    heights, low = height_map(body, T, CELL_M / 4)
    m = gaussian_filter(heights, 2.0)
    steps = round(RING_M / CELL_M * 4)
    ring: Mask = np.asarray(binary_dilation(heights > 0, iterations=steps), dtype=np.bool_)
    at = np.argwhere(map_.weights > 0)
    places = map_.low + CELL_M * at
    cells = np.round((places - low) / (CELL_M / 4)).astype(np.int64)
    inside = np.all((cells >= 0) & (cells < m.shape), axis=1)
    at, cells = at[inside], cells[inside]
    near = ring[tuple(cells.T)]
    at, cells = at[near], cells[near]
    if len(at) * 16 < MEASURED * ring.sum():
        return None
    h = map_.heights[tuple(at.T)]
    w = 1.0 / (1.0 / map_.weights[tuple(at.T)] + max(FLOOR_M, table_off_m) ** 2)
    left = max(float(w @ np.square(h - m[tuple(cells.T)])) - len(w), 0.0)
    return 1.0 - left / max(float(w @ np.square(h)), 1e-12)


def is_free(map_: TableMap, body: Body, T_world_obj: Array) -> bool:
    """Return whether enough of the map is left where an object would lie."""
    left = map_.weights[_footprint(map_, body, T_world_obj)] > 0
    return bool(len(left)) and float(np.mean(left)) >= MEASURED


def _footprint(map_: TableMap, body: Body, T_world_obj: Array) -> tuple[Int64, ...]:
    """Return the rows and columns of the map on which an object lies."""
    heights, low = height_map(body, se3.invert(map_.T_world_table) @ T_world_obj, CELL_M)
    at = np.argwhere(heights > 0) + np.round((low - map_.low) / CELL_M).astype(np.int64)
    return tuple(at[np.all((at >= 0) & (at < map_.weights.shape), axis=1)].T)


def seek_flat(body: Body, map_: TableMap) -> FlatPose | None:
    """Return where a flat object lies; None = it has no flat side, or lies nowhere."""
    w, h = map_.weights, map_.heights
    spectra = [np.fft.rfft2(image) for image in (w * h * h, w, w * h, (w > 0).astype(np.float64))]
    found: list[tuple[float, Array]] = []
    for resting in resting_orientations(body.model.mesh):
        if resting.height > FLAT_HEIGHT_M or resting.probability < LIKELY:
            continue
        for yaw in np.radians(np.arange(0.0, 360.0, YAW_DEG)):
            R = se3.exp_so3(np.array([0.0, 0.0, yaw])) @ resting.R
            up = -float((body.model.mesh.vertices @ R[2]).min())
            T = se3.from_rt(R, np.array([0.0, 0.0, up]))
            found.append(_best_place(body, map_, T, spectra))
    found = sorted((f for f in found if f[0] >= EXPLAINED), key=lambda f: -f[0])
    if not found:
        return None
    distinct: list[Array] = []
    for _, T in found:
        if len(distinct) < POLISHED and all(
            mssd_symmetric(T, other, body.model) > SAME_PLACE_M for other in distinct
        ):
            distinct.append(T)
    polished = [_polished(body, map_, T) for T in distinct]
    polished.sort(key=lambda one: float(one[1].sum()))
    (T, squares), *others = polished
    rivals = (one for one in others if mssd_symmetric(T, one[0], body.model) > SAME_PLACE_M)
    contrast = None
    if (rival := next(rivals, None)) is not None:
        contrast = _contrast(squares, rival[1])
    return FlatPose(map_.T_world_table @ T, found[0][0], contrast)


def _polished(body: Body, map_: TableMap, T_table_obj: Array) -> tuple[Array, Array]:
    """Return a pose (4, 4) fitted to the map, and the squares (N,) of all cells' residuals."""
    at = np.argwhere(map_.weights > 0)
    places = np.column_stack([map_.low + CELL_M * at, map_.heights[tuple(at.T)]])
    sigmas = np.sqrt(1.0 / map_.weights[tuple(at.T)] + FLOOR_M**2)
    above = places + np.array([0.0, 0.0, 1.0])
    T, c = T_table_obj, se3.from_translation(body.center_obj)
    for _ in range(POLISH_STEPS):
        H, b = step_term(body, T, places, above, sigmas, CELL_M)
        xi = np.linalg.lstsq(H, b, rcond=1e-9)[0]
        T = T @ c @ se3.exp(xi) @ se3.invert(c)
    heights, low = height_map(body, T, CELL_M / 4)
    smooth = gaussian_filter(heights, 2.0)
    cells = ((places[:, :2] - low) / (CELL_M / 4)).T
    m = map_coordinates(smooth, cells, order=1, mode="constant")
    return T, np.minimum(np.square((places[:, 2] - m) / sigmas), CAP)


def _contrast(squares: Array, rival: Array) -> float:
    """Return how clearly a rival is worse, cell by cell, on the scale of `near_rivals.duel`."""
    differ = np.abs(squares - rival) > 1e-9
    worse = (rival - squares)[differ]
    if len(worse) < 2:
        return 0.0
    t = worse.mean() / max(float(np.std(worse, ddof=1)) / np.sqrt(len(worse)), 1e-12)
    ratio = worse.mean() / max(float(squares[differ].mean()), 1.0)
    return CONTRAST_DECIDED * float(np.clip(min(t / DECIDED_T, ratio / DECIDED_RATIO), -1.0, 10.0))


def _best_place(
    body: Body, map_: TableMap, T_table_obj: Array, spectra: Sequence[NDArray[np.complex128]]
) -> tuple[float, Array]:
    """Return what the best shift of a pose explains, and the shifted pose (4, 4)."""
    m, low = height_map(body, T_table_obj, CELL_M)
    ring = binary_dilation(m > 0, iterations=round(RING_M / CELL_M))
    shape = map_.weights.shape
    right, up = shape[0] - m.shape[0] + 1, shape[1] - m.shape[1] + 1
    if right < 1 or up < 1:
        return -1.0, T_table_obj

    def sums(image: int, template: Array) -> Array:
        """Return the sums of image times template, for all shifts that keep it inside."""
        spectrum = spectra[image] * np.conj(np.fft.rfft2(template.astype(np.float64), shape))
        return np.fft.irfft2(spectrum, shape)[:right, :up]

    there, square, cells = sums(0, ring), sums(1, m * m), sums(3, ring)
    explained = (2.0 * sums(2, m) - square) / np.maximum(there - cells, 0.5 * square + 1e-9)
    explained[cells < MEASURED * ring.sum()] = -1.0
    at = np.unravel_index(int(np.argmax(explained)), explained.shape)
    shift = map_.low + np.array(at) * CELL_M - low
    return float(explained[at]), se3.from_translation(np.array([*shift, 0.0])) @ T_table_obj
