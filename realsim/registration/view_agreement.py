"""Whether views measure the same scene: what one view measured, held against what others see.

A point that one view measured is either seen by another view, too (agrees), or hidden from it by
something nearer, or looked through: the other view measured something further away on the same
ray, so nothing is there. Surfaces of one scene are never looked through; those of another scene,
or of a camera that stood elsewhere, are.

Views held against each other: each with its partners, by points of what stands on the table.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from realsim.arrays import Array, Array32, Int32, Int64
from realsim.compiled import njit
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.records import SupportPlane
from realsim.registration.evidence import DepthNoise
from realsim.registration.find_table import region_of_interest
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


T_CAM_GL = np.diag([1.0, -1.0, -1.0, 1.0])
"""OpenGL's camera (y up, z backward) in OpenCV's."""
OVERDRAWN = 20
"""Factor of points drawn before those above the table, which may be few, are picked."""


ABOVE_M = 0.008
"""Points higher than this over the table are of what stands there [m]."""
MARGIN_M = 0.008
"""Depths that differ by less agree [m]: twice what a 0.4 deg hand-eye does at 0.5 m."""
SIGMAS = 3.0
"""Plus so many sigma_z."""
POINTS = 300
"""Points of a view that others are asked about, of each kind."""
NEAR = 3
"""Partners of a view: the nearest."""
SPREAD = 5
"""Further partners of a view, spread over the session."""
LEAST_DECIDED = 60
"""With fewer points that partners decide upon, nothing is said."""
SCENE_SUPPORT = 0.2
"""Points that agree less those looked through; below it the views are not of one scene. Clean
scenes: 0.55 to 0.7."""
TRIAL_GAIN = 0.2
"""A mistake of all poses is named if undoing it raises the support by this."""
TRIAL_VIEWS = 24
"""Views by which mistakes of all poses are tried."""
SEED = 0
"""Seed of the choice of points."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class HeldViews:
    """Views that hold points, with what is needed to hold them against each other."""

    views: tuple[ViewPoints, ...]
    maps: ViewMaps
    partners: Int64
    """(F, P) the views that each is held against."""
    above: tuple[Array, ...]
    """Per view: (N, 3) points above the table in camera axes [m]; any if there is no table."""
    everywhere: tuple[Array, ...]
    """Per view: (N, 3) any points in camera axes [m]."""


def hold_views(
    views: Sequence[ViewPoints], plane: SupportPlane | None, noise: DepthNoise
) -> HeldViews:
    """Return the views with their maps, partners and points."""
    aim, radius = region_of_interest(views, plane)
    above: list[Array] = []
    everywhere: list[Array] = []
    for v in views:
        rng = np.random.default_rng((SEED, v.index))
        mine = v.points[rng.integers(0, len(v.points), OVERDRAWN * POINTS)]
        mine = mine.astype(np.float64)
        everywhere.append(mine[:POINTS])
        if plane is not None:
            T = se3.invert(plane.T_world_table) @ v.T_world_cam
            height = se3.transform(T, mine)[:, 2]
            near = np.linalg.norm(se3.transform(v.T_world_cam, mine) - aim, axis=1) < radius
            least = ABOVE_M + SIGMAS * noise.sigma(mine[:, 2])
            mine = mine[near & (height > least)]
        above.append(mine[:POINTS])
    maps = make_maps(views, noise)
    return HeldViews(
        views=tuple(views),
        maps=maps,
        partners=partners(maps.Ts_world_cam, NEAR, SPREAD),
        above=tuple(above),
        everywhere=tuple(everywhere),
    )


def contradiction(
    held: HeldViews, k: int, others: Sequence[int] | Int64, T_world_cam: Array | None = None
) -> float:
    """Return the median share by which others contradict view k, above the table; 0 = none can.

    Args:
        held: the views.
        k: which is asked about.
        others: the views that it is held against.
        T_world_cam: (4, 4) where it is supposed to be; None = where it is said to be.
    """
    maps = held.maps if T_world_cam is None else _move_camera(held.maps, k, T_world_cam)
    Ts = maps.Ts_world_cam
    mine = se3.transform(Ts[k], held.above[k])
    counts: list[Counts] = []
    for j in (int(j) for j in others):
        theirs = se3.transform(Ts[j], held.above[j])
        ours = compare(maps, j, mine, MARGIN_M, SIGMAS)
        counts.append(ours.plus(compare(maps, k, theirs, MARGIN_M, SIGMAS)))
    told = [c for c in counts if c.decided >= LEAST_DECIDED // 3]
    if sum(c.decided for c in counts) < LEAST_DECIDED or not told:
        return 0.0
    return float(np.median([c.contradicted for c in told]))


def support(held: HeldViews, k: int, others: Sequence[int] | Int64, T_world_cam: Array) -> float:
    """Return which share of all points of view k, supposed at T_world_cam, others confirm."""
    p = se3.transform(T_world_cam, held.everywhere[k])
    total = NO_COUNTS
    for j in others:
        total = total.plus(compare(held.maps, int(j), p, MARGIN_M, SIGMAS))
    return total.support


def sheet_contradiction(held: HeldViews, k: int, margin_m: float) -> float:
    """Return the share of all points by which view k and its partners contradict each other."""
    Ts = held.maps.Ts_world_cam
    total = NO_COUNTS
    mine = se3.transform(Ts[k], held.everywhere[k])
    for j in (int(j) for j in held.partners[k]):
        theirs = se3.transform(Ts[j], held.everywhere[j])
        total = total.plus(compare(held.maps, j, mine, margin_m, SIGMAS))
        total = total.plus(compare(held.maps, k, theirs, margin_m, SIGMAS))
    return total.contradicted


def check_all_poses(held: HeldViews, plane: SupportPlane | None) -> list[ViewFinding]:
    """Return what is wrong with all poses or units alike, if the views are not of one scene."""
    n = len(held.views)
    now = _scene_support(held, held.maps.Ts_world_cam, 1.0)
    if now > SCENE_SUPPORT:
        return []
    trials = _trials(held.maps.Ts_world_cam)
    then = [_scene_support(held, Ts, scale) for _, Ts, scale in trials]
    best = int(np.argmax(then))
    words = (
        f"the {n} views do not show one scene: where they are said to be, others confirm "
        f"{100 * now:.0f} % more of what a view measures than they look through (of a sound "
        f"session over {100 * SCENE_SUPPORT:.0f} %)"
    )
    if then[best] > max(SCENE_SUPPORT, now + TRIAL_GAIN):
        words += f"; {trials[best][0]}. Then it is {100 * then[best]:.0f} %."
    elif plane is None:
        words += (
            ". Neither inverted poses, other axes, other units nor poses shifted by one view help: "
            "are poses and images of the same session, and was the hand-eye calibrated?"
        )
    else:
        return []  # they share a table: whatever is wrong is wrong with single views
    return [ViewFinding(index=None, kind="all_disagree", words=words, exclude=False)]


def _trials(Ts: Array) -> list[tuple[str, Array, float]]:
    """Return the usual mistakes: words, the poses with it undone, and the factor of the depth."""
    inverse = np.stack([se3.invert(T) for T in Ts])
    in_m = Ts.copy()
    in_m[:, :3, 3] *= 1e-3
    inverse_in_m = np.stack([se3.invert(T) for T in in_m])
    return [
        ("the camera poses seem to be world-to-camera: invert them", inverse, 1.0),
        ("the camera axes seem to be OpenGL's (y up, z backward): turn them", Ts @ T_CAM_GL, 1.0),
        (
            "the camera poses seem to be world-to-camera with OpenGL's axes (y up, z backward)",
            np.stack([se3.invert(T_CAM_GL @ T) for T in Ts]),
            1.0,
        ),
        ("the camera poses seem to be in millimetres", in_m, 1.0),
        ("the camera poses seem to be world-to-camera in millimetres", inverse_in_m, 1.0),
        ("the depth seems to be ten times too large", Ts, 0.1),
        ("the depth seems to be ten times too small", Ts, 10.0),
        ("every image seems to belong to the next view's pose", np.roll(Ts, -1, axis=0), 1.0),
        ("every image seems to belong to the previous view's pose", np.roll(Ts, 1, axis=0), 1.0),
    ]


def _scene_support(held: HeldViews, Ts: Array, scale: float) -> float:
    """Return which share of some views' points others confirm, less those looked through."""
    n = len(held.views)
    pick = np.unique(np.linspace(0, n - 1, min(n, TRIAL_VIEWS)).round().astype(int))
    maps = replace(held.maps, Ts_world_cam=Ts)
    if scale != 1.0:
        factor = np.float32(scale)
        # sigma_z = k z^2 of the depth as it was: scale k (z / scale)^2.
        noise = DepthNoise(per_m=maps.noise.per_m / scale, floor_m=maps.noise.floor_m * scale)
        maps = replace(maps, low=maps.low * factor, high=maps.high * factor, noise=noise)
    near = partners(Ts, NEAR, SPREAD)
    total = NO_COUNTS
    for k in pick:
        p = se3.transform(Ts[k], scale * held.everywhere[k])
        for j in near[k]:
            total = total.plus(compare(maps, int(j), p, MARGIN_M, SIGMAS))
    return total.support


def _move_camera(maps: ViewMaps, k: int, T_world_cam: Array) -> ViewMaps:
    """Return the maps with camera k elsewhere."""
    Ts = maps.Ts_world_cam.copy()
    Ts[k] = T_world_cam
    return replace(maps, Ts_world_cam=Ts)
