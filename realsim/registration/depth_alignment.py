"""Whether depth images lie on their colour images: outlines in depth against edges in colour.

Where depth jumps, the nearer thing ends, and there colour mostly changes, too. So the outlines of
the depth image, moved by the right shift and stretched by the right factors, fall on edges of the
colour image more often than moved by any other. Edges along rows and along columns are kept
apart: an outline must fall on an edge of its own direction.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from realsim.arrays import Array, Array32, UInt8
from realsim.errors import InputError
from realsim.geometry.robust import MAD_TO_SIGMA
from realsim.records import CameraIntrinsics
from realsim.registration.outlines import edge_distance, outlines_of, scores_of

Kind = Literal["aligned", "not_aligned", "unknown", "other_size"]
WIDE_ASPECT = 4 / 3
"""By this a picture of 4:3 is stretched that is resized to 16:9."""
ASPECT_SLACK = 0.07
"""Steps of the stretches, and that the lenses differ [log]."""
LEAST_VOTES = 3
"""Two views may agree by chance."""
WORK_WIDTH_PX = 640
"""Images are reduced to about this width: finer edges are noise."""
REACH_PX = 24
"""Shifts up to this are tried, along both axes."""
STEP_PX = 3
"""Steps of the shifts while stretches are tried, too."""
STRETCHES = np.exp(np.arange(-18, 19) * 0.02)
"""Factors that depth is stretched by about the middle, along each axis: a colour lens of 69
deg against a depth lens of 87 deg is 0.72."""
NEAR_PX = 1.5
"""An outline counts exp(-d^2 / 2 near^2) at distance d from an edge."""
WIDE_PX = 3.0
"""The same while stretches are tried, in coarser steps."""
POINTS = 1200
"""Outline pixels used at most; a third of them while stretches are tried."""
LEAST_POINTS = 150
"""With fewer outlines nothing is said: an empty table has none."""
CONFIDENCE = 5.0
"""The best shift stands out by at least so many robust standard deviations of all shifts."""
VOTE_PX = 3.0
"""Views whose own best shifts lie within this of the common one vote for it; by chance one in
70 does."""
VOTE_SHARE = 0.5
"""With the votes of this share of the views, and three at least, a shift is sure."""
STRETCH_CONFIDENCE = 7.0
"""The same of the best stretch: a thousand times more are tried."""
ALIGNED_PX = 5.5
"""A best shift up to this is aligned: published, aligned data lies up to 5 px off (YCB-Video
2.5 px along y, GraspNet's Kinect 2.3 px, an F200 mapped onto its colour image 4.9 px)."""
WRONG_PX = 6.0
"""Outlines this far off, in the mean over the image, are said to be not aligned."""
STRETCH_GAIN = 1.15
"""A stretch is believed if it is so many times better than the best shift without one."""
AGREE_SHARE = 0.75
"""A view agrees with all of them if their best is worth this share of its own best."""
GAIN = 1.3
"""A stretch or shift is believed if outlines lie on edges so many times as often beyond chance
as they do unmoved."""
FEW_CONFIDENCE = 3.4
"""Least confidence of the best shift in one or two views, which cannot vote. The values from
here to `FEW_RESIZED_GAIN` were set on five frames of YCB-Video (aligned, shifted, stretched),
15 of an F200 and ten resized ones of a UR5e's camera."""
FEW_STRETCH_CONFIDENCE = 3.9
"""Least confidence of the best stretch: misaligned frames 4.0 to 7.7, an aligned one 3.3."""
FEW_SHARE = 0.3
"""Least share of outlines that lie on edges beyond chance."""
FEW_GAIN = 2.0
"""Least ratio of that share to the unmoved one: 2.2 to 5 where depth was moved or stretched,
1.05 to 1.41 where it was not."""
FEW_STRETCH_GAIN = 1.5
"""Least ratio of a stretch to the best shift: 1.7 to 12; aligned frames have up to 1.17."""
FEW_RESIZED_GAIN = 1.2
"""The same ratio for a stretch that is a resize from 4:3 to 16:9 or back: 1.2 to 2."""
SEED = 0
"""Seed of the choice of outline pixels."""


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


def check_alignment(rgb: UInt8, depth_m: Array32, intrinsics: CameraIntrinsics) -> AlignmentFinding:
    """Return how the depth image lies on the colour image.

    Args:
        rgb: (H, W, 3).
        depth_m: (H, W) depth along z [m]; 0 = none.
        intrinsics: the camera both are said to be of.

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
    factor = max(1, round(intrinsics.width / WORK_WIDTH_PX))
    outlines = outlines_of(depth_m[::factor, ::factor])
    radius = 0.125 * (wanted[0] + wanted[1]) / factor
    if len(outlines) < LEAST_POINTS:
        words = (
            f"only {len(outlines)} pixels of outlines are in the depth image; at least "
            f"{LEAST_POINTS} are needed to hold it against the colour image."
        )
        return AlignmentFinding(kind="unknown", words=words, outlines=len(outlines))
    rng = np.random.default_rng(SEED)
    outlines = outlines[np.sort(rng.permutation(len(outlines))[:POINTS])]
    distance = edge_distance(rgb, factor)
    middle = np.array([intrinsics.cx, intrinsics.cy]) / factor
    one = np.ones(1)
    shifts = scores_of(distance, NEAR_PX, outlines, middle, one, REACH_PX, 1)
    first = _finding(_Scores(shifts[0, 0].astype(np.float64), None, len(outlines), factor, radius))
    if first.kind == "aligned":
        return first
    stretches = STRETCHES
    few = outlines[:: max(1, len(outlines) // (POINTS // 3))]
    cube = scores_of(distance, WIDE_PX, few, middle, stretches, REACH_PX, STEP_PX)
    return _finding(_Scores(shifts[0, 0].astype(np.float64), cube, len(outlines), factor, radius))


def pooled_alignment(findings: Sequence[AlignmentFinding]) -> AlignmentFinding:
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
    return _finding(scores, told, len(findings))


@dataclass(frozen=True, eq=False, slots=True)
class _Scores:
    """How often outlines lie on edges beyond chance."""

    shifts: Array
    cube: Array32 | None
    outlines: int
    px_factor: float
    radius_px: float


def _finding(
    scores: _Scores, votes: Sequence[AlignmentFinding] = (), views: int = 1
) -> AlignmentFinding:
    """Return the finding that the scores of one or more views allow."""
    reach, s = REACH_PX, scores.shifts
    spread = MAD_TO_SIGMA * float(np.median(np.abs(s - np.median(s)))) + 1e-9
    row, column = np.unravel_index(int(np.argmax(s)), s.shape)
    moved = np.array([_peak(s[row], int(column)), _peak(s[:, column], int(row))]) - reach
    confidence = float((s[row, column] - np.median(s)) / spread)
    sure = confidence > CONFIDENCE
    few = len(votes) < LEAST_VOTES
    kind: Kind = "unknown"
    stretch = np.ones(2)
    off = float(np.hypot(moved[0], moved[1]))
    unmoved = float(s[reach - 1 : reach + 2, reach - 1 : reach + 2].max())
    near = [
        v for v in votes
        if np.hypot(*(np.array(v.shift_px) / v.px_factor + moved)) < VOTE_PX
        and v.stretch == (1.0, 1.0)
    ]  # fmt: skip
    sure = sure or len(near) >= max(LEAST_VOTES, VOTE_SHARE * len(votes))
    if sure and off <= ALIGNED_PX:
        kind = "aligned"
    elif sure and off > WRONG_PX and s.max() > GAIN * unmoved:
        kind = "not_aligned"
    elif (
        few and off > WRONG_PX and s.max() > max(FEW_SHARE, FEW_GAIN * unmoved)
        and confidence > FEW_CONFIDENCE
    ):  # fmt: skip
        kind = "not_aligned"
    at: tuple[Any, ...] = (slice(None), slice(None), int(row), int(column))
    if kind != "aligned" and scores.cube is not None:
        best = _best_stretch(scores, few)
        if best is not None:
            kind, stretch, moved, at = "not_aligned", *best
    shift = -moved * scores.px_factor
    agreeing = sum(_agrees(v, at) for v in votes) if votes else 1
    if 2 * agreeing < len(votes):
        kind = "unknown"
    words = _words(kind, shift, stretch, (agreeing, views))
    return AlignmentFinding(
        kind=kind, words=words, shift_px=(float(shift[0]), float(shift[1])),
        stretch=(float(stretch[0]), float(stretch[1])),
        outlines=scores.outlines, agreeing=agreeing, views=views, px_factor=scores.px_factor,
        radius_px=scores.radius_px, shift_scores=s, stretch_scores=scores.cube,
    )  # fmt: skip


def _best_stretch(scores: _Scores, few: bool) -> tuple[Array, Array, tuple[Any, ...]] | None:
    """Return stretch, shift and place of the best stretch, if it is believed."""
    cube = scores.cube
    assert cube is not None
    at = tuple(int(i) for i in np.unravel_index(int(np.argmax(cube)), cube.shape))
    sx, sy, row, column = at
    factors = STRETCHES
    unit = int(np.argmin(np.abs(factors - 1)))
    middle = REACH_PX // STEP_PX
    peak = float(cube[at])
    stretch = np.array([factors[sx], factors[sy]])
    plane = cube[sx, sy]
    shift = STEP_PX * (np.array([_peak(plane[row], column), _peak(plane[:, column], row)]) - middle)
    off = float(np.hypot(*(np.abs(shift) + np.abs(stretch - 1) * scores.radius_px)))
    some = cube[::3, ::3].astype(np.float64)
    usual = float(np.median(some))
    sure = (peak - usual) / (MAD_TO_SIGMA * float(np.median(np.abs(some - usual))) + 1e-9)
    better = peak > GAIN * float(cube[unit, unit, middle, middle])
    better &= peak > STRETCH_GAIN * float(cube[unit, unit].max())
    if off < WRONG_PX or not better:
        return None
    if sure < STRETCH_CONFIDENCE and not (
        few
        and sure > FEW_STRETCH_CONFIDENCE
        and peak > max(FEW_SHARE, FEW_GAIN * float(cube[unit, unit, middle, middle]))
        and peak > _least_gain(stretch) * float(cube[unit, unit].max())
    ):
        return None
    return stretch, shift, at


def _least_gain(stretch: Array) -> float:
    """Return how many times better than a shift a stretch of one or two views must be."""
    aspect = abs(math.log(stretch[1] / stretch[0]))
    is_resized = abs(aspect - math.log(WIDE_ASPECT)) < ASPECT_SLACK
    return FEW_RESIZED_GAIN if is_resized else FEW_STRETCH_GAIN


def _agrees(finding: AlignmentFinding, at: tuple[Any, ...]) -> bool:
    """Return whether the best place of all views is nearly the best of this one, too.

    Args:
        finding: of one view.
        at: stretch along x and y, row and column; the stretches are slices if there is none.
    """
    s, cube = finding.shift_scores, finding.stretch_scores
    if isinstance(at[0], int):
        return cube is not None and float(cube[at]) >= AGREE_SHARE * float(cube.max())
    if s is None:
        return False
    row, column = at[2], at[3]
    near = s[max(0, row - 2) : row + 3, max(0, column - 2) : column + 3]
    return float(near.max()) >= AGREE_SHARE * float(s.max())


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


def _size_words(rgb: UInt8, depth_m: Array32, intrinsics: CameraIntrinsics) -> str:
    """Return in words that the sizes differ."""
    return (
        f"depth is {depth_m.shape[1]}x{depth_m.shape[0]}, colour {rgb.shape[1]}x{rgb.shape[0]} "
        f"and the camera {intrinsics.width}x{intrinsics.height} pixels; all three must be alike. "
        "Use the depth stream aligned to colour, or register it with the depth-to-colour "
        "extrinsics; resizing does not align it."
    )
