"""What a camera calibration says of itself: the lens, every view, the models tried, the checks."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array
from realsim.records import CameraIntrinsics, Check, Target
from realsim_calibration.lens.choice import ModelScore
from realsim_calibration.lens.covariance import projection_sd
from realsim_calibration.lens.coverage import Coverage
from realsim_calibration.lens.models import TERM_NAMES
from realsim_calibration.results import BoardShape


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
