"""By how much a stereo depth camera is wrong, smoothly and everywhere, and how sure that is.

A stereo camera measures a disparity d and reports z = f B / d. A wrong focal length or baseline
scales 1/z, a rectification that is off shifts it:

    1 / z_true = scale / z_measured + offset
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.records.checked_arrays import frozen
from realsim.untrusted.own_json import Real

LARGEST_SCALE_ERROR = 0.5
"""A camera that is wrong by half has another fault (its unit, its resolution) than a bias."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class DepthBias:
    """1 / z_true = scale / z_measured + offset_per_m, with its covariance."""

    scale: float = 1.0
    """(f B) that the camera assumes over the true one."""
    offset_per_m: float = 0.0
    """Offset of the inverse depth [1/m]; a disparity that is too large makes it negative."""
    covariance: Array = field(default_factory=lambda: np.zeros((2, 2)))
    """(2, 2) of (scale, offset_per_m); zero = taken for exact."""
    noise_per_m: Real = float("nan")
    """k of one pixel's noise sigma_z = k z^2 [1/m]; NaN = not measured."""
    range_m: tuple[Real, Real] = (0.0, float("inf"))
    """Distances at which it was measured [m]; beyond them it is extrapolated."""
    separable: bool = True
    """Whether scale and offset were told apart; if not, only their sum at the middle distance is
    known, and the covariance is long in one direction."""

    def __post_init__(self) -> None:
        """Check the ranges and freeze the covariance."""
        if not abs(self.scale - 1.0) <= LARGEST_SCALE_ERROR:
            raise InputError(
                f"the depth scale is {self.scale}; between {1 - LARGEST_SCALE_ERROR:g} and "
                f"{1 + LARGEST_SCALE_ERROR:g} is accepted. A larger one is a wrong depth unit."
            )
        if not np.isfinite(self.offset_per_m):
            raise InputError(f"the inverse depth offset is {self.offset_per_m}; it must be finite.")
        if not 0.0 <= self.range_m[0] < self.range_m[1]:
            raise InputError(f"the range of distances {self.range_m} m is empty.")
        C = frozen(self.covariance, np.float64, (2, 2), "covariance of the depth bias")
        if not np.all(np.isfinite(C)) or np.linalg.eigvalsh(C)[0] < -1e-12:
            raise InputError(f"the depth bias' covariance {C.tolist()} has a negative variance.")
        object.__setattr__(self, "covariance", C)

    @classmethod
    def none(cls) -> "DepthBias":
        """Return the bias of a camera whose depth is taken as it is."""
        return cls()

    @classmethod
    def unmeasured(cls, scale_sd: float = 0.005, offset_sd_per_m: float = 0.0086) -> "DepthBias":
        """Return what is known of a camera that was not measured: no bias, with these 1-sigmas.

        The defaults are 0.5 % and 0.1 px of disparity of a RealSense D405 (f = 648 px, 18 mm).
        """
        return cls(covariance=np.diag([scale_sd**2, offset_sd_per_m**2]), separable=False)

    @property
    def is_none(self) -> bool:
        """Whether depth is taken as it is; what is known of the bias may still be uncertain."""
        return self.scale == 1.0 and self.offset_per_m == 0.0

    def corrected(self, depth_m: ArrayLike) -> NDArray[np.floating]:
        """Return the true depth of measured depth, any shape [m]; 0 and NaN stay what they are.

        float32 stays float32. Where the correction has no positive depth, 0 is returned.
        """
        z = np.asarray(depth_m)
        z = z if z.dtype == np.float32 else z.astype(np.float64)
        bottom = self.scale + self.offset_per_m * z
        # Written so that NaN, which is no measurement, stays NaN.
        fine = ~(bottom <= 0)
        return np.where(fine, z / np.where(fine, bottom, 1), 0).astype(z.dtype)

    def measured(self, depth_m: ArrayLike) -> Array:
        """Return what the camera reports for true depth, any shape [m]; inverse of `corrected`."""
        z = np.asarray(depth_m, dtype=np.float64)
        bottom = 1.0 - self.offset_per_m * z
        fine = ~(bottom <= 0)
        return np.where(fine, self.scale * z / np.where(fine, bottom, 1.0), 0.0)

    def bias_m(self, depth_m: ArrayLike) -> Array:
        """Return measured minus true depth at measured depths, any shape [m]."""
        z = np.asarray(depth_m, dtype=np.float64)
        return z - self.corrected(z)

    def sigma_m(self, depth_m: ArrayLike) -> Array:
        """Return the 1-sigma of corrected depth that comes from this bias, at measured depths [m].

        It is common to all pixels: it does not average out. d z_true = -z_true^2 (da / z + db).
        """
        z = np.asarray(depth_m, dtype=np.float64)
        known = z > 0
        inverse = 1.0 / np.where(known, z, 1.0)
        C = self.covariance
        variance = C[0, 0] * inverse**2 + 2 * C[0, 1] * inverse + C[1, 1]
        true = self.corrected(z)
        return np.where(known, true**2 * np.sqrt(np.maximum(variance, 0.0)), 0.0)

    def disparity_px(self, focal_px: float, baseline_m: float) -> float:
        """Return by how much the measured disparity is too large, the scale set aside [px]."""
        return -self.offset_per_m / self.scale * focal_px * baseline_m
