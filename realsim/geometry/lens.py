"""OpenCV's lens in normalised coordinates: Brown (k1 k2 p1 p2 k3) or rational (k1..k6).

The formulas are plain arithmetic: they take numpy arrays here and in `camera`, and numbers in
compiled loops, which call `point_loops`. Nowhere else does the polynomial stand.
"""

from typing import Any


def bent(x: Any, y: Any, terms: Any) -> tuple[Any, Any]:
    """Return where the lens images the ideal point x/z, y/z: both normalised coordinates.

    `terms` are the eight k1 k2 p1 p2 k3 k4 k5 k6.
    """
    k1, k2, p1, p2, k3, k4, k5, k6 = terms
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )


def bent_slopes(x: Any, y: Any, terms: Any) -> tuple[Any, Any, Any, Any, Any]:
    """Return d bent_x / dx, d bent_x / dy = d bent_y / dx, d bent_y / dy, and the radial factor.

    The last number is the denominator of that factor. Arguments as of `bent`.
    """
    k1, k2, p1, p2, k3, k4, k5, k6 = terms
    r2 = x * x + y * y
    denominator = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / denominator
    # d radial / d r2
    slope = (
        (k1 + r2 * (2 * k2 + 3 * r2 * k3)) - radial * (k4 + r2 * (2 * k5 + 3 * r2 * k6))
    ) / denominator
    return (
        radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x,
        2 * x * y * slope + 2 * p1 * x + 2 * p2 * y,
        radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x,
        radial,
        denominator,
    )
