"""The array types that signatures speak of, one name each; the shapes stand in each docstring.

And how a few of many are chosen.
"""

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

T = TypeVar("T")

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
Int32 = NDArray[np.int32]
Int64 = NDArray[np.int64]
UInt8 = NDArray[np.uint8]
UInt16 = NDArray[np.uint16]
Mask = NDArray[np.bool_]

Rows = Int64
Counts = UInt16
Image = UInt8
Rgb = UInt8


def evenly(items: Sequence[T], most: int) -> list[T]:
    """Return at most `most` of the items, evenly spread over their order."""
    places = np.linspace(0, len(items) - 1, min(most, len(items))).round().astype(int)
    return [items[k] for k in places]
