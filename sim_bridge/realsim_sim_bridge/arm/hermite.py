"""Joint paths as cubics between followed poses (Hermite): value and slope are exact at the nodes.

With nodes 2 cm apart the hand leaves the straight line by h^4 / 384 times a fourth derivative, less
than a tenth of a millimetre. Because all lines of a kind share their nodes and times, a path at
many times is one matrix product.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def basis(at: Array, nodes: Array) -> tuple[Array, Array]:
    """Return weights (S, W) of the nodes' values and (S, W) of their slopes at distances (S,).

    Args:
        at: where the path is wanted; cut at the first and last node.
        nodes: (W,) increasing.
    """
    left, u, h = _segment(at, nodes)
    values, slopes = np.zeros((len(at), len(nodes))), np.zeros((len(at), len(nodes)))
    row = np.arange(len(at))
    values[row, left] = (1 + 2 * u) * (1 - u) ** 2
    values[row, left + 1] = u**2 * (3 - 2 * u)
    slopes[row, left] = h * u * (1 - u) ** 2
    slopes[row, left + 1] = h * u**2 * (u - 1)
    return values, slopes


def basis_slope(at: Array, nodes: Array) -> tuple[Array, Array]:
    """Return the derivatives of `basis` by the distance."""
    left, u, h = _segment(at, nodes)
    values, slopes = np.zeros((len(at), len(nodes))), np.zeros((len(at), len(nodes)))
    row = np.arange(len(at))
    values[row, left] = 6 * u * (u - 1) / h
    values[row, left + 1] = 6 * u * (1 - u) / h
    slopes[row, left] = (1 - u) * (1 - 3 * u)
    slopes[row, left + 1] = u * (3 * u - 2)
    return values, slopes


def greatest_slopes(values: Array, slopes: Array, nodes: Array) -> tuple[Array, Array]:
    """Return bounds (..., J) of the first and second derivative over the whole path.

    The derivatives of a cubic are inside the hull of their Bezier points.

    Args:
        values: (..., W, J).
        slopes: (..., W, J).
        nodes: (W,) increasing.
    """
    h = np.diff(nodes)[:, None]
    a, b = slopes[..., :-1, :], slopes[..., 1:, :]
    middle = 3 * np.diff(values, axis=-2) / h - a - b
    first = np.maximum(np.maximum(np.abs(a), np.abs(b)), np.abs(middle))
    second = 2 * np.maximum(np.abs(middle - a), np.abs(b - middle)) / h
    return first.max(axis=-2), second.max(axis=-2)


def _segment(at: Array, nodes: Array) -> tuple[NDArray[np.int64], Array, Array]:
    """Return left node, share of the segment from 0 to 1, and segment length."""
    left = np.clip(np.searchsorted(nodes, at, side="right") - 1, 0, len(nodes) - 2)
    h = np.diff(nodes)[left]
    return left, np.clip((at - nodes[left]) / h, 0.0, 1.0), h
