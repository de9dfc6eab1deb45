"""What a camera calibration says of itself: the lens, every view, the models tried, the checks.

Which part of the image and which directions a calibration has seen, and what is missing.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array, Int64
from realsim.errors import InputError
from realsim.records import CameraIntrinsics, Check, Target
from realsim_calibration.lens.covariance import projection_sd
from realsim_calibration.lens.models import TERM_NAMES, ModelScore
from realsim_calibration.results import BoardShape

QUARTERS = ("upper left", "upper right", "lower left", "lower right")


COLUMNS = 8
"""Cells across the image: small enough that an empty one matters to the lens."""
ROWS = 6
"""Cells down the image."""
GOOD_SHARE = 0.8
"""Share of cells with corners from which on nothing is asked for."""
THIN_QUARTER = 0.5
"""A quarter of the image with a smaller share of its cells seen is named."""
GOOD_REACH = 0.9
"""Distance of the outermost corners from the image's middle, relative to half the diagonal."""
GOOD_TILT_DEG = 20.0
"""Tilts that the board should reach: without them focal length and distance trade places."""
REACH_QUANTILE = 0.99
"""Corner whose distance counts as the reach: a single stray corner says little."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Coverage:
    """Where corners were, and how the board stood."""

    counts: Int64
    """(rows, columns) corners in every cell of the image."""
    share: float
    """Share of cells with corners."""
    reach: float
    """Distance of the outermost corners from the image's middle, relative to half the diagonal."""
    tilt_deg: Array
    """(views,) angle between the board's normal and the optical axis [deg]."""
    distance_m: Array
    """(views,) distance of the board's middle along the optical axis [m]."""
    normal_spread_deg: float
    """Largest angle between the board's normals of any two views [deg]."""
    advice: str
    """What to add; empty where nothing is missing."""


def measure_coverage(uv: Array, image_size: tuple[int, int], poses: Array) -> Coverage:
    """Return the coverage of corners (N, 2) [px] by boards at poses (views, 4, 4) [m].

    Raises:
        InputError: there is no corner or no view.
    """
    uv = np.asarray(uv, dtype=np.float64).reshape(-1, 2)
    if len(uv) == 0 or len(poses) == 0:
        raise InputError("coverage: there are no corners; give the views that were detected.")
    width, height = image_size
    cells = np.floor((uv + 0.5) / [width / COLUMNS, height / ROWS]).astype(np.int64)
    cells = np.clip(cells, 0, [COLUMNS - 1, ROWS - 1])
    counts = np.zeros((ROWS, COLUMNS), dtype=np.int64)
    np.add.at(counts, (cells[:, 1], cells[:, 0]), 1)
    middle = (np.array([width, height]) - 1) / 2
    radius = np.linalg.norm(uv - middle, axis=-1) / np.hypot(width / 2, height / 2)
    normal = poses[:, :3, 2] * np.where(poses[:, 2:3, 2] > 0, -1.0, 1.0)
    tilt = np.degrees(np.arccos(np.clip(-normal[:, 2], -1, 1)))
    share = float(np.mean(counts > 0))
    reach = float(np.quantile(radius, REACH_QUANTILE))
    spread = float(np.degrees(np.arccos(np.clip(np.min(normal @ normal.T), -1, 1))))
    return Coverage(
        counts=counts,
        share=share,
        reach=reach,
        tilt_deg=tilt,
        distance_m=poses[:, 2, 3].copy(),
        normal_spread_deg=spread,
        advice=_advice(counts, share, reach, tilt, spread),
    )


def _advice(counts: Int64, share: float, reach: float, tilt: Array, spread: float) -> str:
    parts: list[str] = []
    seen = counts > 0
    r, c = ROWS // 2, COLUMNS // 2
    quarters = (seen[:r, :c], seen[:r, c:], seen[r:, :c], seen[r:, c:])
    shares = [float(q.mean()) for q in quarters]
    empty = [name for name, s in zip(QUARTERS, shares, strict=True) if s == 0]
    thin = [n for n, s in zip(QUARTERS, shares, strict=True) if 0 < s < THIN_QUARTER]
    if empty:
        parts.append(f"There are no corners in the {_list(empty)} quarter of the image.")
    if thin:
        parts.append(f"There are few corners in the {_list(thin)} quarter of the image.")
    if not empty and not thin and share < GOOD_SHARE:
        parts.append(f"Only {share:.0%} of the image has corners.")
    if reach < GOOD_REACH:
        parts.append(
            f"Corners reach {reach:.0%} of the way to the image's corners: add views with the "
            "board in the corners, where the distortion is largest."
        )
    if float(tilt.max()) < GOOD_TILT_DEG:
        parts.append(
            f"The board is tilted by {float(tilt.max()):.0f} deg at most: tilt it by 30 deg about "
            "two axes."
        )
    elif spread < GOOD_TILT_DEG:
        parts.append("All views see the board under the same angle: tilt it to other sides too.")
    return " ".join(parts)


def _list(names: list[str]) -> str:
    return names[0] if len(names) == 1 else ", ".join(names[:-1]) + " and " + names[-1]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class LensView:
    """One view's part in a camera calibration."""

    index: int
    """Its place in the list that was given."""
    name: str
    """File name, or the index."""
    used: bool
    reason: str
    """Why it was not used; empty where it was."""
    uv: Array
    """(n, 2) corners used [px]."""
    residuals: Array
    """(n, 2) predicted minus seen [px]; (0, 2) where not used."""
    rms_px: float
    """RMS of the 2-D residuals [px]; NaN where not used."""
    T_cam_board: Array
    """(4, 4) the board in the camera [m]; NaN where not used."""
    outliers: tuple[tuple[int, float], ...] = ()
    """(point of the target, its distance [px]) of corners that were left out."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class IntrinsicsReport:
    """A camera calibration with its diagnosis."""

    target: Target
    intrinsics: CameraIntrinsics
    covariance: Array
    """(12, 12) of fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6; zero rows = held."""
    open_covariance: Array
    """(12, 12) the same with the refused terms left open under their prior: what the lens may do
    where there were no corners. The same as `covariance` where nothing was refused."""
    inflation: float
    """Scatter of the views relative to what independent corners would give, a variance; well above
    1 where corners of a view err together."""
    model: str
    """Lens model chosen."""
    terms: tuple[str, ...]
    """Distortion terms estimated."""
    held_out: tuple[ModelScore, ...]
    """Every model tried, smallest first."""
    refused: tuple[tuple[str, str], ...]
    """(term, reason) of terms that the model has but the views do not determine."""
    sigma_px: float
    """Unit-weight 1-sigma of a corner's coordinate [px]."""
    rms_px: float
    """RMS of the 2-D residuals over all corners used [px]: in-sample."""
    views: tuple[LensView, ...]
    """Every view that was given, in its order."""
    coverage: Coverage
    board: BoardShape
    """How the print differs from its drawing; the scale cannot be seen by a camera alone."""
    start: str
    """Where the focal length of the first fit came from."""
    checks: tuple[Check, ...]

    @property
    def sd(self) -> Array:
        """(12,) 1-sigma of the terms (0 = held)."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    @property
    def held_out_px(self) -> float:
        """RMS 2-D error on unseen views of the chosen model [px]; NaN where it was not measured."""
        return next((s.held_out_px for s in self.held_out if s.model == self.model), float("nan"))

    @property
    def used(self) -> tuple[LensView, ...]:
        """The views that took part."""
        return tuple(v for v in self.views if v.used)

    @property
    def warnings(self) -> tuple[str, ...]:
        """The sentence of every check that is not good."""
        return tuple(c.words for c in self.checks if c.verdict in ("warn", "bad"))

    def projection_sd_px(self, uv: ArrayLike) -> Array:
        """Return how well the lens is known at pixels (N, 2): 1-sigma of a coordinate (N,) [px].

        The rotation of the camera that fits best is taken out: a pose found with this lens absorbs
        it. NaN where the lens model reaches no ray.
        """
        return projection_sd(self.intrinsics, self.open_covariance, uv)

    def table(self) -> tuple[tuple[str, float, float], ...]:
        """Return (term, value, 1-sigma) of the twelve terms."""
        i = self.intrinsics
        values = [i.fx, i.fy, i.cx, i.cy, *i.distortion.tolist()]
        return tuple(
            (name, float(value), float(sd))
            for name, value, sd in zip(TERM_NAMES, values, self.sd, strict=True)
        )
