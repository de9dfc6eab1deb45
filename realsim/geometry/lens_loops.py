"""The lens in compiled loops; `camera` is (12,) fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6, or longer."""

from realsim.arrays import Array
from realsim.compiled import njit
from realsim.geometry import lens

_bent = njit(lens.bent)
_bent_slopes = njit(lens.bent_slopes)


@njit
def bent(camera: Array, x: float, y: float) -> tuple[float, float]:
    """Return the distorted normalised coordinates of ideal ones, as `lens.bent` does."""
    c = camera
    return _bent(x, y, (c[4], c[5], c[6], c[7], c[8], c[9], c[10], c[11]))


@njit
def bent_slopes(camera: Array, x: float, y: float) -> tuple[float, float, float, float, float]:
    """Return the derivatives of `bent`, its radial factor and denominator: `lens.bent_slopes`."""
    c = camera
    return _bent_slopes(x, y, (c[4], c[5], c[6], c[7], c[8], c[9], c[10], c[11]))


@njit
def pixel(camera: Array, x: float, y: float) -> tuple[float, float]:
    """Return the pixel u, v of ideal normalised coordinates x/z, y/z."""
    c = camera
    a, b = _bent(x, y, (c[4], c[5], c[6], c[7], c[8], c[9], c[10], c[11]))
    return c[0] * a + c[2], c[1] * b + c[3]
