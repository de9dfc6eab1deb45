"""Rigid motions and the lens in compiled loops, point by point.

`T` is a rigid motion (4, 4), of which `turn` and `turn_back` take the rotation alone; `camera`
is (12,) fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6, or longer.
"""

from realsim.arrays import Array, Array32
from realsim.compiled import njit
from realsim.geometry import lens

_bent = njit(lens.bent)
_bent_slopes = njit(lens.bent_slopes)


@njit(inline="always")
def move(T: Array | Array32, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return the point that T moves a point to."""
    return (
        T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3],
        T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3],
        T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3],
    )


@njit(inline="always")
def turn(T: Array | Array32, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return the vector that T turns a vector to."""
    return (
        T[0, 0] * x + T[0, 1] * y + T[0, 2] * z,
        T[1, 0] * x + T[1, 1] * y + T[1, 2] * z,
        T[2, 0] * x + T[2, 1] * y + T[2, 2] * z,
    )


@njit(inline="always")
def turn_back(T: Array | Array32, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return the vector that T turns to this one."""
    return (
        T[0, 0] * x + T[1, 0] * y + T[2, 0] * z,
        T[0, 1] * x + T[1, 1] * y + T[2, 1] * z,
        T[0, 2] * x + T[1, 2] * y + T[2, 2] * z,
    )


@njit(inline="always")
def move_back(T: Array | Array32, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return the point that T moves to this one."""
    return turn_back(T, x - T[0, 3], y - T[1, 3], z - T[2, 3])


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
