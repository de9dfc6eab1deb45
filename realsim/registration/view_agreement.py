"""Whether views measure the same scene: what one view measured, held against what others see.

A point that one view measured is either seen by another view, too (agrees), or hidden from it by
something nearer, or looked through: the other view measured something further away on the same
ray, so nothing is there. Surfaces of one scene are never looked through; those of another scene,
or of a camera that stood elsewhere, are.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from realsim.arrays import Array, Array32, Int32, Int64
from realsim.compiled import njit
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.registration.evidence import DepthNoise
from realsim.registration.views import ViewPoints

CELL_STRIDES = 2.0
"""Cells of the depth maps are so many sampling strides wide: four samples fill one."""
NEAREST_M = 0.02
"""Nothing nearer to a camera than this is measured [m]."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ViewMaps:
    """Small depth maps of all views: nearest and farthest trusted depth in every cell."""

    pinhole: Array
    """(4,) fx, fy, cx, cy fitted to the points; a lens' distortion is less than a cell [px]."""
    cell_px: float
    """Width of a cell [px]."""
    low: Array32
    """(F, rows, columns) least depth [m]; 0 = none."""
    high: Array32
    """(F, rows, columns) greatest depth [m]; 0 = none."""
    Ts_world_cam: Array
    """(F, 4, 4) where the cameras are said to be [m]."""
    noise: DepthNoise


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Counts:
    """What other views say of points."""

    agree: int
    """Seen there by the other view, too."""
    through: int
    """Looked through."""
    points: int
    """All that were asked about; the rest is hidden, outside of the image, or not measured."""

    @property
    def decided(self) -> int:
        """How many points the other view can say anything about."""
        return self.agree + self.through

    @property
    def contradicted(self) -> float:
        """Share of the points that are decided upon that were looked through; 0 if none is."""
        return self.through / max(1, self.agree + self.through)

    @property
    def support(self) -> float:
        """Share of all points that agree, less those looked through."""
        return (self.agree - self.through) / max(1, self.points)

    def plus(self, other: "Counts") -> "Counts":
        """Return the sum."""
        return Counts(
            agree=self.agree + other.agree,
            through=self.through + other.through,
            points=self.points + other.points,
        )


NO_COUNTS = Counts(agree=0, through=0, points=0)


def make_maps(views: Sequence[ViewPoints], noise: DepthNoise) -> ViewMaps:
    """Return the depth maps of the views.

    Raises:
        InputError: no view holds enough points to tell the camera's focal length.
    """
    pinhole = _pinhole(views)
    cell = CELL_STRIDES * float(np.sqrt(max(v.area_px for v in views)))
    most = np.max([v.pixels.max(0) for v in views if len(v.pixels)], axis=0)
    columns, rows = (int(x // cell) + 1 for x in most)
    low = np.zeros((len(views), rows, columns), np.float32)
    high = np.zeros_like(low)
    for k, v in enumerate(views):
        z = np.ascontiguousarray(v.points[:, 2], dtype=np.float32)
        _fill(v.pixels, z, cell, low[k], high[k])
    Ts = np.stack([v.T_world_cam for v in views])
    return ViewMaps(pinhole=pinhole, cell_px=cell, low=low, high=high, Ts_world_cam=Ts, noise=noise)


def _pinhole(views: Sequence[ViewPoints]) -> Array:
    """Return fx, fy, cx, cy (4,) by least squares of pixel = f x/z + c over all views."""
    some = [(v.points[::17], v.pixels[::17]) for v in views if len(v.points)]
    xyz = np.concatenate([s[0] for s in some]).astype(np.float64) if some else np.zeros((0, 3))
    if len(xyz) < 8:
        raise InputError(f"{len(views)} views hold no depth to speak of; there is no scene.")
    uv = np.concatenate([s[1] for s in some]).astype(np.float64)
    out = np.empty(4)
    for axis in (0, 1):
        A = np.stack([xyz[:, axis] / xyz[:, 2], np.ones(len(xyz))], axis=1)
        out[[axis, 2 + axis]] = np.linalg.lstsq(A, uv[:, axis], rcond=None)[0]
    return out


def compare(maps: ViewMaps, k: int, points_world: Array, margin_m: float, sigmas: float) -> Counts:
    """Return what view k says of points (N, 3) that others measured [m].

    Args:
        maps: of all views.
        k: which of them is asked.
        points_world: (N, 3) [m].
        margin_m: closer than this to what the view measured, a point agrees [m].
        sigmas: plus so many sigma_z.
    """
    p = np.ascontiguousarray(se3.transform(se3.invert(maps.Ts_world_cam[k]), points_world))
    limits = (margin_m, sigmas, maps.noise.per_m, maps.noise.floor_m)
    agree, through = _compare(p, maps.low[k], maps.high[k], maps.pinhole, maps.cell_px, limits)
    return Counts(agree=int(agree), through=int(through), points=len(p))


def partners(Ts_world_cam: Array, near: int, spread: int) -> Int64:
    """Return for every view (F, near + spread) those it is held against, itself never.

    The nearest by position see the same surfaces; those spread evenly over the session break the
    agreement of a whole run of views that is wrong in itself.
    """
    n = len(Ts_world_cam)
    eyes = Ts_world_cam[:, :3, 3]
    wanted = min(near + spread, n - 1)
    rows: list[list[int]] = []
    for k in range(n):
        order = np.argsort(np.linalg.norm(eyes - eyes[k], axis=1), kind="stable")
        mine = [int(j) for j in order if j != k][: min(near, wanted)]
        step = max(1, n // (spread + 1))
        far = [(k + step * (i + 1)) % n for i in range(spread)] + [int(j) for j in order]
        for j in far:
            if len(mine) < wanted and j != k and j not in mine:
                mine.append(j)
        rows.append(mine)
    return np.array(rows, dtype=np.int64).reshape(n, wanted)


@njit
def _fill(pixels: Int32, z: Array32, cell: float, low: Array32, high: Array32) -> None:
    """Enter the depths (N,) [m] into the cells of one view's maps."""
    for n in range(len(z)):
        i, j = int(pixels[n, 1] / cell), int(pixels[n, 0] / cell)
        if low[i, j] == 0.0 or z[n] < low[i, j]:
            low[i, j] = z[n]
        high[i, j] = max(high[i, j], z[n])


@njit
def _compare(
    points_cam: Array,
    low: Array32,
    high: Array32,
    pinhole: Array,
    cell: float,
    limits: tuple[float, float, float, float],
) -> tuple[int, int]:
    """Return how many points (N, 3) in camera axes agree, and how many are looked through.

    The neighbouring cells count as well: what lies beside a point may stand a cell away, because
    the cameras are not exactly where they are said to be.
    """
    margin, sigmas, per_m, floor = limits
    fx, fy, cx, cy = pinhole
    rows, columns = low.shape
    agree, through = 0, 0
    for n in range(len(points_cam)):
        x, y, z = points_cam[n]
        if z < NEAREST_M:
            continue
        u, v = (fx * x / z + cx + 0.5) / cell, (fy * y / z + cy + 0.5) / cell
        if not (0.0 <= u < columns and 0.0 <= v < rows):
            continue
        i, j = int(v), int(u)
        if low[i, j] == 0.0:
            continue
        nearest, farthest = low[i, j], high[i, j]
        for a in range(max(0, i - 1), min(rows, i + 2)):
            for b in range(max(0, j - 1), min(columns, j + 2)):
                if low[a, b] > 0.0:
                    nearest = min(nearest, low[a, b])
                    farthest = max(farthest, high[a, b])
        allowed = margin + sigmas * max(floor, per_m * z * z)
        if z < nearest - allowed:
            through += 1
        elif z <= farthest + allowed:
            agree += 1
    return agree, through


Kind = Literal[
    "no_depth", "little_depth", "table_off", "foreign", "partly_foreign", "pose_of_another",
    "slipped", "all_disagree", "objects_off", "cameras_moved", "cameras_far", "odometry",
    "fixed_cameras",
]  # fmt: skip


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ViewFinding:
    """What is wrong with a view."""

    index: int | None
    """Number of the view; None = all of them."""
    kind: Kind
    words: str
    """One sentence for a person."""
    exclude: bool
    """Whether the view is to be left out of the registration."""
