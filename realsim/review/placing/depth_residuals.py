"""How far measured points are from the nearest model, as numbers and as colours.

Of every object only the points near it are kept with their distances, so that after a correction
the objects that stayed where they are cost nothing.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array, Array32, Int64, Rgb
from realsim.compiled import njit
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.geometry.distance_field import DistanceField, sample
from realsim.records import Mesh

FIELD_CELLS = 96
"""Cells of a distance field along the longest side: those of the registration, which keeps them."""
FULL_M = 0.005
"""Distance at which the colours are full [m]: what tells a wrong pose from a right one."""
TABLE_M = 0.004
"""How far from the plane points may be the table's [m]: twice the depth's noise at 0.4 m."""
STOPS_RGB = np.array([[49, 54, 149], [116, 173, 209], [253, 141, 60], [165, 0, 38]], np.float64)
"""Blue to the noise, and from the noise to red: ColorBrewer's RdYlBu, which stays apart without
red-green vision."""
NOISE_RGB = (205, 226, 190)
"""Colour of what the depth's noise explains: pale, whatever its sign."""
NOISE_M = (0.0005, 0.001)
"""Least and greatest noise that is taken for such [m]: a pose off by more is never hidden in it."""
SIGMAS = 2.0
"""Distances up to so many standard deviations of the noise are noise."""
NONE_RGB = (140, 140, 140)
"""Colour of a point that is near no model."""


class _Near(NamedTuple):
    """The points near one object at one pose."""

    T_world_obj: Array
    which: Int64
    """(M,) numbers of the points."""
    distance_m: Array32
    """(M,) their signed distances [m]."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Legend:
    """What the colours mean."""

    values_mm: tuple[float, ...]
    """Signed distances, negative first [mm]."""
    rgb: Rgb
    """(K, 3) their colours."""
    words: str


class CloudResiduals:
    """The residuals of one cloud against objects that are moved one at a time."""

    def __init__(
        self,
        points: ArrayLike,
        *,
        within_m: float = 0.01,
        folder: Path | None = None,
        T_world_table: ArrayLike | None = None,
    ) -> None:
        """Take the cloud.

        Args:
            points: (N, 3) in world [m].
            within_m: points farther from every model than this belong to none [m].
            folder: where the registration keeps distance fields; None = in memory only.
            T_world_table: (4, 4) the supporting plane; points on it are the table's, not a part
                of an object that is missing. None = there is none.

        Raises:
            InputError: the points have another shape, or the distance is not positive.
        """
        p = np.ascontiguousarray(points, dtype=np.float32)
        if p.ndim != 2 or p.shape[1] != 3:
            raise InputError(f"the cloud has the shape {p.shape}; (N, 3) is accepted.")
        if not 0 < within_m < np.inf:
            raise InputError(f"residuals within {within_m} m; a positive distance is needed.")
        self._points, self._within_m, self._folder = p, float(within_m), folder
        self._near: dict[tuple[int, int], _Near] = {}
        self._fields: dict[int, tuple[Mesh, DistanceField]] = {}
        self._height_m = np.full(len(p), np.inf, np.float32)
        if T_world_table is not None:
            T = se3.check_rigid(T_world_table, "T_world_table").astype(np.float32)
            self._height_m = np.abs((p - T[:3, 3]) @ T[:3, 2])

    def against(self, T_world_objs: ArrayLike, meshes: Sequence[Mesh]) -> Array32:
        """Return the signed distance (N,) [m] of every point to the model it is nearest to.

        NaN = farther than `within_m` from all; positive = outside of the model, in front of its
        surface; negative = inside. Only objects whose pose or mesh has changed since the last call
        are computed.

        Args:
            T_world_objs: (K, 4, 4) where the objects stand.
            meshes: K of them.

        Raises:
            InputError: there are more poses than meshes, or fewer.
        """
        Ts = np.asarray(T_world_objs, dtype=np.float64).reshape(-1, 4, 4)
        if len(Ts) != len(meshes):
            raise InputError(f"{len(Ts)} poses and {len(meshes)} meshes; one of each is needed.")
        kept: dict[tuple[int, int], _Near] = {}
        out = np.full(len(self._points), np.nan, np.float32)
        least = np.full(len(self._points), np.inf, np.float32)
        for k, (T, mesh) in enumerate(zip(Ts, meshes, strict=True)):
            near = self._near.get((k, id(mesh)))
            if near is None or not np.array_equal(near.T_world_obj, T):
                near = self._measured(se3.check_rigid(T, f"the pose of object {k}"), mesh)
            kept[k, id(mesh)] = near
            d = np.abs(near.distance_m)
            nearer = d < least[near.which]
            mine = near.which[nearer]
            least[mine], out[mine] = d[nearer], near.distance_m[nearer]
        # What is nearer to the table than to any model is the table.
        out[(self._height_m < TABLE_M) & (self._height_m < least)] = np.nan
        self._near = kept
        used = {id(mesh) for mesh in meshes}
        self._fields = {key: field for key, field in self._fields.items() if key in used}
        return out

    def _measured(self, T_world_obj: Array, mesh: Mesh) -> _Near:
        """Return the points near an object and their distances."""
        if id(mesh) not in self._fields:
            field = DistanceField.from_mesh(mesh, FIELD_CELLS, self._folder)
            self._fields[id(mesh)] = (mesh, field)  # the mesh is held, so that its id stays its own
        field = self._fields[id(mesh)][1]
        low, high = mesh.bounds
        index, distance = _near_points(
            (field.grid, field.origin, field.cell), self._points, se3.invert(T_world_obj),
            (low, high), self._within_m,
        )  # fmt: skip
        return _Near(T_world_obj.copy(), index, distance)


def noise_of(residuals_m: ArrayLike) -> float:
    """Return the standard deviation of the depth's noise [m], within `NOISE_M`.

    Taken from the median distance: most objects stand right, or at least most of their surface.

    Args:
        residuals_m: (N,) signed distances [m]; NaN = none.
    """
    r = np.abs(np.asarray(residuals_m, dtype=np.float64).reshape(-1))
    r = r[np.isfinite(r)]
    return float(np.clip(1.4826 * np.median(r) if len(r) else NOISE_M[0], *NOISE_M))


def residual_rgb(
    residuals_m: ArrayLike, full_m: float = FULL_M, noise_m: float = NOISE_M[0]
) -> Rgb:
    """Return the colours (N, 3) of signed distances (N,) [m]: blue inside, red outside, grey none.

    What is within `SIGMAS` of the noise is pale: noise must not look like an error.

    Args:
        residuals_m: (N,); NaN = none.
        full_m: distance at which the colour is full [m].
        noise_m: standard deviation of the measured depth [m].

    Raises:
        InputError: `full_m` is not more than the noise.
    """
    if not 0 <= SIGMAS * noise_m < full_m < np.inf:
        raise InputError(
            f"colours that are full at {full_m} m with a noise of {noise_m} m; a distance of more "
            f"than {SIGMAS:g} times the noise is needed."
        )
    r = np.asarray(residuals_m, dtype=np.float32).reshape(-1)
    # A table of 511 colours instead of three interpolations of 200,000 points.
    levels = np.linspace(-full_m, full_m, 511)
    edge = SIGMAS * noise_m
    at = np.array([-full_m, -edge, edge, full_m])
    table = np.stack([np.interp(levels, at, STOPS_RGB[:, k]) for k in range(3)], axis=-1)
    table[np.abs(levels) <= edge] = NOISE_RGB
    colors = np.concatenate([np.rint(table), [NONE_RGB]]).astype(np.uint8)
    known = np.isfinite(r)
    step = np.rint(255.0 * np.clip(np.where(known, r, 0.0) / full_m, -1.0, 1.0)).astype(np.int64)
    return colors[np.where(known, step + 255, 511)]


def legend(full_m: float = FULL_M, within_m: float = 0.01, noise_m: float = NOISE_M[0]) -> Legend:
    """Return what the colours mean.

    Args:
        full_m: as of `residual_rgb` [m].
        within_m: as of `CloudResiduals` [m].
        noise_m: as of `residual_rgb` [m].
    """
    edge = SIGMAS * noise_m
    values = np.array([-full_m, -0.5 * (full_m + edge), 0.0, 0.5 * (full_m + edge), full_m])
    words = (
        f"distance of the measured points from the models: pale green = on the surface, within the "
        f"noise of {1e3 * edge:.2g} mm; red = in front of it, blue = inside, full at "
        f"{1e3 * full_m:g} mm; grey = farther than {1e3 * within_m:g} mm from every model"
    )
    return Legend(
        values_mm=tuple(float(v) for v in 1e3 * values),
        rgb=residual_rgb(values, full_m, noise_m), words=words,
    )  # fmt: skip


@njit
def _near_points(
    lattice: tuple[Array32, Array, float],
    points: Array32,
    T: Array,
    box: tuple[Array, Array],
    within: float,
) -> tuple[Int64, Array32]:
    """Return which points (N, 3), mapped by T, are near a surface, and their signed distances.

    Args:
        lattice: grid, origin and cell of the distance field.
        points: (N, 3) [m].
        T: (4, 4) T_obj_points.
        box: least and greatest corner of the mesh (3,) each [m].
        within: how near [m].
    """
    grid, origin, cell = lattice
    low, high = box
    index = np.empty(len(points), np.int64)
    distance = np.empty(len(points), np.float32)
    n = 0
    for m in range(len(points)):
        a, b, c = points[m, 0], points[m, 1], points[m, 2]
        x = T[0, 0] * a + T[0, 1] * b + T[0, 2] * c + T[0, 3]
        if not (low[0] - within <= x <= high[0] + within):
            continue
        y = T[1, 0] * a + T[1, 1] * b + T[1, 2] * c + T[1, 3]
        if not (low[1] - within <= y <= high[1] + within):
            continue
        z = T[2, 0] * a + T[2, 1] * b + T[2, 2] * c + T[2, 3]
        if not (low[2] - within <= z <= high[2] + within):
            continue
        d, _, _, _ = sample(grid, origin, cell, x, y, z)
        if abs(d) <= within:
            index[n], distance[n] = m, d
            n += 1
    return index[:n].copy(), distance[:n].copy()
