"""The array types that signatures speak of, one name each; the shapes stand in each docstring."""

import numpy as np
from numpy.typing import NDArray

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
