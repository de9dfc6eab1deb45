"""The measured depth of many views as one cloud, in levels of detail that nest."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from realsim.arrays import Array32, Int32, Int64, Mask, Rgb
from realsim.errors import InputError
from realsim.geometry.camera import ray_table
from realsim.records import View
from realsim.review.content import quick_png
from realsim.review.content.views import Region, strided
from realsim.store import SessionStore
from realsim.store.session_store import depth_path, rgb_path

SAMPLES_PER_POINT = 4
"""Depth samples fused per point wanted: on overlapping views about as many fall into one voxel."""
MOST_SAMPLES = 4_000_000
"""Depth samples taken in all, about: 30 bytes each while they are sorted into voxels."""
BLOCK = 200_000
"""Samples averaged at a time: 70 bytes each."""
TRIED_PER_POINT = 10
"""Points that are looked at per point of the coarse level: hardly a cell is missed."""
AREA_POINTS, AREA_CELL = 100_000, 5
"""Points by which the measured area is found, and edge of its cells in voxels."""
LEVEL_GROWTH = 4
"""Points of a level over those of the next coarser one: half the distance between neighbours."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class LeveledCloud:
    """A coloured cloud in levels: level k is `points[: ends[k]]`, and so holds those before it."""

    points: Array32
    """(N, 3) in world [m]."""
    colors: Rgb
    """(N, 3) as photographed."""
    ends: tuple[int, ...]
    """Points of every level, coarse first; the last is N."""
    voxel_m: float
    """Edge of the voxels of the finest level [m]."""
    area_m2: float
    """Area of the surfaces that were measured [m^2]."""

    def __len__(self) -> int:
        """Return the number of points of the finest level."""
        return len(self.points)

    def spacing_m(self, count: int) -> float:
        """Return the distance of neighbours among the first `count` points, on a surface [m]."""
        return float(np.sqrt(self.area_m2 / max(1, min(count, len(self)))))

    def pieces(self, most: int, piece: int) -> list[slice]:
        """Return the levels up to about `most` points as messages carry them.

        The first piece is the coarse level; the others add to it, in order, and hold at most
        `piece` points each.
        """
        most = min(most, len(self))
        at = min(self.ends[0], most)
        cuts = [0, at, *range(at + piece, most, piece), most]
        return [slice(a, b) for a, b in pairwise(cuts) if b > a]


def fused_cloud(
    store: SessionStore,
    views: Sequence[View],
    region: Region,
    *,
    voxel_m: float,
    most: int,
    coarse: int,
    damaged: dict[int, str],
    on_photograph: Callable[[int, Rgb], None],
) -> LeveledCloud:
    """Return the measured depth of several views as one coloured cloud in world.

    Every view gives an even share of the samples, so that the cost does not grow with the number
    of views. A point is the mean of the samples in its voxel, or the sample nearest to that mean
    where the mean is more than half a voxel from each.

    Args:
        store: the session.
        views: views with a camera pose and depth.
        region: points outside are left out.
        voxel_m: samples are averaged in voxels of this edge [m].
        most: no more points than this are returned; those seen most often stay.
        coarse: points of the coarse level, about.
        damaged: is given view -> why for views whose images cannot be read: they are left out.
        on_photograph: called with every photograph (H, W, 3) that is decoded on the way, and the
            number of its view.
    """
    intrinsics = store.session.intrinsics
    size = intrinsics.height, intrinsics.width
    share = min(SAMPLES_PER_POINT * most, MOST_SAMPLES) / max(1, len(views))
    stride = max(1, round(float(np.sqrt(intrinsics.width * intrinsics.height / share))))
    rays = np.ascontiguousarray(ray_table(strided(intrinsics, stride)).reshape(-1, 3).T)
    # Touched only where samples come to lie: joining what each view gives would take it twice.
    samples = np.empty((len(views) * rays.shape[1], 3), np.float32)
    sampled = np.empty(samples.shape, np.uint8)
    n = 0
    for view in views:
        deep = store.path(depth_path(view.index))
        try:
            rgb = quick_png.read_rgb(store.path(rgb_path(view.index)))
            on_photograph(view.index, rgb)
            depth_m = quick_png.read_depth(deep, store.session.depth_unit_m)
            if not rgb.shape[:2] == depth_m.shape == size:
                raise InputError(f"its photograph has {rgb.shape[:2]} pixels, its depth "
                                 f"{depth_m.shape}, and the session's camera {size}.")  # fmt: skip
        except InputError as error:
            damaged[view.index] = str(error)
            continue
        points, at = _seen(depth_m[::stride, ::stride], rays, view, region)
        samples[n : n + len(points)] = points
        sampled[n : n + len(points)] = rgb[::stride, ::stride].reshape(-1, 3)[at]
        n += len(points)
    points, rgb = _voxel_points(samples[:n], sampled[:n], voxel_m, most)
    del samples, sampled
    order, ends = _coarse_first(points, voxel_m, coarse)
    points, rgb = points[order], rgb[order]
    points.setflags(write=False)
    rgb.setflags(write=False)
    area = _area_m2(points[:AREA_POINTS], voxel_m)
    return LeveledCloud(points=points, colors=rgb, ends=ends, voxel_m=voxel_m, area_m2=area)


def _area_m2(points: Array32, voxel_m: float) -> float:
    """Return the area that points (N, 3) cover [m^2]: that of the cells of a grid they lie in."""
    size = AREA_CELL * voxel_m
    return len(np.unique(_cells(points, size))) * size**2 if len(points) else 0.0


def _seen(depth_m: Array32, rays: Array32, view: View, region: Region) -> tuple[Array32, Int64]:
    """Return the points (N, 3) of a view in the region [m], and the numbers (N,) of their pixels.

    Args:
        depth_m: (H, W).
        rays: (3, H * W) of its pixels, z = 1; NaN where there is none.
        view: says where the camera stood.
        region: points outside are left out.
    """
    T, z = np.asarray(view.T_world_cam), depth_m.ravel()
    # Relative to the region, whose size float32 resolves to a hundredth of a micrometre.
    R, t = T[:3, :3].astype(np.float32), (T[:3, 3] - region.center).astype(np.float32)
    offset = R @ (rays * z) + t[:, None]
    near = np.square(offset).sum(0) <= np.float32(region.radius_m) ** 2
    at = np.flatnonzero(near & (z > 0))
    return (offset.T[at] + region.center).astype(np.float32), at


def _cells(points: Array32, size_m: float) -> Int64:
    """Return the number (N,) of the grid cell that holds each point."""
    key = np.zeros(len(points), np.int64)
    for axis in range(3):
        # In double: single would put points near a wall on either side of it.
        line = points[:, axis]
        low, high = (np.floor(v / np.float64(size_m)) for v in (line.min(), line.max()))
        key *= np.int64(high - low) + 1
        for start in range(0, len(points), BLOCK):
            part = slice(start, start + BLOCK)
            key[part] += (np.floor(line[part] / np.float64(size_m)) - low).astype(np.int64)
    return key


def _voxel_points(points: Array32, rgb: Rgb, voxel_m: float, most: int) -> tuple[Array32, Rgb]:
    """Return a point and a colour per occupied voxel; of more than `most` those seen most often."""
    if len(points) == 0:
        return points, rgb
    order, counts = _by_voxel(points, voxel_m)
    if len(counts) > most:
        keep = _greatest(counts, most)
        order, counts = order[np.repeat(keep, counts)], counts[keep]
    first = np.cumsum(counts, dtype=np.int32) - counts
    del counts
    means, colors = np.empty((len(first), 3), np.float32), np.empty((len(first), 3), np.uint8)
    ends = [*np.searchsorted(first, np.arange(BLOCK, len(order), BLOCK)).tolist(), len(first)]
    begin = 0
    for end in ends:
        if end == begin:
            continue
        samples = order[first[begin] : first[end] if end < len(first) else len(order)]
        means[begin:end], colors[begin:end] = _means(
            points[samples], rgb[samples], first[begin:end] - first[begin], voxel_m
        )
        begin = end
    return means, colors


def _by_voxel(points: Array32, voxel_m: float) -> tuple[Int32, Int32]:
    """Return the numbers (N,) of the points, voxel by voxel, and how many every voxel (V,) has."""
    key, bits = _cells(points, voxel_m), len(points).bit_length()
    if int(key.max()).bit_length() + bits < 64:
        # Cell and number as one: sorted in place, which takes a third of the time and memory.
        key <<= bits
        key |= np.arange(len(points), dtype=np.int32)
        key.sort()
        order = np.empty(len(points), np.int32)
        np.bitwise_and(key, (1 << bits) - 1, out=order, casting="unsafe")
        key >>= bits
    else:
        order = np.argsort(key).astype(np.int32)
        key = key[order]
    is_first = np.concatenate([[True], key[1:] != key[:-1]])
    del key
    first = np.flatnonzero(is_first).astype(np.int32)
    return order, np.diff(first, append=np.int32(len(points)))


def _greatest(counts: Int32, most: int) -> Mask:
    """Return (V,) which are the `most` greatest; of those equal to the least, every so manieth."""
    least = np.partition(counts, len(counts) - most)[len(counts) - most]
    keep = counts > least
    equal, room = np.flatnonzero(counts == least).astype(np.int32), most - np.count_nonzero(keep)
    keep[equal[np.linspace(0, len(equal), room, endpoint=False, dtype=np.int32)]] = True
    return keep


def _means(points: Array32, rgb: Rgb, first: Int32, voxel_m: float) -> tuple[Array32, Rgb]:
    """Return point and colour of every voxel.

    Args:
        points: (N, 3) samples, those of a voxel in a row [m].
        rgb: (N, 3) their colours.
        first: (V,) the first sample of every voxel.
        voxel_m: its edge [m].
    """
    counts = np.diff(np.append(first, len(points)))
    voxel = np.repeat(np.arange(len(first)), counts)
    # Relative to the first sample of the voxel: sums of coordinates would lose digits in float32.
    offset = points - points[first][voxel]
    mean = np.add.reduceat(offset, first, axis=0) / counts[:, None].astype(np.float32)
    offset -= mean[voxel]
    distance = np.einsum("nk,nk->n", offset, offset)
    least = np.minimum.reduceat(distance, first)
    means = (points[first] + mean).astype(np.float32)
    apart = np.flatnonzero(least > (voxel_m / 2) ** 2)
    if len(apart):
        nearest = np.flatnonzero(distance == least[voxel])
        _, at = np.unique(voxel[nearest], return_index=True)
        means[apart] = points[nearest[at[apart]]]
    colors = np.add.reduceat(rgb.astype(np.float32), first, axis=0) / counts[:, None]
    return means, np.rint(colors).astype(np.uint8)


def _coarse_first(points: Array32, voxel_m: float, coarse: int) -> tuple[Int64, tuple[int, ...]]:
    """Return an order of the points in which the first ones are spread evenly, and its levels.

    The coarse level has one point in each cell of a grid that leaves about so many. The others
    follow in random order: of points that are one to a voxel any choice is spread evenly enough.
    """
    n = len(points)
    order = np.random.default_rng(0).permutation(n)
    if n <= coarse:
        return order, (n,)
    # On a surface the cells of a grid grow fewer with the square of its edge.
    some = order[: TRIED_PER_POINT * coarse]
    size = voxel_m * float(np.sqrt(n / coarse))
    _, at = np.unique(_cells(points[some], size), return_index=True)
    at = np.sort(at)[:coarse]
    rest = np.ones(n, np.bool_)
    rest[at] = False
    ends = [len(at)]
    while LEVEL_GROWTH * ends[-1] < n:
        ends.append(LEVEL_GROWTH * ends[-1])
    return np.concatenate([order[at], order[rest]]), (*ends, n)
