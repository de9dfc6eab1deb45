"""What one count of a depth image means, and whether that can be."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.errors import UnitError

MILLIMETRE = 1e-3
FINE_UNIT_M = 1e-4
"""Float metres are stored in tenths of a millimetre as far as 16 bit reach (6.5 m)."""
COUNT_MAX = 65535
HEADROOM = 1.3
"""Frames that were not looked at may be this much deeper."""
NEAREST_M, FARTHEST_M = 0.05, 20.0
"""A depth camera's median depth lies between these, or the unit is wrong."""


def unit_of(
    images: Sequence[NDArray[Any]],
    topic: str,
    encoding: str,
    given: float | None,
    recorded: float | None,
) -> tuple[float, str]:
    """Return metres per count to store depth in, and a note on where it comes from.

    Args:
        images: some depth images of the recording, uint16 counts or float32 metres.
        topic: what messages call it.
        encoding: of the messages.
        given: unit that a person gave [m].
        recorded: unit that the recording says [m].

    Raises:
        UnitError: 16-bit depth of an unknown unit, or one with which the depth cannot be right.
    """
    values = np.concatenate([i[np.isfinite(i) & (i > 0)].ravel() for i in images] or [np.zeros(0)])
    median = float(np.median(values)) if len(values) else 0.0
    if images and images[0].dtype != np.uint16:
        _check_median(median, topic, "metres (32FC1)")
        if given is not None:
            return given, f"{topic}: float metres were stored in counts of {given:g} m."
        deepest = float(values.max()) if len(values) else 0.0
        unit = FINE_UNIT_M if deepest * HEADROOM < FINE_UNIT_M * COUNT_MAX else MILLIMETRE
        reach = unit * COUNT_MAX
        return unit, (
            f"{topic}: float metres were stored in counts of {unit:g} m; beyond {reach:.1f} m "
            "counts as no measurement."
        )
    unit = given or recorded
    if unit is not None:
        source = "given" if given else "recorded with the depth"
        if given and recorded and abs(given / recorded - 1) > 1e-3:
            source = f"given, against {recorded:g} m in the recording"
        _check_median(median * unit, topic, f"counts of {unit:g} m ({source})")
        return unit, f"{topic}: one count is {unit:g} m ({source}); median {median * unit:.3f} m."
    if encoding != "16UC1":
        raise UnitError(
            f"{topic}: depth of 16 bit as '{encoding}' has no unit (only for 16UC1 ROS says "
            f"millimetres). Its median is {median:.0f} counts: {median * 1e-3:.3f} m in "
            f"millimetres, {median * 1e-4:.3f} m in tenths. Give depth_unit_m=0.001 or 0.0001."
        )
    _check_median(median * MILLIMETRE, topic, "millimetres (ROS's rule for 16UC1)")
    return MILLIMETRE, (
        f"{topic}: 16UC1 was taken as millimetres (ROS REP 118), which makes the median depth "
        f"{median * MILLIMETRE:.3f} m; give depth_unit_m= if that is wrong."
    )


def _check_median(median_m: float, topic: str, assumed: str) -> None:
    """Refuse a unit that puts the scene where no depth camera sees; no depth at all passes."""
    if median_m and not NEAREST_M <= median_m <= FARTHEST_M:
        raise UnitError(
            f"{topic}: read as {assumed}, the median depth is {median_m:.4g} m; between "
            f"{NEAREST_M} and {FARTHEST_M} m is plausible. Give the unit: depth_unit_m=0.001 "
            "(millimetres), 0.0001 (a D405's own), or what the camera was set to."
        )


def counts_of(depth: NDArray[Any], unit_m: float) -> NDArray[np.uint16]:
    """Return depth as counts of a unit; float metres that do not fit become 0 = none."""
    if depth.dtype == np.uint16:
        return depth
    counts = np.rint(depth / np.float32(unit_m))
    with np.errstate(invalid="ignore"):
        fits = (counts > 0) & (counts <= COUNT_MAX)
    return np.where(fits, counts, 0).astype(np.uint16)
