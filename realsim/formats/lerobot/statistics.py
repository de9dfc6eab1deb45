"""Statistics of columns and pictures as LeRobot keeps them: min, max, mean, sd and count.

Those of a data set are put together from those of its episodes: extremes of extremes, and mean and
variance weighted by the counts (Chan, Golub & LeVeque 1979).
"""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Stats = dict[str, dict[str, Any]]
"""Feature -> 'min', 'max', 'mean', 'std', 'count' -> nested lists of numbers."""


def column_stats(columns: Mapping[str, NDArray[Any]]) -> Stats:
    """Return the statistics of columns (S,) or (S, n)."""
    out: Stats = {}
    for key, column in columns.items():
        values = np.asarray(column, dtype=np.float64).reshape(len(column), -1)
        out[key] = {
            "min": values.min(axis=0).tolist(),
            "max": values.max(axis=0).tolist(),
            "mean": values.mean(axis=0).tolist(),
            "std": values.std(axis=0).tolist(),
            "count": [len(values)],
        }
    return out


class PictureStats:
    """Statistics of the pictures of one camera, each channel from 0 to 1."""

    def __init__(self) -> None:
        """Begin with none."""
        self._count = self._pixels = 0
        self._low, self._high = np.full(3, 255.0), np.zeros(3)
        self._sum, self._squares = np.zeros(3), np.zeros(3)

    def add(self, rgb: NDArray[np.uint8]) -> None:
        """Add a picture (H, W, 3)."""
        flat = rgb.reshape(-1, 3)
        levels = np.arange(256.0)
        for c in range(3):
            histogram = np.bincount(flat[:, c], minlength=256)
            there = np.flatnonzero(histogram)
            self._low[c] = min(self._low[c], there[0])
            self._high[c] = max(self._high[c], there[-1])
            self._sum[c] += histogram @ levels
            self._squares[c] += histogram @ levels**2
        self._count += 1
        self._pixels += len(flat)

    def result(self) -> dict[str, Any]:
        """Return the statistics, (3, 1, 1) each; count is that of the pictures."""
        mean = self._sum / self._pixels
        sd = np.sqrt(np.maximum(self._squares / self._pixels - mean**2, 0.0))
        values = {"min": self._low, "max": self._high, "mean": mean, "std": sd}
        return {
            **{name: (v / 255.0).reshape(3, 1, 1).tolist() for name, v in values.items()},
            "count": [self._count],
        }


def together(parts: Iterable[Stats]) -> Stats:
    """Return the statistics of all episodes, one after the other: none is kept."""
    total: dict[str, dict[str, Array]] = {}
    for stats in parts:
        for key, given in stats.items():
            new = {name: np.asarray(value, dtype=np.float64) for name, value in given.items()}
            total[key] = _merged(total[key], new) if key in total else new
    return {
        key: {
            name: [int(value[0])] if name == "count" else value.tolist()
            for name, value in stats.items()
        }
        for key, stats in total.items()
    }


def _merged(a: dict[str, Array], b: dict[str, Array]) -> dict[str, Array]:
    n_a, n_b = float(a["count"][0]), float(b["count"][0])
    n = n_a + n_b
    apart = b["mean"] - a["mean"]
    variance = (n_a * a["std"] ** 2 + n_b * b["std"] ** 2) / n + apart**2 * n_a * n_b / n**2
    return {
        "min": np.minimum(a["min"], b["min"]),
        "max": np.maximum(a["max"], b["max"]),
        "mean": a["mean"] + apart * n_b / n,
        "std": np.sqrt(variance),
        "count": np.array([n]),
    }
