"""Whether depth images lie on their colour images: outlines in depth against edges in colour.

Where depth jumps, the nearer thing ends, and there colour mostly changes, too. So the outlines of
the depth image, moved by the right shift and stretched by the right factors, fall on edges of the
colour image more often than moved by any other. Edges along rows and along columns are kept
apart: an outline must fall on an edge of its own direction.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numba
import numpy as np
from numpy.typing import NDArray

from realsim.errors import InputError
from realsim.geometry.depth import MAD_TO_SIGMA
from realsim.records import CameraIntrinsics

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
Kind = Literal["aligned", "not_aligned", "unknown", "other_size"]


def _stretches() -> tuple[float, ...]:
    """Return the factors that depth is stretched by: about +-2 % apart, from 0.7 to 1.45."""
    return tuple(float(s) for s in np.exp(np.arange(-18, 19) * 0.02))


@dataclass(frozen=True, kw_only=True, slots=True)
class AlignmentConfig:
    """How outlines are compared with edges. Pixels are those of an image `work_width_px` wide."""

    work_width_px: int = 640
    """Images are reduced to about this width: finer edges are noise."""
    jump_m: float = 0.015
    """Depth differences beyond this are outlines [m]; plus `jump_share` of the depth."""
    jump_share: float = 0.02
    """Noise and slopes grow with depth."""
    gap_px: int = 12
    """Depth that is missing over less than this beside an outline is the stereo camera's shadow:
    the nearer side of the gap is the outline."""
    run_px: int = 8
    """Outlines are at least so long."""
    reach_px: int = 24
    """Shifts up to this are tried, along both axes."""
    step_px: int = 3
    """Steps of the shifts while stretches are tried, too."""
    stretches: tuple[float, ...] = field(default_factory=_stretches)
    """Factors that depth is stretched by about the middle, along each axis: a colour lens of 69
    deg against a depth lens of 87 deg is 0.72."""
    near_px: float = 1.5
    """An outline counts exp(-d^2 / 2 near^2) at distance d from an edge."""
    wide_px: float = 3.0
    """The same while stretches are tried, in coarser steps."""
    edge_share: float = 0.08
    """The strongest edges of the colour image, so large a share of its pixels, are used."""
    points: int = 1200
    """Outline pixels used at most; a third of them while stretches are tried."""
    least_points: int = 150
    """With fewer outlines nothing is said: an empty table has none."""
    confidence: float = 5.0
    """The best shift stands out by at least so many robust standard deviations of all shifts."""
    stretch_confidence: float = 8.0
    """The same of the best stretch: a thousand times more are tried."""
    aligned_px: float = 4.0
    """A best shift up to this is aligned: published, aligned data lies up to 2.7 px off (YCB-Video
    by 2.5 px along y, GraspNet's Kinect by 2.5 px)."""
    wrong_px: float = 5.0
    """Outlines this far off, in the mean over the image, are said to be not aligned."""
    stretch_gain: float = 1.15
    """A stretch is believed if it is so many times better than the best shift without one."""
    agree_share: float = 0.75
    """A view agrees with all of them if their best is worth this share of its own best."""
    gain: float = 1.3
    """A stretch or shift is believed if outlines lie on edges so many times as often beyond chance
    as they do unmoved."""
    seed: int = 0
    """Of the choice of outline pixels."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class AlignmentFinding:
    """How depth lies on colour, in one view or in several."""

    kind: Kind
    words: str
    """One sentence for a person."""
    shift_px: tuple[float, float] = (0.0, 0.0)
    """Where depth lies against colour: right and down, in pixels of the colour image."""
    stretch: tuple[float, float] = (1.0, 1.0)
    """By what depth is to be stretched along x and y to lie on colour."""
    confidence: float = 0.0
    """By how many robust standard deviations the best shift stands out."""
    outlines: int = 0
    """How many outline pixels were used."""
    agreeing: int = 0
    """Views that say the same."""
    views: int = 1
    """Views looked at."""
    px_factor: float = 1.0
    """Pixels of the colour image per working pixel."""
    radius_px: float = 0.0
    """Mean distance of a pixel from the middle, along an axis [working px]."""
    shift_scores: Array | None = None
    """(Y, X) share of outlines on edges beyond chance, per shift of a pixel."""
    stretch_scores: Array32 | None = None
    """(SX, SY, Y, X) the same per stretch and shift in steps; None where it was not needed."""


def check_alignment(
    rgb: NDArray[np.uint8],
    depth_m: NDArray[np.float32],
    intrinsics: CameraIntrinsics,
    config: AlignmentConfig,
) -> AlignmentFinding:
    """Return how the depth image lies on the colour image.

    Args:
        rgb: (H, W, 3).
        depth_m: (H, W) depth along z [m]; 0 = none.
        intrinsics: the camera both are said to be of.
        config: see there.

    Raises:
        InputError: the colour image is not (H, W, 3) of 8 bits.
    """
    if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8:
        raise InputError(
            f"the colour image has shape {rgb.shape} of {rgb.dtype}; (height, width, 3) of 8-bit "
            "red, green, blue is expected."
        )
    wanted = (intrinsics.height, intrinsics.width)
    if rgb.shape[:2] != wanted or depth_m.shape != wanted:
        return AlignmentFinding(kind="other_size", words=_size_words(rgb, depth_m, intrinsics))
    factor = max(1, round(intrinsics.width / config.work_width_px))
    outlines = _outlines(depth_m[::factor, ::factor], config)
    radius = 0.125 * (wanted[0] + wanted[1]) / factor
    if len(outlines) < config.least_points:
        words = (
            f"only {len(outlines)} pixels of outlines are in the depth image; at least "
            f"{config.least_points} are needed to hold it against the colour image."
        )
        return AlignmentFinding(kind="unknown", words=words, outlines=len(outlines))
    rng = np.random.default_rng(config.seed)
    outlines = outlines[np.sort(rng.permutation(len(outlines))[: config.points])]
    distance = _edge_distance(rgb, factor, config)
    middle = np.array([intrinsics.cx, intrinsics.cy]) / factor
    one = np.ones(1)
    shifts = _scores(distance, config.near_px, outlines, middle, one, config.reach_px, 1)
    first = _finding(
        _Scores(shifts[0, 0].astype(np.float64), None, len(outlines), factor, radius), config
    )
    if first.kind == "aligned":
        return first
    stretches = np.array(config.stretches)
    few = outlines[:: max(1, len(outlines) // (config.points // 3))]
    cube = _scores(
        distance, config.wide_px, few, middle, stretches, config.reach_px, config.step_px
    )
    return _finding(
        _Scores(shifts[0, 0].astype(np.float64), cube, len(outlines), factor, radius), config
    )


def pooled_alignment(
    findings: Sequence[AlignmentFinding], config: AlignmentConfig
) -> AlignmentFinding:
    """Return what several views together say: their scores are added.

    Raises:
        InputError: there are none.
    """
    if not findings:
        raise InputError("no view was held against its colour image; at least one is needed.")
    sizes = [f for f in findings if f.kind == "other_size"]
    if sizes:
        return sizes[0]
    told = [f for f in findings if f.shift_scores is not None]
    if not told:
        return findings[0]
    total = sum(f.outlines for f in told)
    shifts = np.sum([f.outlines / total * f.shift_scores for f in told], axis=0)  # type: ignore[operator]
    cubes = [(f.outlines, f.stretch_scores) for f in told if f.stretch_scores is not None]
    cube = None
    if cubes:
        weight = sum(n for n, _ in cubes)
        cube = np.sum([np.float32(n / weight) * c for n, c in cubes], axis=0)
    scores = _Scores(shifts, cube, total, told[0].px_factor, told[0].radius_px)
    return _finding(scores, config, told, len(findings))


@dataclass(frozen=True, eq=False, slots=True)
class _Scores:
    """How often outlines lie on edges beyond chance."""

    shifts: Array
    cube: Array32 | None
    outlines: int
    px_factor: float
    radius_px: float


def _finding(
    scores: _Scores, config: AlignmentConfig, votes: Sequence[AlignmentFinding] = (), views: int = 1
) -> AlignmentFinding:
    """Return the finding that the scores of one or more views allow."""
    reach, s = config.reach_px, scores.shifts
    spread = MAD_TO_SIGMA * float(np.median(np.abs(s - np.median(s)))) + 1e-9
    row, column = np.unravel_index(int(np.argmax(s)), s.shape)
    moved = np.array([_peak(s[row], int(column)), _peak(s[:, column], int(row))]) - reach
    sure = float((s[row, column] - np.median(s)) / spread)
    kind: Kind = "unknown"
    stretch = np.ones(2)
    off = float(np.hypot(moved[0], moved[1]))
    unmoved = float(s[reach - 1 : reach + 2, reach - 1 : reach + 2].max())
    if sure > config.confidence and off <= config.aligned_px:
        kind = "aligned"
    elif sure > config.confidence and off > config.wrong_px and s.max() > config.gain * unmoved:
        kind = "not_aligned"
    at: tuple[Any, ...] = (slice(None), slice(None), int(row), int(column))
    if kind != "aligned" and scores.cube is not None:
        best = _best_stretch(scores, config)
        if best is not None:
            kind, stretch, moved, sure, at = "not_aligned", *best
    shift = -moved * scores.px_factor
    agreeing = sum(_agrees(v, at, config) for v in votes) if votes else 1
    words = _words(kind, shift, stretch, (agreeing, views))
    return AlignmentFinding(
        kind=kind, words=words, shift_px=(float(shift[0]), float(shift[1])),
        stretch=(float(stretch[0]), float(stretch[1])), confidence=sure,
        outlines=scores.outlines, agreeing=agreeing, views=views, px_factor=scores.px_factor,
        radius_px=scores.radius_px, shift_scores=s, stretch_scores=scores.cube,
    )  # fmt: skip


def _best_stretch(
    scores: _Scores, config: AlignmentConfig
) -> tuple[Array, Array, float, tuple[Any, ...]] | None:
    """Return stretch, shift, confidence and place of the best stretch, if it is believed."""
    cube = scores.cube
    assert cube is not None
    at = tuple(int(i) for i in np.unravel_index(int(np.argmax(cube)), cube.shape))
    sx, sy, row, column = at
    factors = np.array(config.stretches)
    unit = int(np.argmin(np.abs(factors - 1)))
    middle = config.reach_px // config.step_px
    peak = float(cube[at])
    stretch = np.array([factors[sx], factors[sy]])
    plane = cube[sx, sy]
    shift = config.step_px * (
        np.array([_peak(plane[row], column), _peak(plane[:, column], row)]) - middle
    )
    off = float(np.hypot(*(np.abs(shift) + np.abs(stretch - 1) * scores.radius_px)))
    some = cube[::3, ::3].astype(np.float64)
    usual = float(np.median(some))
    sure = (peak - usual) / (MAD_TO_SIGMA * float(np.median(np.abs(some - usual))) + 1e-9)
    better = peak > config.gain * float(cube[unit, unit, middle, middle])
    better &= peak > config.stretch_gain * float(cube[unit, unit].max())
    if sure < config.stretch_confidence or off < config.wrong_px or not better:
        return None
    return stretch, shift, float(sure), at


def _agrees(finding: AlignmentFinding, at: tuple[Any, ...], config: AlignmentConfig) -> bool:
    """Return whether the best place of all views is nearly the best of this one, too.

    Args:
        finding: of one view.
        at: stretch along x and y, row and column; the stretches are slices if there is none.
        config: see there.
    """
    s, cube = finding.shift_scores, finding.stretch_scores
    if isinstance(at[0], int):
        return cube is not None and float(cube[at]) >= config.agree_share * float(cube.max())
    if s is None:
        return False
    row, column = at[2], at[3]
    near = s[max(0, row - 2) : row + 3, max(0, column - 2) : column + 3]
    return float(near.max()) >= config.agree_share * float(s.max())


def _peak(values: NDArray[np.floating], i: int) -> float:
    """Return where a parabola through the greatest value and its neighbours has its top."""
    if i == 0 or i == len(values) - 1:
        return float(i)
    a, b, c = (float(values[i + k]) for k in (-1, 0, 1))
    bend = a - 2 * b + c
    return i + (0.5 * (a - c) / bend if bend < 0 else 0.0)


def _words(kind: Kind, shift: Array, stretch: Array, count: tuple[int, int]) -> str:
    """Return the finding as a sentence."""
    if kind == "aligned":
        return f"depth lies on the colour image in {count[0]} of {count[1]} views."
    if kind == "unknown":
        return (
            "whether depth lies on the colour image cannot be told: its outlines fall on edges of "
            "the colour image nowhere more often than by chance."
        )
    sides: list[str] = []
    if abs(shift[0]) >= 1:
        sides.append(f"{abs(shift[0]):.0f} px to the {'right' if shift[0] > 0 else 'left'} of")
    if abs(shift[1]) >= 1:
        sides.append(f"{abs(shift[1]):.0f} px {'below' if shift[1] > 0 else 'above'}")
    parts: list[str] = []
    if sides:
        parts.append(f"its edges lie {' and '.join(sides)} the colour edges")
    if np.any(np.abs(stretch - 1) > 0.01):
        parts.append(f"it has to be stretched by {stretch[0]:.2f} in x and {stretch[1]:.2f} in y")
    return (
        f"depth is not aligned to the colour image: {', and '.join(parts)}, in {count[0]} of "
        f"{count[1]} views. Use the stream aligned to colour, or register depth with the "
        "depth-to-colour extrinsics."
    )


def _size_words(
    rgb: NDArray[np.uint8], depth_m: NDArray[np.float32], intrinsics: CameraIntrinsics
) -> str:
    """Return in words that the sizes differ."""
    return (
        f"depth is {depth_m.shape[1]}x{depth_m.shape[0]}, colour {rgb.shape[1]}x{rgb.shape[0]} "
        f"and the camera {intrinsics.width}x{intrinsics.height} pixels; all three must be alike. "
        "Use the depth stream aligned to colour, or register it with the depth-to-colour "
        "extrinsics; resizing does not align it."
    )


def _outlines(depth_m: NDArray[np.float32], config: AlignmentConfig) -> Array32:
    """Return outline points (N, 3): x, y, and 0 where depth jumps along x, 1 along y."""
    import cv2

    found: list[NDArray[np.float32]] = []
    full = _without_pinholes(np.where(np.isfinite(depth_m) & (depth_m > 0), depth_m, 0))
    for axis, z in ((0, full), (1, full.T)):
        columns = np.arange(z.shape[1])
        # Column of the last measured pixel before each one: gaps are stepped over.
        last = np.maximum.accumulate(np.where(z > 0, columns, -1), axis=1)
        before = np.concatenate([np.full((len(z), 1), -1), last[:, :-1]], axis=1)
        i, j = np.nonzero((z > 0) & (before >= 0) & (columns - before <= config.gap_px))
        b = before[i, j]
        here, there = z[i, j], z[i, b]
        jump = np.abs(here - there)
        keep = jump > config.jump_m + config.jump_share * np.minimum(here, there)
        i, j, b = i[keep], j[keep], b[keep]
        # The border of the nearer of the two, half a pixel outside of it.
        x = np.where(here[keep] < there[keep], j - 0.5, b + 0.5)
        mask = np.zeros(z.shape, np.uint8)
        mask[i, np.ceil(x).astype(np.int64)] = 1
        _, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
        # Noise jumps here and there, outlines run on.
        long = stats[:, cv2.CC_STAT_HEIGHT] >= config.run_px
        keep = long[labels[i, np.ceil(x).astype(np.int64)]]
        i, x = i[keep], x[keep]
        xy = (x, i) if axis == 0 else (i, x)
        found.append(np.stack([*xy, np.full(len(x), axis)], axis=1).astype(np.float32))
    return np.concatenate(found)


def _without_pinholes(depth_m: NDArray[np.float32]) -> Array:
    """Return the depth (H, W) with holes of a pixel filled: depth mapped onto a larger image."""
    z = depth_m.astype(np.float64)
    for axis in (1, 0):
        a, b = np.roll(z, 1, axis), np.roll(z, -1, axis)
        z = np.where((z == 0) & (a > 0) & (b > 0), np.maximum(a, b), z)
    return z


def _edge_distance(rgb: NDArray[np.uint8], factor: int, config: AlignmentConfig) -> Array32:
    """Return the distance (2, H, W) to the nearest colour edge along x and along y [px]."""
    import cv2

    size = (-(-rgb.shape[1] // factor), -(-rgb.shape[0] // factor))
    small = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA) if factor > 1 else rgb
    smooth = cv2.GaussianBlur(small, (0, 0), 1.0).astype(np.float32)
    gx = cv2.Sobel(smooth, cv2.CV_32F, 1, 0)
    gy = cv2.Sobel(smooth, cv2.CV_32F, 0, 1)
    # Of the three colours the one that changes most.
    most = np.argmax(gx**2 + gy**2, axis=2)[..., None]
    gx = np.take_along_axis(gx, most, 2)[..., 0]
    gy = np.take_along_axis(gy, most, 2)[..., 0]
    out = np.empty((2, *gx.shape), np.float32)
    for axis, g in ((0, np.abs(gx)), (1, np.abs(gy))):
        a, b = np.roll(g, 1, axis=1 - axis), np.roll(g, -1, axis=1 - axis)
        crest = (g >= a) & (g > b)
        values = g[crest]
        n = int(0.5 * config.edge_share * g.size)
        least = np.partition(values, -n)[-n] if n < len(values) else 0.0
        edges = crest & (g >= max(float(least), 1.0))
        out[axis] = cv2.distanceTransform((~edges).astype(np.uint8), cv2.DIST_L2, 3)
    return out


def _scores(
    distance: Array32, width_px: float, outlines: Array32, middle: Array, stretches: Array,
    reach: int, step: int,
) -> Array32:  # fmt: skip
    """Return (S, S, Y, X) the share of outlines on edges beyond chance per stretch and shift."""
    near = np.exp(-0.5 * np.square(distance / np.float32(width_px))).astype(np.float32)
    chance = near.reshape(2, -1).mean(1)
    raw = _sum_near(near, chance, outlines, middle, stretches, (reach // step, step))
    mean = float(np.mean(chance[outlines[:, 2].astype(np.int64)]))
    return ((raw / len(outlines) - mean) / (1.0 - mean)).astype(np.float32)


@numba.njit(cache=True)  # pyright: ignore[reportUntypedFunctionDecorator]
def _sum_near(
    near: Array32, chance: Array32, outlines: Array32, middle: Array, stretches: Array,
    shifts: tuple[int, int],
) -> Array:  # fmt: skip
    """Return (S, S, Y, X) the sum of closeness over outlines (N, 3); outside it is chance."""
    count, step = shifts
    size = 2 * count + 1
    _, height, width = near.shape
    out = np.zeros((len(stretches), len(stretches), size, size))
    for sx in range(len(stretches)):
        for sy in range(len(stretches)):
            for n in range(len(outlines)):
                axis = int(outlines[n, 2])
                x0 = middle[0] + stretches[sx] * (outlines[n, 0] - middle[0])
                y0 = middle[1] + stretches[sy] * (outlines[n, 1] - middle[1])
                j0, i0 = int(np.floor(x0 + 0.5)), int(np.floor(y0 + 0.5))
                for a in range(size):
                    i = i0 + (a - count) * step
                    for b in range(size):
                        j = j0 + (b - count) * step
                        if 0 <= i < height and 0 <= j < width:
                            out[sx, sy, a, b] += near[axis, i, j]
                        else:
                            out[sx, sy, a, b] += chance[axis]
    return out
